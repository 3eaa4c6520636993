// Markers on the map: from the registry's vector tiles, or from rows that a filter found. Markers close together are one
// circle with their number; where a tile has thousands, the server sends groups with their numbers in place of the
// markers. Roads and planned markers are layers of their own.

import { api, ok, request } from "../api/client.js";
import { followColours } from "./create.js";
import { FAMILIES, pageColours, STATUSES } from "./symbols.js";

/** @typedef {import("maplibre-gl").Map} MapLibreMap */
/**
 * A marker, or a group of several markers.
 *
 * @typedef {{ id: string, family: string, status: string, code: string, lon_deg: number, lat_deg: number }} Place
 * @typedef {{ count: number, suspect: number, lon_deg: number, lat_deg: number }} Group
 */

const TILE_ZOOM = 18; // 4 cm on the ground at most
const CLUSTER_PX = 34;
const MAX_ROADS = 200;
const AT_ONCE = 8; // requests of roads
const TILES = { markers: "tiles-markers", retired_markers: "tiles-retired", plans: "tiles-plans" };

/** @type {import("maplibre-gl").ExpressionSpecification} */
const COUNT = ["get", "count"];
/** @type {import("maplibre-gl").ExpressionFilterSpecification} */
const SEVERAL = [">", COUNT, 1];
/** @type {import("maplibre-gl").ExpressionSpecification} */
const SHORT_COUNT = [
  "case",
  [">=", COUNT, 1_000_000], ["concat", ["number-format", ["/", COUNT, 1_000_000], { "max-fraction-digits": 1 }], "M"],
  [">=", COUNT, 10_000], ["concat", ["number-format", ["/", COUNT, 1000], { "max-fraction-digits": 0 }], "k"],
  [">=", COUNT, 1000], ["concat", ["number-format", ["/", COUNT, 1000], { "max-fraction-digits": 1 }], "k"],
  ["to-string", COUNT],
];

/** @param {string} collection */
const tileUrl = (collection) => `${window.location.origin}/ogc/collections/${collection}/tiles/WebMercatorQuad/{z}/{y}/{x}?groups=true`;

/** @returns {import("geojson").FeatureCollection} */
const empty = () => ({ type: "FeatureCollection", features: [] });

/**
 * Add the layers, with nothing in them yet.
 *
 * @param {MapLibreMap} map
 */
export function addMarkerLayers(map) {
  map.addSource("roads", { type: "geojson", data: empty() });
  for (const [collection, source] of Object.entries(TILES)) {
    map.addSource(source, { type: "vector", tiles: [tileUrl(collection)], maxzoom: TILE_ZOOM });
  }
  map.addSource("markers", {
    type: "geojson", data: empty(), cluster: true, clusterRadius: CLUSTER_PX, clusterMaxZoom: 16,
    clusterProperties: { count: ["+", ["get", "count"]], suspect: ["+", ["get", "suspect"]] },
  });
  map.addSource("chosen", { type: "geojson", data: empty() });
  map.addLayer({ id: "roads", type: "line", source: "roads", layout: { "line-cap": "round", "line-join": "round" }, paint: { "line-width": ["interpolate", ["linear"], ["zoom"], 8, 2, 18, 8] } });
  map.addLayer({ id: "road-names", type: "symbol", source: "roads", layout: { "text-field": ["get", "name"], "text-size": 12, "symbol-placement": "line", "text-font": ["sans-serif"] } });
  for (const [collection, source] of Object.entries(TILES)) {
    // layers that draw nothing: without one, the tiles of a source are not loaded
    map.addLayer({ id: source, type: "circle", source, "source-layer": collection, paint: { "circle-opacity": 0 }, layout: { visibility: collection === "markers" ? "visible" : "none" } });
  }
  map.addLayer({ id: "plans", type: "circle", source: "tiles-plans", "source-layer": "plans", layout: { visibility: "none" }, paint: { "circle-radius": 4, "circle-opacity": 0, "circle-stroke-width": 2 } });
  map.addLayer({ id: "clusters", type: "circle", source: "markers", filter: SEVERAL, paint: { "circle-radius": ["step", ["get", "count"], 13, 10, 16, 100, 20, 1000, 24], "circle-stroke-width": 2 } });
  map.addLayer({
    id: "cluster-counts", type: "symbol", source: "markers", filter: SEVERAL,
    layout: {
      "text-field": ["concat", SHORT_COUNT, ["case", [">", ["get", "suspect"], 0], " !", ""]],
      "text-size": 12, "text-font": ["sans-serif"], "text-allow-overlap": true,
    },
  });
  map.addLayer({
    id: "marker-symbols", type: "symbol", source: "markers", filter: ["!", SEVERAL],
    layout: {
      "icon-image": ["concat", ["get", "family"], "-", ["get", "status"]],
      "icon-size": ["interpolate", ["linear"], ["zoom"], 12, 0.7, 18, 1], "icon-allow-overlap": true,
    },
  });
  map.addLayer({
    id: "marker-codes", type: "symbol", source: "markers", minzoom: 17, filter: ["!", SEVERAL],
    layout: { "text-field": ["get", "code"], "text-size": 11, "text-offset": [0, 1.4], "text-font": ["sans-serif"], "text-optional": true },
  });
  map.addLayer({ id: "chosen", type: "circle", source: "chosen", paint: { "circle-radius": 16, "circle-opacity": 0, "circle-stroke-width": 3 } });
  paint(map);
  followColours(map, () => paint(map));
}

