// Forms made from the JSON Schema of a request's body. Each field has a label, its limits and help from the schema, and
// the error that a problem document reports for it.

import { html } from "htm/preact";
import { useEffect, useId, useRef, useState } from "preact/hooks";

import { request } from "../api/client.js";
import { t, textOr } from "../texts/index.js";
import { fieldErrors, ProblemBox } from "./problem.js";

/**
 * @typedef {Record<string, any>} Schema
 * @typedef {Record<string, string | boolean>} Values Texts and flags by the path of the field in the body.
 */

/** @type {Promise<Record<string, Schema>> | null} */
let loading = null;

/**
 * The schema of a body, from /openapi.json, e.g. `loadSchema("PlateIn")`.
 *
 * @param {keyof import("../api/schema.js").components["schemas"]} name
 * @returns {Promise<Schema>}
 */
export async function loadSchema(name) {
  loading ??= request("/openapi.json").then((response) => response.json()).then((document) => document.components.schemas);
  const schemas = await loading.catch((error) => {
    loading = null;
    throw error;
  });
  return { ...schemas[name], schemas };
}

/**
 * The schema of a field.
 *
 * @param {Schema} root
 * @param {string} path
 * @returns {Schema}
 */
export function schemaAt(root, path) {
  let place = /** @type {Schema} */ (root);
  for (const part of partsOf(path)) place = resolved(root, (typeof part === "number" ? place.items : place.properties?.[part]) ?? {});
  return place;
}

/** The parts of a path such as `costs.items[0].price`; numbers are places in lists. @param {string} path */
export function partsOf(path) {
  return path.split(".").flatMap((part) => {
    const [name = "", ...places] = part.split("[");
    return [name, ...places.map((place) => Number(place.slice(0, -1)))];
  });
}

/** A schema without references and without the alternative null. @param {Schema} root @param {Schema} schema @returns {Schema} */
function resolved(root, schema) {
  const { $ref, anyOf, ...rest } = schema;
  if ($ref) return { ...resolved(root, root.schemas[$ref.split("/").pop()]), ...rest };
  const options = anyOf?.filter((/** @type {Schema} */ option) => option.type !== "null");
  return options?.length === 1 ? { ...resolved(root, options[0]), ...rest } : { ...schema };
}

/**
 * The values of a form, its problem, and how it is submitted.
 *
 * @param {Values} start
 */
export function useForm(start) {
  const [values, setValues] = useState(start);
  const [error, setError] = useState(/** @type {unknown} */ (null));
  const [busy, setBusy] = useState(false);
  return {
    values,
    error,
    busy,
    errors: fieldErrors(error),
    setError,
    setValues,
    /** @param {string} path @param {string | boolean} value */
    set: (path, value) => setValues((old) => ({ ...old, [path]: value })),
    /** @param {() => Promise<void>} work @returns {(event: Event) => Promise<void>} */
    submit: (work) => async (event) => {
      event.preventDefault();
      setError(null);
      setBusy(true);
      try {
        await work();
      } catch (problem) {
        setError(problem);
      } finally {
        setBusy(false);
      }
    },
  };
}

/** @typedef {ReturnType<typeof useForm>} Form */

/**
 * The body of a request from the values of a form. Empty fields are left out; what is no number stays a text, which the
 * server refuses.
 *
 * @param {Values} values
 * @param {Schema} [schema]
 * @returns {Record<string, any>}
 */
export function bodyOf(values, schema) {
  /** @type {Record<string, any>} */
  const body = {};
  for (const [path, value] of Object.entries(values)) {
    const read = valueOf(value, schema ? schemaAt(schema, path) : {});
    if (read === undefined) continue;
    const parts = partsOf(path);
    /** @type {any} */
    let place = body;
    for (const [k, part] of parts.entries()) {
      if (k === parts.length - 1) place[part] = read;
      else place = place[part] ??= typeof parts[k + 1] === "number" ? [] : {};
    }
  }
  return body;
}

/** @param {string | boolean} value @param {Schema} schema @returns {any} */
function valueOf(value, schema) {
  if (typeof value === "boolean") return value || undefined;
  const text = value.trim();
  if (!text) return undefined;
  if (schema.type === "array") return text.split(",").map((part) => valueOf(part, schema.items ?? schema.prefixItems?.[0] ?? {})).filter((part) => part !== undefined);
  if (schema.anyOf?.some((/** @type {Schema} */ option) => option.type === "number") && Number.isFinite(Number(text))) return Number(text);
  if (schema.type !== "number" && schema.type !== "integer") return text;
  const found = Number(text.replace(",", "."));
  return Number.isFinite(found) ? found : text;
}

/**
 * A form: a problem that belongs to no field, groups of fields, and the button.
 *
 * @param {{ form: Form, onSubmit: () => Promise<void>, button: string, children?: any, actions?: any }} props
 */
export function FormFrame({ form, onSubmit, button, children, actions }) {
  const frame = useRef(/** @type {HTMLFormElement | null} */ (null));
  useEffect(() => {
    const wrong = form.error ? frame.current?.querySelector("[aria-invalid=true]") : null;
    if (wrong instanceof HTMLElement) wrong.focus();
  }, [form.error]);
  return html`
    <form class="form" novalidate autocomplete="off" ref=${frame} onSubmit=${form.submit(onSubmit)}>
      ${children}
      <${ProblemBox} error=${form.error} />
      <p class="actions"><button type="submit" disabled=${form.busy}>${form.busy ? t("form.busy") : button}</button>${actions}</p>
    </form>
  `;
}

/** @param {{ title: string, children?: any }} props */
export function Group({ title, children }) {
  return html`<fieldset><legend>${title}</legend><div class="group">${children}</div></fieldset>`;
}

