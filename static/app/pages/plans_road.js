// The road of a plan: one that is there already, a file, a line that is drawn on the map, or a registered road.

import { html } from "htm/preact";
import { useEffect, useId, useState } from "preact/hooks";

import { api, ok, page, Problem, request } from "../api/client.js";
import { DropArea } from "../components/drop.js";
import { bodyOf, FormFrame, Group, loadSchema, SchemaField, SelectField, TextField, useForm } from "../components/form.js";
import { Shown, useLoad } from "../components/load.js";
import { attempt } from "../components/notices.js";
import { useMap } from "../components/use_map.js";
import { number } from "../format.js";
import { draw, length_m } from "../map/draw.js";
import { addPlanLayers, showLanes } from "../map/plan_layers.js";
import { may } from "../session.js";
import { t } from "../texts/index.js";

const FORMATS = ".geojson,.json,.gpkg,.zip,.xml,.landxml,.dxf,.osm,.xodr";
const DECLARED = ["crs", "unit", "realization", "epoch", "vertical_datum", "height_unit", "ignore_heights", "bearing_deg"];
export const WAYS = /** @type {const} */ (["file", "draw", "registered"]);

/** @typedef {import("../api/schema.js").components["schemas"]["AlignmentDocument"]} Alignment */

/**
 * @param {{ way: string, onWay: (way: string) => void, onDone: (alignment: Alignment) => void }} props
 */
export function RoadForm({ way, onWay, onDone }) {
  const ways = WAYS.filter((name) => name !== "registered" || may("GET /v1/roads"));
  return html`
    <div class="segments" role="group" aria-label=${t("road_form.way")}>
      ${ways.map((name) => html`<button type="button" class="quiet" aria-pressed=${way === name} onClick=${() => onWay(name)}>${t(`road_form.${name}`)}</button>`)}
    </div>
    ${way === "draw" ? html`<${DrawForm} onDone=${onDone} />` : way === "registered" ? html`<${RegisteredForm} onDone=${onDone} />` : html`<${FileForm} onDone=${onDone} />`}
  `;
}

/** @param {Blob} file @param {string} name @param {any} declaration @returns {Promise<Alignment>} */
async function send(file, name, declaration) {
  const parts = new FormData();
  parts.append("file", file, name);
  parts.append("declaration", JSON.stringify(declaration));
  return (await request("/v1/alignments", { method: "POST", body: parts })).json();
}

/** @param {{ onDone: (alignment: Alignment) => void }} props */
function FileForm({ onDone }) {
  const id = useId();
  const form = useForm({ name: "" });
  const [file, setFile] = useState(/** @type {File | null} */ (null));
  const schema = useLoad(() => loadSchema("AlignmentIn"), []);
  /** @param {File | undefined} chosen */
  const take = (chosen) => {
    if (!chosen) return;
    setFile(chosen);
    if (!form.values.name) form.set("name", chosen.name.replace(/\.[^.]+$/, "").slice(0, 80));
  };
  const submit = async () => {
    if (!file) throw new Problem({ title: t("road_form.no_file"), detail: "", field: "file", limit: t("road_form.formats"), cure: t("road_form.no_file_cure") });
    const { origin_lon, origin_lat, ...values } = form.values;
    const body = bodyOf(values, schema.data ?? undefined);
    if (String(origin_lon ?? "").trim() || String(origin_lat ?? "").trim()) body.origin = [Number(origin_lon), Number(origin_lat)];
    onDone(await send(file, file.name, body));
  };
  const wrong = form.errors.file;
  return html`<${Shown} of=${schema}>${(/** @type {any} */ root) => html`
    <${FormFrame} form=${form} onSubmit=${submit} button=${t("road_form.upload")}>
      <${DropArea} onFiles=${(/** @type {File[]} */ files) => take(files[0])}>
        <label for=${id}>${t("road_form.drop")}</label>
        <input id=${id} type="file" name="file" accept=${FORMATS} aria-invalid=${wrong ? "true" : undefined} aria-describedby=${`${id}-note`} onChange=${(/** @type {any} */ event) => take(event.currentTarget.files[0])} />
        <p class=${wrong ? "field-error" : "hint"} id=${`${id}-note`}>${wrong ?? (file ? file.name : t("road_form.formats"))}</p>
      </${DropArea}>
      <div class="group"><${TextField} form=${form} path="name" label=${t("road_form.name")} placeholder="L 560, km 12 to 14" required /></div>
      <details class="more" open=${[...DECLARED, "origin"].some((path) => form.errors[path])}>
        <summary>${t("road_form.declared")}</summary>
        <p class="hint">${t("road_form.declared_hint")}</p>
        <div class="group">
          ${DECLARED.map((path) => html`<${SchemaField} form=${form} schema=${root} path=${path} />`)}
          <${TextField} form=${form} path="origin_lon" label=${t("road_form.origin_lon")} inputmode="decimal" />
          <${TextField} form=${form} path="origin_lat" label=${t("road_form.origin_lat")} inputmode="decimal" />
        </div>
        ${form.errors.origin && html`<p class="field-error">${form.errors.origin}</p>`}
      </details>
    </${FormFrame}>
  `}</${Shown}>`;
}

