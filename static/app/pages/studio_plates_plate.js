// The plate as it will be made: fields beside the drawing, its dimensions, its files, and its registration.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

import { download, request } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Facts } from "../components/facts.js";
import { bodyOf, CheckField, FormFrame, Group, SchemaField, SelectField, TextField, useForm } from "../components/form.js";
import { Empty } from "../components/load.js";
import { attempt, notify } from "../components/notices.js";
import { Picture } from "../components/picture.js";
import { fieldErrors, isAtField, ProblemBox } from "../components/problem.js";
import { codeOf, degrees, number } from "../format.js";
import { navigate } from "../router.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";
import { jsonText, markerIdOf, plateBody, plateText } from "./studio_plates_draft.js";
import { PlateDrawing } from "./studio_plates_drawing.js";

/** @typedef {import("./studio_plates_draft.js").Draft} Draft */

const SCHEMES = /** @type {const} */ (["id", "position-robust", "position-check", "position"]);
/** Units along a side and their size, for plates of 325 mm: docs/decisions/0008-plate-codes.md. @type {Record<string, [string, string]>} */
const SIZES = { "position-robust": ["10", "27"] };
const FORMATS = ["pdf", "svg", "dxf", "png"];
const DRAWN = ["side", "unit", "gap", "border", "pitch", "marker", "thickness", "diagonal"]; // dimensions in the drawing

/** @param {{ schema: any, typed: import("../components/query_form.js").QueryForm, draft: Draft }} props */
export function PlateTab({ schema, typed, draft }) {
  const [chosen, setChosen] = useState("");
  const { plate } = draft;
  return html`
    <div class="studio">
      <div class="studio-form">
        <${PlateForm} schema=${schema} typed=${typed} draft=${draft} />
        ${!draft.marker && may("POST /v1/markers") && html`<${Registration} schema=${schema} typed=${typed} />`}
      </div>
      <div class="studio-view">
        ${!plate && !draft.error && html`<p class="loading" role="status">${t("load.loading")}</p>`}
        ${!plate && draft.error && html`<div class="card"><${Empty} title=${t("studio.nothing_yet")}><p>${t("studio.nothing_yet_cure")}</p></${Empty}></div>`}
        ${plate && html`
          <section class=${draft.error ? "card stale" : "card"} aria-label=${t("studio.drawing")}>
            <${PlateHead} draft=${draft} />
            <${PlateDrawing} plate=${plate} chosen=${chosen} />
            <${Files} draft=${draft} />
          </section>
          <div class="columns">
            <${Dimensions} plate=${plate} chosen=${chosen} onChoose=${setChosen} />
            <${CodeFacts} plate=${plate} />
          </div>
        `}
      </div>
    </div>
  `;
}

/** @param {{ schema: any, typed: import("../components/query_form.js").QueryForm, draft: Draft, short?: boolean }} props */
export function PlateForm({ schema, typed, draft, short }) {
  const form = { ...typed, errors: errorsOf(draft.error) };
  const scheme = /** @type {(typeof SCHEMES)[number]} */ (typed.values["code.scheme"]);
  const pick = (/** @type {string} */ picked) => {
    const [n, unit] = SIZES[picked] ?? ["8", "35"];
    typed.setMany({ "code.scheme": picked, "geometry.n": n, "geometry.unit_mm": unit, "geometry.gap_mm": "5" });
  };
  const field = (/** @type {string} */ path, more = {}) => html`<${SchemaField} form=${form} schema=${schema} path=${path} ...${more} />`;
  const isMarker = Boolean(markerIdOf(typed.values));
  const unnamed = draft.error && !isAtField(form.errors, typed.values);
  return html`
    <form class="card form" novalidate autocomplete="off" aria-label=${t("studio.plate_fields")} onSubmit=${(/** @type {Event} */ event) => event.preventDefault()}>
      <${Group} title=${t("register.code")}>
        <${SelectField} form=${form} path="code.scheme" label=${t("field.scheme")} options=${SCHEMES.map((name) => [name, t(`scheme.${name}`)])} onPick=${pick}
          hint=${t(`scheme_hint.${scheme}`)} />
        ${scheme === "id" && html`<${TextField} form=${form} path="number" label=${t("studio.number")} hint=${t("studio.number_hint")} placeholder="0xC0FFEE42" />`}
        ${scheme === "position-check" && html`<${SelectField} form=${form} path="code.check_digits" label=${labelOfChecks()} options=${[["", "1"], ["2", "2"]]} />`}
      </${Group}>
      ${!isMarker && html`
        <${Group} title=${scheme === "id" ? t("studio.place_optional") : t("studio.place")}>
          ${field("position.lon_deg", { required: scheme !== "id", placeholder: "114.179203" })}
          ${field("position.lat_deg", { required: scheme !== "id", placeholder: "22.304161" })}
        </${Group}>
        <${Group} title=${t("studio.size")}>
          <${SelectField} form=${form} path="geometry.n" label=${t("field.n")} options=${["8", "10", "12"].map((name) => [name, name])} />
          ${field("geometry.unit_mm", { hint: t("form.range", { least: 20, most: 50 }) })}
          ${field("geometry.gap_mm", { hint: t("form.range", { least: 2, most: 10 }) })}
          ${field("geometry.thickness_mm", { hint: t("form.range", { least: 5, most: 50 }) })}
        </${Group}>
        ${!short && html`
          <details class="more" open=${Boolean(typed.values["code.digits"])}>
            <summary>${t("studio.own_digits")}</summary>
            <div class="group">
              ${field("code.digits", { placeholder: t("register.computed") })}
              ${scheme !== "id" && html`<${CheckField} form=${form} path="code.allow_mismatched_digits" label=${t("register.mismatched")} />`}
            </div>
          </details>
        `}
      `}
      <div aria-live="polite">
        ${draft.error && draft.plate && html`<p class="warning">${t("studio.stale")}</p>`}
        ${unnamed && html`<${ProblemBox} error=${draft.error} />`}
      </div>
    </form>
  `;
}

