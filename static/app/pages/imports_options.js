// What is declared of a survey: a form from the JSON Schema of the declaration, and the declaration from the form.

import { html } from "htm/preact";

import { Problem } from "../api/client.js";
import { bodyOf, Group, SchemaField, SelectField, TextField } from "../components/form.js";
import { t, textOr } from "../texts/index.js";

const FAMILIES = /** @type {const} */ (["plate", "cerpm", "fiducial"]);
const BOXES = { area_deg: 4, height_range_m: 2 };
const READING = ["format", "layout", "decimal", "delimiter", "encoding", "layer"];
const FRAME = ["unit", "height_unit", "realization", "epoch"];
const SURVEY = ["horizontal_rmse_m", "vertical_rmse_m", "survey_method", "surveyor", "instrument", "check_points"];
const OF_FAMILY = /** @type {Record<string, string[]>} */ ({ plate: ["scheme"], cerpm: ["side", "speed_limit.value", "speed_limit.unit"], fiducial: ["sign.dictionary", "sign.geometry.side_mm", "sign.geometry.mounting"] });
const STORED = "waymark-import";

/** @typedef {import("../components/form.js").Form} Form */

/** Options that are kept while the tab is open: surveys of one project are alike. */
export function keptValues() {
  try {
    return { family: "plate", ...JSON.parse(sessionStorage.getItem(STORED) ?? "{}") };
  } catch {
    return { family: "plate" };
  }
}

/** @param {import("../components/form.js").Values} values */
export const keepValues = ({ area_deg: _area, columns: _columns, layout: _layout, mode: _mode, ...values }) => sessionStorage.setItem(STORED, JSON.stringify(values));

/** @param {{ form: Form, schema: import("../components/form.js").Schema }} props */
export function Options({ form, schema }) {
  const family = String(form.values.family);
  const field = (/** @type {string} */ path, more = {}) => html`<${SchemaField} form=${form} schema=${schema} path=${path} label=${labelOf(path)} ...${more} />`;
  const wrong = (/** @type {string[]} */ paths) => paths.some((path) => form.errors[path]);
  const more = [...READING, ...FRAME, ...Object.keys(BOXES), "columns", "local_grid", "duplicates", "warnings", "match", "tolerance_m"];
  return html`
    <${Group} title=${t("imports.markers")}>
      <${SelectField} form=${form} path="family" label=${t("field.family")} options=${FAMILIES.map((name) => [name, t(`family.${name}`)])} />
      ${field("status", { hint: t("imports.status_hint") })}
      <${TextField} form=${form} path="road" label=${t("field.road")} hint=${t("imports.road_hint")} />
      ${(OF_FAMILY[family] ?? []).map((path) => field(path))}
      ${field("compare")}
      ${form.values.compare && html`${field("match")}${field("tolerance_m")}`}
    </${Group}>
    <${Group} title=${t("imports.frame")}>
      ${field("crs", { hint: t("imports.crs_hint"), placeholder: "EPSG:25832" })}
      ${field("vertical_datum", { hint: t("imports.datum_hint"), placeholder: "ellipsoid" })}
      ${field("ignore_heights")}
    </${Group}>
    <details class="section" open=${wrong(SURVEY.map((name) => `survey.${name}`)) || undefined}>
      <summary><strong>${t("imports.survey")}</strong></summary>
      <div class="group">${SURVEY.map((name) => field(`survey.${name}`))}</div>
    </details>
    <details class="section" open=${wrong(more) || undefined}>
      <summary><strong>${t("imports.more")}</strong></summary>
      <div class="group">
        ${[...READING, ...FRAME].map((path) => field(path))}
        <${TextField} form=${form} path="area_deg" label=${t("imports.area_deg")} hint=${t("imports.area_hint")} placeholder="8.3, 48.9, 8.6, 49.1" />
        <${TextField} form=${form} path="height_range_m" label=${t("imports.height_range_m")} placeholder="90, 140" />
        ${field("duplicates")}${field("warnings")}
      </div>
      <${TextField} form=${form} path="columns" label=${t("imports.columns")} hint=${t("imports.columns_hint")} rows=${3} placeholder=${"code = Punkt\neasting = Rechts\nnorthing = Hoch"} />
      <${TextField} form=${form} path="local_grid" label=${t("imports.local_grid")} hint=${t("imports.local_grid_hint")} rows=${3} />
    </details>
  `;
}

