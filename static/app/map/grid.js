// A quiet grid of meridians and parallels, with steps that fit the view, and their degrees at the edges.

const STEPS_DEG = [30, 10, 5, 2, 1, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5, 1e-5];
const LINES = 5;
const MOST_LAT_DEG = 85;

/**
 * Lines, and points with a `label` where they meet the lower and the left edge.
 *
 * @param {number} west
 * @param {number} south
 * @param {number} east
 * @param {number} north
 * @returns {import("geojson").FeatureCollection}
 */
export function gridLines(west, south, east, north) {
  const span = Math.max(Math.min(east - west, 360), 1e-6);
  const step = STEPS_DEG.find((wanted) => span / wanted >= LINES) ?? 1e-5;
  const digits = Math.max(0, Math.ceil(-Math.log10(step) - 1e-9));
  const [low, high] = [Math.max(south, -MOST_LAT_DEG), Math.min(north, MOST_LAT_DEG)];
  const [left, right] = [Math.max(west, -180), Math.min(east, 180)];
  const edge = { lon: left + (right - left) * 0.004, lat: low + (high - low) * 0.012 };
  /** @type {import("geojson").Feature[]} */
  const features = [];
  /** @param {number[][]} coordinates @param {number[]} at @param {number} value @param {string} anchor */
  const add = (coordinates, at, value, anchor) => features.push(
    { type: "Feature", properties: {}, geometry: { type: "LineString", coordinates } },
    { type: "Feature", properties: { label: `${value.toFixed(digits)}°`, anchor }, geometry: { type: "Point", coordinates: at } },
  );
  for (let k = Math.ceil(left / step); k * step <= right; k += 1) add([[k * step, low], [k * step, high]], [k * step, edge.lat], k * step, "bottom");
  for (let k = Math.ceil(low / step); k * step <= high; k += 1) add([[left, k * step], [right, k * step]], [edge.lon, k * step], k * step, "left");
  return { type: "FeatureCollection", features };
}
