// Import a survey: choose a file, declare what it is, check it, accept corrections, store it. Nothing is stored before the
// last step.

import { html } from "htm/preact";
import { useEffect, useId, useRef, useState } from "preact/hooks";

import { Problem, request, save } from "../api/client.js";
import { DropArea } from "../components/drop.js";
import { FormFrame, loadSchema, useForm } from "../components/form.js";
import { JobProgress, oneJob } from "../components/job.js";
import { Shown, useLoad } from "../components/load.js";
import { notify } from "../components/notices.js";
import { fileSize, number } from "../format.js";
import { setQuery } from "../router.js";
import { t } from "../texts/index.js";
import { corrected, declarationOf, keepValues, keptValues, Options } from "./imports_options.js";
import { allOf, Comparison, Detected, Downloads, Faults, Summary } from "./imports_report.js";
import { Rows } from "./imports_rows.js";

const ACCEPTED = ".csv,.txt,.asc,.xyz,.geojson,.json,.gpkg,.zip,.kml,.kmz,.gpx,.xml,.landxml,.jxl,.gsi,.dxf";
const LISTED = 2000;
// ten points of a road in Karlsruhe, five metres apart
const EXAMPLE = ["point,lon,lat,height,horizontal_rmse_m", ...Array.from({ length: 10 }, (_, k) => `P${k + 1},${(8.4 + k * 6.82e-5).toFixed(8)},49.01000000,${(115 + k * 0.02).toFixed(2)},0.015`)].join("\n");
const EXAMPLE_VALUES = { family: "plate", crs: "EPSG:4326", vertical_datum: "ellipsoid" };

/** @typedef {import("./imports_report.js").Report} Report */
/** @typedef {{ file: File | null, report: Report | null, family: string, leftOut: Set<number> }} Draft */

/** What the reader works on, also after a look at another page. @type {Draft} */
let kept = { file: null, report: null, family: "plate", leftOut: new Set() };

/** @param {{ onStored: () => void }} props */
export function NewImport({ onStored }) {
  const schema = useLoad(() => loadSchema("DeclarationIn"), []);
  return html`<${Shown} of=${schema}>${(/** @type {any} */ found) => html`<${Steps} schema=${found} onStored=${onStored} />`}</${Shown}>`;
}

/** @param {{ schema: any, onStored: () => void }} props */
function Steps({ schema, onStored }) {
  const form = useForm(keptValues());
  const [draft, setDraft] = useState(kept);
  const [job, setJob] = useState(/** @type {{ id: string, values: import("../components/form.js").Values } | null} */ (null));
  const [stale, setStale] = useState(false);
  const results = useRef(/** @type {HTMLElement | null} */ (null));
  const latest = useRef(draft);
  latest.current = draft;
  const change = (/** @type {Partial<Draft>} */ parts) => {
    kept = { ...latest.current, ...parts };
    latest.current = kept;
    setDraft(kept);
  };
  useEffect(() => setStale(draft.report !== null), [JSON.stringify(form.values)]);
  const take = (/** @type {File | null} */ file) => {
    change({ file, report: null, leftOut: new Set() });
    form.setError(null);
    setQuery({ row: null, rows: null });
  };
  const show = (/** @type {Report} */ report, /** @type {import("../components/form.js").Values} */ values) => {
    change({ report, family: String(values.family) });
    setStale(false);
    if (report.outcome === "stored") {
      notify(t("imports.stored", { count: number(report.stored) }));
      onStored();
    }
    setTimeout(() => results.current?.focus(), 0);
  };
  /** @param {import("../components/form.js").Values} values @param {boolean} dry */
  const send = async (values, dry) => {
    const { file, leftOut } = latest.current;
    if (!file) throw new Problem({ title: t("decode.no_file"), detail: "", field: "file", cure: t("imports.choose") });
    const declaration = declarationOf(values, schema, leftOut);
    keepValues(values);
    const parts = new FormData();
    parts.append("file", file, file.name);
    parts.append("declaration", JSON.stringify({ ...declaration, dry_run: dry, list_rows: LISTED }));
    try {
      const response = await request("/v1/imports", { method: "POST", body: parts });
      const document = await response.json();
      if (response.status === 202) setJob({ id: document.id, values });
      else show(document, values);
    } catch (error) {
      const refused = error instanceof Problem ? /** @type {any} */ (error.document).report : null;
      if (!refused) throw error;
      show(refused, values);
    }
  };
  const run = (/** @type {import("../components/form.js").Values} */ values, /** @type {boolean} */ dry) => form.submit(() => send(values, dry))(new Event("submit"));
  const accept = {
    onChanges: (/** @type {Record<string, any>} */ changes) => {
      const values = corrected(form.values, changes);
      form.setValues(values);
      run(values, true);
    },
    onLeaveOut: (/** @type {number[]} */ rows, /** @type {boolean} */ out) => {
      const leftOut = new Set(latest.current.leftOut);
      for (const row of rows) if (out) leftOut.add(row); else leftOut.delete(row);
      change({ leftOut });
      run(form.values, true);
    },
    onAll: () => {
      const { changes, rows } = allOf(/** @type {Report} */ (draft.report));
      const values = corrected(form.values, changes);
      form.setValues(values);
      change({ leftOut: new Set([...latest.current.leftOut, ...rows]) });
      run(values, true);
    },
  };
  const ended = async () => {
    if (!job) return;
    const { result } = await oneJob(job.id, "import");
    if (result) show(result, job.values);
    setJob(null);
  };
  const example = () => {
    take(new File([EXAMPLE], "example.csv", { type: "text/csv" }));
    form.setValues((old) => ({ ...old, ...EXAMPLE_VALUES }));
  };
  const { report } = draft;
  return html`
    <${FormFrame} form=${form} onSubmit=${() => send(form.values, true)} button=${t("imports.check")} actions=${html`<span class="hint">${t("imports.check_hint")}</span>`}>
      <${Drop} file=${draft.file} onTake=${take} onExample=${example} />
      <${Options} form=${form} schema=${schema} />
    </${FormFrame}>
    ${job && html`<section class="card"><${JobProgress} key=${job.id} id=${job.id} onDone=${ended} /></section>`}
    ${report && !job && html`
      <section class="card results" tabindex="-1" ref=${results} aria-label=${t("imports.result")}>
        <div class="title-line"><h2>${t("imports.result")}</h2><span class="buttons"><${Downloads} report=${report} /></span></div>
        ${stale && html`<p class="warning" role="status">${t("imports.stale")}</p>`}
        <${Summary} report=${report} />
        ${report.outcome === "stored"
          ? html`<${Stored} report=${report} onAnother=${() => take(null)} />`
          : html`<${Store} form=${form} report=${report} disabled=${stale || form.busy} onStore=${() => run(form.values, false)} />`}
      </section>
      <section class="card"><h2>${t("imports.rows_title")}</h2><${Rows} report=${report} family=${draft.family} leftOut=${draft.leftOut} onLeaveOut=${report.outcome === "stored" ? undefined : accept.onLeaveOut} /></section>
      <section class="card"><h2>${t("imports.faults")}</h2><${Faults} report=${report} accept=${report.outcome === "stored" ? undefined : accept} /></section>
      <${Comparison} report=${report} />
      <section class="card"><h2>${t("imports.detected")}</h2><${Detected} report=${report} /></section>
    `}
  `;
}

