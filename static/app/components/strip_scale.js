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

/** A station as drawings write it, e.g. 1+234.56. @param {number} station_m @param {number} [digits] */
export function stationText(station_m, digits = 2) {
  const factor = 10 ** digits;
  const value = Math.round(Math.abs(station_m) * factor) / factor;
  const kilometre = Math.floor(value / 1000);
  const rest = (value - 1000 * kilometre).toFixed(digits);
  const text = `${station_m < 0 ? "-" : ""}${kilometre}+${rest.padStart(digits ? digits + 4 : 3, "0")}`;
  return language.value === "de" ? text.replace(".", ",") : text;
}

/** The metres of a number, or of a station as drawings write it; NaN of other text. @param {string} typed */
export function stationValue(typed) {
  const [, sign, kilometre, rest] = /^\s*([+-]?)(\d{1,6})\+(\d{1,3}(?:[.,]\d+)?)\s*$/.exec(typed) ?? [];
  if (kilometre === undefined || rest === undefined) return typed.trim() ? Number(typed.replace(",", ".")) : NaN;
  return (sign === "-" ? -1 : 1) * (1000 * Number(kilometre) + Number(rest.replace(",", ".")));
}

/**
 * Stations with a label, and where they are: twice where stations repeat, none where they are left out.
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
  /** @type {{ at_m: number, text: string }[]} */
  const ticks = [];
  for (let k = 1; k < way.chainage_m.length && ticks.length < 200; k += 1) {
    const [start = 0, end = 0] = [way.chainage_m[k - 1], way.chainage_m[k]];
    const [first = 0, last = 0] = [way.station_m[k - 1], way.station_m[k]];
    const rise = (last - first) / (end - start);
    if (end < from_m || start > to_m || !(Math.abs(rise) > 0.4 && Math.abs(rise) < 2.5)) continue; // stations jump here
    const high = Math.max(first, last);
    for (let n = Math.ceil(Math.min(first, last) / step - 1e-9); n * step <= high + 1e-9; n += 1) {
      const at_m = start + (n * step - first) / rise;
      const isNew = !ticks.length || at_m - (ticks[ticks.length - 1]?.at_m ?? 0) > 1e-6;
      if (isNew && at_m >= from_m - 1e-6 && at_m <= to_m + 1e-6) ticks.push({ at_m, text: stationText(n * step, step < 1 ? 1 : 0) });
    }
  }
  return ticks.sort((a, b) => a.at_m - b.at_m);
}
