// The rows of a survey on the map and in a table. The chosen row and the filter of states are in the address.

import { html } from "htm/preact";
import { useEffect, useMemo } from "preact/hooks";

import { Symbol, Verdict } from "../components/badges.js";
import { Empty } from "../components/load.js";
import { Table } from "../components/table.js";
import { useMap } from "../components/use_map.js";
import { degrees, number, text } from "../format.js";
import { addRowLayers, isPlaced, setChosenRow, setRows, SYMBOLS } from "../map/rows.js";
import { query, setQuery } from "../router.js";
import { t } from "../texts/index.js";

const STATES = /** @type {const} */ (["good", "warning", "refused", "left-out"]);
const LEVELS = /** @type {const} */ ({ good: "good", warning: "warn", refused: "bad", "left-out": "none" });

/** @typedef {import("../api/schema.js").components["schemas"]["ImportReport"]} Report */
/** @typedef {import("../map/rows.js").SurveyRow} SurveyRow */

/**
 * @param {{ report: Report, family: string, leftOut?: Set<number>, onLeaveOut?: (rows: number[], out: boolean) => void }} props Without `onLeaveOut` rows
 *   are only shown.
 */
export function Rows({ report, family, leftOut = new Set(), onLeaveOut }) {
  const wanted = query.value.get("rows") ?? "";
  const chosen = query.value.get("row");
  const faults = useMemo(() => faultsByRow(report), [report]);
  const rows = useMemo(() => report.listed.filter((row) => !wanted || row.state === wanted), [report, wanted]);
  const counts = useMemo(() => countsOf(report.listed), [report]);
  if (!report.listed.length) return null;
  return html`
    <div class="segments" role="group" aria-label=${t("imports.rows_shown")}>
      <button type="button" class="quiet" aria-pressed=${!wanted} onClick=${() => setQuery({ rows: null })}>${t("filter.all")} (${report.listed.length})</button>
      ${STATES.filter((state) => counts[state]).map((state) => html`<button type="button" class="quiet" aria-pressed=${wanted === state} onClick=${() => setQuery({ rows: state })}>${t(`imports.state_${state}`)} (${counts[state]})</button>`)}
    </div>
    ${report.rows > report.listed.length && html`<p class="hint">${t("imports.listed", { listed: number(report.listed.length), rows: number(report.rows) })}</p>`}
    <div class="rows-view">
      <${RowMap} rows=${report.listed} family=${family} chosen=${chosen} />
      ${rows.length
        ? html`<${Table} label=${t("imports.rows")} rows=${rows} idOf=${(/** @type {SurveyRow} */ row) => String(row.row)} chosen=${chosen} columns=${columns(faults, leftOut, onLeaveOut)} footer=${t("list.count", { count: number(rows.length) })} />`
        : html`<${Empty} title=${t("list.none_found")} />`}
    </div>
  `;
}

/** @param {Report} report @returns {Map<number, string>} */
function faultsByRow(report) {
  const found = new Map();
  for (const { row, message } of report.faults) if (row !== null) found.set(row, found.has(row) ? `${found.get(row)}; ${message}` : message);
  return found;
}

/** @param {SurveyRow[]} rows */
function countsOf(rows) {
  const counts = { good: 0, warning: 0, refused: 0, "left-out": 0 };
  for (const { state } of rows) counts[state] += 1;
  return counts;
}

/**
 * @param {Map<number, string>} faults
 * @param {Set<number>} leftOut
 * @param {((rows: number[], out: boolean) => void) | undefined} onLeaveOut
 * @returns {import("../components/table.js").Column<SurveyRow>[]}
 */
function columns(faults, leftOut, onLeaveOut) {
  /** @type {import("../components/table.js").Column<SurveyRow>[]} */
  const found = [
    { name: "row", title: t("imports.row"), head: true, order: (row) => row.row, cell: (row) => html`<button type="button" class="link" onClick=${() => setQuery({ row: row.row })}>${row.row}</button>` },
    { name: "state", title: t("field.state"), order: (row) => STATES.indexOf(row.state), cell: (row) => html`<${Verdict} level=${LEVELS[row.state]}>${t(`imports.state_${row.state}`)}</${Verdict}>` },
    { name: "code", title: t("field.code"), order: (row) => row.code, cell: (row) => html`<span class="code">${text(row.code)}</span>` },
    { name: "point", title: t("imports.point"), order: (row) => row.point, cell: (row) => text(row.point) },
    { name: "fault", title: t("imports.fault"), order: (row) => faults.get(row.row), cell: (row) => html`<span class="cut" title=${faults.get(row.row)}>${faults.get(row.row) ?? ""}</span>` },
    { name: "lon", title: t("field.lon_deg"), number: true, order: (row) => row.lon_deg, cell: (row) => degrees(row.lon_deg) },
    { name: "lat", title: t("field.lat_deg"), number: true, order: (row) => row.lat_deg, cell: (row) => degrees(row.lat_deg) },
    { name: "height", title: t("imports.height"), number: true, hidden: true, order: (row) => row.height_m, cell: (row) => number(row.height_m, 3) },
  ];
  if (onLeaveOut) {
    found.splice(2, 0, {
      name: "use", title: t("imports.use"),
      cell: (row) => html`<input type="checkbox" aria-label=${t("imports.use_row", { row: row.row })} checked=${!leftOut.has(row.row)} onChange=${(/** @type {any} */ event) => onLeaveOut([row.row], !event.currentTarget.checked)} />`,
    });
  }
  return found;
}

/** @param {{ rows: SurveyRow[], family: string, chosen: string | null }} props */
function RowMap({ rows, family, chosen }) {
  const { box, ready, failed } = useMap(() => null, (map) => {
    addRowLayers(map);
    map.on("click", "rows", (event) => setQuery({ row: event.features?.[0]?.properties.row ?? null }));
  });
  useEffect(() => {
    if (!ready) return;
    setRows(ready.map, rows, family);
  }, [ready, rows, family]);
  const places = rows.filter(isPlaced);
  const extent = places.length ? `${places[0]?.lon_deg} ${places[0]?.lat_deg} ${places.length}` : "";
  useEffect(() => {
    if (!ready || !places.length) return;
    const bounds = new ready.maplibre.LngLatBounds();
    for (const row of places) bounds.extend([row.lon_deg ?? 0, row.lat_deg ?? 0]);
    ready.map.fitBounds(bounds, { padding: 50, maxZoom: 18, animate: false });
  }, [ready, extent]);
  useEffect(() => {
    if (!ready) return;
    const row = rows.find((one) => String(one.row) === chosen);
    setChosenRow(ready.map, row);
    const place = /** @type {[number, number]} */ ([row?.lon_deg ?? 0, row?.lat_deg ?? 0]);
    if (row && isPlaced(row) && !ready.map.getBounds().contains(place)) ready.map.jumpTo({ center: place });
  }, [ready, rows, chosen]);
  return html`
    <div class="map-frame">
      <div class="map" ref=${box}></div>
      ${failed && html`<p class="map-failed" role="status">${t("map.failed")} <span class="hint">${failed}</span></p>`}
      ${!ready && !failed && html`<p class="map-failed loading" role="status">${t("load.loading")}</p>`}
      <div class="map-tools"><details class="choice"><summary>${t("legend.title")}</summary><div class="choice-list"><div class="legend"><ul>
        ${STATES.map((state) => html`<li><${Symbol} family=${family} status=${SYMBOLS[state]} /> ${t(`imports.state_${state}`)}</li>`)}
        <li>${t("imports.registered")}</li>
      </ul></div></div></details></div>
    </div>
  `;
}
