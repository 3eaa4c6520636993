// One marker: what it is, its position and where that comes from, its files, its health and its history; edit and retire.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

import { api, ok, page, Problem } from "../api/client.js";
import { StatusBadge, FamilyName } from "../components/badges.js";
import { Dialog } from "../components/dialog.js";
import { Facts } from "../components/facts.js";
import { bodyOf, FormFrame, loadSchema, SchemaField, TextField, useForm } from "../components/form.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { notify } from "../components/notices.js";
import { Panel, Section } from "../components/panel.js";
import { stationText } from "../components/strip_scale.js";
import { codeOf, degrees, number, time } from "../format.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";
import { FilesOf } from "./marker_files.js";
import { HealthOf } from "./marker_health.js";

/** @typedef {import("../api/schema.js").components["schemas"]} Schemas */
/** @typedef {Schemas["PlateDocument"] | Schemas["MagnetDetailDocument"] | Schemas["CerpmDocument"] | Schemas["FiducialDocument"]} MarkerDetail */

const EDITED = ["status", "road", "measure_m", "offset_m", "heading_deg", "position.lon_deg", "position.lat_deg", "position.height_m", "position.horizontal_rmse_m", "position.survey_method"];

/** @param {{ id: string, onClose: () => void, onChanged: () => void }} props */
export function MarkerPanel({ id, onClose, onChanged }) {
  const marker = useLoad((signal) => ok(api.GET("/v1/markers/{marker_id}", { params: { path: { marker_id: id } }, signal })), [id]);
  const [dialog, setDialog] = useState(/** @type {"edit" | "retire" | null} */ (null));
  const close = () => setDialog(null);
  const changed = () => {
    marker.reload();
    onChanged();
  };
  const data = /** @type {MarkerDetail} */ (marker.data);
  const name = data ? codeOf(data) : "";
  return html`
    <${Panel} label=${t("marker.title", { code: name || id })} onClose=${onClose} title=${data ? html`<span class="code">${name}</span>` : t("load.loading")}>
      <${Shown} of=${marker}>${() => html`
        <p class="panel-line"><${StatusBadge} status=${data.status} family=${data.family} /> <span><${FamilyName} family=${data.family} />, ${t("marker.version", { version: data.version })}</span></p>
        ${may("PATCH /v1/markers/{marker_id}") && html`
          <p class="actions">
            <button type="button" class="quiet" onClick=${() => setDialog("edit")}>${t("marker.edit")}</button>
            ${data.status !== "retired" && html`<button type="button" class="quiet" onClick=${() => setDialog("retire")}>${t("marker.retire")}</button>`}
          </p>
        `}
        <${Facts} of=${factsOf(data)} />
        ${data.family === "plate" && data.code_warnings.map((/** @type {any} */ warning) => html`<p class="warning">${warning.message}</p>`)}
        <${Section} title=${t("marker.files")} open>${() => html`<${FilesOf} marker=${data} />`}</${Section}>
        <${Section} title=${t("marker.position")}>${() => html`<${PositionOf} marker=${data} />`}</${Section}>
        <${Section} title=${t("marker.health")}>${() => html`<${HealthOf} id=${id} />`}</${Section}>
        <${Section} title=${t("marker.history")}>${() => html`<${HistoryOf} id=${id} version=${data.version} />`}</${Section}>
        ${dialog === "edit" && html`<${EditDialog} marker=${data} onClose=${close} onChanged=${changed} />`}
        ${dialog === "retire" && html`<${RetireDialog} marker=${data} onClose=${close} onChanged=${changed} />`}
      `}</${Shown}>
    </${Panel}>
  `;
}

/** @param {MarkerDetail} marker @returns {[string, any][]} */
function factsOf(marker) {
  return [
    ...factsOfFamily(marker),
    [t("field.road"), marker.road],
    [t("roads.measure"), marker.measure_m === null ? null : stationText(marker.measure_m)],
    [t("field.offset_m"), marker.offset_m === null ? null : number(marker.offset_m, 2)],
    [t("field.heading_deg"), marker.heading_deg === null ? null : number(marker.heading_deg, 2)],
    [t("field.position"), `${degrees(marker.position.lon_deg)}, ${degrees(marker.position.lat_deg)}`],
    [t("field.grade"), textOr(`grade.${marker.position.localization_grade}`, marker.position.localization_grade)],
    [t("field.id"), html`<span class="code small">${marker.id}</span>`],
  ];
}

