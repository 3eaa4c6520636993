// One registered road: its axis with stations on the map, its markers along its measures, its calibration and history.

import { html } from "htm/preact";
import { useMemo, useRef, useState } from "preact/hooks";

import { api, ok, page } from "../api/client.js";
import { Facts } from "../components/facts.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { notify } from "../components/notices.js";
import { RoadMap } from "../components/road_map.js";
import { Strip } from "../components/strip.js";
import { chainageNear, stationText } from "../components/strip_scale.js";
import { codeOf, number, text, time } from "../format.js";
import { navigate, query, setQuery } from "../router.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";
import { allOf } from "./plans.js";
import { AxisForm } from "./roads_axis.js";

const MAX_TICKS = 12;

/** @param {{ parameters: { road_id: string } }} props */
export default function RoadPage({ parameters }) {
  const id = parameters.road_id;
  const changed = useRef(false);
  const found = useLoad(async (signal) => {
    const path = { road_id: id };
    const road = await ok(api.GET("/v1/roads/{road_id}", { params: { path }, signal }));
    const [markers, ticks, alignments] = await Promise.all([
      may("GET /v1/roads/{road_id}/markers") ? allOf((after) => page(api.GET("/v1/roads/{road_id}/markers", { params: { path, query: { limit: 1000, ...(after ? { after } : {}) } }, signal }))) : [],
      stationPlaces(road, signal),
      may("GET /v1/alignments") ? allOf((after) => page(api.GET("/v1/alignments", { params: { query: { limit: 1000, ...(after ? { after } : {}) } }, signal }))) : [],
    ]);
    if (changed.current) setQuery({ edit: null }); // only now: a form that is opened meanwhile would show the old version
    changed.current = false;
    return { road, markers, ticks, alignments: alignments.filter(({ declaration }) => declaration.road_id === id) };
  }, [id]);
  const reload = () => {
    changed.current = true;
    found.reload();
  };
  return html`
    <h1>${found.data?.road.name ?? t("roads.title")}</h1>
    <${Shown} of=${found}>${(/** @type {any} */ data) => html`<${Road} key=${`${id} ${data.road.version}`} ...${data} onChanged=${reload} />`}</${Shown}>
  `;
}

/** Places of round measures, for the map. @param {any} road @param {AbortSignal} signal */
async function stationPlaces(road, signal) {
  const wanted = Math.max((road.to_m - road.from_m) / MAX_TICKS, 1);
  const power = 10 ** Math.floor(Math.log10(wanted));
  const step = [1, 2, 5, 10].map((times) => times * power).find((value) => value >= wanted) ?? 10 * power;
  /** @type {{ measure_m: number, offset_m: number }[]} */
  const references = [];
  for (let k = Math.ceil(road.from_m / step); k * step <= road.to_m; k += 1) references.push({ measure_m: k * step, offset_m: 0 });
  if (!references.length) return [];
  const { items } = await ok(api.POST("/v1/roads/{road_id}/position", { params: { path: { road_id: road.id } }, body: { references }, signal }));
  const found = items.flatMap(({ places }, k) => places.map((place) => ({ ...place, sign: stationText(references[k]?.measure_m ?? 0, 0) })));
  found.sort((a, b) => a.section - b.section || a.chainage_m - b.chainage_m);
  /** @type {typeof found} */
  const places = [];
  for (const place of found) {
    const last = places[places.length - 1];
    if (last && Math.abs(last.chainage_m - place.chainage_m) < 0.01) last.sign += ` = ${place.sign}`; // an equation of stationing
    else places.push(place);
  }
  return places;
}

/** Sections of a road with their chainages: they follow each other along the axis. @param {any} road */
function sectionsOf(road) {
  let start_m = 0;
  return road.sections.map((/** @type {{ from_m: number, to_m: number, length_m: number }} */ { from_m, to_m, length_m }) => {
    const section = { from_m, to_m, start_m, end_m: start_m + length_m };
    start_m = section.end_m;
    return section;
  });
}

/** @typedef {{ from_m: number, to_m: number, start_m: number, end_m: number }} Section */

/** The axis of a road as a strip takes it: its measures jump between sections. @param {any} road @param {Section[]} sections */
function wayOf(road, sections) {
  /** @type {number[][]} */
  const points = road.geometry.type === "MultiLineString" ? road.geometry.coordinates.flat() : road.geometry.coordinates;
  return {
    name: road.name, length_m: road.length_m,
    chainage_m: sections.flatMap(({ start_m, end_m }) => [start_m, end_m]), station_m: sections.flatMap(({ from_m, to_m }) => [from_m, to_m]),
    lon_deg: points.map(([lon = 0]) => lon), lat_deg: points.map(([, lat = 0]) => lat),
  };
}

