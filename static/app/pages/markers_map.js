// The map of the markers' page: view and layers in the address, tools to measure and to select an area.

import { html } from "htm/preact";
import { useEffect, useRef, useState } from "preact/hooks";

import { Legend } from "../components/badges.js";
import { attempt } from "../components/notices.js";
import { useMap } from "../components/use_map.js";
import { codeOf, number } from "../format.js";
import { draw, length_m, ringOf, wktOf } from "../map/draw.js";
import { addMarkerLayers, findBounds, followClicks, setChosen, setPlaces, showRoads, showTiles } from "../map/markers.js";
import { query, setQuery } from "../router.js";
import { may } from "../session.js";
import { t } from "../texts/index.js";
import { isFiltered } from "./markers_filters.js";

/**
 * @typedef {import("./markers.js").Marker} Marker
 * @typedef {import("./markers_filters.js").Filters} Filters
 * @typedef {import("../map/markers.js").Place} Place
 * @typedef {[number, number, number, number]} Bounds
 */

const LAYERS = /** @type {const} */ (["roads", "retired", "plans"]);
const CHOSEN_ZOOM = 17;

/**
 * @param {{ filters: Filters, rows: Marker[], chosen: string | null, known?: Marker, onChoose: (id: string) => void }} props
 */
export function MarkerMap({ filters, rows, chosen, known, onChoose }) {
  const latest = useRef({ filters, rows, onChoose });
  latest.current = { filters, rows, onChoose };
  const layers = useRef(readLayers());
  layers.current = readLayers();
  const [shown, setShown] = useState(0);
  const redraw = useRef(() => {});
  const start = useRef(/** @type {{ bounds: Bounds | null, found: Promise<Bounds | null> | null }} */ ({ bounds: null, found: null }));
  useEffect(() => {
    if (!byTiles(filters) || readView()) return;
    start.current.found = findBounds(); // while the map is made
    start.current.found.then((bounds) => {
      start.current.bounds = bounds;
    }, () => {}); // the effect below awaits it again, and shows its error
  }, []);
  const { box, ready, failed } = useMap(readView, (map) => {
    if (start.current.bounds) fit(map, start.current.bounds); // before any tile is asked for
    addMarkerLayers(map);
    followClicks(map, (id) => latest.current.onChoose(id));
    redraw.current = showTiles(map, {
      layers: () => layers.current,
      accepts: () => acceptsOf(latest.current.filters),
      isOn: () => byTiles(latest.current.filters),
      onCount: setShown,
    });
    map.on("moveend", () => setQuery({ map: viewText(map) }));
    if (may("GET /v1/roads")) attempt(() => showRoads(map));
  });

  useEffect(() => {
    if (!ready) return;
    redraw.current();
    if (byTiles(filters)) return;
    setPlaces(ready.map, rows.map(placeOf));
    setShown(rows.length);
  }, [ready, rows, JSON.stringify(filters), [...layers.current].join()]);

  // with no view in the address, the map shows all markers; what a filter found is brought into view
  const look = (/** @type {Bounds | null} */ bounds) => {
    if (bounds && ready) fit(ready.map, bounds);
  };
  const places = () => rows.map(({ position }) => /** @type {[number, number]} */ ([position.lon_deg, position.lat_deg]));
  const showAll = () => attempt(async () => look(isFiltered(filters) ? boundsOf(places()) : await findBounds()));
  useEffect(() => {
    if (!ready || !byTiles(latest.current.filters) || readView()) return;
    if (!start.current.bounds) attempt(async () => look(await (start.current.found ?? findBounds())));
  }, [ready]);
  useEffect(() => {
    if (!ready || !rows.length || byTiles(filters)) return;
    const view = readView() && ready.map.getBounds();
    if (view && places().some((place) => view.contains(place))) return;
    look(boundsOf(places()));
  }, [ready, rows]);

  useEffect(() => {
    if (!ready) return;
    setChosen(ready.map, known ? [placeOf(known)] : []);
    if (!known) return;
    const place = /** @type {[number, number]} */ ([known.position.lon_deg, known.position.lat_deg]);
    if (!ready.map.getBounds().contains(place) || ready.map.getZoom() < 12) {
      ready.map.jumpTo({ center: place, zoom: Math.max(ready.map.getZoom(), CHOSEN_ZOOM) });
    }
  }, [ready, chosen, known?.position.lon_deg, known?.position.lat_deg, known?.status]);

  useArea(ready?.map ?? null, filters.polygon);

  return html`
    <div class="map-frame">
      <div class="map" ref=${box}></div>
      ${failed && html`<p class="map-failed" role="status">${t("map.failed")} <span class="hint">${failed}</span></p>`}
      ${!ready && !failed && html`<p class="map-failed loading" role="status">${t("load.loading")}</p>`}
      ${ready && html`<${Tools} map=${ready.map} onShowAll=${showAll} />`}
      <p class="map-caption" role="status">${t("map.count", { count: number(shown) })}</p>
    </div>
  `;
}

/** @param {import("maplibre-gl").Map} map @param {Bounds} bounds */
const fit = (map, bounds) => map.fitBounds(bounds, { padding: 60, maxZoom: CHOSEN_ZOOM, animate: false });

