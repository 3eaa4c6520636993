// The work list: faults that vehicles and people report, the most urgent first; approved or rejected by a person.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

import { api, download, ok, request } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Facts } from "../components/facts.js";
import { FormFrame, SelectField, TextField, useForm } from "../components/form.js";
import { ChoiceFilter, closeTo, filterOf, linked, ListPage, TextFilter } from "../components/list_page.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { attempt, notify } from "../components/notices.js";
import { addressOf, usePages } from "../components/pages.js";
import { Panel } from "../components/panel.js";
import { Picture } from "../components/picture.js";
import { stationText } from "../components/strip_scale.js";
import { degrees, MISSING, number, text, time } from "../format.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";

const BASE = "/operations/maintenance";
const FAULTS = /** @type {const} */ (["missing", "moved", "cloned", "wrong-way", "fading", "unregistered", "shifted", "turned", "wrong-way-driver", "reported"]);
const OUTCOMES = /** @type {const} */ (["suspect", "resurvey", "retired", "none"]);
const URGENT = 0.6;
const SOON = 0.3;

/** @typedef {import("../api/schema.js").components["schemas"]["MaintenanceItem"]} Item */

/** @param {{ id: string | null }} props */
export default function Maintenance({ id }) {
  const status = filterOf("status") || "open";
  const wanted = { status: status === "all" ? null : status, what: filterOf("what"), road: filterOf("road"), family: filterOf("family"), min_priority: filterOf("min_priority"), marker_id: filterOf("marker_id") };
  const list = usePages("/v1/maintenance", wanted);
  const save = (/** @type {"csv" | "geojson"} */ form) => attempt(async () => {
    await download(addressOf(`/v1/maintenance.${form}`, wanted), `maintenance.${form}`);
    notify(t("maintenance.saved"));
  });
  const actions = html`
    <button type="button" class="quiet" onClick=${() => save("csv")}>${t("maintenance.csv")}</button>
    <button type="button" class="quiet" onClick=${() => save("geojson")}>${t("maintenance.geojson")}</button>
  `;
  const filters = html`
    <${ChoiceFilter} name="status" label=${t("field.status")} otherwise="open" options=${[["open", t("option.open")], ["approved", t("option.approved")], ["rejected", t("option.rejected")], ["all", t("filter.all")]]} />
    <${ChoiceFilter} name="what" label=${t("field.what")} options=${[["", t("filter.all")], ...FAULTS.map((fault) => [fault, t(`fault.${fault}`)])]} />
    <${TextFilter} name="road" label=${t("field.road")} />
    <${ChoiceFilter} name="min_priority" label=${t("field.priority")} options=${[["", t("filter.all")], ["0.3", t("maintenance.soon")], ["0.6", t("maintenance.urgent")]]} />
  `;
  const empty = html`<${Empty} title=${t("maintenance.none")}><p>${t("maintenance.none_text")}</p><p><a href="/operations/maintenance?status=all">${t("maintenance.show_all")}</a></p></${Empty}>`;
  return html`<${ListPage} title=${t("maintenance.title")} base=${BASE} list=${list} columns=${columns()} chosen=${id} filters=${filters} actions=${actions} empty=${empty}
    lead=${t("maintenance.lead")} panel=${id !== null && html`<${One} key=${id} id=${id} onChanged=${list.reload} />`} />`;
}

/** @returns {import("../components/table.js").Column<any>[]} */
const columns = () => [
  linked(BASE, { name: "what", title: t("field.what"), order: (row) => row.what, cell: (row) => textOr(`fault.${row.what}`, row.what) }),
  { name: "priority", title: t("field.priority"), order: (row) => -row.priority, cell: (row) => html`<${Priority} of=${row.priority} />` },
  { name: "code", title: t("field.code"), order: (row) => row.code, cell: (row) => (row.marker_id ? html`<a class="code" href=${`/markers/${row.marker_id}`}>${text(row.code)}</a>` : text(row.code)) },
  { name: "road", title: t("field.road"), order: (row) => row.road, cell: (row) => text(row.road) },
  { name: "measure", title: t("roads.measure"), number: true, order: (row) => row.measure_m, cell: (row) => (row.measure_m === null ? MISSING : stationText(row.measure_m, 1)) },
  { name: "vehicles", title: t("maintenance.vehicles"), number: true, order: (row) => row.vehicles, cell: (row) => number(row.vehicles) },
  { name: "last", title: t("field.last_at"), order: (row) => row.last_at, cell: (row) => time(row.last_at) },
  { name: "status", title: t("field.status"), order: (row) => row.status, cell: (row) => textOr(`option.${row.status}`, row.status) },
];

/** @param {{ of: number }} props */
function Priority({ of }) {
  const level = of >= URGENT ? "bad" : of >= SOON ? "warn" : "none";
  return html`<${Verdict} level=${level}>${number(of, 2)} ${t(level === "bad" ? "maintenance.is_urgent" : level === "warn" ? "maintenance.is_soon" : "maintenance.is_later")}</${Verdict}>`;
}

