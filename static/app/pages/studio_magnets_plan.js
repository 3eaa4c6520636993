// Plan a magnet tag on a lane, from a meaning of a codebook.

import { html } from "htm/preact";

import { api, ok, page } from "../api/client.js";
import { bodyOf, FormFrame, Group, SchemaField, SelectField, TextField, useForm } from "../components/form.js";
import { Empty, useLoad } from "../components/load.js";
import { notify } from "../components/notices.js";
import { codeOf } from "../format.js";
import { navigate } from "../router.js";
import { t } from "../texts/index.js";

/** @param {{ schema: any, books: any[] }} props */
export function PlanForm({ schema, books }) {
  if (!books.length) return html`<div class="card"><${Empty} title=${t("magnets.no_codebooks")}><p><a href="/studio/magnets">${t("magnets.make_codebook")}</a></p></${Empty}></div>`;
  return html`<${TagForm} schema=${schema} books=${books} />`;
}

/** @param {{ schema: any, books: any[] }} props */
function TagForm({ schema, books }) {
  const form = useForm({ codebook: books[0].id, meaning: "0" });
  const book = String(form.values.codebook);
  const entries = useLoad(async (signal) => (await page(api.GET("/v1/codebooks/{codebook_id}/entries", { params: { path: { codebook_id: book } }, signal }))).items, [book]);
  const submit = async () => {
    const { meaning, line, codebook: _codebook, ...values } = form.values;
    delete values[values["installation.mounting"] === "surface" ? "installation.hole_depth_mm" : "installation.shell_height_mm"];
    const body = { family: "magnet", lane: {}, tag: {}, ...bodyOf(values, schema) };
    const entry = entries.data?.[Number(meaning)];
    Object.assign(body.tag, { codebook_id: book }, entry && { meaning: { kind: entry.meaning.kind, value: entry.meaning.value } });
    const geometry = readLine(String(line ?? ""));
    if (geometry) Object.assign(body.lane, { geometry });
    const marker = await ok(api.POST("/v1/markers", { body: /** @type {any} */ (body) }));
    const warnings = /** @type {any} */ (marker).warnings ?? [];
    notify(t("register.done", { code: codeOf(marker) }), { detail: warnings.length ? t("magnets.warnings", { names: warnings.join(", ") }) : "" });
    navigate(`/markers/${marker.id}`);
  };
  // the server names the line by its path in the body
  const shown = { ...form, errors: { ...form.errors, line: form.errors["lane.geometry"] ?? form.errors.lane ?? "", meaning: form.errors["tag.meaning"] ?? "" } };
  const field = (/** @type {string} */ path, more = {}) => html`<${SchemaField} form=${form} schema=${schema} path=${path} ...${more} />`;
  return html`
    <${FormFrame} form=${form} onSubmit=${submit} button=${t("magnets.plan_button")}>
      <${Group} title=${t("marker.meaning")}>
        <${SelectField} form=${form} path="codebook" label=${t("magnets.codebook")} options=${books.map(({ id, name }) => [id, name])} onPick=${() => form.set("meaning", "0")} />
        <${SelectField} form=${shown} path="meaning" label=${t("marker.meaning")} options=${(entries.data ?? []).map((/** @type {any} */ entry, /** @type {number} */ k) => [String(k), `${entry.meaning.text}: ${entry.code}`])} />
      </${Group}>
      <${Group} title=${t("magnets.first")}>
        ${field("tag.chainage_m", { required: true, placeholder: "60" })}
        ${field("tag.offset_m", { placeholder: "0" })}
        ${field("lane.horizontal_rmse_m", { placeholder: "0.02" })}
      </${Group}>
      <${TextField} form=${shown} path="line" label=${t("magnets.line")} hint=${t("magnets.line_hint")} rows=${4} placeholder=${"-84.4800, 42.7263\n-84.4776, 42.7263"} required />
      <${Group} title=${t("magnets.traffic")}>
        ${field("site.design_speed_m_s", { placeholder: "13.4" })}
        ${field("site.stop_line_chainage_m")}
        ${field("road")}
      </${Group}>
      <${Group} title=${t("rules.installation")}>
        ${field("installation.mounting")}
        ${form.values["installation.mounting"] === "surface" ? field("installation.shell_height_mm", { placeholder: "15" }) : field("installation.hole_depth_mm", { placeholder: "30" })}
      </${Group}>
    </${FormFrame}>
  `;
}

/** A GeoJSON geometry, feature or collection, or one longitude and latitude on each line. @param {string} text @returns {any} */
function readLine(text) {
  if (!text.trim()) return null;
  try {
    const document = JSON.parse(text);
    const feature = document.type === "FeatureCollection" ? document.features[0] : document;
    return feature.geometry ?? feature;
  } catch {
    const rows = text.split("\n").filter((row) => row.trim());
    const value = (/** @type {string} */ part) => (Number.isFinite(Number(part)) ? Number(part) : part);
    return { type: "LineString", coordinates: rows.map((row) => row.trim().split(/[\s,;]+/).map(value)) };
  }
}
