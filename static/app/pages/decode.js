// Upload files and have them decoded: several at once, each a row with its kind, its progress and what went wrong.
// /decodes/{id} shows a result.

import { html } from "htm/preact";
import { useEffect, useId } from "preact/hooks";

import { Problem } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { DropArea } from "../components/drop.js";
import { FormFrame, loadSchema, useForm } from "../components/form.js";
import { useLoad } from "../components/load.js";
import { attempt } from "../components/notices.js";
import { ProblemBox } from "../components/problem.js";
import { fileSize, number } from "../format.js";
import { t } from "../texts/index.js";
import { contextOf, Options } from "./decode_options.js";
import { addFiles, change, pauseRow, removeRow, restore, rows, send, sendAll, supply } from "./decode_queue.js";
import { DecodeView } from "./decode_view.js";

const KINDS = /** @type {const} */ (["frame", "trace", "packets"]);
const ACCEPTED = "image/jpeg,image/png,video/mp4,video/quicktime,video/x-msvideo,.mcap,.bag,.db3,.csv,.txt,.bin,.dat,.parquet,.zip,.json,.jsonl,.ndjson,.gpx,.nmea";
const SAMPLE = "/static/samples/trace.zip";
const SAMPLE_CONTEXT = { "coarse_position.lon_deg": "8.417", "coarse_position.lat_deg": "49.006", "coarse_position.accuracy_m": "50" };

/** @param {{ parameters: { decode_id?: string } }} props */
export default function Decode({ parameters }) {
  return parameters.decode_id ? html`<${DecodeView} key=${parameters.decode_id} id=${parameters.decode_id} />` : html`<${Upload} />`;
}

function Upload() {
  const form = useForm({ context: "" });
  const schema = useLoad(() => loadSchema("UploadContext"), []);
  useEffect(() => {
    restore();
  }, []);
  const list = rows.value;
  const ready = list.filter(({ state }) => state === "ready").length;
  const done = list.filter(({ decode, state }) => decode && state === "done");
  const submit = async () => {
    if (!list.some((row) => row.state === "ready" || row.state === "failed")) throw new Problem({ title: t("decode.no_file"), detail: "", field: "file", cure: t("decode.choose") });
    await sendAll((kind) => contextOf(form.values, schema.data, kind));
    const wrong = rows.peek().find(({ error }) => error instanceof Problem && error.document.field)?.error;
    if (wrong instanceof Problem && !/^(file|Upload)/.test(wrong.document.field ?? "")) throw wrong;
  };
  const trySample = () => attempt(async () => {
    const blob = await (await fetch(SAMPLE)).blob();
    form.setValues((old) => ({ ...old, ...SAMPLE_CONTEXT }));
    await addFiles([new File([blob], "sample-trace.zip")]);
  });
  return html`
    <h1>${t("decode.heading")}</h1>
    <div class=${list.length ? "upload-page" : "upload-page none"}>
      <section aria-label=${t("decode.files")}>
        <${Drop} onFiles=${(/** @type {File[]} */ files) => attempt(() => addFiles(files))} />
        ${!list.length && html`<${FirstSteps} onSample=${trySample} />`}
        ${list.length > 0 && html`<ul class="uploads">${list.map((row) => html`<${FileRow} key=${row.key} row=${row} onAgain=${() => attempt(async () => send(row.key, contextOf(form.values, schema.data, row.kind)))} />`)}</ul>`}
        ${done.length > 1 && html`<p><a class="button" href=${`/decodes/${done[0]?.decode}?with=${done.slice(1).map(({ decode }) => decode).join()}`}>${t("decode.show_together", { count: done.length })}</a></p>`}
      </section>
      <section class="card" aria-label=${t("decode.options")}>
        <${FormFrame} form=${form} onSubmit=${submit} button=${ready > 1 ? t("decode.button_count", { count: ready }) : t("decode.button")}>
          <${Options} form=${form} schema=${schema} kinds=${new Set(list.length ? list.map(({ kind }) => kind) : ["frame"])} />
        </${FormFrame}>
      </section>
    </div>
  `;
}

/** What can be decoded, and a file to try it with. @param {{ onSample: () => void }} props */
function FirstSteps({ onSample }) {
  return html`
    <div class="card first-steps">
      <h2>${t("decode.first_title")}</h2>
      <ol><li>${t("decode.first_choose")}</li><li>${t("decode.first_place")}</li><li>${t("decode.first_decode")}</li></ol>
      <dl class="facts">${KINDS.map((kind) => html`<dt>${t(`decode.kind_${kind}`)}</dt><dd>${t(`decode.first_${kind}`)}</dd>`)}</dl>
      <p><button type="button" class="quiet" onClick=${onSample}>${t("decode.sample")}</button> <span class="hint">${t("decode.sample_hint")}</span></p>
    </div>
  `;
}

