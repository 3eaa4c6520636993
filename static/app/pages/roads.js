// Roads: the registered axes with their measures, and the roads with lanes that plans are made for.

import { html } from "htm/preact";

import { api, ok, page } from "../api/client.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { RoadMap } from "../components/road_map.js";
import { Table } from "../components/table.js";
import { stationText } from "../components/strip_scale.js";
import { number, text, time } from "../format.js";
import { navigate, query, setQuery } from "../router.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";
import { allOf, loadAlignments } from "./plans.js";

const MAX_ON_MAP = 200;
const AT_ONCE = 8;

export default function Roads() {
  const kind = query.value.get("kind") === "lanes" ? "lanes" : "registered";
  return html`
    <div class="title-line"><h1>${t("roads.title")}</h1>
      ${kind === "registered" ? may("POST /v1/roads") && html`<a class="button" href="/roads/new">${t("roads.new")}</a>` : may("POST /v1/alignments") && html`<a class="button" href="/roads/new?kind=lanes">${t("roads.new_lanes")}</a>`}
    </div>
    <div class="segments" role="group" aria-label=${t("roads.kind")}>
      ${/** @type {const} */ (["registered", "lanes"]).map((name) => html`<button type="button" class="quiet" aria-pressed=${kind === name} onClick=${() => setQuery({ kind: name === "lanes" ? name : null, sort: null, columns: null }, { replace: false })}>${t(`roads.kind_${name}`)}</button>`)}
    </div>
    <p class="hint">${t(`roads.text_${kind}`)}</p>
    ${kind === "registered" ? html`<${Registered} />` : html`<${WithLanes} />`}
  `;
}

function Registered() {
  const roads = useLoad((signal) => allOf((after) => page(api.GET("/v1/roads", { params: { query: { limit: 1000, ...(after ? { after } : {}) } }, signal }))), []);
  return html`<${Shown} of=${roads}>${(/** @type {any[]} */ rows) => (rows.length ? html`
    <${OverviewMap} roads=${rows} />
    <${Table} label=${t("roads.kind_registered")} rows=${rows} idOf=${(/** @type {any} */ row) => row.id} columns=${registeredColumns()} footer=${t("list.count", { count: number(rows.length) })} />` : html`
    <${Empty} title=${t("roads.none")}>${may("POST /v1/roads") && html`<p><a href="/roads/new">${t("roads.new")}</a></p>`}</${Empty}>`)}</${Shown}>`;
}

/** @returns {import("../components/table.js").Column<any>[]} */
const registeredColumns = () => [
  { name: "name", title: t("field.name"), head: true, order: (row) => row.name, cell: (row) => html`<a href=${`/roads/${row.id}`}>${row.name}</a>` },
  { name: "from", title: t("roads.from"), number: true, order: (row) => row.from_m, cell: (row) => stationText(row.from_m, 1) },
  { name: "to", title: t("roads.to"), number: true, order: (row) => row.to_m, cell: (row) => stationText(row.to_m, 1) },
  { name: "length", title: t("field.length_m"), number: true, order: (row) => row.length_m, cell: (row) => number(row.length_m, 1) },
  { name: "grade", title: t("field.grade"), order: (row) => row.localization_grade, cell: (row) => textOr(`grade.${row.localization_grade}`, row.localization_grade) },
  { name: "markers", title: t("markers.title"), cell: (row) => html`<a href=${`/markers?road=${encodeURIComponent(row.name)}`}>${t("roads.its_markers")}</a>` },
  { name: "crs", title: t("field.crs"), hidden: true, order: (row) => row.crs, cell: (row) => text(row.crs) },
  { name: "updated", title: t("field.updated_at"), order: (row) => row.updated_at, cell: (row) => time(row.updated_at) },
];

/** @param {{ roads: any[] }} props */
function OverviewMap({ roads }) {
  const lines = useLoad(async (signal) => {
    const found = [];
    const some = roads.slice(0, MAX_ON_MAP);
    for (let k = 0; k < some.length; k += AT_ONCE) {
      found.push(...(await Promise.all(some.slice(k, k + AT_ONCE).map(({ id }) => ok(api.GET("/v1/roads/{road_id}", { params: { path: { road_id: id } }, signal }))))));
    }
    return found.map(({ name, geometry }) => ({ name, line: /** @type {any} */ (geometry.coordinates) }));
  }, [roads.length]);
  return html`<${RoadMap} lanes=${lines.data ?? []} spots=${NOTHING} caption=${t("roads.on_map", { count: number(Math.min(roads.length, MAX_ON_MAP)) })} />`;
}

/** @type {any[]} */
const NOTHING = [];

function WithLanes() {
  const roads = useLoad(loadAlignments, []);
  return html`<${Shown} of=${roads}>${(/** @type {any[]} */ rows) => (rows.length ? html`
    <${Table} label=${t("roads.kind_lanes")} rows=${rows} idOf=${(/** @type {any} */ row) => row.id} columns=${laneColumns()} footer=${t("list.count", { count: number(rows.length) })} />` : html`
    <${Empty} title=${t("roads.no_lanes")}>${may("POST /v1/alignments") && html`<p><button type="button" class="quiet" onClick=${() => navigate("/roads/new?kind=lanes")}>${t("roads.new_lanes")}</button></p>`}</${Empty}>`)}</${Shown}>`;
}

/** @returns {import("../components/table.js").Column<any>[]} */
const laneColumns = () => [
  { name: "name", title: t("field.name"), head: true, order: (row) => row.name, cell: (row) => html`<a href=${`/roads/lanes/${row.id}`}>${row.name}</a>` },
  { name: "lanes", title: t("road_facts.lanes"), number: true, order: (row) => row.lanes.length, cell: (row) => number(row.lanes.length) },
  { name: "length", title: t("field.lane_length_m"), number: true, order: (row) => row.lane_length_m, cell: (row) => number(row.lane_length_m, 1) },
  { name: "format", title: t("road_facts.format"), order: (row) => row.format, cell: (row) => text(row.format) },
  { name: "grade", title: t("field.grade"), order: (row) => row.localization_grade, cell: (row) => textOr(`grade.${row.localization_grade}`, row.localization_grade) },
  { name: "plans", title: t("plans.title"), cell: (row) => html`<a href=${`/plans?alignment=${row.id}`}>${t("roads.its_plans")}</a>` },
  { name: "created", title: t("field.created_at"), order: (row) => row.created_at, cell: (row) => time(row.created_at) },
];