/** @param {[number, number][]} places @returns {Bounds | null} */
function boundsOf(places) {
  if (!places.length) return null;
  const [west, east] = span(places.map(([lon_deg]) => lon_deg));
  const [south, north] = span(places.map(([, lat_deg]) => lat_deg));
  return [west, south, east, north];
}

/** @param {number[]} values @returns {[number, number]} */
const span = (values) => values.reduce(([low, high], value) => [Math.min(low, value), Math.max(high, value)], [Infinity, -Infinity]);

/** Whether tiles have what a filter asks for; other filters are shown by their rows. @param {Filters} filters */
const byTiles = ({ code, road, bbox, polygon }) => !code && !road && !bbox && !polygon;

/** @param {Filters} filters @returns {(place: { family: string, status: string }) => boolean} */
const acceptsOf = ({ family, status }) => (place) => (!family || place.family === family) && (!status || place.status === status);

/** @param {Marker} marker @returns {Place} */
const placeOf = (marker) => ({
  id: marker.id, family: marker.family, status: marker.status, code: codeOf(marker),
  lon_deg: marker.position.lon_deg, lat_deg: marker.position.lat_deg,
});

function readView() {
  const [lon_deg, lat_deg, zoom] = (query.peek().get("map") ?? "").split(",").map(Number);
  if (lon_deg === undefined || lat_deg === undefined || zoom === undefined) return null;
  return [lon_deg, lat_deg, zoom].every(Number.isFinite) && Math.abs(lat_deg) <= 90 ? { lon_deg, lat_deg, zoom } : null;
}

/** @param {import("maplibre-gl").Map} map */
function viewText(map) {
  const { lng, lat } = map.getCenter();
  return `${lng.toFixed(6)},${lat.toFixed(6)},${map.getZoom().toFixed(2)}`;
}

/** @returns {Set<string>} */
const readLayers = () => new Set((query.value.get("layers") ?? "roads").split(",").filter(Boolean));

/** The outline of the area that markers are selected by. @param {import("maplibre-gl").Map | null} map @param {string} [polygon] */
function useArea(map, polygon) {
  useEffect(() => {
    if (!map) return;
    const ring = polygon ? ringOf(polygon) : [];
    /** @type {any} */
    const data = { type: "Feature", properties: {}, geometry: { type: "LineString", coordinates: ring } };
    const source = /** @type {import("maplibre-gl").GeoJSONSource | undefined} */ (map.getSource("area"));
    if (source) source.setData(data);
    else {
      map.addSource("area", { type: "geojson", data });
      map.addLayer({ id: "area", type: "line", source: "area", paint: { "line-color": "#b3541e", "line-width": 2, "line-dasharray": [2, 2] } });
    }
  }, [map, polygon]);
}

/** @param {{ map: import("maplibre-gl").Map, onShowAll: () => void }} props */
function Tools({ map, onShowAll }) {
  const [tool, setTool] = useState(/** @type {import("../map/draw.js").Shape | null} */ (null));
  const [measured, setMeasured] = useState(/** @type {number | null} */ (null));
  useEffect(() => {
    if (!tool) return undefined;
    let end = () => {};
    let stopped = false;
    setMeasured(tool === "linestring" ? 0 : null);
    attempt(async () => {
      end = await draw(map, tool, {
        onChange: (coordinates) => tool === "linestring" && setMeasured(length_m(coordinates)),
        onFinish: (coordinates) => {
          if (tool === "linestring") return;
          setQuery({ polygon: wktOf(coordinates), bbox: null }, { replace: false });
          setTool(null);
        },
      });
      if (stopped) end();
    });
    return () => {
      stopped = true;
      end();
      setMeasured(null);
    };
  }, [tool]);
  /** @param {import("../map/draw.js").Shape} shape */
  const button = (shape, /** @type {string} */ text) => html`<button type="button" class="quiet" aria-pressed=${tool === shape} onClick=${() => setTool(tool === shape ? null : shape)}>${text}</button>`;
  return html`
    <div class="map-tools">
      <button type="button" class="quiet" onClick=${onShowAll}>${t("map.fit")}</button>
      ${button("rectangle", t("map.box"))}
      ${button("polygon", t("map.polygon"))}
      ${button("linestring", t("map.measure"))}
      <${LayerChoice} />
      <details class="choice"><summary>${t("legend.title")}</summary><div class="choice-list"><${Legend} /></div></details>
    </div>
    ${tool && html`<p class="map-hint" role="status">${measured !== null ? t("map.measured", { distance: number(measured, measured < 100 ? 2 : 0, "m") }) : t(tool === "rectangle" ? "map.box_hint" : "map.polygon_hint")}</p>`}
  `;
}

function LayerChoice() {
  const on = readLayers();
  /** @param {string} name @param {boolean} wanted */
  const choose = (name, wanted) => {
    const next = LAYERS.filter((layer) => (layer === name ? wanted : on.has(layer)));
    setQuery({ layers: next.join() === "roads" ? null : next.join() || "none" });
  };
  return html`
    <details class="choice">
      <summary>${t("map.layers")}</summary>
      <div class="choice-list">
        ${LAYERS.map((name) => html`<label class="check"><input type="checkbox" checked=${on.has(name)} onChange=${(/** @type {any} */ event) => choose(name, event.currentTarget.checked)} /> ${t(`layer.${name}`)}</label>`)}
      </div>
    </details>
  `;
}
