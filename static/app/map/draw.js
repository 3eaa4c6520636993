// Drawing on the map: a box or a polygon to select markers, a line to measure. terra-draw is loaded when it is needed.

import { pageColours } from "./symbols.js";

const EARTH_M = 6_371_008.8;

/**
 * @typedef {"rectangle" | "polygon" | "linestring"} Shape
 */

/**
 * Let the reader draw one shape.
 *
 * @param {import("maplibre-gl").Map} map
 * @param {Shape} shape
 * @param {{ onChange?: (coordinates: number[][]) => void, onFinish: (coordinates: number[][]) => void }} events
 * @returns {Promise<() => void>} Ends drawing and removes what was drawn.
 */
export async function draw(map, shape, { onChange, onFinish }) {
  const [terra, { TerraDrawMapLibreGLAdapter }] = await Promise.all([import("terra-draw"), import("terra-draw-maplibre-gl-adapter")]);
  const colour = /** @type {`#${string}`} */ (pageColours().accent);
  const areas = { styles: { fillColor: colour, fillOpacity: 0.15, outlineColor: colour, outlineWidth: 2 } };
  const modes = {
    rectangle: () => new terra.TerraDrawRectangleMode(areas),
    polygon: () => new terra.TerraDrawPolygonMode(areas),
    linestring: () => new terra.TerraDrawLineStringMode({ styles: { lineStringColor: colour, lineStringWidth: 3 } }),
  };
  const drawing = new terra.TerraDraw({ adapter: new TerraDrawMapLibreGLAdapter({ map }), modes: [modes[shape]()] });
  const current = () => {
    const feature = drawing.getSnapshot().find(({ geometry }) => geometry.type !== "Point");
    if (!feature) return [];
    return /** @type {number[][]} */ (feature.geometry.type === "Polygon" ? feature.geometry.coordinates[0] : feature.geometry.coordinates);
  };
  drawing.start();
  drawing.setMode(shape);
  map.getContainer().dataset.drawing = shape;
  drawing.on("change", () => onChange?.(current()));
  drawing.on("finish", () => onFinish(current()));
  return () => {
    drawing.stop();
    delete map.getContainer().dataset.drawing;
  };
}

/**
 * Length of a line on the sphere. [m]
 *
 * @param {number[][]} coordinates
 */
export function length_m(coordinates) {
  let sum = 0;
  for (let k = 1; k < coordinates.length; k += 1) sum += distance_m(coordinates[k - 1] ?? [], coordinates[k] ?? []);
  return sum;
}

/**
 * Distance of two places on the sphere; within 0.6 % of that on the ellipsoid. [m]
 *
 * @param {number[]} from
 * @param {number[]} to
 */
export function distance_m([lon1 = 0, lat1 = 0], [lon2 = 0, lat2 = 0]) {
  const rad = Math.PI / 180;
  const dlat = (lat2 - lat1) * rad;
  const dlon = (lon2 - lon1) * rad;
  const h = Math.sin(dlat / 2) ** 2 + Math.cos(lat1 * rad) * Math.cos(lat2 * rad) * Math.sin(dlon / 2) ** 2;
  return 2 * EARTH_M * Math.asin(Math.min(1, Math.sqrt(h)));
}

/** A polygon as WKT, as searches take it. @param {number[][]} ring */
export const wktOf = (ring) => `POLYGON((${ring.map(([lon = 0, lat = 0]) => `${lon.toFixed(7)} ${lat.toFixed(7)}`).join(",")}))`;

/** The ring of a WKT polygon. @param {string} wkt @returns {number[][]} */
export function ringOf(wkt) {
  const found = /^POLYGON\(\(([^()]*)\)\)$/.exec(wkt);
  return found ? (found[1] ?? "").split(",").map((pair) => pair.trim().split(/\s+/).map(Number)) : [];
}