/**
 * A field of a schema: a choice, a flag, a number or a text.
 *
 * @param {{ form: Form, schema: Schema, path: string, label?: string, hint?: string, placeholder?: string, required?: boolean }} props
 */
export function SchemaField({ form, schema, path, label, hint, placeholder, required }) {
  const part = schemaAt(schema, path);
  const words = label ?? labelOf(path);
  if (part.type === "boolean") return html`<${CheckField} form=${form} path=${path} label=${words} />`;
  const choices = part.type === "array" && part.items ? resolved(schema, part.items).enum : null;
  if (choices) return html`<${ChecksField} form=${form} path=${path} label=${words} options=${choices} start=${part.default ?? []} />`;
  if (part.enum) {
    const options = part.enum.map((/** @type {string | number} */ name) => [String(name), textOr(`option.${name}`, textOr(`status.${name}`, String(name)))]);
    const empty = part.default === undefined || part.default === null;
    return html`<${SelectField} form=${form} path=${path} label=${words} hint=${hint} options=${empty ? [["", "–"], ...options] : options} start=${part.default === undefined || part.default === null ? undefined : String(part.default)} />`;
  }
  const numeric = part.type === "number" || part.type === "integer";
  return html`<${TextField} form=${form} path=${path} label=${words} hint=${hint ?? limitsOf(part)} required=${required}
    placeholder=${placeholder ?? (part.default === undefined || part.default === null ? "" : String(part.default))} inputmode=${numeric ? "decimal" : undefined} />`;
}

/** The name of a field: a text of ours, or its name in the API. @param {string} path */
export function labelOf(path) {
  const plain = path.replace(/\[\d+\]/g, "");
  const last = plain.split(".").pop() ?? plain;
  return textOr(`field.${plain}`, textOr(`field.${last}`, last));
}

/** @param {Schema} part */
function limitsOf(part) {
  const least = part.minimum ?? part.exclusiveMinimum;
  const most = part.maximum ?? part.exclusiveMaximum;
  if (least === undefined || most === undefined || most >= 1e5) return "";
  return t("form.range", { least, most });
}

/**
 * @param {{ form: Form, path: string, label: string, hint?: string, placeholder?: string, inputmode?: string, required?: boolean, type?: string, rows?: number }} props
 */
export function TextField({ form, path, label, hint, placeholder, inputmode, required, type = "text", rows }) {
  const id = useId();
  const error = form.errors[path];
  const shared = {
    id,
    name: path,
    value: form.values[path] ?? "",
    placeholder,
    required,
    spellcheck: false,
    "aria-invalid": error ? "true" : undefined,
    "aria-describedby": error || hint ? `${id}-note` : undefined,
    onInput: (/** @type {any} */ event) => form.set(path, event.currentTarget.value),
  };
  return html`
    <div class=${rows ? "field wide" : "field"}>
      <label for=${id}>${label}${required && html` <span class="required">${t("form.required")}</span>`}</label>
      ${rows ? html`<textarea ...${shared} rows=${rows}></textarea>` : html`<input ...${shared} type=${type} inputmode=${inputmode} />`}
      <${Note} id=${`${id}-note`} error=${error} hint=${hint} />
    </div>
  `;
}

/**
 * @param {{ form: Form, path: string, label: string, hint?: string, options: [string, string][], start?: string, onPick?: (value: string) => void }} props
 */
export function SelectField({ form, path, label, hint, options, start, onPick }) {
  const id = useId();
  const error = form.errors[path];
  return html`
    <div class="field">
      <label for=${id}>${label}</label>
      <select id=${id} name=${path} value=${form.values[path] ?? start ?? ""} aria-invalid=${error ? "true" : undefined} aria-describedby=${error || hint ? `${id}-note` : undefined}
        onChange=${(/** @type {any} */ event) => {
          form.set(path, event.currentTarget.value);
          onPick?.(event.currentTarget.value);
        }}>
        ${options.map(([value, text]) => html`<option value=${value}>${text}</option>`)}
      </select>
      <${Note} id=${`${id}-note`} error=${error} hint=${hint} />
    </div>
  `;
}

/** @param {{ form: Form, path: string, label: string }} props */
export function CheckField({ form, path, label }) {
  return html`
    <label class="check"><input type="checkbox" name=${path} checked=${form.values[path] === true}
      onChange=${(/** @type {any} */ event) => form.set(path, event.currentTarget.checked)} /> ${label}</label>
  `;
}

/**
 * Some of several words, kept as a text with commas.
 *
 * @param {{ form: Form, path: string, label: string, options: string[], start: string[] }} props
 */
export function ChecksField({ form, path, label, options, start }) {
  const id = useId();
  const text = form.values[path];
  const on = text === undefined || text === "" ? start : String(text).split(",").map((part) => part.trim());
  const error = form.errors[path];
  return html`
    <div class="field" role="group" aria-labelledby=${id} aria-describedby=${error ? `${id}-note` : undefined}>
      <span class="field-name" id=${id}>${label}</span>
      <div class="checks">
        ${options.map((name) => html`<label class="check"><input type="checkbox" name=${path} value=${name} checked=${on.includes(name)} aria-invalid=${error ? "true" : undefined}
          onChange=${(/** @type {any} */ event) => form.set(path, options.filter((other) => (other === name ? event.currentTarget.checked : on.includes(other))).join(", "))} /> ${textOr(`option.${name}`, name)}</label>`)}
      </div>
      <${Note} id=${`${id}-note`} error=${error} />
    </div>
  `;
}

/** @param {{ id: string, error?: string, hint?: string }} props */
function Note({ id, error, hint }) {
  if (error) return html`<p class="field-error" id=${id}>${error}</p>`;
  return hint ? html`<p class="hint" id=${id}>${hint}</p>` : null;
}
