// What a plan has, in tables: checks, markers, places left out. Pointing at a row marks its place on the road.

import { html } from "htm/preact";

import { Verdict } from "../components/badges.js";
import { Empty } from "../components/load.js";
import { stationText } from "../components/strip_scale.js";
import { Table } from "../components/table.js";
import { MISSING, number, text } from "../format.js";
import { path, withQuery } from "../router.js";
import { t, textOr } from "../texts/index.js";
import { figureText, LEVELS } from "./plans_preview.js";
import { checkName, placeText } from "./plans_view.js";

/** @typedef {import("./plans_view.js").Plan} Plan @typedef {import("./plans_view.js").Marker} Marker */

/** A limit of a check as people read it. @param {any} finding */
export const limitText = (finding) => `${finding.relation === ">=" ? "≥" : finding.relation === "<=" ? "≤" : finding.relation} ${figureText({ ...finding, figure: finding.limit })}`;

/**
 * @param {{ plan: { findings: any[] }, pointed?: string | null, onPoint?: (id: string | null) => void }} props
 */
export function ChecksTable({ plan, pointed = null, onPoint }) {
  return html`
    <div class="table-frame"><div class="table-scroll checks-table" tabindex="0" role="region" aria-label=${t("plan.checks")}>
      <table>
        <thead><tr><th scope="col">${t("checks.check")}</th><th scope="col">${t("checks.verdict")}</th><th scope="col" class="number">${t("checks.figure")}</th><th scope="col" class="number">${t("checks.limit")}</th><th scope="col">${t("checks.place")}</th><th scope="col">${t("checks.sentence")}</th></tr></thead>
        <tbody>${plan.findings.map((finding, k) => html`
          <tr class=${pointed === `c${k}` ? "pointed" : undefined} onPointerEnter=${() => onPoint?.(`c${k}`)} onPointerLeave=${() => onPoint?.(null)}>
            <th scope="row">${finding.lane && onPoint ? html`<a href=${withQuery(path.value, { tab: "checks", item: `c${k}` })}>${checkName(finding.name)}</a>` : checkName(finding.name)}</th>
            <td><${Verdict} level=${LEVELS[finding.verdict] ?? "none"}>${textOr(`verdict.${finding.verdict}`, finding.verdict)}</${Verdict}></td>
            <td class="number">${figureText(finding)}</td><td class="number">${limitText(finding)}</td><td>${placeText(finding)}</td>
            <td class="sentence">${finding.sentence}<br /><span class="hint small">${finding.source}</span></td>
          </tr>`)}</tbody>
      </table>
    </div></div>
  `;
}

/**
 * @param {{ markers: Marker[], proof?: Plan["proof"], chosen?: string | null, pointed?: string | null, onPoint?: (id: string | null) => void }} props
 */
export function MarkersTable({ markers, proof = null, chosen = null, pointed = null, onPoint }) {
  if (!markers.length) return html`<${Empty} title=${t("plan.no_markers_text")} />`;
  const weak = new Map((proof?.weak_markers ?? []).map((marker) => [marker.number, marker]));
  /** @type {import("../components/table.js").Column<Marker>[]} */
  const columns = [
    { name: "number", title: t("field.number"), head: true, order: (row) => row.number, cell: (row) => html`<a href=${withQuery(path.value, { tab: "markers", item: `m${row.number}` })}>${number(row.number)}</a>` },
    { name: "family", title: t("field.family"), order: (row) => row.family, cell: (row) => textOr(`family.${row.family}`, row.family) },
    { name: "code", title: t("field.code"), order: (row) => row.code, cell: (row) => html`<span class="code">${text(row.code)}</span>` },
    { name: "purpose", title: t("field.purpose"), order: (row) => row.purpose, cell: (row) => textOr(`purpose.${row.purpose}`, text(row.purpose)) },
    { name: "lane", title: t("field.lane"), order: (row) => row.lane, cell: (row) => row.lane },
    { name: "station", title: t("field.station"), number: true, order: (row) => row.station, cell: (row) => text(row.station) },
    { name: "chainage", title: t("field.chainage_m"), number: true, order: (row) => row.chainage_m, cell: (row) => number(row.chainage_m, 2) },
    { name: "offset", title: t("field.offset_m"), number: true, order: (row) => row.offset_m, cell: (row) => number(row.offset_m, 2) },
    { name: "details", title: t("field.details"), order: (row) => row.details, cell: (row) => text(row.details) },
    { name: "lon", title: t("field.lon_deg"), number: true, hidden: true, order: (row) => row.lon_deg, cell: (row) => row.lon_deg.toFixed(7) },
    { name: "lat", title: t("field.lat_deg"), number: true, hidden: true, order: (row) => row.lat_deg, cell: (row) => row.lat_deg.toFixed(7) },
    ...(proof ? [{ name: "proved", title: t("plan.proof"), order: (/** @type {Marker} */ row) => (weak.has(row.number) ? 0 : 1), cell: (/** @type {Marker} */ row) => (weak.has(row.number) ? html`<${Verdict} level="warn">${t("plan.weak_one")}</${Verdict}>` : MISSING) }] : []),
  ];
  return html`<${Table} label=${t("markers.title")} rows=${markers} columns=${columns} idOf=${(/** @type {Marker} */ row) => `m${row.number}`} chosen=${chosen} pointed=${pointed}
    onPoint=${onPoint && ((/** @type {Marker | null} */ row) => onPoint(row ? `m${row.number}` : null))} footer=${t("list.count", { count: number(markers.length) })} />`;
}

/** @param {{ plan: Plan }} props */
export function LeftOutTable({ plan }) {
  if (!plan.left_out.length) return html`<${Empty} title=${t("plan.nothing_left_out")} />`;
  return html`
    <div class="table-frame"><div class="table-scroll" tabindex="0" role="region" aria-label=${t("plan.left_out")}>
      <table>
        <thead><tr><th scope="col">${t("field.lane")}</th><th scope="col" class="number">${t("field.station")}</th><th scope="col">${t("field.family")}</th><th scope="col">${t("left_out.what")}</th><th scope="col">${t("field.reason")}</th></tr></thead>
        <tbody>${plan.left_out.map((row) => html`
          <tr><th scope="row">${row.lane}</th><td class="number">${row.station_m == null ? number(row.chainage_m, 2) : stationText(row.station_m)}</td><td>${textOr(`family.${row.family}`, row.family)}</td>
            <td><${Verdict} level=${row.moved_m === null ? "bad" : "warn"}>${row.moved_m === null ? t("left_out.left_out") : t("left_out.moved", { distance: number(row.moved_m, 2, "m") })}</${Verdict}></td><td class="sentence">${row.reason}</td></tr>`)}</tbody>
      </table>
    </div>
    ${plan.left_out_count > plan.left_out.length && html`<div class="table-foot"><span>${t("left_out.more", { shown: plan.left_out.length, count: plan.left_out_count })}</span></div>`}</div>
  `;
}