/** @param {MapLibreMap} map */
function paint(map) {
  const colours = pageColours();
  /** @type {[string, string, any][]} */
  const values = [
    ["roads", "line-color", colours.road],
    ["road-names", "text-color", colours.text], ["road-names", "text-halo-color", colours.ground], ["road-names", "text-halo-width", 2],
    ["plans", "circle-stroke-color", colours.soft],
    ["clusters", "circle-color", colours.card], ["clusters", "circle-stroke-color", ["case", [">", ["get", "suspect"], 0], colours.warn, colours.accent]],
    ["cluster-counts", "text-color", colours.text],
    ["marker-codes", "text-color", colours.text], ["marker-codes", "text-halo-color", colours.ground], ["marker-codes", "text-halo-width", 2],
    ["chosen", "circle-stroke-color", colours.chosen],
  ];
  for (const [layer, property, value] of values) map.setPaintProperty(layer, /** @type {any} */ (property), value);
}

/**
 * Show markers of the tiles that a test accepts, now and whenever tiles arrive.
 *
 * @param {MapLibreMap} map
 * @param {{ accepts: () => (place: { family: string, status: string }) => boolean, layers: () => Set<string>, isOn: () => boolean, onCount: (count: number) => void }} options
 * @returns {() => void} Call it when the test or the layers have changed.
 */
export function showTiles(map, { accepts, layers, isOn, onCount }) {
  let before = "";
  let waiting = 0;
  const draw = () => {
    waiting = 0;
    const shown = layers();
    map.setLayoutProperty("tiles-retired", "visibility", isOn() && shown.has("retired") ? "visible" : "none");
    for (const layer of ["plans", "tiles-plans"]) map.setLayoutProperty(layer, "visibility", shown.has("plans") ? "visible" : "none");
    for (const layer of ["roads", "road-names"]) map.setLayoutProperty(layer, "visibility", shown.has("roads") ? "visible" : "none");
    if (!isOn()) {
      before = "";
      return;
    }
    const collections = shown.has("retired") ? /** @type {const} */ (["markers", "retired_markers"]) : /** @type {const} */ (["markers"]);
    const places = placesOf(collections.flatMap((name) => map.querySourceFeatures(TILES[name], { sourceLayer: name })), accepts());
    const groups = groupsOf(collections.flatMap((name) => map.querySourceFeatures(TILES[name], { sourceLayer: `${name}_groups` })), accepts());
    const signature = `${places.map(({ id }) => id).sort().join()} ${groups.map(({ count, lon_deg, lat_deg }) => `${count} ${lon_deg} ${lat_deg}`).sort().join()}`;
    if (signature === before) return;
    before = signature;
    setPlaces(map, places, groups);
    onCount(places.length + groups.reduce((sum, { count }) => sum + count, 0));
  };
  const soon = () => {
    if (!waiting) waiting = window.setTimeout(draw, 100);
  };
  map.on("sourcedata", (event) => {
    if (event.sourceId.startsWith("tiles-")) soon();
  });
  map.on("moveend", soon);
  draw();
  return () => {
    before = "";
    draw();
  };
}

/**
 * @param {import("maplibre-gl").MapGeoJSONFeature[] | import("maplibre-gl").GeoJSONFeature[]} features
 * @param {(place: Place) => boolean} accepts
 */
function placesOf(features, accepts) {
  /** @type {Map<string, Place>} */
  const places = new Map();
  for (const feature of features) {
    if (feature.geometry.type !== "Point") continue;
    const [lon_deg = 0, lat_deg = 0] = feature.geometry.coordinates;
    const { id, family, status, code } = feature.properties;
    const place = { id, family, status, code, lon_deg, lat_deg };
    if (!places.has(id) && accepts(place)) places.set(id, place);
  }
  return [...places.values()];
}

