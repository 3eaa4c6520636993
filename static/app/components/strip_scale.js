// Distances along a lane and its stations: what the strip and its readers compute with.

import { language } from "../texts/index.js";

/**
 * A lane along its way, as `GET /v1/alignments/{id}/profile` describes it; a registered road has no curvature.
 *
 * @typedef {{ name: string, length_m: number, chainage_m: number[], station_m: number[], curvature_per_m?: number[] | null, lon_deg?: number[], lat_deg?: number[] }} Way
 */

/**
 * The value of `ys` at `x`, linearly between the samples `xs`, which increase.
 *
 * @param {number[]} xs
 * @param {number[]} ys
 * @param {number} x
 */
export function valueAt(xs, ys, x) {
  let [low, high] = [0, xs.length - 1];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if ((xs[middle] ?? 0) <= x) low = middle;
    else high = middle;
  }
  const [x0 = 0, x1 = 0, y0 = 0, y1 = 0] = [xs[low], xs[high], ys[low], ys[high]];
  return x1 === x0 ? y0 : y0 + ((y1 - y0) * (x - x0)) / (x1 - x0);
}

/**
 * The chainage of the place on a lane that is nearest to a position.
 *
 * @param {{ chainage_m: number[], lon_deg: number[], lat_deg: number[] }} lane
 * @param {number} lon_deg
 * @param {number} lat_deg
 */
export function chainageNear(lane, lon_deg, lat_deg) {
  const cos = Math.cos((lat_deg * Math.PI) / 180);
  let [best, least] = [0, Infinity];
  for (let k = 1; k < lane.chainage_m.length; k += 1) {
    const [x, y] = [((lane.lon_deg[k - 1] ?? 0) - lon_deg) * cos, (lane.lat_deg[k - 1] ?? 0) - lat_deg];
    const [dx, dy] = [((lane.lon_deg[k] ?? 0) - (lane.lon_deg[k - 1] ?? 0)) * cos, (lane.lat_deg[k] ?? 0) - (lane.lat_deg[k - 1] ?? 0)];
    const share = Math.min(Math.max(-(x * dx + y * dy) / (dx * dx + dy * dy || 1), 0), 1);
    const apart = Math.hypot(x + share * dx, y + share * dy);
    if (apart >= least) continue;
    least = apart;
    best = (lane.chainage_m[k - 1] ?? 0) + share * ((lane.chainage_m[k] ?? 0) - (lane.chainage_m[k - 1] ?? 0));
  }
  return best;
}

/** The chainage of a station; where a station repeats, the first one. @param {Way} way @param {number} station_m */
export function chainageOf(way, station_m) {
  const { chainage_m: at, station_m: stations } = way;
  for (let k = 1; k < at.length; k += 1) {
    const [a = 0, b = 0] = [stations[k - 1], stations[k]];
    if ((a <= station_m && station_m <= b) || (b <= station_m && station_m <= a)) {
      const share = a === b ? 0 : (station_m - a) / (b - a);
      return (at[k - 1] ?? 0) + share * ((at[k] ?? 0) - (at[k - 1] ?? 0));
    }
  }
  return null;
}

/** A station as drawings write it, e.g. 1+234.56. @param {number} station_m @param {number} [digits] */
export function stationText(station_m, digits = 2) {
  const factor = 10 ** digits;
  const value = Math.round(Math.abs(station_m) * factor) / factor;
  const kilometre = Math.floor(value / 1000);
  const rest = (value - 1000 * kilometre).toFixed(digits);
  const text = `${station_m < 0 ? "-" : ""}${kilometre}+${rest.padStart(digits ? digits + 4 : 3, "0")}`;
  return language.value === "de" ? text.replace(".", ",") : text;
}

/**
 * Stations with a label, and where they are.
 *
 * @param {Way} way
 * @param {number} from_m
 * @param {number} to_m
 * @param {number} count About how many.
 * @returns {{ at_m: number, text: string }[]}
 */
export function stationTicks(way, from_m, to_m, count) {
  const wanted = Math.max((to_m - from_m) / Math.max(count, 1), 1e-3);
  const power = 10 ** Math.floor(Math.log10(wanted));
  const step = [1, 2, 5, 10].map((times) => times * power).find((value) => value >= wanted) ?? 10 * power;
  const [first, last] = [valueAt(way.chainage_m, way.station_m, from_m), valueAt(way.chainage_m, way.station_m, to_m)];
  const [low, high] = [Math.min(first, last), Math.max(first, last)];
  const ticks = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 && ticks.length < 200; k += 1) {
    const at_m = chainageOf(way, k * step);
    if (at_m !== null && at_m >= from_m - 1e-6 && at_m <= to_m + 1e-6) ticks.push({ at_m, text: stationText(k * step, step < 1 ? 1 : 0) });
  }
  return ticks;
}
