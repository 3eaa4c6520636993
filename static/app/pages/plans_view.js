// The road of a plan with its markers and checks: on the map and on a strip along one lane. What is pointed at in one is
// marked in the other, and in the tables of the page.

import { html } from "htm/preact";
import { useMemo, useState } from "preact/hooks";

import { api, ok } from "../api/client.js";
import { RoadMap } from "../components/road_map.js";
import { Strip } from "../components/strip.js";
import { chainageNear, stationText, valueAt } from "../components/strip_scale.js";
import { number } from "../format.js";
import { query, setQuery } from "../router.js";
import { t, textOr } from "../texts/index.js";

/**
 * @typedef {import("../api/schema.js").components["schemas"]["AlignmentProfile"]} Profile
 * @typedef {import("../api/schema.js").components["schemas"]["PlanDocument"]} Plan
 * @typedef {import("../api/schema.js").components["schemas"]["PlanFinding"]} Finding
 * @typedef {import("../components/strip.js").Pointed} Pointed
 * @typedef {{ number: number, family: string, purpose?: string, code?: string, lane: string, chainage_m: number, offset_m: number, station?: string, lon_deg: number, lat_deg: number, status?: string, details?: string }} Marker
 * @typedef {{ id: string, lane: string, at_m: number, row: string, kind: "marker" | "check" | "event" | "weak", label: string, family?: string, status?: string, sign?: string, level?: string, lon_deg: number, lat_deg: number }} Thing
 */

/** @type {Map<string, Promise<Profile>>} Alignments never change. */
const profiles = new Map();

/** @param {string} id @returns {Promise<Profile>} */
export function loadProfile(id) {
  let found = profiles.get(id);
  if (!found) {
    found = ok(api.GET("/v1/alignments/{alignment_id}/profile", { params: { path: { alignment_id: id } } }));
    profiles.set(id, found);
    found.catch(() => profiles.delete(id));
  }
  return found;
}

const SIGNS = /** @type {Record<string, string>} */ ({ ok: "✓", warn: "!", fail: "✕" });
const EVENT_SIGNS = /** @type {Record<string, string>} */ ({ stop_line: "S", junction: "J", crossing: "Z", arrow: "↑", speed_limit: "V", curve: "⤴" });

/**
 * Everything along the lanes, with its place.
 *
 * @param {Profile} profile
 * @param {{ markers: Marker[], findings?: Finding[], weak?: any[] }} of
 * @returns {Thing[]}
 */
export function thingsOf(profile, { markers, findings = [], weak = [] }) {
  const lanes = new Map(profile.lanes.map((lane) => [lane.name, lane]));
  const byNumber = new Map(markers.map((marker) => [marker.number, marker]));
  /** @type {Thing[]} */
  const things = markers.map((marker) => ({
    id: `m${marker.number}`, lane: marker.lane, at_m: marker.chainage_m, row: `family ${marker.family}`, kind: "marker", family: marker.family,
    status: marker.status ?? "planned", label: markerName(marker), lon_deg: marker.lon_deg, lat_deg: marker.lat_deg,
  }));
  for (const [k, finding] of findings.entries()) {
    const lane = finding.lane ? lanes.get(finding.lane) : undefined;
    if (!lane || finding.station_m === null || finding.lon_deg === null || finding.lat_deg === null) continue;
    const at_m = chainageNear(lane, finding.lon_deg, finding.lat_deg);
    things.push({ id: `c${k}`, lane: lane.name, at_m, row: "checks", kind: "check", sign: SIGNS[finding.verdict] ?? "!", level: finding.verdict, label: `${checkName(finding.name)}: ${textOr(`verdict.${finding.verdict}`, finding.verdict)}`, lon_deg: finding.lon_deg, lat_deg: finding.lat_deg });
  }
  for (const found of weak) {
    const marker = byNumber.get(found.number);
    if (marker) things.push({ id: `w${found.number}`, lane: marker.lane, at_m: marker.chainage_m, row: "weak", kind: "weak", sign: "!", level: "warn", label: t("plan.weak_at", { name: markerName(marker), rate: found.rate === null ? "–" : number(100 * found.rate, 0) }), lon_deg: marker.lon_deg, lat_deg: marker.lat_deg });
  }
  for (const [k, event] of profile.events.entries()) {
    things.push({ id: `e${k}`, lane: event.lane, at_m: event.chainage_m, row: "events", kind: "event", sign: EVENT_SIGNS[event.kind] ?? "•", label: eventName(event), lon_deg: event.lon_deg, lat_deg: event.lat_deg });
  }
  return things;
}

