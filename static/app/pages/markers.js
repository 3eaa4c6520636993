// The registry's markers on a map and in a table. Filters, order, columns, ticked markers and the map's view are in the
// address; the chosen marker is its path.

import { html } from "htm/preact";
import { useEffect, useMemo, useRef, useState } from "preact/hooks";

import { api, page } from "../api/client.js";
import { FamilyName, StatusBadge } from "../components/badges.js";
import { Empty, isAborted } from "../components/load.js";
import { ProblemBox } from "../components/problem.js";
import { stationText } from "../components/strip_scale.js";
import { Table } from "../components/table.js";
import { codeOf, degrees, MISSING, number, text, time } from "../format.js";
import { distance_m } from "../map/draw.js";
import { navigate, query, setQuery, withQuery } from "../router.js";
import { may } from "../session.js";
import { t } from "../texts/index.js";
import { ArtworkDialog, ExportDialog, StatusDialog } from "./markers_actions.js";
import { Filters, isFiltered, readFilters } from "./markers_filters.js";
import { MarkerMap } from "./markers_map.js";
import { MarkerPanel } from "./markers_panel.js";

/** @typedef {import("../api/schema.js").components["schemas"]["MarkerPage"]["items"][number]} Marker */

const PAGE = 1000;
const AT_ONCE = 5000;
const MAX_TICKED_IN_ADDRESS = 40;

/** @param {{ parameters: { marker_id?: string } }} props */
export default function Markers({ parameters }) {
  const chosen = parameters.marker_id ?? null;
  const filters = readFilters(query.value);
  const filtersKey = JSON.stringify(filters);
  const view = query.value.get("view") ?? (window.matchMedia("(max-width: 48rem)").matches ? "map" : "both");
  const list = useMarkers(filters, filtersKey, view !== "map" || chosen !== null || isFiltered(filters));
  const [ticked, setTicked] = useTicked();
  const choose = (/** @type {string | null} */ id) => navigate(withQuery(id ? `/markers/${encodeURIComponent(id)}` : "/markers"));
  const known = chosen ? list.rows.find(({ id }) => id === chosen) : undefined;
  return html`
    <div class="markers-page">
      <div class="toolbar">
        <h1>${t("markers.title")}</h1>
        <${Filters} filters=${filters} />
        <${ViewSwitch} view=${view} />
      </div>
      <div class=${chosen ? "workspace with-panel" : "workspace"}>
        <div class=${`workspace-main view-${view}`}>
          ${view !== "table" && html`<${MarkerMap} filters=${filters} rows=${list.rows} chosen=${chosen} known=${known} onChoose=${choose} />`}
          ${view !== "map" && html`
            <div class="list">
              <${Actions} list=${list} filters=${filters} ticked=${ticked} onTick=${setTicked} />
              <${ProblemBox} error=${list.error} retry=${list.reload} />
              <${List} list=${list} chosen=${chosen} ticked=${ticked} onTick=${setTicked} />
            </div>
          `}
        </div>
        ${chosen && html`<${MarkerPanel} key=${chosen} id=${chosen} onClose=${() => choose(null)} onChanged=${list.reload} />`}
      </div>
    </div>
  `;
}

/** @param {{ view: string }} props */
function ViewSwitch({ view }) {
  return html`
    <div class="segments" role="group" aria-label=${t("markers.view")}>
      ${/** @type {const} */ (["map", "both", "table"]).map((name) => html`
        <button type="button" class=${`quiet segment-${name}`} aria-pressed=${view === name} onClick=${() => setQuery({ view: name }, { replace: false })}>${t(`markers.view_${name}`)}</button>
      `)}
    </div>
  `;
}

/**
 * Markers of a filter: the first pages at once, the others when they are asked for.
 *
 * @param {import("./markers_filters.js").Filters} filters
 * @param {string} filtersKey
 * @param {boolean} isNeeded Tiles alone draw all markers; then no rows are loaded.
 */
function useMarkers(filters, filtersKey, isNeeded) {
  const [state, setState] = useState({ rows: /** @type {Marker[]} */ ([]), after: /** @type {string | null} */ (null), loading: true, error: /** @type {unknown} */ (null) });
  const [turn, setTurn] = useState(0);
  const abort = useRef(new AbortController());
  /** @param {Marker[]} rows @param {string | null} start */
  const load = async (rows, start) => {
    const { signal } = abort.current;
    try {
      let after = start;
      const most = rows.length + AT_ONCE;
      do {
        const parameters = { ...filters, limit: PAGE, ...(after ? { after } : {}) };
        const found = await page(api.GET("/v1/markers", { params: { query: parameters }, signal }));
        rows = [...rows, ...found.items];
        after = found.after;
        if (signal.aborted) return;
        setState({ rows, after, loading: after !== null && rows.length < most, error: null });
      } while (after && rows.length < most);
    } catch (error) {
      if (!isAborted(error) && !signal.aborted) setState((old) => ({ ...old, loading: false, error }));
    }
  };
  useEffect(() => {
    if (!isNeeded) return undefined;
    abort.current = new AbortController();
    setState((old) => ({ ...old, loading: true, error: null }));
    load([], null);
    return () => abort.current.abort();
  }, [filtersKey, turn, isNeeded]);
  return { ...state, reload: () => setTurn((old) => old + 1), more: () => load(state.rows, state.after) };
}

/** @typedef {ReturnType<typeof useMarkers>} MarkerList */

/**
 * Ids of the ticked markers; a few of them stay in the address.
 *
 * @returns {[Set<string>, (ids: Set<string>) => void]}
 */
