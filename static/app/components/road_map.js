// A map of lanes with markers and checks. `onPoint` is called with the one under the pointer; `pointed` is highlighted.

import { html } from "htm/preact";
import { useEffect, useRef } from "preact/hooks";

import { addPlanLayers, followPointer, showAreas, showLanes, showPointed, showSpots } from "../map/plan_layers.js";
import { query, setQuery } from "../router.js";
import { t } from "../texts/index.js";
import { useMap } from "./use_map.js";

const CLOSEST_ZOOM = 18;

/**
 * @param {object} props
 * @param {import("../map/plan_layers.js").LaneLine[]} props.lanes
 * @param {string} [props.chosenLane]
 * @param {import("../map/plan_layers.js").Spot[]} props.spots
 * @param {{ kind: string, ring_deg: number[][] }[]} [props.areas]
 * @param {number[] | null} [props.pointed] Longitude and latitude of what is marked.
 * @param {(id: string | null) => void} [props.onPoint]
 * @param {(id: string) => void} [props.onChoose]
 * @param {string} props.caption
 */
export function RoadMap({ lanes, chosenLane = "", spots, areas = [], pointed = null, onPoint, onChoose, caption }) {
  const latest = useRef({ onPoint, onChoose });
  latest.current = { onPoint, onChoose };
  const { box, ready, failed } = useMap(readView, (map) => {
    addPlanLayers(map);
    followPointer(map, { onPoint: (id) => latest.current.onPoint?.(id), onChoose: (id) => latest.current.onChoose?.(id) });
    map.on("moveend", (event) => {
      if (/** @type {any} */ (event).originalEvent) setQuery({ map: viewText(map) });
    });
  });
  const fit = () => {
    if (!ready) return;
    const bounds = new ready.maplibre.LngLatBounds();
    for (const place of placesOf(lanes)) bounds.extend(/** @type {[number, number]} */ (place.slice(0, 2)));
    for (const { lon_deg, lat_deg } of spots) bounds.extend([lon_deg, lat_deg]);
    if (!bounds.isEmpty()) ready.map.fitBounds(bounds, { padding: 50, maxZoom: CLOSEST_ZOOM, animate: false });
  };
  const extent = lanes.map(({ name, line }) => `${name} ${line.length} ${line[0]}`).join();
  useEffect(() => {
    if (ready && !readView()) fit();
  }, [ready, extent]);
  useEffect(() => {
    if (ready) showLanes(ready.map, lanes, chosenLane);
  }, [ready, extent, chosenLane]);
  useEffect(() => {
    if (ready) showAreas(ready.map, areas);
  }, [ready, areas.length]);
  useEffect(() => {
    if (ready) showSpots(ready.map, spots);
  }, [ready, spots]);
  useEffect(() => {
    if (ready) showPointed(ready.map, pointed);
  }, [ready, pointed?.[0], pointed?.[1]]);
  return html`
    <div class="map-frame road-map">
      <div class="map" ref=${box}></div>
      ${failed && html`<p class="map-failed" role="status">${t("map.failed")} <span class="hint">${failed}</span></p>`}
      ${!ready && !failed && html`<p class="map-failed loading" role="status">${t("load.loading")}</p>`}
      ${ready && html`<div class="map-tools"><button type="button" class="quiet" onClick=${() => {
        fit();
        setQuery({ map: null });
      }}>${t("map.fit_road")}</button></div>`}
      <p class="map-caption">${caption}</p>
    </div>
  `;
}

/** @param {import("../map/plan_layers.js").LaneLine[]} lanes @returns {number[][]} */
const placesOf = (lanes) => lanes.flatMap(({ line }) => /** @type {any} */ (Array.isArray(line[0]?.[0]) ? line.flat() : line));

function readView() {
  const [lon_deg = NaN, lat_deg = NaN, zoom = NaN] = (query.peek().get("map") ?? "").split(",").map(Number);
  return [lon_deg, lat_deg, zoom].every(Number.isFinite) && Math.abs(lat_deg) <= 90 && query.peek().get("map") ? { lon_deg, lat_deg, zoom } : null;
}

/** @param {import("maplibre-gl").Map} map */
function viewText(map) {
  const { lng, lat } = map.getCenter();
  return `${lng.toFixed(6)},${lat.toFixed(6)},${map.getZoom().toFixed(2)}`;
}
