// The grade of a printed plate by a photo: parameters with cause and cure, the units, and whether vehicles will read it.

import { html } from "htm/preact";
import { useEffect, useState } from "preact/hooks";

import { Problem, request, save } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { DropArea } from "../components/drop.js";
import { Facts } from "../components/facts.js";
import { CheckField, Group, TextField, useForm } from "../components/form.js";
import { attempt } from "../components/notices.js";
import { ProblemBox } from "../components/problem.js";
import { number } from "../format.js";
import { t, textOr } from "../texts/index.js";

/** @typedef {import("../api/schema.js").components["schemas"]["PrintGradeDocument"]} Grade */

const LEVELS = /** @type {Record<string, "good" | "warn" | "bad">} */ ({ A: "good", B: "good", C: "warn", D: "warn", F: "bad" });

/** @param {{ draft: import("./studio_plates_draft.js").Draft }} props */
export function PrintTab({ draft }) {
  const form = useForm({ expected: true, speed_kmh: "60" });
  const [photo, setPhoto] = useState(/** @type {File | null} */ (null));
  const [grade, setGrade] = useState(/** @type {Grade | null} */ (null));
  const isKnown = Boolean(draft.plate && !draft.plate.code.example);
  const send = (/** @type {File} */ file, /** @type {string} */ query) => request(`/v1/print-grades${query}`, { method: "POST", body: formOf(file, form.values, isKnown ? draft : null) });
  const submit = form.submit(async () => {
    setGrade(null);
    if (!photo) throw new Problem({ title: t("print.no_photo"), cure: t("print.choose_photo") });
    setGrade(await (await send(photo, "")).json());
  });
  const report = () => attempt(async () => save(await (await send(/** @type {File} */ (photo), "?format=pdf")).blob(), `print-grade-${grade?.plate.digits}.pdf`));
  return html`
    <div class="studio">
      <form class="studio-form card form" novalidate aria-label=${t("studio.tab_print")} onSubmit=${submit}>
        <${Drop} photo=${photo} onPhoto=${setPhoto} />
        <${Group} title=${t("print.expected")}>
          ${isKnown
            ? html`<${CheckField} form=${form} path="expected" label=${t("print.is_plate", { digits: draft.plate?.code.grouped_digits ?? "" })} />`
            : html`<p class="hint">${t("print.unknown_plate")}</p>`}
          <${TextField} form=${form} path="speed_kmh" label=${t("print.speed")} hint=${t("form.range", { least: 5, most: 250 })} inputmode="decimal" />
        </${Group}>
        <${ProblemBox} error=${form.error} />
        <p class="actions"><button type="submit" disabled=${form.busy}>${t(form.busy ? "print.grading" : "print.grade")}</button></p>
        <${Advice} />
      </form>
      <div class="studio-view" aria-live="polite">
        ${grade ? html`<${GradeOf} grade=${grade} photo=${photo} onReport=${report} />` : html`<div class="card empty"><p class="empty-title">${t("print.empty")}</p><p>${t("print.empty_note")}</p></div>`}
      </div>
    </div>
  `;
}

/** @param {File} file @param {import("../components/form.js").Values} values @param {import("./studio_plates_draft.js").Draft | null} draft */
function formOf(file, values, draft) {
  const speed = Number(String(values.speed_kmh).replace(",", "."));
  /** @type {Record<string, unknown>} */
  const declaration = { speed_kmh: Number.isFinite(speed) ? speed : values.speed_kmh };
  if (draft?.plate && values.expected) {
    const { code: { scheme, digits, check_digits }, geometry: { n, unit_mm, gap_mm, thickness_mm } } = draft.plate;
    if (draft.marker) declaration.marker_id = draft.marker.id;
    else Object.assign(declaration, { code: { scheme, digits, ...(check_digits ? { check_digits } : {}) }, geometry: { n, unit_mm, gap_mm, thickness_mm } });
  }
  const form = new FormData();
  form.append("photo", file);
  form.append("declaration", new Blob([JSON.stringify(declaration)], { type: "application/json" }));
  return form;
}

/** @param {{ photo: File | null, onPhoto: (file: File | null) => void }} props */
function Drop({ photo, onPhoto }) {
  return html`
    <${DropArea} onFiles=${(/** @type {File[]} */ files) => onPhoto(files[0] ?? null)}>
      <label for="photo">${t("print.photo")}</label>
      <input id="photo" name="photo" type="file" accept="image/jpeg,image/png" onChange=${(/** @type {any} */ event) => onPhoto(event.currentTarget.files[0] ?? null)} />
      <p class="hint">${photo ? photo.name : t("print.drop")}</p>
    </${DropArea}>
  `;
}

function Advice() {
  return html`
    <details class="more"><summary>${t("print.advice")}</summary>
      <ol>${/** @type {const} */ (["print.advice_light", "print.advice_above", "print.advice_focus", "print.advice_file"]).map((name) => html`<li>${t(name)}</li>`)}</ol>
    </details>
  `;
}

