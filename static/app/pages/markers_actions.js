// What is done with many markers: export, artwork as a ZIP, a new status.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

import { api, download, jsonBody, ok, Problem, request, save } from "../api/client.js";
import { Dialog } from "../components/dialog.js";
import { CheckField, FormFrame, SelectField, TextField, useForm } from "../components/form.js";
import { JobProgress } from "../components/job.js";
import { attempt, notify } from "../components/notices.js";
import { codeOf } from "../format.js";
import { STATUSES } from "../map/symbols.js";
import { t, textOr } from "../texts/index.js";

/** @typedef {import("./markers.js").Marker} Marker */

const EXPORTS = {
  csv: "csv", geojson: "geojson", gpkg: "gpkg", geoparquet: "parquet", flatgeobuf: "fgb", shapefile: "zip", kml: "kml",
  landxml: "xml", dxf: "dxf",
};
const MAX_ITEMS = 1000; // of POST /v1/markers/bulk

/** @param {{ filters: Record<string, any>, onClose: () => void }} props */
export function ExportDialog({ filters, onClose }) {
  const form = useForm({ format: "csv" });
  const submit = async () => {
    const kind = /** @type {keyof typeof EXPORTS} */ (form.values.format);
    const response = await download(`/v1/exports/${kind}?${new URLSearchParams(filters)}`, `markers.${EXPORTS[kind]}`);
    const left = response.headers.get("Waymark-Left-Out");
    notify(t("export.done"), { detail: left ? t("export.left_out", { ids: left }) : "" });
    onClose();
  };
  return html`
    <${Dialog} title=${t("export.title")} onClose=${onClose}>
      <p>${t(Object.keys(filters).length ? "export.filtered" : "export.all")}</p>
      <${FormFrame} form=${form} onSubmit=${submit} button=${t("export.save")}>
        <${SelectField} form=${form} path="format" label=${t("export.format")} options=${Object.keys(EXPORTS).map((name) => [name, textOr(`export.${name}`, name)])} />
      </${FormFrame}>
    </${Dialog}>
  `;
}

/** @param {{ markers: Marker[], onClose: () => void }} props */
export function ArtworkDialog({ markers, onClose }) {
  const form = useForm({ pdf: true, svg: true, dxf: false, png: false, heaters: false, leds: false });
  const [job, setJob] = useState("");
  const plates = markers.filter(({ family }) => family === "plate");
  const submit = async () => {
    const formats = ["pdf", "svg", "dxf", "png"].filter((name) => form.values[name]);
    if (!formats.length) throw new Problem({ title: t("artwork.none"), detail: "", cure: t("artwork.choose") });
    const body = { marker_ids: plates.map(({ id }) => id), formats, heaters: form.values.heaters, leds: form.values.leds };
    const response = await request("/v1/artwork", jsonBody(body));
    if (response.status === 202) {
      setJob((await response.json()).id);
      return;
    }
    save(await response.blob(), "waymark-artwork.zip");
    notify(t("artwork.done", { count: plates.length }), { detail: response.headers.get("Waymark-Note") ?? "" });
    onClose();
  };
  const done = (/** @type {import("../components/job.js").Job} */ ended) => attempt(async () => {
    await download(ended.links.result ?? "", "waymark-artwork.zip");
    notify(t("artwork.done", { count: plates.length }));
    onClose();
  });
  return html`
    <${Dialog} title=${t("artwork.title")} onClose=${onClose}>
      <p>${t("artwork.count", { count: plates.length })}${plates.length < markers.length && ` ${t("artwork.others", { count: markers.length - plates.length })}`}</p>
      ${job
        ? html`<${JobProgress} id=${job} onDone=${done} />`
        : html`
          <${FormFrame} form=${form} onSubmit=${submit} button=${t("artwork.make")}>
            <fieldset><legend>${t("artwork.formats")}</legend><div class="checks">
              ${["pdf", "svg", "dxf", "png"].map((name) => html`<${CheckField} form=${form} path=${name} label=${name.toUpperCase()} />`)}
            </div></fieldset>
            <div class="checks">
              <${CheckField} form=${form} path="heaters" label=${t("artwork.heaters")} />
              <${CheckField} form=${form} path="leds" label=${t("artwork.leds")} />
            </div>
          </${FormFrame}>
        `}
    </${Dialog}>
  `;
}

/** @param {{ markers: Marker[], onClose: () => void, onDone: () => void }} props */
export function StatusDialog({ markers, onClose, onDone }) {
  const form = useForm({ status: "active", reason: "" });
  const [report, setReport] = useState(/** @type {{ updated: number, refused: { code: string, text: string }[] } | null} */ (null));
  const submit = async () => {
    let updated = 0;
    /** @type {{ code: string, text: string }[]} */
    const refused = [];
    const reason = String(form.values.reason ?? "").trim();
    for (let start = 0; start < markers.length; start += MAX_ITEMS) {
      const part = markers.slice(start, start + MAX_ITEMS);
      const items = part.map(({ id, version }) => ({ update: { id, version, change: { status: form.values.status, ...(reason ? { reason } : {}) } } }));
      const found = await bulk(items);
      updated += found.updated;
      for (const [k, result] of found.results.entries()) {
        const marker = part[k];
        if (result.problem && marker) refused.push({ code: codeOf(marker), text: result.problem.detail });
      }
    }
    onDone();
    if (refused.length) setReport({ updated, refused });
    else {
      notify(t("bulk.done", { count: updated }));
      onClose();
    }
  };
  return html`
    <${Dialog} title=${t("bulk.title")} onClose=${onClose}>
      ${report
        ? html`
          <p>${t("bulk.report", { updated: report.updated, refused: report.refused.length })}</p>
          <ul class="scroll-list">${report.refused.map(({ code, text }) => html`<li><span class="code">${code}</span>: ${text}</li>`)}</ul>
          <p class="actions"><button type="button" onClick=${onClose}>${t("action.close")}</button></p>
        `
        : html`
          <p>${t("bulk.count", { count: markers.length })}</p>
          <${FormFrame} form=${form} onSubmit=${submit} button=${t("bulk.save")}>
            <${SelectField} form=${form} path="status" label=${t("field.status")} options=${STATUSES.map((name) => [name, textOr(`status.${name}`, name)])} />
            <${TextField} form=${form} path="reason" label=${t("field.reason")} hint=${t("bulk.reason_hint")} />
          </${FormFrame}>
        `}
    </${Dialog}>
  `;
}

/**
 * The report of a bulk request: also where all items were refused, which is a problem with the report in it.
 *
 * @param {any[]} items
 * @returns {Promise<import("../api/schema.js").components["schemas"]["BulkReport"]>}
 */
async function bulk(items) {
  try {
    return await ok(api.POST("/v1/markers/bulk", { body: { items, mode: "good" } }));
  } catch (error) {
    const report = error instanceof Problem ? /** @type {any} */ (error.document).report : null;
    if (report) return report;
    throw error;
  }
}
