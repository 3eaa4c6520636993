// The map of a decode: the vehicle's track, the lane, the markers that were read, and where the vehicle was at the
// timeline's time.

import { html } from "htm/preact";
import { useEffect } from "preact/hooks";

import { useMap } from "../components/use_map.js";
import { followColours } from "../map/create.js";
import { FAMILIES, pageColours } from "../map/symbols.js";
import { navigate } from "../router.js";
import { t } from "../texts/index.js";
import { positionAt } from "./decode_timeline.js";

const MAX_ZOOM = 19;

/** @param {any[]} features @returns {import("geojson").FeatureCollection} */
const collection = (features) => ({ type: "FeatureCollection", features });

/**
 * @param {{ sources: import("./decode_timeline.js").Source[], timeline: import("./decode_timeline.js").Timeline }} props
 */
export function DecodeMap({ sources, timeline }) {
  if (placesOf(sources).length) return html`<${PlacedMap} sources=${sources} timeline=${timeline} />`;
  return html`<div class="empty"><p class="empty-title">${t("decode.no_places")}</p><p class="hint">${t("decode.no_places_cure")}</p></div>`;
}

/** @param {{ sources: import("./decode_timeline.js").Source[], timeline: import("./decode_timeline.js").Timeline }} props */
function PlacedMap({ sources, timeline }) {
  const { box, ready, failed } = useMap(() => null, (made) => {
    addLayers(made);
    made.on("click", "decode-markers", (event) => {
      const id = event.features?.[0]?.properties.marker_id;
      if (id) navigate(`/markers/${id}`);
    });
  });
  const map = ready?.map ?? null;
  useEffect(() => {
    if (!ready) return;
    show(ready.map, sources);
    const bounds = new ready.maplibre.LngLatBounds();
    for (const place of placesOf(sources)) bounds.extend(/** @type {[number, number]} */ (place));
    ready.map.fitBounds(bounds, { padding: 48, maxZoom: MAX_ZOOM, animate: false });
  }, [ready, sources]);
  useEffect(() => {
    if (!map) return undefined;
    return timeline.cursor.subscribe((at) => {
      const found = positionAt(sources, at);
      setData(map, "decode-vehicle", found ? [{ type: "Feature", properties: { heading: found.heading_deg ?? 0, known: found.heading_deg !== null }, geometry: { type: "Point", coordinates: [found.lon_deg, found.lat_deg] } }] : []);
      if (found && !map.getBounds().contains([found.lon_deg, found.lat_deg])) map.panTo([found.lon_deg, found.lat_deg], { animate: false });
    });
  }, [map, timeline]);
  return html`
    <div class="map-frame decode-map">
      <div class="map" ref=${box}></div>
      ${failed && html`<p class="map-failed" role="status">${t("map.failed")} <span class="hint">${failed}</span></p>`}
      ${!map && !failed && html`<p class="map-failed loading" role="status">${t("load.loading")}</p>`}
      <${Where} sources=${sources} timeline=${timeline} />
    </div>
  `;
}

/** The position in numbers. @param {{ sources: import("./decode_timeline.js").Source[], timeline: import("./decode_timeline.js").Timeline }} props */
function Where({ sources, timeline }) {
  const found = positionAt(sources, timeline.cursor.value);
  return html`<p class="map-caption decode-where">${found ? `${found.lat_deg.toFixed(7)}, ${found.lon_deg.toFixed(7)}` : t("decode.no_place_now")}</p>`;
}

/** All places that are shown, longitude and latitude. @param {import("./decode_timeline.js").Source[]} sources @returns {number[][]} */
export function placesOf(sources) {
  const places = [];
  for (const { track, readings, lane } of sources) {
    for (const { geometry } of track) places.push(...(geometry.type === "Point" ? [geometry.coordinates] : geometry.coordinates));
    for (const { lon_deg, lat_deg } of readings) if (lon_deg !== null) places.push([lon_deg, lat_deg]);
    for (const { geometry } of lane) if (geometry?.type === "LineString") places.push(...geometry.coordinates);
  }
  return places;
}

