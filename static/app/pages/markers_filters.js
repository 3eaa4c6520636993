// Which markers are shown: by code, road and measure, family, status and area. Filters are parameters of the address.

import { html } from "htm/preact";
import { useEffect, useId, useRef, useState } from "preact/hooks";

import { stationValue } from "../components/strip_scale.js";
import { FAMILIES, STATUSES } from "../map/symbols.js";
import { query, setQuery } from "../router.js";
import { t, textOr } from "../texts/index.js";

/**
 * @typedef {{ code?: string, road?: string, from_m?: number, to_m?: number, family?: "plate" | "magnet" | "cerpm" | "fiducial",
 *   status?: "planned" | "built" | "surveyed" | "active" | "suspect" | "retired", bbox?: string, polygon?: string }} Filters
 */

const NAMES = /** @type {const} */ (["code", "road", "from_m", "to_m", "family", "status", "bbox", "polygon"]);
const TYPING_MS = 350;

/**
 * The filters of an address, as GET /v1/markers takes them.
 *
 * @param {URLSearchParams} parameters
 * @returns {Filters}
 */
export function readFilters(parameters) {
  /** @type {Record<string, any>} */
  const found = {};
  for (const name of NAMES) {
    const value = parameters.get(name);
    if (value) found[name] = name === "from_m" || name === "to_m" ? stationValue(value) : value;
  }
  return found;
}

/** @param {Filters} filters */
export const isFiltered = (filters) => Object.keys(filters).length > 0;

/** @param {{ filters: Filters }} props */
export function Filters({ filters }) {
  const more = Boolean(filters.from_m ?? filters.to_m ?? filters.bbox ?? filters.polygon);
  const some = isFiltered(filters);
  return html`
    <form class="filters" role="search" aria-label=${t("filter.title")} onSubmit=${(/** @type {Event} */ event) => event.preventDefault()}>
      <${TypedFilter} name="code" label=${t("filter.code")} value=${filters.code} />
      <${TypedFilter} name="road" label=${t("field.road")} value=${filters.road} />
      <${ChosenFilter} name="family" label=${t("field.family")} value=${filters.family} options=${FAMILIES} prefix="family" />
      <${ChosenFilter} name="status" label=${t("field.status")} value=${filters.status} options=${STATUSES} prefix="status" />
      <details class="choice" open=${more}>
        <summary>${t("filter.more")}</summary>
        <div class="choice-list">
          <${TypedFilter} name="from_m" label=${t("filter.from_m")} value=${query.value.get("from_m") ?? undefined} station placeholder="12+345" disabled=${!filters.road} />
          <${TypedFilter} name="to_m" label=${t("filter.to_m")} value=${query.value.get("to_m") ?? undefined} station placeholder="12+400" disabled=${!filters.road} />
          ${!filters.road && html`<p class="hint">${t("filter.measure_needs_road")}</p>`}
          <${TypedFilter} name="bbox" label=${t("filter.bbox")} value=${filters.bbox} placeholder="114.17,22.30,114.18,22.31" />
          ${filters.polygon && html`<p>${t("filter.polygon")} <button type="button" class="quiet" onClick=${() => setQuery({ polygon: null })}>${t("action.remove")}</button></p>`}
        </div>
      </details>
      ${some && html`<button type="button" class="quiet" onClick=${() => setQuery(Object.fromEntries(NAMES.map((name) => [name, null])), { replace: false })}>${t("filter.clear")}</button>`}
    </form>
  `;
}

/** @param {{ name: string, label: string, value?: string | number, station?: boolean, disabled?: boolean, placeholder?: string }} props */
function TypedFilter({ name, label, value, station, disabled, placeholder }) {
  const id = useId();
  const [typed, setTyped] = useState(String(value ?? ""));
  const timer = useRef(0);
  useEffect(() => setTyped(String(value ?? "")), [value]);
  const wrong = Boolean(station && typed && !Number.isFinite(stationValue(typed)));
  const type = (/** @type {string} */ next) => {
    setTyped(next);
    clearTimeout(timer.current);
    if (station && next && !Number.isFinite(stationValue(next))) return;
    timer.current = window.setTimeout(() => {
      /** @type {Record<string, string | null>} */
      const changes = { [name]: next.trim() || null };
      if (name === "road" && !next.trim()) Object.assign(changes, { from_m: null, to_m: null });
      setQuery(changes);
    }, TYPING_MS);
  };
  return html`
    <div class="filter">
      <label for=${id}>${label}</label>
      <input id=${id} name=${name} value=${typed} disabled=${disabled} placeholder=${placeholder} spellcheck=${false} autocomplete="off"
        aria-invalid=${wrong ? "true" : undefined} onInput=${(/** @type {any} */ event) => type(event.currentTarget.value)} />
    </div>
  `;
}

/** @param {{ name: string, label: string, value?: string, options: string[], prefix: string }} props */
function ChosenFilter({ name, label, value, options, prefix }) {
  const id = useId();
  return html`
    <div class="filter">
      <label for=${id}>${label}</label>
      <select id=${id} name=${name} value=${value ?? ""} onChange=${(/** @type {any} */ event) => setQuery({ [name]: event.currentTarget.value }, { replace: false })}>
        <option value="">${t("filter.all")}</option>
        ${options.map((option) => html`<option value=${option}>${textOr(`${prefix}.${option}`, option)}</option>`)}
      </select>
    </div>
  `;
}