/** The last step. @param {{ form: import("../components/form.js").Form, report: Report, disabled: boolean, onStore: () => void }} props */
function Store({ form, report, disabled, onStore }) {
  const partly = form.values.mode === "good";
  const blocked = report.refused_rows > 0 && !partly;
  return html`
    ${report.refused_rows > 0 && report.good_rows > 0 && html`<label class="check"><input type="checkbox" name="mode" checked=${partly} onChange=${(/** @type {any} */ event) => form.set("mode", event.currentTarget.checked ? "good" : "all")} /> ${t("imports.only_good")}</label>`}
    <div class="field"><label for="import-reason">${t("field.reason")}</label><input id="import-reason" name="reason" value=${form.values.reason ?? ""} onInput=${(/** @type {any} */ event) => form.set("reason", event.currentTarget.value)} /><p class="hint">${t("bulk.reason_hint")}</p></div>
    <p class="actions"><button type="button" disabled=${disabled || report.good_rows === 0 || blocked} onClick=${onStore}>${t("imports.store", { count: number(report.good_rows) })}</button>
      <span class="hint">${blocked ? t("imports.blocked") : report.good_rows === 0 ? t("imports.nothing_good") : ""}</span></p>
  `;
}

/** @param {{ report: Report, onAnother?: () => void }} props */
export function Stored({ report, onAnother }) {
  const [west = 0, south = 0, east = 0, north = 0] = report.extent_deg ?? [];
  const margin = 1e-5;
  const bbox = [west - margin, south - margin, east + margin, north + margin].map((side) => side.toFixed(6)).join(",");
  return html`<p class="actions"><a class="button" href=${`/markers?bbox=${bbox}`}>${t("imports.show_markers")}</a>
    <a href=${`/operations/audit?subject=${report.file_sha256}`}>${t("audit.of_this")}</a>
    ${onAnother && html`<button type="button" class="quiet" onClick=${onAnother}>${t("imports.another")}</button>`}</p>`;
}

/** @param {{ file: File | null, onTake: (file: File | null) => void, onExample: () => void }} props */
function Drop({ file, onTake, onExample }) {
  const id = useId();
  return html`
    <${DropArea} onFiles=${(/** @type {File[]} */ files) => onTake(files[0] ?? null)}>
      <label for=${id}>${t("imports.drop")}</label>
      <input id=${id} name="file" type="file" accept=${ACCEPTED} onChange=${(/** @type {any} */ event) => onTake(event.currentTarget.files[0] ?? null)} />
      ${file ? html`<p role="status"><strong>${file.name}</strong>, ${fileSize(file.size)}</p>` : html`<p class="hint">${t("imports.formats")}</p>`}
      ${!file && html`<p class="buttons"><button type="button" class="quiet" onClick=${onExample}>${t("imports.try_example")}</button>
        <button type="button" class="quiet" onClick=${() => save(new Blob([EXAMPLE], { type: "text/csv" }), "example.csv")}>${t("imports.save_example")}</button></p>`}
    </${DropArea}>
  `;
}
