// A map: MapLibre, loaded when a page needs it, with our base map and colours. It asks no other host than those that
// the operator configured, and draws texts with the fonts of the reader's computer.

import { addStyleSheet } from "../components/style_sheet.js";
import { key, pageSettings } from "../session.js";
import { t } from "../texts/index.js";
import { gridLines } from "./grid.js";
import { FAMILIES, pageColours, STATUSES, symbolPicture } from "./symbols.js";

/** @typedef {import("maplibre-gl").Map} MapLibreMap */
/** @typedef {{ lon_deg: number, lat_deg: number, zoom: number }} View */

/** @type {Promise<typeof import("maplibre-gl")> | null} */
let loading = null;

/** The library, with its worker and its style sheet. */
export function loadMapLibre() {
  loading ??= import("maplibre-gl").then(async (maplibre) => {
    maplibre.setWorkerUrl(import.meta.resolve("maplibre-gl/worker"));
    await addStyleSheet(import.meta.resolve("maplibre-gl/style"));
    return maplibre;
  });
  return loading;
}

/**
 * @param {HTMLElement} container
 * @param {View | null} view Where to look; null: the whole world.
 * @param {string} [title] What people hear who do not see it.
 * @returns {Promise<{ map: MapLibreMap, maplibre: typeof import("maplibre-gl") }>} Once its style is there.
 */
export async function createMap(container, view, title = t("map.title")) {
  const maplibre = await loadMapLibre();
  const map = new maplibre.Map({
    container,
    style: await baseStyle(maplibre),
    center: view ? [view.lon_deg, view.lat_deg] : [0, 25],
    zoom: view?.zoom ?? 1,
    maxZoom: 22,
    attributionControl: false,
    dragRotate: false,
    pitchWithRotate: false,
    fadeDuration: 0,
    locale: {
      "NavigationControl.ZoomIn": t("map.zoom_in"),
      "NavigationControl.ZoomOut": t("map.zoom_out"),
      "Map.Title": title,
    },
    transformRequest: (url) => {
      const ours = new URL(url, window.location.href).origin === window.location.origin;
      if (!ours || !key.peek()) return { url };
      // without "omit" a browser asks for a password of its own when the key is refused
      return { url, headers: { Authorization: `Bearer ${key.peek()}` }, credentials: /** @type {any} */ ("omit") };
    },
  });
  map.on("error", ({ error }) => {
    if (/** @type {any} */ (error)?.status !== 403) console.error(error); // the page shows that the key does not allow it
  });
  map.touchZoomRotate.disableRotation();
  map.addControl(new maplibre.NavigationControl({ showCompass: false }), "top-right");
  map.addControl(new maplibre.ScaleControl({ maxWidth: 120 }), "bottom-left");
  if (pageSettings.value?.base_map?.attribution) map.addControl(new maplibre.AttributionControl({ compact: true }), "bottom-left");
  await map.once("load");
  addSymbols(map);
  followColours(map, () => paintBase(map));
  drawGrid(map);
  return { map, maplibre };
}

/** @param {typeof import("maplibre-gl")} maplibre */
async function baseStyle(maplibre) {
  const colours = pageColours();
  /** @type {import("maplibre-gl").StyleSpecification} */
  const style = {
    version: 8,
    sources: { grid: { type: "geojson", data: { type: "FeatureCollection", features: [] } } },
    layers: [{ id: "ground", type: "background", paint: { "background-color": colours.ground } }],
  };
  const base = pageSettings.value?.base_map;
  if (base?.kind === "raster") {
    style.sources.base = { type: "raster", tiles: [new URL(base.url, window.location.href).href.replaceAll("%7B", "{").replaceAll("%7D", "}")], tileSize: 256, attribution: escaped(base.attribution) };
    style.layers.push({ id: "base", type: "raster", source: "base", paint: { "raster-opacity": 0.8 } });
  } else if (base) {
    const { addPmtilesBase } = await import("./base_map.js");
    await addPmtilesBase(maplibre, style, base.url, escaped(base.attribution), colours);
  }
  style.layers.push(
    { id: "grid", type: "line", source: "grid", paint: { "line-color": colours.line, "line-width": 1 } },
    {
      id: "grid-labels", type: "symbol", source: "grid",
      filter: ["has", "label"],
      layout: { "text-field": ["get", "label"], "text-size": 11, "text-anchor": ["get", "anchor"], "text-font": ["sans-serif"] },
      paint: { "text-color": colours.soft, "text-halo-color": colours.ground, "text-halo-width": 2 },
    },
  );
  return style;
}

/** MapLibre draws attributions as markup. @param {string} text */
const escaped = (text) => text.replace(/[&<>"']/g, (sign) => `&#${sign.charCodeAt(0)};`);

/** @param {MapLibreMap} map */
function addSymbols(map) {
  const colours = pageColours();
  for (const family of FAMILIES) {
    for (const status of STATUSES) {
      const name = `${family}-${status}`;
      if (map.hasImage(name)) map.removeImage(name);
      map.addImage(name, symbolPicture(family, status, colours), { pixelRatio: 2 });
    }
  }
}

/**
 * Paint again whenever the reader changes between light and dark.
 *
 * @param {MapLibreMap} map
 * @param {() => void} paint
 */
export function followColours(map, paint) {
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  dark.addEventListener("change", paint);
  map.once("remove", () => dark.removeEventListener("change", paint));
}

/** @param {MapLibreMap} map */
function paintBase(map) {
  const colours = pageColours();
  map.setPaintProperty("ground", "background-color", colours.ground);
  map.setPaintProperty("grid", "line-color", colours.line);
  map.setPaintProperty("grid-labels", "text-color", colours.soft);
  map.setPaintProperty("grid-labels", "text-halo-color", colours.ground);
  addSymbols(map);
}

/** @param {MapLibreMap} map */
function drawGrid(map) {
  const draw = () => {
    const source = /** @type {import("maplibre-gl").GeoJSONSource} */ (map.getSource("grid"));
    const bounds = map.getBounds();
    source.setData(gridLines(bounds.getWest(), bounds.getSouth(), bounds.getEast(), bounds.getNorth()));
  };
  map.on("moveend", draw);
  draw();
}