const labelOfChecks = () => textOr("field.check_digits", "check_digits");

/** Errors by the fields of the page: a number and a pair of coordinates have names of their own there. @param {unknown} error */
function errorsOf(error) {
  const found = fieldErrors(error);
  return { ...found, number: found["code.registry_number"] ?? found.registry_number ?? found.marker_id ?? "", "position.lon_deg": found["position.lon_deg"] ?? found.position ?? "" };
}

/** @param {{ draft: Draft }} props */
function PlateHead({ draft }) {
  const { code, geometry } = /** @type {import("./studio_plates_draft.js").PlateDraft} */ (draft.plate);
  return html`
    <div class="title-line">
      <h2 class="code">${code.grouped_digits}</h2>
      <p class="hint">${t("register.side", { side: number(geometry.side_mm, 0, "mm") })}</p>
    </div>
    ${draft.marker && html`<p>${t("studio.registered_as")} <a href=${`/markers/${draft.marker.id}`}>${codeOf(draft.marker)}</a></p>`}
    ${code.example && html`<p class="hint">${t("studio.example_number")}</p>`}
  `;
}

/** @param {{ draft: Draft }} props */
function Files({ draft }) {
  const form = useForm({ heaters: false, leds: false, dpi: "150" });
  const [sheet, setSheet] = useState(false);
  const heaters = form.values.heaters === true;
  const leds = form.values.leds === true;
  const digits = draft.plate?.code.digits ?? "";
  const dpi = Number(form.values.dpi);
  /** @param {string} kind @returns {[string, RequestInit | undefined]} */
  const source = (kind) => {
    if (draft.marker) return [`/v1/markers/${draft.marker.id}/artwork.${kind}?${new URLSearchParams({ heaters: String(heaters), leds: String(leds), resolution_dpi: String(dpi) })}`, undefined];
    return [`/v1/plate-drafts/artwork.${kind}`, jsonText(plateText({ ...draft.body, heaters, leds, resolution_dpi: dpi }))];
  };
  const [sheetPath, sheetOptions] = source("svg");
  return html`
    <h3>${t("studio.files")}</h3>
    <div class="studio-files">
      <div class="buttons" role="group" aria-label=${t("marker.download_artwork")}>
        ${FORMATS.map((kind) => html`<button type="button" class="quiet" disabled=${Boolean(draft.error)} onClick=${() => attempt(async () => {
          const [path, options] = source(kind);
          const response = await download(path, `${digits}.${kind}`, options);
          notify(t("studio.saved", { name: `${digits}.${kind}` }), { detail: t("marker.proof", { proof: response.headers.get("Waymark-Proof") ?? "" }) });
        })}>${kind.toUpperCase()}</button>`)}
      </div>
      <${CheckField} form=${form} path="heaters" label=${t("artwork.heaters")} />
      <${CheckField} form=${form} path="leds" label=${t("artwork.leds")} />
      <label class="check">${t("studio.dpi")} <select name="dpi" value=${form.values.dpi} onChange=${(/** @type {any} */ event) => form.set("dpi", event.currentTarget.value)}>
        ${["72", "150", "300"].map((value) => html`<option value=${value}>${value}</option>`)}</select></label>
    </div>
    <details class="more" onToggle=${(/** @type {any} */ event) => setSheet(event.currentTarget.open)}>
      <summary>${t("studio.sheet")}</summary>
      ${sheet && html`<${Picture} kind="artwork" path=${sheetPath} options=${sheetOptions} alt=${t("marker.artwork_of", { code: digits })} />`}
    </details>
  `;
}