/** @param {Marker} marker */
export const markerName = (marker) => [textOr(`family.${marker.family}`, marker.family), marker.number, marker.code].filter(Boolean).join(" ");

/** What a check is called; names of cameras and conditions follow. @param {string} name */
export function checkName(name) {
  const [first = "", ...rest] = name.split(" ");
  return [textOr(`check.${first}`, first), ...rest.map((part) => textOr(`option.${part}`, part))].join(" ");
}

/** @param {{ kind: string, value: string | number | null }} event */
export function eventName({ kind, value }) {
  const shown = typeof value === "number" ? number(value, 0, kind === "speed_limit" ? "km/h" : "°") : value ? textOr(`option.${value}`, value) : "";
  return `${textOr(`option.${kind}`, kind)}${shown && ` ${shown}`}`;
}

/**
 * @param {object} props
 * @param {Profile} props.profile
 * @param {Thing[]} props.things
 * @param {string | null} props.pointedId What another part of the page points at.
 * @param {(id: string | null) => void} props.onPoint
 * @param {(id: string) => void} props.onChoose
 * @param {string} [props.note] What the map shows, if it is not the plan itself.
 */
export function PlanView({ profile, things, pointedId, onPoint, onChoose, note = "" }) {
  const [bare, setBare] = useState(/** @type {Pointed | null} */ (null)); // a place of the lane without a thing
  const wanted = query.value.get("lane");
  const first = profile.lanes.find(({ name }) => things.some((thing) => thing.lane === name && thing.kind === "marker")) ?? profile.lanes[0];
  const lane = profile.lanes.find(({ name }) => name === wanted) ?? first;
  const byId = useMemo(() => new Map(things.map((thing) => [thing.id, thing])), [things]);
  const pointed = pointedId ? byId.get(pointedId) : undefined;
  const items = useMemo(() => things.filter((thing) => thing.lane === lane?.name).map((thing) => ({ ...thing, kind: thing.level ?? thing.kind, ...(thing.kind === "marker" ? {} : { family: "" }) })), [things, lane]);
  const spots = useMemo(() => things.filter(({ kind, level }) => kind !== "check" || level !== "ok"), [things]);
  if (!lane) return null;
  const at = pointed ? { id: pointed.id, lane: pointed.lane, at_m: pointed.at_m } : bare;
  const rows = [
    { id: "checks", title: t("plan.checks") },
    ...[...new Set(things.filter(({ kind }) => kind === "marker").map(({ family }) => family ?? ""))].map((family) => ({ id: `family ${family}`, title: textOr(`family_many.${family}`, family) })),
    { id: "weak", title: t("plan.weak") },
    { id: "events", title: t("plan.events") },
  ];
  const place = pointed ? [pointed.lon_deg, pointed.lat_deg]
    : at && at.lane === lane.name ? [valueAt(lane.chainage_m, lane.lon_deg, at.at_m), valueAt(lane.chainage_m, lane.lat_deg, at.at_m)] : null;
  /** @param {string} id */
  const choose = (id) => {
    const thing = byId.get(id);
    if (thing && thing.lane !== lane.name) setQuery({ lane: thing.lane, strip: null });
    onChoose(id);
  };
  const counted = things.filter(({ kind }) => kind === "marker").length;
  return html`
    <section class="plan-view" aria-label=${t("plan.view")}>
      <${RoadMap} lanes=${profile.lanes} chosenLane=${lane.name} spots=${spots} areas=${profile.areas} pointed=${place}
        onPoint=${onPoint} onChoose=${choose} caption=${note || t("plan.on_map", { count: number(counted) })} />
      ${profile.lanes.length > 1 && html`
        <label class="lane-choice">${t("plan.lane")} <select value=${lane.name} onChange=${(/** @type {any} */ event) => setQuery({ lane: event.currentTarget.value, strip: null })}>
          ${profile.lanes.map(({ name, length_m }) => html`<option value=${name} selected=${name === lane.name}>${name} (${number(length_m, 0, "m")}, ${t("plan.markers_on", { count: things.filter((thing) => thing.kind === "marker" && thing.lane === name).length })})</option>`)}
        </select></label>
      `}
      <${Strip} way=${lane} rows=${rows} items=${items} label=${t("plan.along", { lane: lane.name })} pointed=${at}
        onPoint=${(/** @type {Pointed | null} */ next) => {
          setBare(next?.id ? null : next);
          onPoint(next?.id ?? null);
        }} onChoose=${choose} />
    </section>
  `;
}

/** @param {Finding} finding */
export function placeText(finding) {
  if (!finding.lane) return t("plan.whole");
  return finding.station_m === null ? finding.lane : `${finding.lane}, ${stationText(finding.station_m)}`;
}