/** @param {{ grade: Grade, photo: File | null, onReport: () => void }} props */
function GradeOf({ grade, photo, onReport }) {
  const { prediction } = grade;
  const limiting = grade.parameters.filter(({ name }) => grade.limited_by.includes(name));
  return html`
    <section class="card" aria-label=${t("print.result")}>
      <div class="grade-head">
        <p class=${`grade-letter ${LEVELS[grade.letter]}`}>${grade.letter}</p>
        <div>
          <h2>${t("print.overall", { grade: number(grade.grade, 1) })}</h2>
          <p><${Verdict} level=${prediction.will_be_read ? "good" : "bad"}>${t(prediction.will_be_read ? "print.will_be_read" : "print.will_not_be_read", { rate: number(prediction.read_rate * 100, 1, "%"), speed: number(prediction.speed_kmh, 0, "km/h") })}</${Verdict}></p>
          <p class="code">${grade.plate.digits}</p>
        </div>
        <button type="button" class="quiet" onClick=${onReport}>${t("print.report")}</button>
      </div>
      ${limiting.length > 0 && html`
        <h3>${t("print.what_to_do")}</h3>
        <ul>${limiting.map(({ name, finding, cure }) => html`<li><b>${textOr(`print.${name}`, name)}</b>: ${finding}${cure && html`. <em>${cure}</em>`}</li>`)}</ul>
      `}
      <${Parameters} parameters=${grade.parameters} />
    </section>
    <div class="columns">
      <section class="card"><h2>${t("print.units")}</h2><${UnitMap} units=${grade.units} /><p class="hint">${t("print.units_note")}</p></section>
      <section class="card">
        <h2>${t("print.photo")}</h2>
        <${PhotoPreview} photo=${photo} />
        <${Facts} of=${[
          [t("print.side"), number(grade.view.side_px, 0, "px")], [t("print.tilt"), number(grade.view.tilt_deg, 1, "°")],
          [t("print.edge"), number(grade.view.edge_mm, 2, "mm")], [t("print.reading"), textOr(`outcome.${grade.reading.outcome}`, grade.reading.outcome)],
          [t("print.simulated"), t("print.simulated_frames", { read: prediction.frames_read, frames: prediction.simulated_frames })],
          [t("print.height"), t("print.height_ratio", { ratio: number(prediction.unit_height_ratio, 2) })],
        ]} />
        <ul class="plain hint">${grade.notes.map((note) => html`<li>${note}</li>`)}</ul>
      </section>
    </div>
  `;
}

/** @param {{ parameters: Grade["parameters"] }} props */
function Parameters({ parameters }) {
  return html`
    <div class="table-scroll plain-table tall" tabindex="0" role="region" aria-label=${t("print.parameters")}>
      <table>
        <thead><tr><th scope="col">${t("print.parameter")}</th><th scope="col">${t("print.grade_of")}</th><th scope="col" class="number">${t("print.value")}</th><th scope="col">${t("print.finding")}</th><th scope="col">${t("problem.cure")}</th></tr></thead>
        <tbody>${parameters.map((one) => html`
          <tr>
            <th scope="row" title=${one.thresholds.source}>${textOr(`print.${one.name}`, one.name)}</th>
            <td><${Verdict} level=${LEVELS[one.letter] ?? "none"}>${one.letter}</${Verdict}></td>
            <td class="number">${number(one.value, 2, one.unit === "1" ? "" : one.unit)}</td>
            <td>${one.finding}</td><td>${one.cure ?? "–"}</td>
          </tr>
        `)}</tbody>
      </table>
    </div>
  `;
}

/** Distance of each unit from the threshold between dark and light. @param {{ units: Grade["units"] }} props */
function UnitMap({ units }) {
  const n = units.reflectance_margin.length;
  return html`
    <svg class="unit-map" viewBox=${`0 0 ${n * 10} ${n * 10}`} role="img" aria-label=${t("print.units_alt", { wrong: units.wrong.flat().filter(Boolean).length })}>
      ${units.reflectance_margin.flatMap((row, r) => row.map((margin, c) => html`
        <g>
          <rect class=${margin === null ? "unit none" : units.wrong[r]?.[c] ? "unit bad" : margin < 0.3 ? "unit weak" : margin < 0.5 ? "unit fair" : "unit good"} x=${c * 10 + 0.5} y=${r * 10 + 0.5} width="9" height="9" />
          ${margin !== null && html`<text x=${c * 10 + 5} y=${r * 10 + 6.4} text-anchor="middle" font-size="3.6">${units.wrong[r]?.[c] ? "✕" : Math.round(margin * 100)}</text>`}
        </g>
      `))}
    </svg>
  `;
}

/** @param {{ photo: File | null }} props */
function PhotoPreview({ photo }) {
  const [url, setUrl] = useState("");
  useEffect(() => {
    const made = photo ? URL.createObjectURL(photo) : "";
    setUrl(made);
    return () => URL.revokeObjectURL(made);
  }, [photo]);
  return url ? html`<img class="picture" src=${url} alt=${t("print.photo_alt")} />` : null;
}
