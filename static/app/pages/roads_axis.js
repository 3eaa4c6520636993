// The axis of a registered road and its known measures: a form for a new road, and for one that is changed.

import { html } from "htm/preact";
import { useId, useState } from "preact/hooks";

import { api, ok, Problem } from "../api/client.js";
import { Facts } from "../components/facts.js";
import { FormFrame, Group, TextField, useForm } from "../components/form.js";
import { number } from "../format.js";
import { t } from "../texts/index.js";
import { DrawMap, placesOf } from "./plans_road.js";

const STATION = /** @type {const} */ (["measure_m", "ahead_m", "part", "vertex", "chainage_m"]);

/** @param {{ road?: any, onStored: (road: any) => void }} props `road`: the one that is changed. */
export function AxisForm({ road, onStored }) {
  const id = useId();
  const [start] = useState(() => (road ? valuesOf(road) : { name: "", geometry: "" }));
  const form = useForm(start);
  const [stations, setStations] = useState(/** @type {number[]} */ (road ? road.calibration.map((/** @type {any} */ _, /** @type {number} */ row) => row) : []));
  const [checked, setChecked] = useState(/** @type {any} */ (null));
  const places = placesOf(String(form.values.geometry ?? ""));
  const edited = form.values.geometry !== start.geometry;
  const several = /\n\s*\n/.test(String(form.values.geometry ?? "").trim());
  /** @param {File | undefined} file */
  const take = async (file) => {
    if (!file) return;
    const lines = linesOf(await file.text());
    if (lines.length) form.set("geometry", textOf(lines));
    else form.setError(new Problem({ title: t("axis.no_line"), detail: "", field: "geometry", limit: "GeoJSON", cure: t("axis.no_line_cure") }));
    if (!form.values.name) form.set("name", file.name.replace(/\.[^.]+$/, "").slice(0, 200));
  };
  const send = async (/** @type {boolean} */ dry_run) => {
    const stored = await (road ? change(road, form.values, start, stations, dry_run) : register(form.values, stations, dry_run));
    if (dry_run) setChecked(stored);
    else onStored(stored);
  };
  const check = html`<button type="button" class="quiet" disabled=${form.busy} onClick=${form.submit(() => send(true))}>${t("axis.check")}</button>`;
  const errors = { ...form.errors };
  for (const [path, text] of Object.entries(form.errors)) {
    const [first = "", k = "", name = "vertex"] = path.split(".");
    if (first === "geometry") errors.geometry = text;
    if (first === "calibration" && k) errors[`calibration.${stations[Number(k)]}.${name}`] = text; // rows keep their number when others are removed
  }
  const fields = { ...form, errors };
  return html`
    <${FormFrame} form=${form} onSubmit=${() => send(false)} button=${t(road ? "axis.change_button" : "axis.button")} actions=${check}>
      <${DrawMap} places=${places} onDrawn=${(/** @type {number[][]} */ line) => form.set("geometry", textOf([line]))} />
      <div class="group">
        ${!road && html`<${TextField} form=${fields} path="name" label=${t("field.name")} hint=${t("axis.name_hint")} placeholder="A 5 northbound" required />`}
        ${(!road || edited) && html`<${TextField} form=${fields} path="crs" label=${t("field.crs")} placeholder="EPSG:4326" hint=${road && t("axis.crs_hint")} />`}
        <div class="field"><label for=${id}>${t("axis.file")}</label><input id=${id} type="file" accept=".geojson,.json" onChange=${(/** @type {any} */ event) => take(event.currentTarget.files[0])} /></div>
      </div>
      <${TextField} form=${fields} path="geometry" label=${t("axis.vertices")} hint=${t("axis.vertices_hint", { count: places.length })} rows=${6} />
      <${Group} title=${t("roads.calibration")}>
        ${stations.map((row) => html`<${Station} key=${row} form=${fields} row=${row} number=${stations.indexOf(row) + 1} several=${several} onRemove=${() => setStations(stations.filter((other) => other !== row))} />`)}
      </${Group}>
      <p class="actions"><button type="button" class="quiet" onClick=${() => setStations([...stations, Math.max(-1, ...stations) + 1])}>${t("axis.add_station")}</button></p>
      <p class="hint">${t(stations.length ? "axis.stations_hint" : "axis.true_metres")}</p>
      ${road && html`<${TextField} form=${fields} path="reason" label=${t("field.reason")} hint=${t("bulk.reason_hint")} />`}
      ${checked && html`<section class="card" role="status"><h2>${t(road ? "axis.would_change" : "axis.would")}</h2><${Facts} of=${[
        [t("field.length_m"), number(checked.length_m, 3)], [t("roads.from"), number(checked.from_m, 3)], [t("roads.to"), number(checked.to_m, 3)],
        [t("axis.measured"), checked.markers ? t("axis.measured_text", { measured: checked.markers.measured, unchanged: checked.markers.unchanged, left: checked.markers.left }) : null],
        [t("axis.largest_change"), checked.markers?.largest_change_m ? number(checked.markers.largest_change_m, 3, "m") : null],
      ]} /></section>`}
    </${FormFrame}>
  `;
}

