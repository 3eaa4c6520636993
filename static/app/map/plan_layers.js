// Lanes, planned markers, checks and events on a map, and the place that is pointed at.

import { followColours } from "./create.js";
import { FAMILIES, pageColours } from "./symbols.js";

/**
 * @typedef {import("maplibre-gl").Map} MapLibreMap
 * @typedef {{ id: string, kind: "marker" | "check" | "event" | "weak" | "station", family?: string, status?: string, sign?: string, label: string, lon_deg: number, lat_deg: number }} Spot
 * @typedef {{ name: string, line: number[][] | number[][][] }} LaneLine
 */

const NEAR_PX = 7;

/** @returns {import("geojson").FeatureCollection} */
const empty = () => ({ type: "FeatureCollection", features: [] });

/** Add the layers, with nothing in them yet. @param {MapLibreMap} map */
export function addPlanLayers(map) {
  for (const source of ["lanes", "areas", "spots", "signs", "stations", "pointed"]) map.addSource(source, { type: "geojson", data: empty() });
  map.addLayer({ id: "areas", type: "fill", source: "areas", paint: { "fill-opacity": 0.3 } });
  map.addLayer({ id: "lanes", type: "line", source: "lanes", layout: { "line-cap": "round", "line-join": "round" }, paint: { "line-width": ["interpolate", ["linear"], ["zoom"], 8, 2, 15, 4, 20, 14], "line-opacity": ["case", ["get", "chosen"], 1, 0.55] } });
  map.addLayer({ id: "lane-names", type: "symbol", source: "lanes", minzoom: 13, layout: { "text-field": ["get", "name"], "text-size": 11, "symbol-placement": "line", "text-font": ["sans-serif"], "text-offset": [0, 1.1] } });
  map.addLayer({ id: "stations", type: "circle", source: "stations", paint: { "circle-radius": 3, "circle-stroke-width": 1.5 } });
  map.addLayer({ id: "station-texts", type: "symbol", source: "stations", layout: { "text-field": ["get", "sign"], "text-size": 11, "text-font": ["sans-serif"], "text-offset": [0, 1.4], "text-allow-overlap": true } });
  map.addLayer({
    id: "spots", type: "symbol", source: "spots",
    layout: { "icon-image": ["concat", ["get", "family"], "-", ["get", "status"]], "icon-size": ["interpolate", ["linear"], ["zoom"], 12, 0.45, 18, 0.9], "icon-allow-overlap": true },
  });
  map.addLayer({ id: "signs", type: "circle", source: "signs", paint: { "circle-radius": 9, "circle-stroke-width": 2 } });
  map.addLayer({ id: "sign-texts", type: "symbol", source: "signs", layout: { "text-field": ["get", "sign"], "text-size": 12, "text-font": ["sans-serif"], "text-allow-overlap": true } });
  map.addLayer({ id: "pointed", type: "circle", source: "pointed", paint: { "circle-radius": 14, "circle-opacity": 0, "circle-stroke-width": 3 } });
  paint(map);
  followColours(map, () => paint(map));
}

/** @param {MapLibreMap} map */
function paint(map) {
  const colours = pageColours();
  /** @type {[string, string, any][]} */
  const values = [
    ["lanes", "line-color", colours.road], ["areas", "fill-color", colours.warn],
    ["lane-names", "text-color", colours.soft], ["lane-names", "text-halo-color", colours.ground], ["lane-names", "text-halo-width", 2],
    ["signs", "circle-color", colours.card], ["signs", "circle-stroke-color", ["match", ["get", "kind"], "check", colours.warn, "weak", colours.warn, colours.soft]],
    ["stations", "circle-color", colours.card], ["stations", "circle-stroke-color", colours.text], ["station-texts", "text-color", colours.text], ["station-texts", "text-halo-color", colours.ground], ["station-texts", "text-halo-width", 2],
    ["sign-texts", "text-color", colours.text], ["pointed", "circle-stroke-color", colours.chosen],
  ];
  for (const [layer, property, value] of values) map.setPaintProperty(layer, /** @type {any} */ (property), value);
}

/** @param {MapLibreMap} map @param {string} name @param {any[]} features */
function fill(map, name, features) {
  const source = /** @type {import("maplibre-gl").GeoJSONSource} */ (map.getSource(name));
  source.setData({ type: "FeatureCollection", features });
}

/** @param {MapLibreMap} map @param {LaneLine[]} lanes @param {string} chosen Name of the lane that the strip shows. */
export function showLanes(map, lanes, chosen) {
  fill(map, "lanes", lanes.map(({ name, line }) => ({
    type: "Feature", properties: { name, chosen: name === chosen },
    geometry: { type: Array.isArray(line[0]?.[0]) ? "MultiLineString" : "LineString", coordinates: line },
  })));
}

/** @param {MapLibreMap} map @param {{ kind: string, ring_deg: number[][] }[]} areas */
export function showAreas(map, areas) {
  fill(map, "areas", areas.map(({ kind, ring_deg }) => ({ type: "Feature", properties: { kind }, geometry: { type: "Polygon", coordinates: [ring_deg] } })));
}

/** @param {MapLibreMap} map @param {Spot[]} spots */
export function showSpots(map, spots) {
  const features = spots.map(({ lon_deg, lat_deg, family = "", status = "planned", ...properties }) => ({
    type: "Feature", properties: { ...properties, family: FAMILIES.includes(family) ? family : "plate", status },
    geometry: { type: "Point", coordinates: [lon_deg, lat_deg] },
  }));
  fill(map, "spots", features.filter(({ properties }) => properties.kind === "marker"));
  fill(map, "stations", features.filter(({ properties }) => properties.kind === "station"));
  fill(map, "signs", features.filter(({ properties }) => properties.kind !== "marker" && properties.kind !== "station"));
}

/** @param {MapLibreMap} map @param {number[] | null} place Longitude and latitude. */
export function showPointed(map, place) {
  fill(map, "pointed", place ? [{ type: "Feature", properties: {}, geometry: { type: "Point", coordinates: place } }] : []);
}

/**
 * Tell what the pointer is at, and what is clicked.
 *
 * @param {MapLibreMap} map
 * @param {{ onPoint: (id: string | null) => void, onChoose: (id: string) => void }} events
 */
export function followPointer(map, { onPoint, onChoose }) {
  let before = /** @type {string | null} */ (null);
  /** @param {import("maplibre-gl").MapMouseEvent} event */
  const under = ({ point: { x, y } }) => {
    const found = map.queryRenderedFeatures([[x - NEAR_PX, y - NEAR_PX], [x + NEAR_PX, y + NEAR_PX]], { layers: ["spots", "signs"] });
    return found[0] ? String(found[0].properties.id) : null;
  };
  map.on("mousemove", (event) => {
    const id = under(event);
    map.getCanvas().style.cursor = id ? "pointer" : "";
    if (id !== before) onPoint(id);
    before = id;
  });
  map.on("mouseout", () => {
    if (before) onPoint(null);
    before = null;
  });
  map.on("click", (event) => {
    const id = under(event);
    if (id) onChoose(id);
  });
}