/**
 * Groups of the tiles, with as many markers as a test accepts. Their properties are described in docs/ogc.md.
 *
 * @param {import("maplibre-gl").GeoJSONFeature[]} features
 * @param {(place: { family: string, status: string }) => boolean} accepts
 * @returns {Group[]}
 */
function groupsOf(features, accepts) {
  /** @type {Map<string, Group>} */
  const groups = new Map();
  for (const { geometry, properties } of features) {
    if (geometry.type !== "Point") continue;
    const [lon_deg = 0, lat_deg = 0] = geometry.coordinates;
    const group = { count: 0, suspect: 0, lon_deg, lat_deg };
    for (const [name, count] of Object.entries(properties)) {
      const [family = "", status] = name.split("_");
      if (status === undefined || !accepts({ family, status })) continue;
      group.count += count;
      if (status === "suspect") group.suspect += count;
    }
    if (group.count) groups.set(`${lon_deg} ${lat_deg}`, group);
  }
  return [...groups.values()];
}

/**
 * @param {MapLibreMap} map
 * @param {Place[]} places
 * @param {Group[]} [groups]
 */
export function setPlaces(map, places, groups = []) {
  const source = /** @type {import("maplibre-gl").GeoJSONSource} */ (map.getSource("markers"));
  source.setData({ type: "FeatureCollection", features: [...places.map(featureOf), ...groups.map(pointOf)] });
}

/**
 * @param {MapLibreMap} map
 * @param {Place[]} places
 */
export function setChosen(map, places) {
  const source = /** @type {import("maplibre-gl").GeoJSONSource} */ (map.getSource("chosen"));
  source.setData({ type: "FeatureCollection", features: places.map(featureOf) });
}

/** @param {Place} place @returns {import("geojson").Feature} */
const featureOf = (place) => pointOf({
  ...place,
  family: FAMILIES.includes(place.family) ? place.family : "plate",
  status: STATUSES.includes(place.status) ? place.status : "planned",
  count: 1,
  suspect: place.status === "suspect" ? 1 : 0,
});

/** @param {{ lon_deg: number, lat_deg: number } & Record<string, any>} place @returns {import("geojson").Feature} */
const pointOf = ({ lon_deg, lat_deg, ...properties }) => ({
  type: "Feature", properties, geometry: { type: "Point", coordinates: [lon_deg, lat_deg] },
});

/** The registered roads. @param {MapLibreMap} map */
export async function showRoads(map) {
  const { items } = await ok(api.GET("/v1/roads", { params: { query: { limit: MAX_ROADS } } }));
  const roads = [];
  for (let k = 0; k < items.length; k += AT_ONCE) {
    const some = items.slice(k, k + AT_ONCE).map(({ id }) => ok(api.GET("/v1/roads/{road_id}", { params: { path: { road_id: id ?? "" } } })));
    roads.push(...(await Promise.all(some)));
  }
  const source = /** @type {import("maplibre-gl").GeoJSONSource | undefined} */ (map.getSource("roads"));
  source?.setData({
    type: "FeatureCollection",
    features: roads.map((road) => ({ type: "Feature", properties: { name: road.name }, geometry: /** @type {any} */ (road.geometry) })),
  });
}

/**
 * West, south, east and north of all markers; null without any. [deg]
 *
 * @returns {Promise<[number, number, number, number] | null>}
 */
export async function findBounds() {
  const { bounds } = await (await request("/ogc/collections/markers/tiles/WebMercatorQuad/tilejson")).json();
  return bounds ?? null;
}

/**
 * A click on a marker chooses it, one on a circle goes closer.
 *
 * @param {MapLibreMap} map
 * @param {(id: string) => void} onChoose
 */
export function followClicks(map, onChoose) {
  map.on("click", "marker-symbols", (event) => {
    const id = event.features?.[0]?.properties.id;
    if (typeof id === "string") onChoose(id);
  });
  map.on("click", "clusters", async (event) => {
    const feature = event.features?.[0];
    if (feature?.geometry.type !== "Point") return;
    const source = /** @type {import("maplibre-gl").GeoJSONSource} */ (map.getSource("markers"));
    const id = feature.properties.cluster_id; // a group of the server has none
    const zoom = id === undefined ? map.getZoom() + 2 : (await source.getClusterExpansionZoom(id)) + 0.5;
    map.easeTo({ center: /** @type {[number, number]} */ (feature.geometry.coordinates), zoom, animate: !reducedMotion() });
  });
  for (const layer of ["marker-symbols", "clusters"]) {
    map.on("mouseenter", layer, () => {
      map.getCanvas().style.cursor = "pointer";
    });
    map.on("mouseleave", layer, () => {
      map.getCanvas().style.cursor = "";
    });
  }
}

export const reducedMotion = () => window.matchMedia("(prefers-reduced-motion: reduce)").matches;