/** @param {MarkerDetail} marker @returns {[string, any][]} */
function factsOfFamily(marker) {
  if (marker.family === "plate") {
    const { code, geometry } = marker;
    return [
      [t("field.scheme"), code.registry_number === null ? code.scheme : t("marker.scheme_number", { scheme: code.scheme, number: code.registry_number })],
      [t("marker.size"), t("marker.size_units", { n: geometry.n, side: number(geometry.side_mm, 0) })],
    ];
  }
  if (marker.family === "fiducial") return [[t("field.scheme"), marker.code.scheme], [t("marker.size"), number(marker.geometry.side_mm, 0, "mm")]];
  if (marker.family === "cerpm") {
    const { code, side, speed_limit: limit, radio, dev_eui } = marker;
    return [
      [t("field.scheme"), code.scheme],
      [t("field.side"), side && textOr(`option.${side}`, side)],
      [t("marker.speed_limit"), limit && `${limit.value} ${limit.unit}`],
      [t("marker.transmission"), radio && t("marker.transmission_text", { interval: radio.interval_s, sf: radio.spreading_factor, khz: radio.bandwidth_hz / 1000, mhz: radio.frequency_hz / 1e6 })],
      ["DevEUI", dev_eui],
    ];
  }
  const { code, layout } = marker;
  return [
    [t("field.scheme"), code.scheme],
    code.scheme === "line-tag" ? [t("marker.line_style"), textOr(`option.${code.style}`, code.style)] : [t("marker.meaning"), code.meaning?.text],
    [t("marker.magnets"), t("marker.magnets_text", { count: marker.magnets.length, length: number(marker.length_m, 2) })],
    [t("marker.place_in_lane"), "chainage_m" in layout ? t("marker.chainage", { chainage: number(layout.chainage_m, 2), offset: number(layout.offset_m, 2) }) : t("marker.chainage_range", { from: layout.from_m, to: layout.to_m ?? "…" })],
    [t("marker.mounting"), installationText(marker)],
    [t("marker.cost"), number(marker.bill.total_usd, 2, "USD")],
  ];
}

/** How the magnets are fixed, and how deep. @param {Schemas["MagnetDetailDocument"]} marker */
function installationText({ installation, depth_m: depth }) {
  const mounting = textOr(`option.${installation.mounting}`, String(installation.mounting));
  const high = installation.shell_height_mm;
  if (high) return t("marker.mounted_high", { mounting, height: number(high, 0, "mm") });
  return depth > 0 ? t("marker.mounted_deep", { mounting, depth: number(1000 * depth, 0, "mm") }) : mounting;
}

/** Where the position comes from. @param {{ marker: MarkerDetail }} props */
function PositionOf({ marker }) {
  const { position } = marker;
  const original = Object.entries(position.original ?? {}).filter(([, value]) => value !== null && typeof value !== "object");
  return html`
    <${Facts} of=${[
      [t("field.lon_deg"), degrees(position.lon_deg, 8)],
      [t("field.lat_deg"), degrees(position.lat_deg, 8)],
      [t("field.height_m"), position.height_m === null ? null : number(position.height_m, 3)],
      [t("field.horizontal_rmse_m"), position.horizontal_rmse_m === null ? t("marker.not_stated") : number(position.horizontal_rmse_m, 3)],
      [t("field.vertical_rmse_m"), position.vertical_rmse_m === null ? null : number(position.vertical_rmse_m, 3)],
      [t("field.crs"), position.crs],
      [t("field.realization"), position.realization],
      [t("field.epoch"), position.epoch],
      [t("field.vertical_datum"), position.vertical_datum],
      [t("field.survey_method"), position.survey_method],
      [t("field.surveyor"), position.surveyor],
      [t("field.instrument"), position.instrument],
      [t("field.check_points"), position.check_points],
      [t("field.transform_accuracy_m"), position.transform_accuracy_m === null ? null : number(position.transform_accuracy_m, 3)],
      [t("field.transform_note"), position.transform_note],
      [t("field.survey_file_sha256"), position.survey_file_sha256 && html`<span class="code small">${position.survey_file_sha256}</span>`],
    ]} />
    ${original.length > 0 && html`<h4>${t("marker.original")}</h4><${Facts} of=${original.map(([name, value]) => [textOr(`field.${name}`, name), String(value)])} />`}
    ${(marker.position_warnings ?? []).map((/** @type {any} */ warning) => html`<p class="warning">${warning.message}</p>`)}
  `;
}

/** @param {{ id: string, version: number }} props */
function HistoryOf({ id, version }) {
  const history = useLoad(async (signal) => {
    /** @type {any[]} */
    const items = [];
    let after = /** @type {string | null} */ (null);
    do {
      const found = await page(api.GET("/v1/markers/{marker_id}/versions", { params: { path: { marker_id: id }, query: { limit: 1000, ...(after ? { after: Number(after) } : {}) } }, signal }));
      items.push(...found.items);
      after = found.after;
    } while (after);
    return items.reverse();
  }, [id, version]);
  return html`<${Shown} of=${history}>${(/** @type {any[]} */ items) => (items.length ? html`
    <ol class="history">${items.map((entry, k) => html`<${HistoryEntry} entry=${entry} before=${items[k + 1]} />`)}</ol>
  ` : html`<${Empty} title=${t("marker.no_history")} />`)}</${Shown}>`;
}

/** @param {{ entry: any, before: any }} props */
function HistoryEntry({ entry, before }) {
  const changes = before ? changesOf(before.marker, entry.marker) : [];
  return html`
    <li>
      <p><strong>${t("marker.version", { version: entry.version })}</strong> ${textOr(`kind.${entry.kind}`, entry.kind)}, ${time(entry.at)} UTC</p>
      <p>${t("marker.by", { who: entry.who })}${entry.why && `: ${entry.why}`}</p>
      ${changes.length > 0 && html`<ul>${changes.map((change) => html`<li>${change}</li>`)}</ul>`}
    </li>
  `;
}

