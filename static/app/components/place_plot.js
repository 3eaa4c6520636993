// A small plot of places in local metres, with a scale and north: for pages that need no map. SVG, without any library.

import { html } from "htm/preact";

import { number } from "../format.js";
import { t } from "../texts/index.js";

const WIDTH = 640;
const HEIGHT = 260;
const MARGIN = 44;
const DEGREE_M = 111_320;

/**
 * @typedef {object} PlottedPlace
 * @property {number} lon_deg
 * @property {number} lat_deg
 * @property {number | null} [heading_deg]
 * @property {string} label
 * @property {string} [kind] A class of style/pages.css.
 */

/**
 * @param {{ places: PlottedPlace[], vehicle?: any, label: string, least_m?: number }} props `vehicle` has a covariance in
 *   metres, east before north, whose ellipse of two standard deviations is drawn.
 */
export function PlacePlot({ places, vehicle = null, label, least_m = 20 }) {
  const all = vehicle ? [...places, vehicle] : places;
  const first = all[0];
  if (!first) return null;
  const cos = Math.cos((first.lat_deg * Math.PI) / 180);
  const points = all.map(({ lon_deg, lat_deg }) => [
    (((lon_deg - first.lon_deg + 540) % 360) - 180) * DEGREE_M * cos, (lat_deg - first.lat_deg) * DEGREE_M,
  ]);
  const [xs, ys] = [points.map(([x = 0]) => x), points.map(([, y = 0]) => y)];
  const [west, east, south, north] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const scale = Math.min((WIDTH - 2 * MARGIN) / Math.max(east - west, least_m), (HEIGHT - 2 * MARGIN) / Math.max(north - south, least_m));
  /** @param {number[]} point */
  const at = ([x = 0, y = 0]) => [WIDTH / 2 + (x - (west + east) / 2) * scale, HEIGHT / 2 - (y - (south + north) / 2) * scale];
  const spots = points.map(at);
  return html`
    <svg class="place-plot" viewBox=${`0 0 ${WIDTH} ${HEIGHT}`} role="img" aria-label=${label}>
      <${Scale} scale=${scale} />
      ${places.map((place, k) => html`<${Spot} place=${place} at=${spots[k]} />`)}
      ${vehicle && html`<${Vehicle} vehicle=${vehicle} at=${spots[spots.length - 1]} scale=${scale} />`}
    </svg>
  `;
}

/** @param {{ scale: number }} props Pixels per metre. */
function Scale({ scale }) {
  const wanted = 140 / scale;
  const power = 10 ** Math.floor(Math.log10(wanted));
  const metres = [5, 2, 1].map((step) => step * power).find((step) => step <= wanted) ?? power;
  const [x, y, length] = [16, HEIGHT - 16, metres * scale];
  return html`
    <path class="scale" d=${`M${x} ${y - 5}v5h${length}v-5`} />
    <text x=${x + length + 8} y=${y}>${metres >= 1000 ? number(metres / 1000, 0, "km") : number(metres, metres < 1 ? 1 : 0, "m")}</text>
    <path class="scale" d=${`M${WIDTH - 24} 34v-18m-5 6l5 -7l5 7`} />
    <text x=${WIDTH - 28} y="48">N</text>
  `;
}

/** @param {{ place: PlottedPlace, at: number[] | undefined }} props */
function Spot({ place, at = [0, 0] }) {
  const [x = 0, y = 0] = at;
  const angle = ((place.heading_deg ?? 0) * Math.PI) / 180;
  return html`
    ${place.heading_deg !== null && place.heading_deg !== undefined && html`<line class="tick" x1=${x} y1=${y} x2=${x + 16 * Math.sin(angle)} y2=${y - 16 * Math.cos(angle)} />`}
    <circle class=${`spot ${place.kind ?? ""}`} cx=${x} cy=${y} r="6"><title>${place.label}</title></circle>
  `;
}

/** @param {{ vehicle: any, at: number[] | undefined, scale: number }} props */
function Vehicle({ vehicle, at = [0, 0], scale }) {
  const [x, y] = at;
  const [[a, b], [, d]] = vehicle.covariance.slice(0, 2).map((/** @type {number[]} */ row) => row.slice(0, 2));
  const mean = (a + d) / 2;
  const apart = Math.hypot((a - d) / 2, b);
  const [long, short] = [mean + apart, Math.max(mean - apart, 0)].map((variance) => Math.max(2 * Math.sqrt(variance) * scale, 1));
  const angle = (-Math.atan2(2 * b, a - d) * 90) / Math.PI;
  return html`
    <ellipse class="ellipse" cx=${x} cy=${y} rx=${long} ry=${short} transform=${`rotate(${angle} ${x} ${y})`} />
    <path class="vehicle" d="M0 -12l8 20l-8 -5l-8 5z" transform=${`translate(${x} ${y}) rotate(${vehicle.heading_deg})`}><title>${t("decode.vehicle_title")}</title></path>
  `;
}
