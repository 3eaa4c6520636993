// Camera calculator: frames of a pass, rows of a unit, motion blur, predicted read rates, and a picture of a frame.

import { html } from "htm/preact";
import { useRef } from "preact/hooks";

import { request } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { bodyOf, Group, SchemaField, TextField } from "../components/form.js";
import { Empty } from "../components/load.js";
import { fieldErrors, isAtField, ProblemBox } from "../components/problem.js";
import { useLive, useQueryForm } from "../components/query_form.js";
import { number } from "../format.js";
import { t, textOr } from "../texts/index.js";
import { CameraPicture } from "./studio_plates_view.js";
import { jsonText, plateText } from "./studio_plates_draft.js";
import { PlateForm } from "./studio_plates_plate.js";

/** @typedef {import("../api/schema.js").components["schemas"]["CameraPass"]} Pass */

const FIELDS = {
  height: "camera.height_m", fov: "camera.horizontal_fov_deg", down: "camera.depression_deg", width: "camera.width_px", rows: "camera.height_px",
  fps: "camera.frames_per_s", exposure: "exposure_ms", speed: "speed_kmh", left: "left_m", ahead: "ahead_m", condition: "condition",
};
/** @type {import("../components/form.js").Values} */
const START = {
  "camera.height_m": "1.57", "camera.horizontal_fov_deg": "70", "camera.depression_deg": "23", "camera.width_px": "1920", "camera.height_px": "1080",
  "camera.frames_per_s": "30", exposure_ms: "1", speed_kmh: "60", left_m: "0", ahead_m: "4", condition: "day",
};
const FILM_MM = 36;

/** @param {{ schema: any, plate: import("../components/query_form.js").QueryForm, draft: import("./studio_plates_draft.js").Draft }} props */
export function CameraTab({ schema, plate, draft }) {
  const typed = useQueryForm(FIELDS, START, null);
  const body = passBody(typed.values, schema, draft);
  const key = body ? plateText(body) : null;
  const opened = useRef(false); // the details show the errors of the plate, so they open with the first one
  opened.current ||= Boolean(draft.error);
  const found = useLive(async (signal) => {
    const response = await request("/v1/plate-drafts/pass", { ...jsonText(key ?? ""), signal });
    return /** @type {Pass} */ (await response.json());
  }, key);
  return html`
    <div class="studio">
      <div class="studio-form">
        <${CameraForm} schema=${schema} typed=${{ ...typed, ...errorsOf(found.error, typed) }} />
        <details class="more card" open=${opened.current}>
          <summary><h2>${t("studio.plate_of", { digits: draft.plate?.code.grouped_digits ?? "–" })}</h2></summary>
          <${PlateForm} schema=${schema} typed=${plate} draft=${draft} short />
        </details>
      </div>
      <div class="studio-view">
        ${found.error && !isAtField(errorsOf(found.error, typed).errors, typed.values) && html`<${ProblemBox} error=${found.error} />`}
        ${!found.data && !found.error && !draft.error && html`<p class="loading" role="status">${t("load.loading")}</p>`}
        ${!found.data && draft.error && html`<div class="card"><${Empty} title=${t("studio.nothing_yet")}><p>${t("studio.nothing_yet_cure")}</p></${Empty}></div>`}
        ${found.data && html`
          <${Figures} pass=${found.data} stale=${Boolean(found.error)} />
          ${body && draft.plate && html`<${CameraPicture} typed=${typed} body=${body} draft=${draft} pass=${found.data} />`}
          <div class="columns">
            <${Rates} pass=${found.data} />
            <${Frames} pass=${found.data} />
          </div>
        `}
      </div>
    </div>
  `;
}

/** @param {import("../components/form.js").Values} values @param {any} schema @param {import("./studio_plates_draft.js").Draft} draft */
function passBody(values, schema, draft) {
  if (!draft.body || draft.error) return null;
  const { exposure_ms, ahead_m: _ahead, condition: _condition, ...others } = values;
  const body = bodyOf(others, schema);
  const exposure = Number(String(exposure_ms).replace(",", "."));
  body.camera = { ...body.camera, ...(exposure_ms ? { exposure_s: Number.isFinite(exposure) ? exposure / 1000 : exposure_ms } : {}) };
  return { ...draft.body, ...body };
}

/** @param {unknown} error @param {import("../components/query_form.js").QueryForm} typed */
function errorsOf(error, typed) {
  const found = error ? fieldErrors(error) : typed.errors;
  return { errors: { ...found, exposure_ms: found["camera.exposure_s"] ?? "" } };
}