/** @param {{ id: string, onChanged: () => void }} props */
function One({ id, onChanged }) {
  const found = useLoad((signal) => ok(api.GET("/v1/maintenance/{item_id}", { params: { path: { item_id: id } }, signal })), [id]);
  const item = /** @type {Item | null} */ (found.data);
  const changed = () => {
    found.reload();
    onChanged();
  };
  return html`
    <${Panel} title=${item ? textOr(`fault.${item.what}`, item.what) : t("maintenance.one")} label=${t("maintenance.one")} onClose=${closeTo(BASE)}>
      <${Shown} of=${found}>${() => item && html`
        <p><${Priority} of=${item.priority} /></p>
        <p>${textOr(`fault_text.${item.what}`, "")}</p>
        <p class="buttons">${item.marker_id && html`<a class="button" href=${`/markers/${item.marker_id}`}>${t("list.marker")}</a>`}
          <a href=${`/markers?view=map&map=${degrees(item.lon_deg, 6)},${degrees(item.lat_deg, 6)},18`}>${t("maintenance.map")}</a></p>
        <${Facts} of=${[
          [t("field.code"), item.code && html`<span class="code">${item.code}</span>`],
          [t("field.family"), textOr(`family.${item.family}`, item.family)],
          [t("field.road"), item.road && `${item.road}${item.measure_m === null ? "" : `, ${stationText(item.measure_m, 1)}`}`],
          [t("field.position"), `${degrees(item.lon_deg)}, ${degrees(item.lat_deg)}`],
          [t("maintenance.first_at"), time(item.first_at)],
          [t("field.last_at"), time(item.last_at)],
          [t("maintenance.evidence"), item.passes > 0 && t("maintenance.evidence_text", { passes: number(item.passes), vehicles: number(item.vehicles) })],
          [t("maintenance.false_alarm"), item.evidence.false_alarm_probability && t("maintenance.false_alarm_text", { one: number(1 / item.evidence.false_alarm_probability) })],
          [t("maintenance.offset"), item.evidence.offset_m && `${number(item.evidence.offset_m, 2, "m")}${item.evidence.offset_sigma_m ? ` ± ${number(item.evidence.offset_sigma_m, 2, "m")}` : ""}`],
          [t("maintenance.offset_parts"), item.evidence.offset_sigma_m && t("maintenance.offset_parts_text", { east: number(item.evidence.offset_east_m, 2, "m"), north: number(item.evidence.offset_north_m, 2, "m") })],
          [t("maintenance.turn"), item.what === "turned" && `${number(item.evidence.turn_deg, 3)}° ± ${number(item.evidence.turn_sigma_deg, 3)}°`],
          [t("maintenance.directions"), item.evidence.directions && t(item.evidence.directions === 1 ? "maintenance.one_direction" : "maintenance.both_directions")],
          [t("field.status"), textOr(`option.${item.status}`, item.status)],
          [t("maintenance.outcome"), item.outcome && textOr(`item_outcome.${item.outcome}`, item.outcome)],
          [t("field.note"), item.note],
          [t("maintenance.decided"), item.decided_by && `${item.decided_by}, ${time(item.decided_at)}`],
        ]} />
        <${Evidence} item=${item} />
        ${item.status === "open" && may("POST /v1/maintenance/{item_id}/approve") && html`<${Decision} item=${item} onDone=${changed} />`}
      `}</${Shown}>
    </${Panel}>
  `;
}

/** Pictures of uploads, and reports of people. @param {{ item: Item }} props */
function Evidence({ item }) {
  const { uploads, reports = [] } = item.evidence;
  return html`
    ${reports.length > 0 && html`<h3>${t("reports.title")}</h3><ul class="plain">${reports.map((report) => html`<li><a href=${`/operations/reports/${report.report_id}`}>${textOr(`report.${report.kind}`, report.kind)}, ${time(report.at)}</a></li>`)}</ul>`}
    ${uploads.length > 0 && html`<h3>${t("maintenance.uploads")}</h3>${uploads.map((upload) => html`<${Upload} key=${upload.decode_id} upload=${upload} />`)}`}
  `;
}

/** @param {{ upload: Item["evidence"]["uploads"][number] }} props */
function Upload({ upload }) {
  const [open, setOpen] = useState(false);
  return html`
    <details class="section" onToggle=${(/** @type {any} */ event) => event.currentTarget.open && setOpen(true)}>
      <summary>${time(upload.at)} UTC</summary>
      ${open && html`<${Picture} path=${upload.picture} alt=${t("maintenance.picture", { at: time(upload.at) })} />`}
      <p><a href=${`/decodes/${upload.decode_id}`}>${t("health.decode")}</a></p>
    </details>
  `;
}

/** @param {{ item: Item, onDone: () => void }} props */
function Decision({ item, onDone }) {
  const form = useForm({ outcome: item.marker_id ? "suspect" : "none", note: "" });
  const reject = form.values.outcome === "reject";
  const outcomes = item.marker_id ? OUTCOMES : /** @type {const} */ (["none"]);
  const submit = async () => {
    const note = String(form.values.note).trim();
    const body = reject ? { reason: note } : { outcome: form.values.outcome, ...(note ? { note } : {}) };
    await request(`/v1/maintenance/${item.id}/${reject ? "reject" : "approve"}`, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
    notify(t(reject ? "maintenance.rejected" : "maintenance.approved"));
    onDone();
  };
  const errors = form.errors.reason ? { note: form.errors.reason, ...form.errors } : form.errors;
  return html`
    <h3>${t("maintenance.decide")}</h3>
    <${FormFrame} form=${form} onSubmit=${submit} button=${t(reject ? "maintenance.reject" : "maintenance.approve")}>
      <${SelectField} form=${form} path="outcome" label=${t("maintenance.outcome")} hint=${t(reject ? "maintenance.reject_hint" : "maintenance.approve_hint")}
        options=${[...outcomes.map((name) => [name, t(`item_outcome.${name}`)]), ["reject", t("maintenance.no_fault")]]} />
      <${TextField} form=${{ ...form, errors }} path="note" label=${t("field.note")} hint=${t("bulk.reason_hint")} required=${reject} />
    </${FormFrame}>
  `;
}