function useTicked() {
  const [ticked, setTicked] = useState(() => new Set((query.peek().get("ticked") ?? "").split(",").filter(Boolean)));
  return [ticked, (ids) => {
    setTicked(ids);
    setQuery({ ticked: ids.size <= MAX_TICKED_IN_ADDRESS ? [...ids].join() : null });
  }];
}

/**
 * What can be done with the markers that were found, and with those that are ticked.
 *
 * @param {{ list: MarkerList, filters: import("./markers_filters.js").Filters, ticked: Set<string>, onTick: (ids: Set<string>) => void }} props
 */
function Actions({ list, filters, ticked, onTick }) {
  const [dialog, setDialog] = useState(/** @type {"export" | "artwork" | "status" | null} */ (null));
  const markers = useMemo(() => list.rows.filter(({ id }) => ticked.has(id)), [list.rows, ticked]);
  const close = () => setDialog(null);
  const [first, second] = markers;
  const apart = markers.length === 2 && first && second
    ? distance_m([first.position.lon_deg, first.position.lat_deg], [second.position.lon_deg, second.position.lat_deg]) : null;
  return html`
    <div class="actions-bar">
      <span role="status">${countText(list)}</span>
      <span>${t("markers.ticked", { count: markers.length })}${apart !== null && `, ${t("markers.apart", { distance: number(apart, apart < 100 ? 2 : 0, "m") })}`}</span>
      ${markers.length > 0 && html`<button type="button" class="quiet" onClick=${() => onTick(new Set())}>${t("markers.untick")}</button>`}
      <span class="spacer"></span>
      <button type="button" class="quiet" onClick=${() => setDialog("export")}>${t("export.button")}</button>
      <button type="button" class="quiet" disabled=${!markers.some(({ family }) => family === "plate")} onClick=${() => setDialog("artwork")}>${t("artwork.button")}</button>
      ${may("POST /v1/markers/bulk") && html`<button type="button" class="quiet" disabled=${!markers.length} onClick=${() => setDialog("status")}>${t("bulk.button")}</button>`}
    </div>
    ${dialog === "export" && html`<${ExportDialog} filters=${filters} onClose=${close} />`}
    ${dialog === "artwork" && html`<${ArtworkDialog} markers=${markers} onClose=${close} />`}
    ${dialog === "status" && html`<${StatusDialog} markers=${markers} onClose=${close} onDone=${list.reload} />`}
  `;
}

/** @param {MarkerList} list */
function countText(list) {
  if (list.loading && !list.rows.length) return t("load.loading");
  return t(list.after ? "markers.count_more" : "markers.count", { count: number(list.rows.length) });
}

/** @param {{ list: MarkerList, chosen: string | null, ticked: Set<string>, onTick: (ids: Set<string>) => void }} props */
function List({ list, chosen, ticked, onTick }) {
  if (!list.rows.length && !list.loading && !list.error) {
    const filtered = JSON.stringify(readFilters(query.value)) !== "{}";
    return html`<${Empty} title=${t(filtered ? "markers.none_found" : "markers.none")}>
      ${!filtered && may("POST /v1/markers") && html`<p><a href="/studio/plates">${t("markers.first")}</a></p>`}
    </${Empty}>`;
  }
  return html`<${Table} label=${t("markers.list")} rows=${list.rows} columns=${columnsOf()} idOf=${(/** @type {Marker} */ row) => row.id} nameOf=${codeOf}
    chosen=${chosen} ticked=${ticked} onTick=${onTick}
    footer=${list.after ? html`${t("table.sorted_loaded")} <button type="button" class="quiet" disabled=${list.loading} onClick=${list.more}>${t("table.more")}</button>` : ""} />`;
}

/** @returns {import("../components/table.js").Column<Marker>[]} */
function columnsOf() {
  return [
    { name: "code", title: t("field.code"), head: true, order: codeOf, cell: (row) => html`<a class="code" href=${withQuery(`/markers/${row.id}`)}>${codeOf(row)}</a>` },
    { name: "family", title: t("field.family"), order: (row) => row.family, cell: (row) => html`<${FamilyName} family=${row.family} />` },
    { name: "status", title: t("field.status"), order: (row) => row.status, cell: (row) => html`<${StatusBadge} status=${row.status} family=${row.family} />` },
    { name: "road", title: t("field.road"), order: (row) => row.road, cell: (row) => text(row.road) },
    { name: "measure", title: t("roads.measure"), number: true, order: (row) => row.measure_m, cell: (row) => (row.measure_m === null ? MISSING : stationText(row.measure_m)) },
    { name: "grade", title: t("field.grade"), order: (row) => ["cm", "dm", "m", "unfit"].indexOf(row.position.localization_grade), cell: (row) => t(`grade.${row.position.localization_grade}`) },
    { name: "lon", title: t("field.lon_deg"), number: true, hidden: true, order: (row) => row.position.lon_deg, cell: (row) => degrees(row.position.lon_deg) },
    { name: "lat", title: t("field.lat_deg"), number: true, hidden: true, order: (row) => row.position.lat_deg, cell: (row) => degrees(row.position.lat_deg) },
    { name: "rmse", title: t("field.horizontal_rmse_m"), number: true, hidden: true, order: (row) => row.position.horizontal_rmse_m, cell: (row) => number(row.position.horizontal_rmse_m, 3) },
    { name: "heading", title: t("field.heading_deg"), number: true, hidden: true, order: (row) => row.heading_deg, cell: (row) => number(row.heading_deg, 1) },
    { name: "version", title: t("field.version"), number: true, hidden: true, order: (row) => row.version, cell: (row) => String(row.version) },
    { name: "updated", title: t("field.updated_at"), order: (row) => row.updated_at, cell: (row) => time(row.updated_at) },
  ];
}