/** @param {string} path */
const labelOf = (path) => textOr(`imports.${path}`, textOr(`field.${path}`, textOr(`field.${path.split(".").pop()}`, path)));

/**
 * The declaration that the form and the decisions on rows make.
 *
 * @param {import("../components/form.js").Values} values
 * @param {import("../components/form.js").Schema} schema
 * @param {Iterable<number>} leftOut
 * @returns {Record<string, any>}
 */
export function declarationOf(values, schema, leftOut) {
  const { columns, local_grid, area_deg, height_range_m, ...plain } = values;
  const family = String(plain.family);
  const others = Object.entries(OF_FAMILY).filter(([name]) => name !== family).flatMap(([, paths]) => paths);
  const declaration = bodyOf(Object.fromEntries(Object.entries(plain).filter(([path]) => !others.includes(path))), schema);
  for (const [name, value] of Object.entries({ area_deg, height_range_m })) if (String(value ?? "").trim()) declaration[name] = numbers(name, String(value));
  if (String(columns ?? "").trim()) declaration.columns = readColumns(String(columns));
  if (String(local_grid ?? "").trim()) declaration.local_grid = readJson("local_grid", String(local_grid));
  const rows = [...leftOut].sort((a, b) => a - b);
  return rows.length ? { ...declaration, leave_out: rows } : declaration;
}

/** @param {string} name @param {string} text */
function numbers(name, text) {
  const found = text.split(/[\s,;]+/).filter(Boolean).map(Number);
  const wanted = BOXES[/** @type {keyof typeof BOXES} */ (name)];
  if (found.length === wanted && found.every(Number.isFinite)) return found;
  throw new Problem({ title: t("imports.bad_numbers"), detail: text, field: name, limit: t("imports.numbers", { count: wanted }), cure: t("imports.bad_numbers_cure") });
}

/** Lines of a role and its column; a role without one has none. @param {string} text */
function readColumns(text) {
  return Object.fromEntries(text.split("\n").filter((line) => line.trim()).map((line) => {
    const [role = "", ...column] = line.split("=");
    return [role.trim(), column.join("=").trim() || null];
  }));
}

/** @param {string} field @param {string} text */
function readJson(field, text) {
  try {
    return JSON.parse(text);
  } catch (error) {
    throw new Problem({ title: t("imports.bad_json"), detail: String(error instanceof Error ? error.message : error), field, limit: "JSON", cure: t("imports.bad_json_cure") });
  }
}

/**
 * The values of the form after a correction: a part of a declaration is merged into them.
 *
 * @param {import("../components/form.js").Values} values
 * @param {Record<string, any>} changes
 * @returns {import("../components/form.js").Values}
 */
export function corrected(values, changes) {
  const next = { ...values };
  for (const [path, value] of flat(changes)) {
    if (path.startsWith("columns.")) {
      const columns = { ...readColumns(String(next.columns ?? "")), [path.slice(8)]: value };
      next.columns = Object.entries(columns).map(([role, column]) => `${role} = ${column ?? ""}`).join("\n");
    } else if (Array.isArray(value)) next[path] = value.join(", ");
    else next[path] = typeof value === "boolean" ? value : value === null ? "" : String(value);
  }
  return next;
}

/**
 * @param {Record<string, any>} changes
 * @param {string} [before]
 * @returns {[string, any][]}
 */
function flat(changes, before = "") {
  return Object.entries(changes).flatMap(([name, value]) => {
    const path = before ? `${before}.${name}` : name;
    return value !== null && typeof value === "object" && !Array.isArray(value) ? flat(value, path) : [/** @type {[string, any]} */ ([path, value])];
  });
}

/** A correction in words. @param {Record<string, any>} changes */
export const changesText = (changes) => flat(changes).map(([path, value]) => {
  const name = path.startsWith("columns.") ? t("imports.column_of", { role: labelOf(path.slice(8)) }) : labelOf(path);
  const shown = value === null ? t("imports.no_column") : typeof value === "boolean" ? t(value ? "changes.yes" : "changes.no") : textOr(`option.${value}`, String(value));
  return `${name}: ${shown}`;
}).join(", ");