/** @param {{ onFiles: (files: File[]) => void }} props */
function Drop({ onFiles }) {
  const id = useId();
  return html`
    <${DropArea} onFiles=${onFiles}>
      <label for=${id}>${t("decode.drop")}</label>
      <input id=${id} name="file" type="file" multiple accept=${ACCEPTED} onChange=${(/** @type {any} */ event) => {
        onFiles([...event.currentTarget.files]);
        event.currentTarget.value = "";
      }} />
    </${DropArea}>
  `;
}

/** @type {Record<string, "good" | "warn" | "bad" | "none">} */
const LEVELS = { done: "good", failed: "bad", missing: "warn", paused: "warn" };

/** @param {{ row: import("./decode_queue.js").Row, onAgain: () => void }} props */
function FileRow({ row, onAgain }) {
  const { key, state, kind } = row;
  const share = row.size ? row.sent / row.size : 0;
  const isMoving = state === "sending" || state === "decoding";
  return html`
    <li class=${`upload-row state-${state}`}>
      <div class="upload-head">
        <strong class="wrap">${row.name}</strong> <span class="hint">${fileSize(row.size)} · ${row.label}${!row.sure && ` (${t("decode.not_sure")})`}</span>
      </div>
      <div class="upload-line">
        ${state === "ready" ? html`<${KindChoice} row=${row} />` : html`<span>${t(`decode.kind_${kind}`)}</span>`}
        <span class="upload-state" role="status"><${Verdict} level=${LEVELS[state] ?? "none"}>${t(`decode.state_${state}`)}</${Verdict}>${state === "sending" || state === "paused" || state === "missing" ? ` ${number(100 * share, 0, "%")}` : ""}${state === "decoding" && row.job.total ? ` ${t("job.steps", { done: row.job.done ?? 0, total: row.job.total })}` : ""}</span>
        <span class="spacer"></span>
        ${state === "sending" && html`<button type="button" class="quiet" onClick=${() => pauseRow(key)}>${t("decode.pause")}</button>`}
        ${state === "paused" && html`<button type="button" class="quiet" onClick=${() => send(key)}>${t("decode.resume")}</button>`}
        ${state === "failed" && row.file && !row.decode && html`<button type="button" class="quiet" onClick=${onAgain}>${t(row.upload ? "decode.resume" : "problem.retry")}</button>`}
        ${state === "missing" && html`<${ChooseAgain} row=${row} />`}
        ${row.decode && html`<a class=${state === "done" ? "button" : ""} href=${`/decodes/${row.decode}`}>${t("decode.open")}</a>`}
        <button type="button" class="icon" aria-label=${t("decode.remove_file", { name: row.name })} onClick=${() => removeRow(key)}>✕</button>
      </div>
      ${(isMoving || state === "paused" || state === "missing") && html`<progress aria-label=${t("decode.progress_of", { name: row.name })} max="1" value=${state === "decoding" ? row.job.progress : share}></progress>`}
      ${state === "missing" && html`<p class="hint">${t("decode.missing_hint", { name: row.name })}</p>`}
      ${row.summary && html`<p class="upload-summary">${row.summary}</p>`}
      ${Boolean(row.error) && html`<${ProblemBox} error=${row.error} />`}
    </li>
  `;
}

/** @param {{ row: import("./decode_queue.js").Row }} props */
function KindChoice({ row }) {
  return html`<label class="inline-choice"><span>${t("decode.kind")}</span> <select name="kind" value=${row.kind}
    onChange=${(/** @type {any} */ event) => change(row.key, { kind: event.currentTarget.value, sure: true })}>${KINDS.map((name) => html`<option value=${name}>${t(`decode.kind_${name}`)}</option>`)}</select></label>`;
}

/** @param {{ row: import("./decode_queue.js").Row }} props */
function ChooseAgain({ row }) {
  const id = useId();
  return html`<span class="choose-again"><label for=${id}>${t("decode.choose_again")}</label>
    <input id=${id} name="again" type="file" onChange=${(/** @type {any} */ event) => attempt(() => supply(row.key, event.currentTarget.files[0]))} /></span>`;
}