/** @param {{ schema: any, typed: import("../components/query_form.js").QueryForm }} props */
function CameraForm({ schema, typed }) {
  const field = (/** @type {string} */ path, more = {}) => html`<${SchemaField} form=${typed} schema=${schema} path=${path} ...${more} />`;
  const fov = Number(String(typed.values["camera.horizontal_fov_deg"]).replace(",", "."));
  const half = Math.tan((fov * Math.PI) / 360);
  const lens = half > 0 ? t("studio.lens_hint", { film: number(FILM_MM / 2 / half, 0), pixels: number(Number(typed.values["camera.width_px"]) / 2 / half, 0) }) : "";
  return html`
    <form class="card form" novalidate autocomplete="off" aria-label=${t("studio.tab_camera")} onSubmit=${(/** @type {Event} */ event) => event.preventDefault()}>
      <${Group} title=${t("studio.camera")}>
        ${field("camera.height_m")}
        ${field("camera.depression_deg")}
        ${field("camera.horizontal_fov_deg", { label: t("studio.lens"), hint: lens })}
        ${field("camera.width_px")}
        ${field("camera.height_px")}
      </${Group}>
      <${Group} title=${t("studio.drive")}>
        ${field("speed_kmh")}
        ${field("camera.frames_per_s")}
        <${TextField} form=${typed} path="exposure_ms" label=${t("studio.exposure_ms")} hint=${t("form.range", { least: "0.001", most: 100 })} inputmode="decimal" />
        ${field("left_m", { label: t("studio.left_m") })}
      </${Group}>
    </form>
  `;
}

/** @param {{ pass: Pass, stale: boolean }} props */
function Figures({ pass, stale }) {
  const day = pass.read_rates.find(({ condition }) => condition === "day");
  return html`
    <div class=${stale ? "figure-tiles stale" : "figure-tiles"} role="group" aria-label=${t("studio.figures")}>
      <${Figure} name=${t("studio.frames_per_pass")} value=${number(pass.readable_frames_per_pass, pass.readable_frames_per_pass < 10 ? 1 : 0)}
        note=${pass.near_m === null ? t("studio.never_readable") : t("studio.frames_between", { near: number(pass.near_m, 1, "m"), far: number(pass.far_m, 1, "m"), step: number(pass.step_m, 2, "m") })} />
      <${Figure} name=${t("studio.unit_rows")} value=${number(pass.best_unit_px, 1, "px")} note=${t("studio.unit_rows_note")} />
      <${Figure} name=${t("studio.blur")} value=${number(pass.blur_mm, 1, "mm")} note=${t("studio.blur_note", { units: number(pass.blur_units, 2), pixels: number(Math.max(0, ...pass.frames.map(({ blur_px }) => blur_px)), 1, "px") })} />
      <${Figure} name=${t("studio.read_by_day")} value=${number((day?.read_rate ?? 0) * 100, 1, "%")} note=${html`<${Will} read=${day?.will_be_read ?? false} />`} />
    </div>
  `;
}

/** @param {{ name: string, value: string, note: any }} props */
function Figure({ name, value, note }) {
  return html`<div class="card tile"><p class="hint">${name}</p><p class="figure">${value}</p><p class="hint">${note}</p></div>`;
}

/** @param {{ read: boolean }} props */
function Will({ read }) {
  return html`<${Verdict} level=${read ? "good" : "bad"}>${t(read ? "studio.expected" : "studio.not_expected")}</${Verdict}>`;
}

/** @param {{ pass: Pass }} props */
function Rates({ pass }) {
  return html`
    <section class="card">
      <h2>${t("studio.rates")}</h2>
      <div class="table-scroll plain-table tall" tabindex="0" role="region" aria-label=${t("studio.rates")}>
        <table>
          <thead><tr><th scope="col">${t("studio.condition")}</th><th scope="col" class="number">${t("studio.read_rate")}</th><th scope="col">${t("studio.verdict")}</th></tr></thead>
          <tbody>${pass.read_rates.map(({ condition, read_rate, will_be_read }) => html`
            <tr><td>${textOr(`condition.${condition}`, condition)}</td><td class="number">${number(read_rate * 100, 1, "%")}</td><td><${Will} read=${will_be_read} /></td></tr>
          `)}</tbody>
        </table>
      </div>
      <p class="hint">${t("studio.rates_note", { least: number(pass.min_read_rate * 100, 0, "%") })}</p>
    </section>
  `;
}

/** @param {{ pass: Pass }} props */
function Frames({ pass }) {
  return html`
    <section class="card">
      <h2>${t("studio.frames")}</h2>
      ${pass.frames.length ? html`
        <div class="table-scroll plain-table" tabindex="0" role="region" aria-label=${t("studio.frames")}>
          <table>
            <thead><tr>${["ahead", "unit", "plate", "blur", "read"].map((name) => html`<th scope="col" class="number">${textOr(`frame.${name}`, name)}</th>`)}</tr></thead>
            <tbody>${pass.frames.map((frame) => html`
              <tr>
                <td class="number">${number(frame.ahead_m, 2, "m")}</td><td class="number">${number(frame.unit_px, 1, "px")}</td>
                <td class="number">${number(frame.plate_width_px, 0)} × ${number(frame.plate_height_px, 0, "px")}</td>
                <td class="number">${number(frame.blur_px, 1, "px")}</td><td class="number">${number(frame.read_probability * 100, 0, "%")}</td>
              </tr>
            `)}</tbody>
          </table>
        </div>
        <p class="hint">${t(pass.listed_every > 1 ? "studio.frames_some" : "studio.frames_note", { every: pass.listed_every })}</p>
      ` : html`<p class="empty">${t("studio.never_readable")}</p>`}
    </section>
  `;
}
