// What a change did: values before and after, side by side.

import { html } from "htm/preact";

import { t, textOr } from "../texts/index.js";

/**
 * Differing values of two documents, by their paths.
 *
 * @param {any} before
 * @param {any} after
 * @param {string} [path]
 * @returns {[string, any, any][]}
 */
export function changesOf(before, after, path = "") {
  if (isPart(before) || isPart(after)) {
    const names = new Set([...Object.keys(before ?? {}), ...Object.keys(after ?? {})]);
    return [...names].flatMap((name) => changesOf(before?.[name], after?.[name], path ? `${path}.${name}` : name));
  }
  return JSON.stringify(before ?? null) === JSON.stringify(after ?? null) ? [] : [[path, before, after]];
}

/** @param {any} value */
const isPart = (value) => value !== null && typeof value === "object" && !Array.isArray(value);

/** @param {any} value */
export function valueText(value) {
  if (value === null || value === undefined || value === "") return t("changes.nothing");
  if (typeof value === "boolean") return t(value ? "changes.yes" : "changes.no");
  if (Array.isArray(value) && value.every((part) => part === null || typeof part !== "object")) return value.join(", ");
  return typeof value === "object" ? JSON.stringify(value) : String(value);
}

/** The name of a value, from its path. @param {string} path */
export function nameOf(path) {
  const last = path.split(".").pop() ?? path;
  return textOr(`field.${path}`, textOr(`field.${last}`, path));
}

/** @param {{ before: any, after: any, label: string }} props */
export function Changes({ before, after, label }) {
  const changes = changesOf(before, after);
  if (!changes.length) return html`<p class="hint">${t("changes.none")}</p>`;
  return html`
    <div class="table-scroll plain-table" tabindex="0" role="region" aria-label=${label}>
      <table class="changes">
        <thead><tr><th scope="col">${t("changes.what")}</th><th scope="col">${t("changes.before")}</th><th scope="col">${t("changes.after")}</th></tr></thead>
        <tbody>${changes.map(([path, old, now]) => html`<tr><th scope="row" title=${path}>${nameOf(path)}</th><td><del>${valueText(old)}</del></td><td><ins>${valueText(now)}</ins></td></tr>`)}</tbody>
      </table>
    </div>
  `;
}
