// Rows of a survey on the map, before they are markers: a symbol for each state, beside the markers that are registered.

import { followColours } from "./create.js";
import { pageColours } from "./symbols.js";

/** @typedef {import("maplibre-gl").Map} MapLibreMap */
/** @typedef {import("../api/schema.js").components["schemas"]["SurveyRow"]} SurveyRow */

/** The status whose symbol a state of a row has. @type {Record<SurveyRow["state"], string>} */
export const SYMBOLS = { good: "active", warning: "suspect", refused: "retired", "left-out": "planned" };

const TILE_ZOOM = 18;

/** @returns {import("geojson").FeatureCollection} */
const empty = () => ({ type: "FeatureCollection", features: [] });

/** @param {MapLibreMap} map */
export function addRowLayers(map) {
  map.addSource("registered", { type: "vector", tiles: [`${window.location.origin}/ogc/collections/markers/tiles/WebMercatorQuad/{z}/{y}/{x}`], maxzoom: TILE_ZOOM });
  map.addSource("rows", { type: "geojson", data: empty() });
  map.addSource("chosen", { type: "geojson", data: empty() });
  map.addLayer({ id: "registered", type: "circle", source: "registered", "source-layer": "markers", paint: { "circle-radius": 3, "circle-opacity": 0.7 } });
  map.addLayer({
    id: "rows", type: "symbol", source: "rows",
    layout: { "icon-image": ["get", "icon"], "icon-size": 0.8, "icon-allow-overlap": true, "symbol-sort-key": ["get", "order"] },
  });
  map.addLayer({
    id: "row-numbers", type: "symbol", source: "rows", minzoom: 16,
    layout: { "text-field": ["get", "label"], "text-size": 11, "text-offset": [0, 1.3], "text-font": ["sans-serif"], "text-optional": true },
  });
  map.addLayer({ id: "chosen", type: "circle", source: "chosen", paint: { "circle-radius": 15, "circle-opacity": 0, "circle-stroke-width": 3 } });
  const paint = () => {
    const colours = pageColours();
    map.setPaintProperty("registered", "circle-color", colours.soft);
    map.setPaintProperty("row-numbers", "text-color", colours.text);
    map.setPaintProperty("row-numbers", "text-halo-color", colours.ground);
    map.setPaintProperty("row-numbers", "text-halo-width", 2);
    map.setPaintProperty("chosen", "circle-stroke-color", colours.chosen);
  };
  paint();
  followColours(map, paint);
}

/**
 * @param {MapLibreMap} map
 * @param {SurveyRow[]} rows
 * @param {string} family
 */
export function setRows(map, rows, family) {
  const source = /** @type {import("maplibre-gl").GeoJSONSource} */ (map.getSource("rows"));
  source.setData({ type: "FeatureCollection", features: rows.filter(isPlaced).map((row) => featureOf(row, family)) });
}

/** @param {MapLibreMap} map @param {SurveyRow | undefined} row */
export function setChosenRow(map, row) {
  const source = /** @type {import("maplibre-gl").GeoJSONSource} */ (map.getSource("chosen"));
  source.setData({ type: "FeatureCollection", features: row && isPlaced(row) ? [featureOf(row, "plate")] : [] });
}

/** @param {SurveyRow} row */
export const isPlaced = (row) => row.lon_deg !== null && row.lat_deg !== null;

const ORDER = { good: 1, "left-out": 0, warning: 2, refused: 3 };

/** @param {SurveyRow} row @param {string} family @returns {import("geojson").Feature} */
const featureOf = (row, family) => ({
  type: "Feature",
  properties: { row: row.row, label: row.code ?? row.point ?? String(row.row), icon: `${family}-${SYMBOLS[row.state]}`, order: ORDER[row.state] },
  geometry: { type: "Point", coordinates: [row.lon_deg ?? 0, row.lat_deg ?? 0] },
});
