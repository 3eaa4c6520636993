// The report on a survey: the result, what is wrong with its cure, corrections to accept, what was detected.

import { html } from "htm/preact";
import { useEffect, useState } from "preact/hooks";

import { save } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Facts } from "../components/facts.js";
import { number } from "../format.js";
import { setQuery } from "../router.js";
import { t, textOr } from "../texts/index.js";
import { changesText } from "./imports_options.js";

const FEW = 12; // rows of one fault that are named

/** @typedef {import("../api/schema.js").components["schemas"]["ImportReport"]} Report */
/** @typedef {Report["faults"][number]} Fault */
/** @typedef {{ onChanges: (changes: Record<string, any>) => void, onLeaveOut: (rows: number[], out: boolean) => void, onAll: () => void }} Accept */

/** @param {{ report: Report }} props */
export function Summary({ report }) {
  const refused = report.outcome === "refused" || report.good_rows === 0;
  const level = refused ? "bad" : report.refused_rows || report.warned_rows ? "warn" : "good";
  return html`
    <p class="summary"><${Verdict} level=${level}>${report.outcome === "stored" ? t("imports.stored", { count: number(report.stored) }) : refused ? t("imports.refused") : t("imports.can_be_stored", { count: number(report.good_rows) })}</${Verdict}></p>
    <ul class="counts">
      <li><strong>${number(report.rows)}</strong> ${t("imports.rows")}</li>
      <li><strong>${number(report.good_rows)}</strong> ${t("imports.count_good")}</li>
      <li><strong>${number(report.warned_rows)}</strong> ${t("imports.count_warning")}</li>
      <li><strong>${number(report.refused_rows)}</strong> ${t("imports.count_refused")}</li>
      ${report.left_out_rows > 0 && html`<li><strong>${number(report.left_out_rows)}</strong> ${t("imports.count_left_out")}</li>`}
    </ul>
  `;
}

/**
 * Faults by what they are, those of the whole file first.
 *
 * @param {{ report: Report, accept?: Accept }} props
 */
export function Faults({ report, accept }) {
  const groups = groupsOf(report.faults);
  if (!groups.length) return html`<p><${Verdict} level="good">${t("imports.no_faults")}</${Verdict}></p>`;
  const offered = accept && allOf(report);
  return html`
    ${offered && (offered.rows.length > 0 || offered.text) && html`<p class="actions"><button type="button" onClick=${accept.onAll}>${t("imports.accept_all")}</button> <span class="hint">${[offered.text, offered.rows.length > 0 && t("imports.leaves_out", { count: offered.rows.length })].filter(Boolean).join("; ")}</span></p>`}
    <ul class="faults">${groups.map((group) => html`<${Group} key=${group.key} group=${group} report=${report} accept=${accept} />`)}</ul>
    ${report.faults_left_out > 0 && html`<p class="hint">${t("imports.faults_left_out", { count: number(report.faults_left_out) })}</p>`}
  `;
}

/** What all corrections together would do: changes for the whole file, and refused rows that are left out. @param {Report} report */
export function allOf(report) {
  /** @type {Record<string, any>} */
  const changes = {};
  for (const fault of report.faults) if (fault.row === null && fault.changes) merge(changes, fault.changes);
  const rows = [...new Set(report.faults.filter((fault) => fault.row !== null && fault.severity === "refused").map((fault) => fault.row ?? 0))];
  return { changes, rows: Object.keys(changes).length ? [] : rows, text: Object.keys(changes).length ? changesText(changes) : "" };
}

/** JSON Merge Patch, RFC 7396, without removal. @param {Record<string, any>} target @param {Record<string, any>} patch */
function merge(target, patch) {
  for (const [name, value] of Object.entries(patch)) {
    if (value !== null && typeof value === "object" && !Array.isArray(value)) merge(target[name] ??= {}, value);
    else target[name] = value;
  }
}

/** @param {Fault[]} faults */
function groupsOf(faults) {
  /** @type {Map<string, { key: string, first: Fault, faults: Fault[] }>} */
  const groups = new Map();
  for (const fault of faults) {
    const key = fault.row === null ? `${fault.code} ${fault.message}` : `${fault.severity} ${fault.code} ${fault.field}`;
    const group = groups.get(key);
    if (group) group.faults.push(fault);
    else groups.set(key, { key, first: fault, faults: [fault] });
  }
  return [...groups.values()].sort((a, b) => Number(a.first.row !== null) - Number(b.first.row !== null));
}

