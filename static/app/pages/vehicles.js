// Vehicles: their sensor profiles, uploads and distances; the calibration of their cameras.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

import { api, ok, page, Problem } from "../api/client.js";
import { Facts } from "../components/facts.js";
import { FormFrame, TextField, useForm } from "../components/form.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { Dialog } from "../components/dialog.js";
import { notify } from "../components/notices.js";
import { Panel } from "../components/panel.js";
import { Table } from "../components/table.js";
import { number, text, time } from "../format.js";
import { navigate, withQuery } from "../router.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";
import { Calibration } from "./vehicles_calibration.js";

const BASE = "/operations/vehicles";
const SECTIONS = ["camera", "thermal", "thermal_range", "trace", "packets"];

/** @param {{ parameters: { item_id?: string } }} props */
export default function Vehicles({ parameters }) {
  const id = parameters.item_id ?? null;
  const vehicles = useLoad(async (signal) => (await page(api.GET("/v1/vehicles", { params: { query: { limit: 1000 } }, signal }))).items, []);
  const [adding, setAdding] = useState(false);
  return html`
    <div class="title-line"><h1>${t("vehicles.title")}</h1>${may("POST /v1/vehicles") && html`<button type="button" onClick=${() => setAdding(true)}>${t("vehicles.add")}</button>`}</div>
    <${Shown} of=${vehicles}>${(/** @type {any[]} */ rows) => html`
      <div class=${id === null ? "workspace" : "workspace with-panel"}>
        <div class="workspace-main">
          ${rows.length ? html`<${Table} label=${t("vehicles.title")} rows=${rows} idOf=${(/** @type {any} */ row) => row.id} chosen=${id} columns=${columnsOf()} footer=${t("list.count", { count: rows.length })} />` : html`<${Empty} title=${t("vehicles.none")} />`}
        </div>
        ${id !== null && html`<${Vehicle} key=${id} id=${id} onClose=${() => navigate(withQuery(BASE))} onChanged=${vehicles.reload} />`}
      </div>
    `}</${Shown}>
    ${adding && html`<${AddDialog} onClose=${() => setAdding(false)} onDone=${vehicles.reload} />`}
  `;
}

/** @returns {import("../components/table.js").Column<any>[]} */
const columnsOf = () => [
  { name: "name", title: t("field.name"), head: true, order: (row) => row.name, cell: (row) => html`<a href=${withQuery(`${BASE}/${row.id}`)}>${row.name}</a>` },
  { name: "status", title: t("field.status"), order: (row) => row.status, cell: (row) => textOr(`status.${row.status}`, row.status) },
  { name: "seen", title: t("field.last_seen_at"), order: (row) => row.last_seen_at, cell: (row) => (row.last_seen_at ? time(row.last_seen_at) : t("vehicles.never")) },
  { name: "uploads", title: t("field.uploads"), number: true, order: (row) => row.uploads, cell: (row) => number(row.uploads) },
  { name: "driven", title: t("field.driven_km"), number: true, order: (row) => row.driven_km, cell: (row) => number(row.driven_km, 1) },
];

/** @param {{ onClose: () => void, onDone: () => void }} props */
function AddDialog({ onClose, onDone }) {
  const form = useForm({ name: "", note: "", profile: "" });
  const submit = async () => {
    const { name, note, profile } = Object.fromEntries(Object.entries(form.values).map(([field, value]) => [field, String(value).trim()]));
    const body = { name, ...(note ? { note } : {}), ...(profile ? { profile: readProfile(profile) } : {}) };
    const vehicle = await ok(api.POST("/v1/vehicles", { body: /** @type {any} */ (body) }));
    notify(t("vehicles.added", { name: vehicle.name }));
    onDone();
    onClose();
    navigate(`${BASE}/${vehicle.id}`);
  };
  return html`
    <${Dialog} title=${t("vehicles.add")} onClose=${onClose}>
      <${FormFrame} form=${form} onSubmit=${submit} button=${t("vehicles.add")}>
        <${TextField} form=${form} path="name" label=${t("field.name")} placeholder="BUS-7" required />
        <${TextField} form=${form} path="note" label=${t("field.note")} />
        <${TextField} form=${form} path="profile" label=${t("vehicles.profile_json")} hint=${t("vehicles.profile_hint")} rows=${6} placeholder=${'{"camera": {"height_m": 1.4, "horizontal_fov_deg": 70}}'} />
      </${FormFrame}>
    </${Dialog}>
  `;
}

/** @param {string} text */
function readProfile(text) {
  try {
    return JSON.parse(text);
  } catch (error) {
    throw new Problem({ title: t("vehicles.bad_profile"), detail: String(error instanceof Error ? error.message : error), field: "profile", limit: "JSON", cure: t("vehicles.bad_profile_cure") });
  }
}

/** @param {{ id: string, onClose: () => void, onChanged: () => void }} props */
function Vehicle({ id, onClose, onChanged }) {
  const found = useLoad((signal) => ok(api.GET("/v1/vehicles/{vehicle_id}", { params: { path: { vehicle_id: id } }, signal })), [id]);
  const vehicle = /** @type {any} */ (found.data);
  const changed = () => {
    found.reload();
    onChanged();
  };
  return html`
    <${Panel} title=${text(vehicle?.name)} label=${t("vehicles.one")} onClose=${onClose}>
      <${Shown} of=${found}>${() => html`
        <${Facts} of=${[
          [t("field.status"), `${textOr(`status.${vehicle.status}`, vehicle.status)}, ${t("marker.version", { version: vehicle.version })}`],
          [t("field.note"), vehicle.note],
          [t("field.last_seen_at"), vehicle.last_seen_at ? `${time(vehicle.last_seen_at)} UTC` : t("vehicles.never")],
          [t("field.uploads"), number(vehicle.uploads)],
          [t("field.driven_km"), number(vehicle.driven_km, 3)],
          [t("keys.title"), vehicle.keys.map((/** @type {any} */ key) => `${key.label} (${key.prefix}…)`).join(", ") || t("vehicles.no_keys")],
          [t("decode.camera"), cameraText(vehicle.profile.camera ?? {})],
          [t("field.id"), html`<span class="code small">${vehicle.id}</span>`],
        ]} />
        <h3>${t("vehicles.profile")}</h3>
        <${Profile} profile=${vehicle.profile} />
        ${may("POST /v1/calibrations") && html`<h3>${t("calibration.title")}</h3><${Calibration} vehicle=${vehicle} onChanged=${changed} />`}
      `}</${Shown}>
    </${Panel}>
  `;
}

/** @param {{ profile: any }} props */
function Profile({ profile }) {
  const known = SECTIONS.filter((section) => section in profile);
  if (!known.length) return html`<p class="hint">${t("vehicles.profile_empty")}</p>`;
  return known.map((section) => html`<details class="section"><summary><h4>${textOr(`profile.${section}`, section)}</h4></summary><pre tabindex="0">${JSON.stringify(profile[section], null, 1)}</pre></details>`);
}

/** @param {any} camera */
function cameraText(camera) {
  if (!Object.keys(camera).length) return null;
  const lens = camera.fx_px ? `fx ${number(camera.fx_px, 1, "px")}` : camera.horizontal_fov_deg ? t("vehicles.fov", { fov: camera.horizontal_fov_deg }) : t("vehicles.no_intrinsics");
  return [
    camera.width_px && `${camera.width_px} × ${camera.height_px} px`, lens,
    camera.height_m && t("vehicles.mount", { height: camera.height_m, depression: camera.depression_deg ?? 23 }),
  ].filter(Boolean).join(", ");
}
