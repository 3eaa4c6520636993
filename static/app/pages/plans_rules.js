// The form of a plan's rules, made from their JSON Schema; and rules as values of a form, and back.

import { html } from "htm/preact";

import { request } from "../api/client.js";
import { bodyOf, partsOf, SchemaField, schemaAt } from "../components/form.js";
import { t, textOr } from "../texts/index.js";

/** @typedef {import("../components/form.js").Schema} Schema @typedef {import("../components/form.js").Form} Form @typedef {import("../components/form.js").Values} Values */

const FAMILIES = ["plates", "lines", "tags", "cerpm"];
const OPTIONAL = [...FAMILIES, "decision_points", "quality", "temporary"];
const LISTS = ["cameras", "costs.items"];
const GROUPS = ["road", "avoid", "vehicles", "predictions", "cameras", "costs", "quality", "temporary", "installation", "tolerances", "applies"];
/** Fields that are shown at once; the others of a group are below "More". @type {Record<string, string[]>} */
const FIRST = {
  plates: ["spacing_m", "scheme", "n", "unit_mm"],
  lines: ["max_spacing_m", "sides", "solid", "dashed"],
  tags: ["at", "before", "magnets", "size"],
  cerpm: ["straight", "curve", "n_m", "max_path_error_m"],
  decision_points: ["at", "before"],
  road: ["design_speed_kmh", "curve_radius_m", "lanes"],
};

/** @type {Promise<Schema> | null} */
let loading = null;

/** The JSON Schema of rules. @returns {Promise<Schema>} */
export function loadRulesSchema() {
  loading ??= request("/v1/plan-rules/schema").then((response) => response.json()).then((schema) => ({ ...schema, schemas: schema.$defs }));
  loading.catch(() => {
    loading = null;
  });
  return loading;
}

/**
 * Rules as values of a form. Whether an optional part is there is a flag of its own, e.g. `+plates`.
 *
 * @param {any} rules
 * @param {Schema} schema
 * @returns {Values}
 */
export function valuesOf(rules, schema) {
  /** @type {Values} */
  const values = {};
  for (const name of OPTIONAL) values[`+${name}`] = rules[name] !== undefined && rules[name] !== null;
  /** @param {string} path @param {any} value */
  const put = (path, value) => {
    if (value === null || value === undefined || path === "version") return;
    if (Array.isArray(value) && value.some((item) => typeof item === "object")) value.forEach((item, k) => put(`${path}[${k}]`, item));
    else if (Array.isArray(value)) values[path] = value.join(", ");
    else if (typeof value === "object") for (const [name, part] of Object.entries(value)) put(path ? `${path}.${name}` : name, part);
    else values[path] = typeof value === "boolean" ? value : String(value);
  };
  put("", rules);
  for (const path of LISTS) if (path !== "cameras" && rowsOf(values, path) === 0) continue;
  if (!rowsOf(values, "cameras")) for (const [name, value] of Object.entries(schema.properties?.cameras?.default?.[0] ?? {})) values[`cameras[0].${name}`] = String(value);
  return values;
}

/**
 * Rules from the values of a form.
 *
 * @param {Values} values
 * @param {Schema} schema
 * @returns {any}
 */
export function rulesOf(values, schema) {
  const off = OPTIONAL.filter((name) => values[`+${name}`] !== true);
  const kept = Object.entries(values).filter(([path]) => !path.startsWith("+") && !off.includes(String(partsOf(path)[0])));
  const rules = bodyOf(Object.fromEntries(kept), schema);
  for (const name of OPTIONAL) if (!off.includes(name)) rules[name] ??= {};
  for (const path of LISTS) {
    const [first = "", second] = path.split(".");
    const place = second ? rules[first] : rules;
    const list = place?.[second ?? first];
    if (Array.isArray(list)) place[second ?? first] = list.filter(Boolean);
  }
  return { version: 1, ...rules };
}

/** How many rows a list has in the form. @param {Values} values @param {string} path */
function rowsOf(values, path) {
  const places = Object.keys(values).filter((name) => name.startsWith(`${path}[`)).map((name) => Number(name.slice(path.length + 1, name.indexOf("]", path.length))));
  return places.length ? Math.max(...places) + 1 : 0;
}

/**
 * All fields of the rules, in groups.
 *
 * @param {{ form: Form, schema: Schema }} props
 */
export function RulesFields({ form, schema }) {
  return html`
    <fieldset>
      <legend>${t("rules.families")}</legend>
      <div class="checks">${FAMILIES.map((name) => html`<${Toggle} form=${form} name=${name} />`)}</div>
    </fieldset>
    ${FAMILIES.filter((name) => form.values[`+${name}`]).map((name) => html`
      <${Fields} key=${name} form=${form} schema=${schema} name=${name}>
        ${name === "plates" && html`<${Toggle} form=${form} name="decision_points" />${form.values["+decision_points"] === true && html`<${Fields} form=${form} schema=${schema} name="decision_points" />`}`}
      </${Fields}>
    `)}
    ${GROUPS.map((name) => html`<${Closed} key=${name} form=${form} schema=${schema} name=${name} />`)}
  `;
}

