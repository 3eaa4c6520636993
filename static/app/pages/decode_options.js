// Options of uploads, from the JSON Schema of their context: for all files, and for each kind of file that is there.

import { html } from "htm/preact";

import { Problem } from "../api/client.js";
import { bodyOf, Group, SchemaField, schemaAt, TextField } from "../components/form.js";
import { Shown } from "../components/load.js";
import { t } from "../texts/index.js";

const COMMON = ["vehicle", "captured_at", "coarse_position.lon_deg", "coarse_position.lat_deg", "coarse_position.accuracy_m", "heading_deg"];
const OF_KIND = /** @type {Record<string, string[]>} */ ({ frame: ["frames", "camera", "thermal"], trace: ["trace"], packets: ["packets", "camera"] });
const FIRST = ["camera.horizontal_fov_deg", "camera.height_m", "camera.depression_deg", "camera.forward_m", "trace.unit", "trace.axes", "packets.method", "frames.rate_hz"];

/**
 * @param {{ form: import("../components/form.js").Form, schema: import("../components/load.js").Loaded<any>, kinds: Set<string> }} props
 */
export function Options({ form, schema, kinds }) {
  return html`<${Shown} of=${schema}>${(/** @type {any} */ root) => {
    const groups = [...new Set([...kinds].flatMap((kind) => OF_KIND[kind] ?? []))];
    const listening = { ...form, set: (/** @type {string} */ path, /** @type {string | boolean} */ value) => (path === "context" ? fill(form, root, String(value)) : form.set(path, value)) };
    return html`
      <${Group} title=${t("decode.approximate")}>
        ${COMMON.map((path) => html`<${SchemaField} form=${form} schema=${root} path=${path} hint=${path === "vehicle" ? t("decode.vehicle_hint") : path === "captured_at" ? t("decode.captured_hint") : undefined}
          placeholder=${path === "captured_at" ? "2026-05-04T08:30:00Z" : undefined} />`)}
      </${Group}>
      ${groups.map((name) => html`<${Part} key=${name} form=${form} root=${root} name=${name} />`)}
      <details class="section"><summary><h3>${t("decode.context")}</h3></summary>
        <${TextField} form=${listening} path="context" label=${t("decode.context_label")} hint=${t("decode.context_hint")} rows=${4} /></details>
    `;
  }}</${Shown}>`;
}

/** Members of one part: the usual ones, the others when they are asked for. @param {{ form: import("../components/form.js").Form, root: any, name: string }} props */
function Part({ form, root, name }) {
  const paths = scalarPaths(root, name);
  const first = paths.filter((path) => FIRST.includes(path) || paths.length === 1);
  const others = paths.filter((path) => !first.includes(path));
  const field = (/** @type {string} */ path) => html`<${SchemaField} form=${form} schema=${root} path=${path} />`;
  return html`
    <${Group} title=${t(/** @type {any} */ (`decode.options_${name}`))}>${first.map(field)}</${Group}>
    ${others.length > 0 && html`<details class="section"><summary><h3>${t("decode.more_options", { count: others.length })}</h3></summary><div class="group">${others.map(field)}</div></details>`}
  `;
}

/** Members that are numbers, flags, choices or texts. @param {any} root @param {string} path @returns {string[]} */
export function scalarPaths(root, path) {
  const part = schemaAt(root, path);
  if (part.enum || ["number", "integer", "boolean", "string"].includes(part.type)) return [path];
  return Object.keys(part.properties ?? {}).flatMap((name) => {
    const inner = schemaAt(root, `${path}.${name}`);
    const isPlain = inner.enum || ["number", "integer", "boolean", "string"].includes(inner.type);
    return isPlain ? [`${path}.${name}`] : [];
  });
}

/**
 * The context of a file: the JSON text, which alone can hold intrinsics and columns, overridden by the fields.
 *
 * @param {import("../components/form.js").Values} values
 * @param {any} root
 * @param {string} kind
 */
export function contextOf({ context: words, ...values }, root, kind) {
  /** @type {any} */
  let context = {};
  try {
    context = JSON.parse(String(words || "{}"));
  } catch (error) {
    throw new Problem({ title: t("decode.bad_context"), detail: String(error instanceof Error ? error.message : error), field: "context", cure: t("decode.bad_context_cure") });
  }
  const fields = bodyOf(values, root);
  for (const [name, value] of Object.entries(fields)) context[name] = value && typeof value === "object" ? { ...context[name], ...value } : value;
  const wanted = [...COMMON.map((path) => path.split(".")[0] ?? path), ...(OF_KIND[kind] ?? []), "thermal_range"];
  const kept = Object.fromEntries(Object.entries(context).filter(([name]) => wanted.includes(name)));
  if (kind !== "frame") kept[kind] = kept[kind] ?? {};
  return kept;
}

/** The fields from a context that was pasted. @param {import("../components/form.js").Form} form @param {any} root @param {string} text */
function fill(form, root, text) {
  try {
    const context = JSON.parse(text);
    const paths = [...COMMON, ...["camera", "frames", "trace", "packets", "thermal"].flatMap((name) => scalarPaths(root, name))];
    /** @type {import("../components/form.js").Values} */
    const values = {};
    for (const path of paths) {
      const value = path.split(".").reduce((place, part) => place?.[part], context);
      if (value !== undefined && value !== null) values[path] = typeof value === "boolean" ? value : String(value);
    }
    form.setValues((old) => ({ ...old, ...values, context: text }));
  } catch {
    form.set("context", text);
  }
}