/** @param {{ onDone: (alignment: Alignment) => void }} props */
function DrawForm({ onDone }) {
  const form = useForm({ name: "", width_m: "3.5", speed_limit_kmh: "70", vertices: "" });
  const places = placesOf(String(form.values.vertices ?? ""));
  const submit = async () => {
    if (places.length < 2) throw new Problem({ title: t("road_form.no_line"), detail: t("road_form.no_line_detail"), field: "vertices", limit: t("road_form.no_line_limit"), cure: t("road_form.no_line_cure") });
    const numbers = Object.fromEntries(["width_m", "speed_limit_kmh"].map((name) => [name, Number(String(form.values[name]).replace(",", "."))]));
    const feature = { type: "Feature", properties: { lane: "1", ...numbers }, geometry: { type: "LineString", coordinates: places } };
    const file = new Blob([JSON.stringify({ type: "FeatureCollection", features: [feature] })], { type: "application/geo+json" });
    onDone(await send(file, "drawn.geojson", { name: String(form.values.name ?? "").trim() }));
  };
  return html`
    <${FormFrame} form=${form} onSubmit=${submit} button=${t("road_form.use_line")}>
      <${DrawMap} places=${places} onDrawn=${(/** @type {number[][]} */ line) => form.set("vertices", line.map(([lon = 0, lat = 0]) => `${lon.toFixed(7)}, ${lat.toFixed(7)}`).join("\n"))} />
      <div class="group">
        <${TextField} form=${form} path="name" label=${t("road_form.name")} required />
        <${TextField} form=${form} path="width_m" label=${t("field.width_m")} inputmode="decimal" />
        <${TextField} form=${form} path="speed_limit_kmh" label=${t("field.speed_limit_kmh")} inputmode="decimal" />
      </div>
      <${TextField} form=${form} path="vertices" label=${t("road_form.vertices")} hint=${places.length > 1 ? t("road_form.length", { length: number(length_m(places), 1, "m"), count: places.length }) : t("road_form.vertices_hint")} rows=${5} />
    </${FormFrame}>
  `;
}

/** Longitudes and latitudes of the lines of a text. @param {string} text */
export const placesOf = (text) => text.split("\n").map((line) => line.trim().split(/[,;\s]+/).map(Number)).filter((place) => place.length >= 2 && place.every(Number.isFinite)).map((place) => place.slice(0, 2));