/** @param {{ plate: import("./studio_plates_draft.js").PlateDraft, chosen: string, onChoose: (name: string) => void }} props */
function Dimensions({ plate, chosen, onChoose }) {
  return html`
    <section class="card">
      <h2>${t("studio.dimensions")}</h2>
      <div class="table-scroll plain-table tall" tabindex="0" role="region" aria-label=${t("studio.dimensions")}>
        <table>
          <thead><tr><th scope="col">${t("studio.dimension")}</th><th scope="col" class="number">mm</th><th scope="col" class="number">${t("studio.tolerance")}</th></tr></thead>
          <tbody>${plate.dimensions.map(({ name, value_mm, tolerance_mm }) => html`
            <tr class=${name === chosen ? "chosen" : undefined} onMouseEnter=${() => onChoose(name)} onMouseLeave=${() => onChoose("")}>
              <td>${DRAWN.includes(name)
                ? html`<button type="button" class="sort" onFocus=${() => onChoose(name)} onBlur=${() => onChoose("")}>${textOr(`dimension.${name}`, name)}</button>`
                : textOr(`dimension.${name}`, name)}</td><td class="number">${number(value_mm, value_mm % 1 ? 1 : 0)}</td>
              <td class="number">${tolerance_mm === null ? "–" : `± ${number(tolerance_mm, 1)}`}</td>
            </tr>
          `)}</tbody>
        </table>
      </div>
      <p class="hint">${t("studio.dimensions_hint")}</p>
    </section>
  `;
}

/** @param {{ plate: import("./studio_plates_draft.js").PlateDraft }} props */
function CodeFacts({ plate }) {
  const { code, position, geometry } = plate;
  const corrects = code.correctable_cells > 0;
  return html`
    <section class="card">
      <h2>${t("register.code")}</h2>
      <${Facts} of=${[
        [t("studio.digits"), html`<span class="code">${code.digits}</span>`],
        [t("studio.registry_number"), code.registry_number && `0x${code.registry_number} = ${BigInt(`0x${code.registry_number}`)}`],
        [t("studio.carried"), t("studio.bits", { bits: number(code.bits, 0) })],
        [t("studio.checks"), html`<${Verdict} level=${corrects ? "good" : "warn"}>${corrects
          ? t("studio.corrects", { wrong: code.correctable_cells, erased: code.correctable_erasures })
          : t("studio.corrects_nothing")}</${Verdict}>`],
        [t("marker.position"), position && `${degrees(position.lon_deg)}, ${degrees(position.lat_deg)}`],
        [t("studio.units"), `${geometry.n} × ${geometry.n}`],
      ]} />
      <h3>${t("studio.colours")}</h3>
      <ul class="plain colours">${plate.colours.map(({ layer, screen, ral }) => html`
        <li><svg class="swatch" viewBox="0 0 10 10" aria-hidden="true"><rect width="10" height="10" fill=${screen} /></svg> ${textOr(`layer.${layer}`, layer)}: ${ral}</li>
      `)}</ul>
    </section>
  `;
}

/** @param {{ schema: any, typed: import("../components/query_form.js").QueryForm }} props */
function Registration({ schema, typed }) {
  const form = useForm({ status: "planned" });
  const submit = async () => {
    const body = plateBody(typed.values, schema);
    const more = bodyOf(form.values, schema);
    const { position, ...others } = more;
    const text = plateText({ family: "plate", ...body, ...others, position: { ...body.position, ...position } });
    const marker = await (await request("/v1/markers", jsonText(text))).json();
    notify(t("register.done", { code: codeOf(marker) }), { detail: marker.code_warnings.map((/** @type {any} */ warning) => warning.message).join(" ") });
    navigate(`/markers/${marker.id}`);
  };
  const field = (/** @type {string} */ path, more = {}) => html`<${SchemaField} form=${form} schema=${schema} path=${path} ...${more} />`;
  return html`
    <details class="card more registration">
      <summary><h2>${t("plates.register")}</h2></summary>
      <p class="hint">${t("studio.register_hint")}</p>
      <${FormFrame} form=${form} onSubmit=${submit} button=${t("register.button")}>
        <div class="group">
          ${field("heading_deg", { placeholder: "78.5" })}
          ${field("status")}
          ${field("road")}
          ${field("position.height_m")}
          ${field("position.horizontal_rmse_m", { placeholder: "0.012" })}
          ${field("position.vertical_rmse_m")}
        </div>
      </${FormFrame}>
    </details>
  `;
}
