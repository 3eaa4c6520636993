// Packets of CERPMs that were received, markers that disagree, and the lane that was estimated from them.

import { html } from "htm/preact";

import { download } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Facts } from "../components/facts.js";
import { Empty } from "../components/load.js";
import { attempt } from "../components/notices.js";
import { PlacePlot } from "../components/place_plot.js";
import { number } from "../format.js";
import { t, textOr } from "../texts/index.js";

const OTHER_LANE = "other lane"; // why a marker of a lane beside the driven one is left out: no fault
const PLOT_STEP = 10; // stations between two ticks of the plot

/** @param {{ decode: any }} props */
export function Packets({ decode }) {
  const { report, markers, lane, steering } = decode;
  const counts = Object.entries(report.verdicts).filter(([, count]) => count).map(([verdict, count]) => `${count} ${textOr(`packet.${verdict}`, verdict)}`);
  const others = markers.filter((/** @type {any} */ marker) => marker.left_out === OTHER_LANE && !marker.notes.length);
  const noted = markers.filter((/** @type {any} */ marker) => (marker.left_out && marker.left_out !== OTHER_LANE) || marker.notes.length);
  return html`
    <${Facts} of=${[
      [t("decode.packets"), `${report.packets}: ${counts.join(", ")}`],
      [t("decode.left_out"), report.left_out.map((/** @type {any} */ entry) => `${entry.what}: ${entry.reason}`).join("; ")],
      [t("decode.of_other_lanes"), others.length ? t("decode.received", { count: others.length }) : null],
      [t("decode.path"), lane && (lane.refusal ?? `${number(lane.length_m, 0, "m")}, ± ${number(100 * lane.sigma_median_m, 1, "cm")}`)],
      [t("decode.steering"), steering && (steering.refusal ?? t("decode.steering_text", { controller: steering.controller, rms: number(100 * steering.rms_m, 1), max: number(100 * steering.max_m, 1) }))],
    ]} />
    ${noted.map((/** @type {any} */ marker) => html`
      <article class="reading">
        <h3><${Verdict} level=${marker.left_out ? "bad" : "warn"}>${t(marker.left_out ? "decode.marker_left_out" : "decode.marker_warning")}</${Verdict}> <span class="code">CERPM ${marker.number}</span></h3>
        <${Facts} of=${[[t("field.reason"), [marker.left_out, ...marker.notes].filter(Boolean).join("; ")], [t("decode.packets"), marker.packets], [t("marker.health"), marker.health?.verdict]]} />
      </article>
    `)}
    ${!noted.length && html`<p class="reading"><${Verdict} level="good">${t("decode.all_agree")}</${Verdict}> ${t("decode.received", { count: markers.length })}</p>`}
  `;
}

/** A lane by its place beside the path's. @param {number} position */
const besideText = (position) => (position === 0 ? t("decode.own_lane") : t(position > 0 ? "decode.lane_left" : "decode.lane_right", { count: Math.abs(position) }));

/** Where the vehicle was in which lane; both halves of a change, before and after the line, are one. @param {any[]} stretches */
function stretchesText(stretches) {
  const parts = stretches.filter((part, k) => !(part.changing && stretches[k - 1]?.changing));
  return parts.map((part, k) => t(part.changing ? "decode.stretch_changing" : "decode.stretch", { from: number(part.from_m, 0), to: number(parts[k + 1]?.from_m ?? part.to_m, 0, "m"), lane: besideText(part.lane) })).join("; ");
}

/** @param {{ decode: any }} props */
export function Lane({ decode }) {
  const { lane } = decode;
  if (!lane || lane.refusal) return html`<${Empty} title=${lane?.refusal ?? t("decode.no_path")} />`;
  const { stations } = lane;
  const places = stations.lon_deg.flatMap((/** @type {number} */ lon_deg, /** @type {number} */ k) => (k % PLOT_STEP ? [] : [{
    lon_deg, lat_deg: stations.lat_deg[k], heading_deg: stations.heading_deg[k], label: number(stations.station_m[k], 0, "m"),
  }]));
  return html`
    <p><button type="button" class="quiet" onClick=${() => attempt(() => download(decode.links.lane, `lane-${decode.id}.geojson`))}>${t("decode.download_path")}</button></p>
    <${Facts} of=${[
      [t("decode.length"), number(lane.length_m, 1, "m")],
      [t("decode.accuracy"), t("decode.accuracy_text", { median: number(100 * lane.sigma_median_m, 1), max: number(100 * lane.sigma_max_m, 1) })],
      [t("marker.speed_limit"), lane.speed_limits_kmh.length ? `${lane.speed_limits_kmh.map((/** @type {number} */ limit) => number(limit)).join(", ")} km/h` : null],
      [t("decode.sharpest"), lane.min_radius_m === null ? null : number(lane.min_radius_m, 0, "m")],
      [t("field.grade"), textOr(`grade.${lane.localization_grade}`, lane.localization_grade)],
      [t("decode.lane_of_vehicle"), stretchesText(lane.stretches ?? [])],
      [t("decode.other_lanes"), (lane.other_lanes ?? []).map((/** @type {any} */ other) => t("decode.other_lane", { place: besideText(other.position), direction: textOr(`decode.direction_${other.direction}`, other.direction), length: number(other.length_m, 0, "m") })).join("; ")],
    ]} />
    <${PlacePlot} places=${places} label=${t("decode.lane_plot")} />
  `;
}
