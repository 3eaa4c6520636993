// Snapshots: signed files with the markers of an area, for vehicles without a connection.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

import { api, download, ok, Problem, save } from "../api/client.js";
import { Facts } from "../components/facts.js";
import { FormFrame, SelectField, TextField, useForm } from "../components/form.js";
import { Shown, useLoad } from "../components/load.js";
import { notify } from "../components/notices.js";
import { query, setQuery } from "../router.js";
import { t } from "../texts/index.js";

const SIDES = /** @type {const} */ (["west", "south", "east", "north"]);
const HOURS = { 4: "snapshots.hours_4", 24: "snapshots.hours_24", 72: "snapshots.hours_72", 168: "snapshots.hours_168" };

/** @typedef {import("../api/schema.js").components["schemas"]["TrustDocument"]} Trust */

export default function Snapshots() {
  return html`
    <h1>${t("snapshots.title")}</h1>
    <p class="lead">${t("snapshots.lead")}</p>
    <div class="wide-tiles">
      <section class="card"><h2>${t("snapshots.make")}</h2><${Make} /></section>
      <section class="card"><h2>${t("snapshots.trust")}</h2><${TrustFile} /></section>
    </div>
  `;
}

function Make() {
  const box = (query.peek().get("bbox") ?? "").split(",");
  const form = useForm({ ...Object.fromEntries(SIDES.map((side, k) => [side, box[k] ?? ""])), hours: "24", bbox: "" });
  const [finding, setFinding] = useState(false);
  const submit = async () => {
    const sides = SIDES.map((side) => String(form.values[side]).trim().replace(",", "."));
    const missing = SIDES.find((_side, k) => !sides[k] || !Number.isFinite(Number(sides[k])));
    if (missing) throw new Problem({ title: t("snapshots.no_area"), detail: "", field: missing, limit: t("snapshots.degrees"), cure: t("snapshots.no_area_cure") });
    const bbox = sides.join(",");
    setQuery({ bbox });
    await download(`/v1/snapshots?${new URLSearchParams({ bbox, hours: String(form.values.hours) })}`, "markers.waymark");
    notify(t("snapshots.saved"));
  };
  const all = async () => {
    setFinding(true);
    const found = await extent().finally(() => setFinding(false));
    if (found) form.setValues((old) => ({ ...old, ...found }));
    else notify(t("markers.none"), { bad: true });
  };
  const shown = { ...form, errors: form.errors.bbox ? { west: form.errors.bbox, ...form.errors } : form.errors };
  return html`
    <${FormFrame} form=${form} onSubmit=${submit} button=${t("snapshots.make_button")} actions=${html`<button type="button" class="quiet" disabled=${finding} onClick=${all}>${t("snapshots.all")}</button>`}>
      <div class="group narrow">${SIDES.map((side) => html`<${TextField} form=${shown} path=${side} label=${t(`snapshots.${side}`)} inputmode="decimal" required />`)}</div>
      <${SelectField} form=${form} path="hours" label=${t("snapshots.valid")} hint=${t("snapshots.valid_hint")} options=${Object.entries(HOURS).map(([hours, name]) => [hours, t(/** @type {any} */ (name))])} />
    </${FormFrame}>
  `;
}

/** The box around all markers, a little wider. */
async function extent() {
  const { items } = await ok(api.GET("/v1/markers", { params: { query: { limit: 1000 } } }));
  const lons = items.map(({ position }) => position.lon_deg);
  const lats = items.map(({ position }) => position.lat_deg);
  if (!items.length) return null;
  const margin = 0.001;
  return {
    west: (Math.min(...lons) - margin).toFixed(4), south: (Math.min(...lats) - margin).toFixed(4),
    east: (Math.max(...lons) + margin).toFixed(4), north: (Math.max(...lats) + margin).toFixed(4),
  };
}

function TrustFile() {
  const found = useLoad((signal) => ok(api.GET("/v1/snapshots/trust", { signal })), []);
  return html`
    <p>${t("snapshots.trust_text")}</p>
    <${Shown} of=${found}>${(/** @type {Trust} */ trust) => html`
      <${Facts} of=${[
        [t("snapshots.algorithm"), trust.algorithm],
        [t("snapshots.keys"), trust.public_keys.map((key) => html`<span class="code small wrap block">${key}</span>`)],
        [t("field.version"), String(trust.snapshot_version)],
      ]} />
      <p><button type="button" class="quiet" onClick=${() => save(new Blob([JSON.stringify(trust, null, 1)], { type: "application/json" }), "trust.json")}>${t("snapshots.trust_save")}</button></p>
    `}</${Shown}>
  `;
}