/** What differs between two versions, as texts. @param {any} old @param {any} now @returns {string[]} */
function changesOf(old, now) {
  /** @type {string[]} */
  const changes = [];
  /** @param {any} value */
  const shown = (value) => (value === null || value === undefined ? t("marker.nothing") : textOr(`status.${value}`, String(value)));
  for (const name of ["status", "road", "measure_m", "offset_m", "heading_deg", "side"]) {
    if (old[name] !== now[name]) changes.push(`${textOr(`field.${name}`, name)}: ${shown(old[name])} → ${shown(now[name])}`);
  }
  for (const name of ["lon_deg", "lat_deg", "height_m", "horizontal_rmse_m", "survey_method"]) {
    if (old.position[name] !== now.position[name]) changes.push(`${textOr(`field.${name}`, name)}: ${shown(old.position[name])} → ${shown(now.position[name])}`);
  }
  return changes;
}

/** @param {{ marker: MarkerDetail, onClose: () => void, onChanged: () => void }} props */
function EditDialog({ marker, onClose, onChanged }) {
  const schema = useLoad(() => loadSchema("MarkerPatch"), []);
  return html`
    <${Dialog} title=${t("marker.edit_title", { code: codeOf(marker) })} onClose=${onClose}>
      <${Shown} of=${schema}>${(/** @type {any} */ found) => html`<${EditForm} schema=${found} marker=${marker} onClose=${onClose} onChanged=${onChanged} />`}</${Shown}>
    </${Dialog}>
  `;
}

/** @param {{ schema: any, marker: MarkerDetail, onClose: () => void, onChanged: () => void }} props */
function EditForm({ schema, marker, onClose, onChanged }) {
  const start = Object.fromEntries(EDITED.map((path) => {
    const value = path.split(".").reduce((place, part) => place?.[part], /** @type {any} */ (marker));
    return [path, value === null || value === undefined ? "" : String(value)];
  }));
  const form = useForm({ ...start, reason: "" });
  const paths = marker.family === "magnet" ? EDITED.filter((path) => !path.startsWith("position.") && path !== "heading_deg") : EDITED;
  const submit = async () => {
    await change(marker, patchOf(form.values, start, paths, schema));
    notify(t("marker.saved"));
    onClose();
    onChanged();
  };
  return html`
    <${FormFrame} form=${form} onSubmit=${submit} button=${t("action.save")}>
      <div class="group">
        ${paths.map((path) => html`<${SchemaField} form=${form} schema=${schema} path=${path} />`)}
        <${TextField} form=${form} path="reason" label=${t("field.reason")} hint=${t("bulk.reason_hint")} />
      </div>
    </${FormFrame}>
  `;
}

/**
 * What was changed in the form; a field that was emptied becomes null, a changed position is sent whole.
 *
 * @param {Record<string, string | boolean>} values
 * @param {Record<string, string>} start
 * @param {string[]} paths
 * @param {any} schema
 */
function patchOf(values, start, paths, schema) {
  const changed = paths.filter((path) => values[path] !== start[path]);
  if (!changed.length) throw new Problem({ title: t("marker.no_change"), detail: "", cure: t("marker.no_change_cure") });
  const moved = changed.some((path) => path.startsWith("position."));
  const sent = Object.fromEntries(paths.filter((path) => changed.includes(path) || (moved && path.startsWith("position."))).map((path) => [path, values[path] ?? ""]));
  const body = bodyOf({ ...sent, reason: values.reason ?? "" }, schema);
  for (const path of changed) if (!path.includes(".") && !String(values[path]).trim()) body[path] = null;
  return body;
}

/** @param {MarkerDetail} marker @param {any} body */
async function change(marker, body) {
  await ok(api.PATCH("/v1/markers/{marker_id}", {
    params: { path: { marker_id: marker.id }, header: { "If-Match": `"${marker.version}"` } },
    body,
  }));
}

/** @param {{ marker: MarkerDetail, onClose: () => void, onChanged: () => void }} props */
function RetireDialog({ marker, onClose, onChanged }) {
  const form = useForm({ reason: "" });
  const submit = async () => {
    const reason = String(form.values.reason ?? "").trim();
    await change(marker, { status: "retired", ...(reason ? { reason } : {}) });
    notify(t("marker.retired", { code: codeOf(marker) }));
    onClose();
    onChanged();
  };
  return html`
    <${Dialog} title=${t("marker.retire_title", { code: codeOf(marker) })} onClose=${onClose}>
      <p>${t("marker.retire_text")}</p>
      <${FormFrame} form=${form} onSubmit=${submit} button=${t("marker.retire")}>
        <${TextField} form=${form} path="reason" label=${t("field.reason")} hint=${t("bulk.reason_hint")} />
      </${FormFrame}>
    </${Dialog}>
  `;
}