/** One known measure. @param {{ form: any, row: number, number: number, several: boolean, onRemove: () => void }} props */
function Station({ form, row, number: count, several, onRemove }) {
  const path = (/** @type {string} */ name) => `calibration.${row}.${name}`;
  return html`
    <fieldset class="station"><legend>${t("axis.station", { number: count })}</legend>
      <div class="group">
        <${TextField} form=${form} path=${path("measure_m")} label=${t("axis.measure")} inputmode="decimal" />
        <${TextField} form=${form} path=${path("ahead_m")} label=${t("axis.ahead")} inputmode="decimal" hint=${t("axis.ahead_hint")} />
        <${TextField} form=${form} path=${path("vertex")} label=${t("axis.vertex")} inputmode="numeric" hint=${t("axis.vertex_hint")} />
        <${TextField} form=${form} path=${path("chainage_m")} label=${t("axis.chainage")} inputmode="decimal" hint=${t("axis.chainage_hint")} />
        ${several && html`<${TextField} form=${form} path=${path("part")} label=${t("roads.part")} inputmode="numeric" hint=${t("axis.vertex_hint")} />`}
      </div>
      <button type="button" class="quiet" onClick=${onRemove}>${t("axis.remove_station")}</button>
    </fieldset>
  `;
}

/** Vertices as a text; an empty line between parts. @param {number[][][]} lines */
const textOf = (lines) => lines.map((line) => line.map(([lon = 0, lat = 0]) => `${lon.toFixed(9).replace(/\.?0+$/, "")}, ${lat.toFixed(9).replace(/\.?0+$/, "")}`).join("\n")).join("\n\n");

/** The values of the form for a road that is changed. @param {any} road @returns {import("../components/form.js").Values} */
function valuesOf(road) {
  const lines = road.geometry.type === "MultiLineString" ? road.geometry.coordinates : [road.geometry.coordinates];
  /** @type {import("../components/form.js").Values} */
  const values = { geometry: textOf(lines), reason: "" };
  for (const [row, point] of road.calibration.entries()) {
    for (const name of STATION) {
      if (name === "chainage_m" && point.vertex !== null) continue; // the vertex is its place
      values[`calibration.${row}.${name}`] = point[name] === null || point[name] === undefined ? "" : String(point[name]);
    }
  }
  return values;
}

/** Lines of a GeoJSON text. @param {string} text @returns {number[][][]} */
function linesOf(text) {
  let document;
  try {
    document = JSON.parse(text);
  } catch {
    return [];
  }
  const features = document.features ?? [document];
  return features.map((/** @type {any} */ feature) => feature.geometry ?? feature)
    .flatMap((/** @type {any} */ geometry) => (geometry.type === "LineString" ? [geometry.coordinates] : geometry.type === "MultiLineString" ? geometry.coordinates : []));
}

/** @param {import("../components/form.js").Values} values */
function geometryOf(values) {
  const parts = String(values.geometry ?? "").split(/\n\s*\n/).map(placesOf).filter((part) => part.length);
  if (!parts.length || parts.some((part) => part.length < 2)) throw new Problem({ title: t("axis.no_line"), detail: "", field: "geometry", limit: t("road_form.no_line_limit"), cure: t("road_form.no_line_cure") });
  const crs = String(values.crs ?? "").trim();
  return { geometry: parts.length > 1 ? { type: "MultiLineString", coordinates: parts } : { type: "LineString", coordinates: parts[0] }, ...(crs ? { crs } : {}) };
}

/** @param {import("../components/form.js").Values} values @param {number[]} stations */
function calibrationOf(values, stations) {
  /** @param {string} path */
  const read = (path) => {
    const text = String(values[path] ?? "").trim().replace(",", ".");
    return text && Number.isFinite(Number(text)) ? Number(text) : text || null;
  };
  return stations.map((row) => Object.fromEntries(STATION.map((name) => [name, read(`calibration.${row}.${name}`)]).filter(([name, value]) => value !== null || name === "measure_m")));
}

/** @param {import("../components/form.js").Values} values @param {number[]} stations @param {boolean} dry_run */
function register(values, stations, dry_run) {
  const body = { name: String(values.name ?? "").trim(), ...geometryOf(values), calibration: calibrationOf(values, stations), dry_run };
  return ok(api.POST("/v1/roads", { body: /** @type {any} */ (body) }));
}

/**
 * Change a road. Its axis is sent only when it was edited: a road of another reference system keeps its exact vertices.
 *
 * @param {any} road @param {import("../components/form.js").Values} values @param {import("../components/form.js").Values} start
 * @param {number[]} stations @param {boolean} dry_run
 */
function change(road, values, start, stations, dry_run) {
  const edited = values.geometry !== start.geometry;
  const reason = String(values.reason ?? "").trim();
  const body = { ...(edited ? geometryOf(values) : {}), calibration: calibrationOf(values, stations), dry_run, ...(reason ? { reason } : {}) };
  return ok(api.PATCH("/v1/roads/{road_id}", { params: { path: { road_id: road.id }, header: { "If-Match": `"${road.version}"` } }, body: /** @type {any} */ (body) }));
}
