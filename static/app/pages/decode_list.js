// All readings in the order of their times: how sure each is, why others were refused, and the marker that it is of.

import { html } from "htm/preact";

import { FamilyName, Verdict } from "../components/badges.js";
import { Empty } from "../components/load.js";
import { Table } from "../components/table.js";
import { MISSING, number, text } from "../format.js";
import { query, setQuery } from "../router.js";
import { t, textOr } from "../texts/index.js";

const LEVELS = /** @type {Record<string, "good" | "warn" | "bad" | "none">} */ ({
  read: "good", legal: "good", received: "good", unchecked: "warn", unsure: "warn", unknown: "warn", "not-in-registry": "warn",
});

/** How a plate is shown: digits that nothing confirms are unchecked. @param {any} reading @returns {string} */
export const outcomeOf = (reading) => (reading.certainty === "unchecked" ? "unchecked" : reading.outcome);

/** @param {string} outcome */
export const levelOf = (outcome) => LEVELS[outcome] ?? "bad";

/**
 * @param {{ timeline: import("./decode_timeline.js").Timeline, chosen: string | null, onChoose: (reading: any) => void }} props
 */
export function ReadingList({ timeline, chosen, onChoose }) {
  const shown = query.value.get("show") ?? "all";
  const all = timeline.sources.flatMap(({ readings, shift }) => readings.map((/** @type {any} */ reading) => ({ ...reading, time: reading.at + shift })));
  all.sort((a, b) => (Number.isFinite(a.time) ? a.time : Infinity) - (Number.isFinite(b.time) ? b.time : Infinity));
  const rows = all.filter((row) => shown === "all" || (levelOf(row.outcome) === "good") === (shown === "read"));
  if (!all.length) return html`<${Empty} title=${t("decode.no_readings")}><p class="hint">${t("decode.no_readings_cure")}</p></${Empty}>`;
  const count = (/** @type {boolean} */ good) => all.filter((row) => (levelOf(row.outcome) === "good") === good).length;
  const counts = /** @type {Record<string, number>} */ ({ all: all.length, read: count(true), refused: count(false) });
  return html`
    <div class="segments" role="group" aria-label=${t("decode.show")}>
      ${/** @type {const} */ (["all", "read", "refused"]).map((name) => html`
        <button type="button" class="quiet" aria-pressed=${shown === name} onClick=${() => setQuery({ show: name === "all" ? null : name })}>${t(`decode.show_${name}`)} (${number(counts[name])})</button>`)}
    </div>
    <div class="readings"><${Table} label=${t("decode.readings")} rows=${rows} columns=${columnsOf(timeline, onChoose)} idOf=${(/** @type {any} */ row) => row.key} chosen=${chosen}
      footer=${t("decode.count_readings", { count: rows.length })} /></div>
  `;
}

/** @param {import("./decode_timeline.js").Timeline} timeline @param {(reading: any) => void} onChoose @returns {import("../components/table.js").Column<any>[]} */
function columnsOf(timeline, onChoose) {
  return [
    {
      name: "code", title: t("field.code"), head: true, order: (row) => row.code,
      cell: (row) => html`<button type="button" class="link code" onClick=${() => onChoose(row)}>${row.code ?? MISSING}</button>`,
    },
    { name: "time", title: t("decode.time"), order: (row) => (Number.isFinite(row.time) ? row.time : null), cell: (row) => (Number.isFinite(row.time) ? timeline.text(row.time) : row.frame !== null ? t("decode.frame_number", { number: row.frame }) : MISSING) },
    { name: "family", title: t("field.family"), order: (row) => row.family, cell: (row) => html`<${FamilyName} family=${row.family} />` },
    { name: "outcome", title: t("decode.outcome"), order: (row) => row.outcome, cell: (row) => html`<${Verdict} level=${levelOf(row.outcome)}>${textOr(`outcome.${row.outcome}`, textOr(`observation.${row.outcome}`, row.outcome))}</${Verdict}>` },
    { name: "confidence", title: t("decode.confidence"), number: true, order: (row) => row.confidence, cell: (row) => (row.confidence === null ? MISSING : html`<span class="sure"><meter min="0" max="1" low="0.9" high="0.99" optimum="1" value=${row.confidence} aria-hidden="true"></meter> ${number(100 * row.confidence, 2, "%")}</span>`) },
    { name: "marker", title: t("decode.marker"), order: (row) => row.marker_id, cell: (row) => (row.marker_id ? html`<a href=${`/markers/${row.marker_id}`}>${row.distance_m === null ? t("list.marker") : t("decode.match_marker", { distance: number(row.distance_m, 1, "m") })}</a>` : html`<span class="hint">${t("decode.not_registered")}</span>`) },
    { name: "reason", title: t("field.reason"), order: (row) => row.reason, cell: (row) => html`<span class="reason" title=${row.reason ?? ""}>${text(row.reason)}</span>` },
  ];
}