/**
 * Where a marker is along the axis, by its measure; of several places with this measure the one nearest to its position.
 *
 * @param {ReturnType<typeof wayOf>} way @param {Section[]} sections @param {any} marker
 */
function placeOf(way, sections, marker) {
  const places = sections.filter(({ from_m, to_m }) => marker.measure_m >= from_m - 0.01 && marker.measure_m <= to_m + 0.01)
    .map(({ from_m, to_m, start_m, end_m }) => start_m + ((marker.measure_m - from_m) / (to_m - from_m || 1)) * (end_m - start_m));
  if (places.length === 1) return places[0] ?? 0;
  const along_m = lengthsAlong(way);
  const total_m = along_m[along_m.length - 1] || 1;
  const near_m = (chainageNear({ ...way, chainage_m: along_m }, marker.position.lon_deg, marker.position.lat_deg) / total_m) * way.length_m;
  return places.length ? places.reduce((best, at_m) => (Math.abs(at_m - near_m) < Math.abs(best - near_m) ? at_m : best)) : near_m;
}

/** Distances along the vertices of an axis, on a sphere: to choose between places, not to measure. @param {{ lon_deg: number[], lat_deg: number[] }} way */
function lengthsAlong({ lon_deg, lat_deg }) {
  const along = [0];
  for (let k = 1; k < lon_deg.length; k += 1) {
    const east = ((lon_deg[k] ?? 0) - (lon_deg[k - 1] ?? 0)) * Math.cos(((lat_deg[k] ?? 0) * Math.PI) / 180);
    along.push((along[k - 1] ?? 0) + Math.hypot(east, (lat_deg[k] ?? 0) - (lat_deg[k - 1] ?? 0)) * 111195);
  }
  return along;
}

/** @param {{ road: any, markers: any[], ticks: any[], alignments: any[], onChanged: () => void }} props */
function Road({ road, markers, ticks, alignments, onChanged }) {
  const editing = query.value.get("edit") === "axis";
  const [pointed, setPointed] = useState(/** @type {any} */ (null));
  const sections = useMemo(() => sectionsOf(road), [road]);
  const way = useMemo(() => wayOf(road, sections), [road]);
  const placed = useMemo(() => markers.filter(({ measure_m }) => measure_m !== null).map((marker) => ({
    id: `m${marker.id}`, marker, row: `family ${marker.family}`, at_m: placeOf(way, sections, marker), family: marker.family, status: marker.status,
    label: `${textOr(`family.${marker.family}`, marker.family)} ${codeOf(marker)}, ${textOr(`status.${marker.status}`, marker.status)}`,
  })), [markers]);
  const points = useMemo(() => road.calibration.map((/** @type {any} */ point, /** @type {number} */ k) => ({ id: `k${k}`, row: "calibration", at_m: point.chainage_m, sign: "K", kind: "event", label: t("roads.calibrated", { measure: stationText(point.measure_m, 3) }) })), [road]);
  const spots = useMemo(() => [
    ...placed.map(({ id, marker, label }) => ({ id, kind: /** @type {const} */ ("marker"), family: marker.family, status: marker.status, label, lon_deg: marker.position.lon_deg, lat_deg: marker.position.lat_deg })),
    ...ticks.map((tick, k) => ({ id: `t${k}`, kind: /** @type {const} */ ("station"), sign: tick.sign, label: tick.sign, lon_deg: tick.lon_deg, lat_deg: tick.lat_deg })),
  ], [placed, ticks]);
  const lines = useMemo(() => [{ name: road.name, line: road.geometry.coordinates }], [road]);
  const spot = pointed?.id ? spots.find(({ id }) => id === pointed.id) : null;
  const open = (/** @type {string} */ id) => id.startsWith("m") && navigate(`/markers/${id.slice(1)}`);
  const families = [...new Set(placed.map(({ marker }) => marker.family))];
  return html`
    <${Facts} of=${[
      [t("roads.measures"), t("roads.measures_text", { from: stationText(road.from_m, 3), to: stationText(road.to_m, 3) })], [t("field.length_m"), number(road.length_m, 3)],
      [t("field.crs"), [road.crs, road.realization, road.epoch].filter(Boolean).join(", ")], [t("field.grade"), textOr(`grade.${road.localization_grade}`, road.localization_grade)],
      [t("field.transform_note"), road.transform_note], [t("field.version"), `${road.version}, ${time(road.updated_at)} UTC`],
    ]} />
    <div class="actions">
      <a class="button quiet" href=${`/markers?road=${encodeURIComponent(road.name)}`}>${t("roads.markers", { count: number(markers.length) })}</a>
      ${may("POST /v1/alignments") && html`<a class="button quiet" href=${`/plans/new?way=registered`}>${t("roads.plan")}</a>`}
      ${may("PATCH /v1/roads/{road_id}") && html`<button type="button" class="quiet" aria-expanded=${editing} onClick=${() => setQuery({ edit: editing ? null : "axis" })}>${t("roads.edit")}</button>`}
    </div>
    ${editing && html`<section class="card" aria-label=${t("roads.edit")}><p class="hint">${t("roads.edit_text")}</p>
      <${AxisForm} road=${road} onStored=${(/** @type {any} */ stored) => {
        notify(t("roads.changed", { name: stored.name, version: stored.version }));
        onChanged();
      }} /></section>`}
    <section class="plan-view" aria-label=${t("plan.view")}>
      <${RoadMap} lanes=${lines} chosenLane=${road.name} spots=${spots} pointed=${spot ? [spot.lon_deg, spot.lat_deg] : null} caption=${t("roads.stations_on_map")}
        onPoint=${(/** @type {string | null} */ id) => setPointed(id ? { id, lane: road.name, at_m: placed.find((one) => one.id === id)?.at_m ?? 0 } : null)} onChoose=${open} />
      <${Strip} way=${way} label=${road.name} items=${[...placed, ...points]} pointed=${pointed} onPoint=${setPointed} onChoose=${open}
        rows=${[...families.map((family) => ({ id: `family ${family}`, title: textOr(`family_many.${family}`, family) })), { id: "calibration", title: t("roads.calibration") }]} />
    </section>
    <div class="columns">
      <section><h2>${t("roads.calibration")}</h2><${Calibration} road=${road} /></section>
      <section><h2>${t("roads.lanes_of")}</h2>
        ${alignments.length ? html`<ul class="plain">${alignments.map(({ id, name }) => html`<li><a href=${`/roads/lanes/${id}`}>${name}</a> · <a href=${`/plans?alignment=${id}`}>${t("roads.its_plans")}</a></li>`)}</ul>` : html`<p class="hint">${t("roads.no_lanes_of")}</p>`}
        <h2>${t("plan.tab_history")}</h2><${History} road=${road} />
      </section>
    </div>
  `;
}

