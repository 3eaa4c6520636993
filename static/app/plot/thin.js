// Fewer points that look the same: of the samples that fall on one pixel, the smallest and the largest value.

/** @typedef {ArrayLike<number | null>} Values */

/**
 * First index whose value is not below a limit, in rising values.
 *
 * @param {ArrayLike<number>} rising
 * @param {number} limit
 */
export function lowerBound(rising, limit) {
  let [low, high] = [0, rising.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if ((rising[middle] ?? 0) < limit) low = middle + 1;
    else high = middle;
  }
  return low;
}

/**
 * What is drawn of columns between two times. All samples if there are at most two a pixel.
 *
 * @param {ArrayLike<number>} t Rising.
 * @param {Values[]} columns
 * @param {number} from
 * @param {number} to
 * @param {number} width Of the plot. [px]
 * @returns {[number[], ...(number | null)[][]]}
 */
export function thin(t, columns, from, to, width) {
  const first = Math.max(lowerBound(t, from) - 1, 0);
  const end = Math.min(lowerBound(t, to) + 2, t.length);
  const bins = Math.max(Math.floor(width), 1);
  if (end - first <= 2 * bins) return [slice(t, first, end), ...columns.map((values) => nullable(values, first, end))];
  const step = (end - first) / bins;
  const times = new Array(2 * bins);
  const thinned = columns.map(() => new Array(2 * bins));
  for (let bin = 0; bin < bins; bin += 1) {
    const start = first + Math.floor(bin * step);
    const stop = Math.min(first + Math.floor((bin + 1) * step), end);
    times[2 * bin] = t[start];
    times[2 * bin + 1] = t[(start + stop) >> 1];
    columns.forEach((values, k) => extremes(values, start, stop, /** @type {(number | null)[]} */ (thinned[k]), 2 * bin));
  }
  return [times, ...thinned];
}

/**
 * The two extremes of a stretch, in the order in which they come; null where it has no value.
 *
 * @param {Values} values
 * @param {number} start
 * @param {number} stop
 * @param {(number | null)[]} out
 * @param {number} at
 */
function extremes(values, start, stop, out, at) {
  let [low, high, lowAt, highAt] = [Infinity, -Infinity, 0, 0];
  for (let k = start; k < stop; k += 1) {
    const value = values[k];
    if (value === null || value === undefined) continue;
    if (value < low) [low, lowAt] = [value, k];
    if (value > high) [high, highAt] = [value, k];
  }
  const known = low <= high;
  out[at] = known ? (lowAt <= highAt ? low : high) : null;
  out[at + 1] = known ? (lowAt <= highAt ? high : low) : null;
}

/** @param {ArrayLike<number>} values @param {number} first @param {number} end @returns {number[]} */
const slice = (values, first, end) => Array.prototype.slice.call(values, first, end);

/** @param {Values} values @param {number} first @param {number} end @returns {(number | null)[]} */
const nullable = (values, first, end) => Array.prototype.slice.call(values, first, end);