/** @param {{ group: ReturnType<typeof groupsOf>[number], report: Report, accept?: Accept }} props */
function Group({ group, report, accept }) {
  const { first, faults } = group;
  const [all, setAll] = useState(false);
  const rows = faults.flatMap(({ row }) => (row === null ? [] : [row]));
  const shown = all ? faults : faults.slice(0, FEW);
  const area = first.code === "place_unchecked" && report.extent_deg ? { area_deg: widened(report.extent_deg) } : null;
  const changes = first.changes ?? area;
  return html`
    <li class=${`fault ${first.severity}`}>
      <p><${Verdict} level=${first.severity === "refused" ? "bad" : "warn"}>${textOr(`import_fault.${first.code}`, first.code)}</${Verdict}> ${rows.length > 0 && html`<span class="hint">${t(rows.length === 1 ? "imports.in_row" : "imports.in_rows", { count: number(rows.length) })}</span>`}</p>
      ${first.row === null
        ? html`<p lang="en">${first.message}</p>`
        : html`<ul class="plain">${shown.map((fault) => html`<li lang="en"><button type="button" class="link" aria-label=${t("imports.show_row", { row: fault.row ?? 0 })} onClick=${() => setQuery({ row: fault.row })}>${fault.row}</button> ${fault.message}</li>`)}</ul>`}
      ${faults.length > shown.length && html`<p><button type="button" class="link" onClick=${() => setAll(true)}>${t("imports.show_all", { count: number(faults.length) })}</button></p>`}
      ${first.proposal && html`<p lang="en"><strong>${t("problem.cure")}:</strong> ${first.proposal}</p>`}
      ${accept && html`<p class="buttons">
        ${changes && html`<button type="button" class="quiet" onClick=${() => accept.onChanges(changes)}>${area ? t("imports.place_is_right") : t("imports.apply", { changes: changesText(changes) })}</button>`}
        ${rows.length > 0 && html`<button type="button" class="quiet" onClick=${() => accept.onLeaveOut(rows, true)}>${t(rows.length === 1 ? "imports.leave_out_one" : "imports.leave_out", { count: number(rows.length) })}</button>`}
      </p>`}
    </li>
  `;
}

/** A box a little wider than all rows: about 100 m. @param {number[]} extent */
function widened([west = 0, south = 0, east = 0, north = 0]) {
  const margin = 0.001;
  return [west - margin, south - margin, east + margin, north + margin].map((side) => Number(side.toFixed(4)));
}

/** @param {{ report: Report }} props */
export function Detected({ report }) {
  return html`
    <${Facts} of=${[[t("field.crs"), report.crs], [t("imports.format"), textOr(`format.${report.format}`, report.format)], [t("field.grade"), textOr(`grade.${report.localization_grade}`, report.localization_grade)], [t("field.transform_note"), report.transform_note], [t("imports.hash"), html`<span class="code small wrap">${report.file_sha256}</span>`]]} />
    ${report.detected.length > 0 && html`<div class="table-scroll plain-table" tabindex="0" role="region" aria-label=${t("imports.detected")}><table>
      <thead><tr><th scope="col">${t("imports.property")}</th><th scope="col">${t("settings.value")}</th><th scope="col">${t("imports.because")}</th></tr></thead>
      <tbody lang="en">${report.detected.map(({ what, value, evidence }) => html`<tr><th scope="row">${what}</th><td class="code">${value}</td><td>${evidence}</td></tr>`)}</tbody>
    </table></div>`}
  `;
}

/** Residuals of a survey that measured registered markers. @param {{ report: Report }} props */
export function Comparison({ report }) {
  const found = /** @type {any} */ (report.comparison);
  const [url, setUrl] = useState("");
  useEffect(() => {
    if (!found?.map_svg) return undefined;
    const made = URL.createObjectURL(new Blob([found.map_svg], { type: "image/svg+xml" }));
    setUrl(made);
    return () => URL.revokeObjectURL(made);
  }, [found?.map_svg]);
  if (!found) return null;
  const { residuals: _rows, map_svg: _map, ...figures } = found;
  return html`
    <section class="card"><h2>${t("imports.comparison")}</h2>
      <${Facts} of=${Object.entries(figures).filter(([, value]) => typeof value === "number").map(([name, value]) => [textOr(`comparison.${name}`, name), number(Number(value), Number.isInteger(value) ? 0 : 3)])} />
      ${url && html`<img class="picture" src=${url} alt=${t("imports.residual_map")} />`}
    </section>
  `;
}

/** @param {{ report: Report }} props */
export function Downloads({ report }) {
  const name = `import-${report.file_sha256.slice(0, 8)}`;
  const cell = (/** @type {unknown} */ value) => `"${String(value ?? "").replace(/^[=+\-@]/, "'$&").replaceAll('"', '""')}"`;
  const csv = () => ["row,severity,code,field,message,proposal", ...report.faults.map((fault) => [fault.row ?? "", fault.severity, fault.code, fault.field, fault.message, fault.proposal].map(cell).join(","))].join("\r\n");
  return html`
    <button type="button" class="quiet" onClick=${() => save(new Blob([JSON.stringify(report, null, 1)], { type: "application/json" }), `${name}.json`)}>${t("imports.report_json")}</button>
    <button type="button" class="quiet" onClick=${() => save(new Blob([csv()], { type: "text/csv" }), `${name}.csv`)}>${t("imports.report_csv")}</button>
  `;
}
