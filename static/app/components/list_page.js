// A page with a list and the chosen row beside it. Filters and the order are in the query, the chosen row is the path.

import { html } from "htm/preact";
import { useEffect, useState } from "preact/hooks";

import { navigate, query, setQuery, withQuery } from "../router.js";
import { t } from "../texts/index.js";
import { Empty } from "./load.js";
import { PagesFoot } from "./pages.js";
import { ProblemBox } from "./problem.js";
import { Table } from "./table.js";

/**
 * @param {object} props
 * @param {string} props.title
 * @param {string} props.base Address of the list.
 * @param {import("./pages.js").Pages} props.list
 * @param {import("./table.js").Column<any>[]} props.columns
 * @param {string | null} props.chosen Id of the chosen row.
 * @param {any} [props.lead] A sentence below the title.
 * @param {any} [props.actions] Buttons beside the title.
 * @param {any} [props.filters]
 * @param {any} [props.empty] What is shown where nothing is filtered and nothing is there.
 * @param {any} [props.panel] The chosen row.
 * @param {(row: any) => string} [props.idOf]
 * @param {any} [props.above] Between the filters and the table.
 */
export function ListPage({ title, list, columns, chosen, lead, actions, filters, empty, panel, above, idOf = (row) => row.id }) {
  const nothing = list.loaded && !list.rows.length && !list.error;
  const filtered = FILTERS.some((name) => query.value.get(name));
  return html`
    <div class="title-line"><h1>${title}</h1><span class="buttons">${actions}</span></div>
    ${lead && html`<p class="lead">${lead}</p>`}
    ${filters && html`<div class="filters" role="search">${filters}
      ${filtered && html`<button type="button" class="quiet" onClick=${clearFilters}>${t("filter.clear")}</button>`}</div>`}
    ${above}
    <${ProblemBox} error=${list.error} retry=${list.reload} />
    <div class=${panel ? "workspace with-panel" : "workspace"}>
      <div class="workspace-main">
        ${!list.loaded && !list.error && html`<p class="loading" role="status">${t("load.loading")}</p>`}
        ${nothing && (filtered ? html`<${Empty} title=${t("list.none_found")} />` : empty ?? html`<${Empty} title=${t("list.empty")} />`)}
        ${list.rows.length > 0 && html`<${Table} label=${title} rows=${list.rows} idOf=${idOf} chosen=${chosen} columns=${columns} footer=${html`<${PagesFoot} of=${list} />`} />`}
      </div>
      ${panel}
    </div>
  `;
}

/** Names of filters in the address, of all lists. */
const FILTERS = ["kind", "state", "status", "what", "road", "family", "min_priority", "marker_id", "who", "action", "subject", "since", "until"];

const clearFilters = () => setQuery(Object.fromEntries(FILTERS.map((name) => [name, null])), { replace: false });

/** A filter's value. @param {string} name */
export const filterOf = (name) => query.value.get(name) ?? "";

/**
 * A text that rows are filtered by, used when the field is left or Enter is pressed.
 *
 * @param {{ name: string, label: string, placeholder?: string, type?: string }} props
 */
export function TextFilter({ name, label, placeholder, type = "search" }) {
  const value = filterOf(name);
  const [typed, setTyped] = useState(value); // what is being typed stays when rows arrive
  useEffect(() => setTyped(value), [value]);
  return html`<div class="filter"><label for=${`filter-${name}`}>${label}</label>
    <input id=${`filter-${name}`} type=${type} value=${typed} placeholder=${placeholder} onInput=${(/** @type {any} */ event) => setTyped(event.currentTarget.value)} onChange=${(/** @type {any} */ event) => setQuery({ [name]: event.currentTarget.value.trim() }, { replace: false })} /></div>`;
}

/**
 * @param {{ name: string, label: string, options: [string, string][], otherwise?: string }} props `otherwise` is the value without a choice.
 */
export function ChoiceFilter({ name, label, options, otherwise = "" }) {
  return html`<div class="filter"><label for=${`filter-${name}`}>${label}</label>
    <select id=${`filter-${name}`} value=${filterOf(name) || otherwise} onChange=${(/** @type {any} */ event) => setQuery({ [name]: event.currentTarget.value === otherwise ? null : event.currentTarget.value }, { replace: false })}>
      ${options.map(([value, text]) => html`<option value=${value}>${text}</option>`)}
    </select></div>`;
}

/** A column whose cell leads to the row. @param {string} base @param {import("./table.js").Column<any>} column @param {(row: any) => string} [idOf] @returns {import("./table.js").Column<any>} */
export const linked = (base, column, idOf = (row) => row.id) => ({
  ...column, head: true, cell: (row) => html`<a href=${withQuery(`${base}/${encodeURIComponent(idOf(row))}`)}>${column.cell(row)}</a>`,
});

/** Close the panel. @param {string} base */
export const closeTo = (base) => () => navigate(withQuery(base));