/** @param {import("maplibre-gl").Map} map */
function addLayers(map) {
  for (const name of ["decode-lane", "decode-track", "decode-markers", "decode-vehicle"]) map.addSource(name, { type: "geojson", data: collection([]) });
  map.addImage("decode-arrow", arrow(), { pixelRatio: 2 });
  map.addLayer({ id: "decode-lane", type: "line", source: "decode-lane", paint: { "line-width": ["match", ["get", "kind"], "path", 3, 1.5], "line-dasharray": [3, 2] } });
  map.addLayer({ id: "decode-track", type: "line", source: "decode-track", layout: { "line-join": "round", "line-cap": "round" }, paint: { "line-width": 4 } });
  map.addLayer({ id: "decode-fixes", type: "circle", source: "decode-track", filter: ["==", ["geometry-type"], "Point"], paint: { "circle-radius": 5 } });
  map.addLayer({
    id: "decode-markers", type: "symbol", source: "decode-markers",
    layout: { "icon-image": ["concat", ["get", "family"], "-", ["get", "look"]], "icon-allow-overlap": true },
  });
  map.addLayer({
    id: "decode-codes", type: "symbol", source: "decode-markers", minzoom: 16,
    layout: { "text-field": ["get", "code"], "text-size": 11, "text-offset": [0, 1.4], "text-font": ["sans-serif"], "text-optional": true },
  });
  map.addLayer({ id: "decode-halo", type: "circle", source: "decode-vehicle", paint: { "circle-radius": 11, "circle-stroke-width": 2 } });
  map.addLayer({ id: "decode-vehicle", type: "symbol", source: "decode-vehicle", filter: ["get", "known"], layout: { "icon-image": "decode-arrow", "icon-rotate": ["get", "heading"], "icon-rotation-alignment": "map", "icon-allow-overlap": true } });
  const paint = () => {
    const colours = pageColours();
    /** @type {[string, string, string][]} */
    const values = [
      ["decode-lane", "line-color", colours.soft], ["decode-track", "line-color", colours.accent], ["decode-fixes", "circle-color", colours.accent],
      ["decode-codes", "text-color", colours.text], ["decode-codes", "text-halo-color", colours.ground],
      ["decode-halo", "circle-color", colours.chosen], ["decode-halo", "circle-stroke-color", colours.card],
    ];
    for (const [layer, property, value] of values) map.setPaintProperty(layer, /** @type {any} */ (property), value);
    map.setPaintProperty("decode-codes", "text-halo-width", 2);
  };
  paint();
  followColours(map, paint);
}

/** @param {import("maplibre-gl").Map} map @param {import("./decode_timeline.js").Source[]} sources */
function show(map, sources) {
  setData(map, "decode-track", sources.flatMap(({ track }) => track));
  setData(map, "decode-lane", sources.flatMap(({ lane }) => lane.filter((/** @type {any} */ { properties }) => properties.kind !== "marker")));
  const seen = new Map();
  for (const reading of sources.flatMap(({ readings }) => readings)) {
    if (reading.lon_deg === null) continue;
    const look = reading.outcome === "left-out" ? "suspect" : reading.registered ? "active" : "planned";
    const family = FAMILIES.includes(reading.family) ? reading.family : "plate";
    seen.set(reading.marker_id ?? `${reading.lon_deg} ${reading.lat_deg}`, {
      type: "Feature", properties: { family, look, code: reading.code ?? "", marker_id: reading.marker_id }, geometry: { type: "Point", coordinates: [reading.lon_deg, reading.lat_deg] },
    });
  }
  setData(map, "decode-markers", [...seen.values()]);
}

/** @param {import("maplibre-gl").Map} map @param {string} name @param {any[]} features */
function setData(map, name, features) {
  const source = /** @type {import("maplibre-gl").GeoJSONSource | undefined} */ (map.getSource(name));
  source?.setData(collection(features));
}

/** A white arrow that points up. */
function arrow() {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 32;
  const pen = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  pen.fillStyle = "#fff";
  for (const [x, y] of [[16, 4], [25, 26], [16, 21], [7, 26]]) pen.lineTo(x ?? 0, y ?? 0);
  pen.fill();
  return pen.getImageData(0, 0, 32, 32);
}