/** @param {{ road: any }} props */
function Calibration({ road }) {
  return html`
    ${road.calibration.length === 0 ? html`<p>${t("roads.true_metres")}</p>` : html`
      <div class="table-scroll plain-table" tabindex="0" role="region" aria-label=${t("roads.calibration")}><table>
        <thead><tr><th scope="col">${t("roads.measure")}</th><th scope="col">${t("roads.ahead")}</th><th scope="col" class="number">${t("roads.part")}</th><th scope="col" class="number">${t("roads.chainage")}</th></tr></thead>
        <tbody>${road.calibration.map((/** @type {any} */ point) => html`<tr><th scope="row">${stationText(point.measure_m, 3)}</th><td>${point.ahead_m === null || point.ahead_m === undefined ? "–" : stationText(point.ahead_m, 3)}</td><td class="number">${point.part}</td><td class="number">${number(point.chainage_m, 3)}</td></tr>`)}</tbody>
      </table></div>`}
    ${road.sections.length > 1 && html`<h3>${t("roads.sections")}</h3><ul class="plain">${road.sections.map((/** @type {any} */ section) => html`<li>${t("roads.section", { from: stationText(section.from_m, 3), to: stationText(section.to_m, 3), length: number(section.length_m, 1, "m") })}</li>`)}</ul>`}
  `;
}

/** @param {{ road: any }} props */
function History({ road }) {
  const versions = useLoad((signal) => page(api.GET("/v1/roads/{road_id}/versions", { params: { path: { road_id: road.id }, query: { limit: 50 } }, signal })), [road.id]);
  return html`<${Shown} of=${versions}>${(/** @type {any} */ { items }) => (items.length ? html`<ol class="history">${[...items].reverse().map((/** @type {any} */ version) => html`<li><p><strong>${t("marker.version", { version: version.version })}</strong>, ${time(version.at)} UTC, ${version.who}</p>${version.why && html`<p>${text(version.why)}</p>`}</li>`)}</ol>` : html`<${Empty} title=${t("list.empty")} />`)}</${Shown}>`;
}