/** A map on which a line is drawn. @param {{ places: number[][], onDrawn: (line: number[][]) => void }} props */
export function DrawMap({ places, onDrawn }) {
  const firstView = () => {
    const first = places[0];
    return first ? { lon_deg: first[0] ?? 0, lat_deg: first[1] ?? 0, zoom: 14 } : knownPlace().catch(() => null); // without it one can draw, too
  };
  const [drawing, setDrawing] = useState(false);
  const { box, ready, failed } = useMap(firstView, addPlanLayers, t("road_form.map"));
  const map = ready?.map ?? null;
  useEffect(() => {
    if (!map) return;
    const seen = places.every(([lon = 0, lat = 0]) => Math.abs(lon) <= 180 && Math.abs(lat) <= 85);
    showLanes(map, places.length > 1 && seen ? [{ name: "", line: places }] : [], "");
    const [lon = 0, lat = 0] = places[0] ?? [];
    if (places.length > 1 && seen && !map.getBounds().contains([lon, lat])) map.jumpTo({ center: [lon, lat], zoom: 14 });
  }, [map, JSON.stringify(places)]);
  useEffect(() => {
    if (!map || !drawing) return undefined;
    let [end, stopped] = [() => {}, false];
    attempt(async () => {
      end = await draw(map, "linestring", { onFinish: (line) => {
        onDrawn(line);
        setDrawing(false);
      } });
      if (stopped) end();
    });
    return () => {
      stopped = true;
      end();
    };
  }, [map, drawing]);
  return html`
    <div class="map-frame road-map"><div class="map" ref=${box}></div>
      ${failed && html`<p class="map-failed" role="status">${t("map.failed")} <span class="hint">${failed}</span></p>`}
      <div class="map-tools"><button type="button" class="quiet" disabled=${!map} aria-pressed=${drawing} onClick=${() => setDrawing(!drawing)}>${t("road_form.draw_line")}</button></div>
      ${drawing && html`<p class="map-hint" role="status">${t("road_form.draw_hint")}</p>`}
    </div>
  `;
}

/** Where the agency has roads or markers: maps to draw on begin there. */
async function knownPlace() {
  const { items } = await page(api.GET("/v1/alignments", { params: { query: { limit: 1 } } }));
  const [west = 0, south = 0, east = 0, north = 0] = items[0]?.extent_deg ?? [];
  if (items.length) return { lon_deg: (west + east) / 2, lat_deg: (south + north) / 2, zoom: 13 };
  const markers = await page(api.GET("/v1/markers", { params: { query: { limit: 1 } } }));
  const position = markers.items[0]?.position;
  return position ? { lon_deg: position.lon_deg, lat_deg: position.lat_deg, zoom: 13 } : null;
}

/** @param {{ onDone: (alignment: Alignment) => void }} props */
function RegisteredForm({ onDone }) {
  const form = useForm({ "lanes.forward": "1", "lanes.backward": "1", "lanes.width_m": "3.5", "lanes.speed_limit_kmh": "70" });
  const found = useLoad(async (signal) => ({ schema: await loadSchema("RoadAlignmentIn"), roads: (await page(api.GET("/v1/roads", { params: { query: { limit: 1000 } }, signal }))).items }), []);
  const submit = async () => {
    const body = bodyOf(form.values, found.data?.schema);
    if (form.values["lanes.forward"] === "0") body.lanes = { ...body.lanes, forward: 0 };
    onDone(await ok(api.POST("/v1/alignments", { body: /** @type {any} */ (body) })));
  };
  return html`<${Shown} of=${found}>${(/** @type {any} */ { schema, roads }) => (roads.length ? html`
    <${FormFrame} form=${form} onSubmit=${submit} button=${t("road_form.make_lanes")}>
      <div class="group">
        <${SelectField} form=${form} path="road_id" label=${t("field.road")} options=${[["", "–"], ...roads.map((/** @type {any} */ road) => [road.id, road.name])]}
          onPick=${(/** @type {string} */ id) => form.values.name || form.set("name", roads.find((/** @type {any} */ road) => road.id === id)?.name ?? "")} />
        <${TextField} form=${form} path="name" label=${t("road_form.name")} required />
      </div>
      <${Group} title=${t("road_form.lanes")}>
        ${["forward", "backward", "width_m", "speed_limit_kmh", "driving_side", "centre_style", "lane_style", "edge_style"].map((name) => html`<${SchemaField} form=${form} schema=${schema} path=${`lanes.${name}`} />`)}
      </${Group}>
    </${FormFrame}>` : html`<p class="hint">${t("road_form.no_roads")} <a href="/roads/new">${t("roads.new")}</a></p>`)}</${Shown}>`;
}