/** @param {{ form: Form, name: string }} props */
function Toggle({ form, name }) {
  return html`<label class="check"><input type="checkbox" name=${`+${name}`} checked=${form.values[`+${name}`] === true} onChange=${(/** @type {any} */ event) => form.set(`+${name}`, event.currentTarget.checked)} /> ${textOr(`rules.${name}`, name)}</label>`;
}

/** Names of the fields of a group that are no constants. @param {Schema} schema @param {string} name */
const namesOf = (schema, name) => Object.entries(schemaAt(schema, name).properties ?? {}).filter(([, part]) => part.const === undefined).map(([field]) => field);

/** @param {Form} form @param {string} name */
const hasError = (form, name) => Object.keys(form.errors).some((path) => path === name || path.startsWith(`${name}.`) || path.startsWith(`${name}[`));

/** @param {{ form: Form, schema: Schema, name: string, children?: any }} props */
function Fields({ form, schema, name, children }) {
  const all = namesOf(schema, name);
  const first = (FIRST[name] ?? all).filter((field) => all.includes(field));
  const more = all.filter((field) => !first.includes(field));
  const show = (/** @type {string} */ field) => html`<${RuleField} form=${form} schema=${schema} path=${`${name}.${field}`} />`;
  return html`
    <fieldset>
      <legend>${textOr(`rules.${name}`, name)}</legend>
      ${form.errors[name] && html`<p class="field-error">${form.errors[name]}</p>`}
      <div class="group">${first.map(show)}</div>
      ${more.length > 0 && html`<details class="more" open=${more.some((field) => form.errors[`${name}.${field}`])}><summary>${t("rules.more")}</summary><div class="group">${more.map(show)}</div></details>`}
      ${children}
    </fieldset>
  `;
}

/** @param {{ form: Form, schema: Schema, path: string }} props */
function RuleField({ form, schema, path }) {
  const part = schemaAt(schema, path);
  const words = part.anyOf?.flatMap((/** @type {Schema} */ option) => option.enum ?? []) ?? [];
  const hint = part.type === "array" && !part.prefixItems ? t("rules.list_hint") : words.length ? t("rules.before_hint") : undefined;
  const start = Array.isArray(part.default) ? part.default.join(", ") : undefined;
  return html`<${SchemaField} form=${form} schema=${schema} path=${path} hint=${hint} placeholder=${start} />`;
}

/** A group that is closed until it is needed. @param {{ form: Form, schema: Schema, name: string }} props */
function Closed({ form, schema, name }) {
  const optional = OPTIONAL.includes(name);
  return html`
    <details class="section" open=${hasError(form, name)}>
      <summary><h3>${textOr(`rules.${name}`, name)}</h3></summary>
      <p class="hint">${textOr(`rules_hint.${name}`, "")}</p>
      ${optional && html`<${Toggle} form=${form} name=${name} />`}
      ${name === "cameras" ? html`<${Rows} form=${form} schema=${schema} path="cameras" least=${1} />`
        : (!optional || form.values[`+${name}`] === true) && html`
          <div class="group">${namesOf(schema, name).filter((field) => `${name}.${field}` !== "costs.items").map((field) => html`<${RuleField} form=${form} schema=${schema} path=${`${name}.${field}`} />`)}</div>
          ${name === "costs" && html`<${Rows} form=${form} schema=${schema} path="costs.items" least=${0} />`}
        `}
    </details>
  `;
}

/** A list of rows, each with the same fields. @param {{ form: Form, schema: Schema, path: string, least: number }} props */
function Rows({ form, schema, path, least }) {
  const count = rowsOf(form.values, path);
  const fields = namesOf(schema, `${path}[0]`);
  const add = () => form.set(`${path}[${count}].${fields[0]}`, path === "cameras" ? `${t("rules.camera")} ${count + 1}` : "");
  /** @param {number} row */
  const remove = (row) => form.setValues((old) => Object.fromEntries(Object.entries(old).flatMap(([name, value]) => {
    if (!name.startsWith(`${path}[`)) return [[name, value]];
    const place = Number(name.slice(path.length + 1, name.indexOf("]", path.length)));
    if (place === row) return [];
    return [[place > row ? name.replace(`${path}[${place}]`, `${path}[${place - 1}]`) : name, value]];
  })));
  return html`
    ${form.errors[path] && html`<p class="field-error">${form.errors[path]}</p>`}
    ${Array.from({ length: count }, (_, row) => html`
      <fieldset key=${row}>
        <legend>${t(path === "cameras" ? "rules.camera_number" : "rules.item_number", { number: row + 1 })}</legend>
        <div class="group">${fields.map((field) => html`<${SchemaField} form=${form} schema=${schema} path=${`${path}[${row}].${field}`} />`)}</div>
        ${count > least && html`<p class="actions"><button type="button" class="quiet" onClick=${() => remove(row)}>${t("action.remove")}</button></p>`}
      </fieldset>
    `)}
    <p class="actions"><button type="button" class="quiet" onClick=${add}>${t(path === "cameras" ? "rules.add_camera" : "rules.add_item")}</button></p>
  `;
}
