// Damage reports of the public pages: read them with their photo, approve them as items of the work list, or reject them.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

import { api, ok, request } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Confirm } from "../components/confirm.js";
import { Facts } from "../components/facts.js";
import { FormFrame, TextField, useForm } from "../components/form.js";
import { ChoiceFilter, closeTo, filterOf, linked, ListPage } from "../components/list_page.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { attempt, notify } from "../components/notices.js";
import { usePages } from "../components/pages.js";
import { Panel } from "../components/panel.js";
import { Picture } from "../components/picture.js";
import { codeOf, text, time } from "../format.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";

const BASE = "/operations/reports";
const LEVELS = /** @type {const} */ ({ new: "warn", approved: "good", rejected: "none" });

/** @typedef {import("../api/schema.js").components["schemas"]["DamageReport"]} Report */

/** @param {{ id: string | null }} props */
export default function Reports({ id }) {
  const status = filterOf("status") || "new";
  const list = usePages("/v1/damage-reports", { status: status === "all" ? null : status, marker_id: filterOf("marker_id") });
  const filters = html`<${ChoiceFilter} name="status" label=${t("field.status")} otherwise="new" options=${[["new", t("report_status.new")], ["approved", t("report_status.approved")], ["rejected", t("report_status.rejected")], ["all", t("filter.all")]]} />`;
  const empty = html`<${Empty} title=${t("reports.none")}><p>${t("reports.none_text")}</p><p><a href="/operations/reports?status=all">${t("reports.show_all")}</a>${may("PUT /v1/public-page") && html`, <a href="/operations/settings">${t("public_page.title")}</a>`}</p></${Empty}>`;
  return html`<${ListPage} title=${t("reports.title")} base=${BASE} list=${list} columns=${columns()} chosen=${id} filters=${filters} empty=${empty} lead=${t("reports.lead")}
    panel=${id !== null && html`<${One} key=${id} id=${id} onChanged=${list.reload} />`} />`;
}

/** @returns {import("../components/table.js").Column<any>[]} */
const columns = () => [
  linked(BASE, { name: "created", title: t("reports.received_at"), order: (row) => row.created_at, cell: (row) => time(row.created_at) }),
  { name: "kind", title: t("field.what"), order: (row) => row.kind, cell: (row) => textOr(`report.${row.kind}`, row.kind) },
  { name: "text", title: t("reports.text"), cell: (row) => html`<span class="cut">${text(row.text)}</span>` },
  { name: "photo", title: t("reports.photo"), order: (row) => Number(row.has_photo), cell: (row) => (row.has_photo ? t("changes.yes") : "") },
  { name: "status", title: t("field.status"), order: (row) => row.status, cell: (row) => html`<${Status} of=${row} />` },
];

/** @param {{ of: Report }} props */
const Status = ({ of }) => html`<${Verdict} level=${LEVELS[of.status]}>${t(`report_status.${of.status}`)}</${Verdict}>`;

/** @param {{ id: string, onChanged: () => void }} props */
function One({ id, onChanged }) {
  const path = { path: { report_id: id } };
  const found = useLoad((signal) => ok(api.GET("/v1/damage-reports/{report_id}", { params: path, signal })), [id]);
  const [deleting, setDeleting] = useState(/** @type {"photo" | "contact" | null} */ (null));
  const report = /** @type {Report | null} */ (found.data);
  const changed = () => {
    found.reload();
    onChanged();
  };
  const remove = async () => {
    if (deleting === "photo") await ok(api.DELETE("/v1/damage-reports/{report_id}/photo", { params: path }));
    else await ok(api.DELETE("/v1/damage-reports/{report_id}/contact", { params: path }));
    changed();
  };
  return html`
    <${Panel} title=${report ? textOr(`report.${report.kind}`, report.kind) : t("reports.one")} label=${t("reports.one")} onClose=${closeTo(BASE)}>
      <${Shown} of=${found}>${() => report && html`
        <p><${Status} of=${report} /></p>
        ${report.text && html`<blockquote class="quote" lang=${report.language}>${report.text}</blockquote>`}
        ${report.has_photo && html`<${Picture} path=${`/v1/damage-reports/${id}/photo`} alt=${t("reports.photo_alt", { at: time(report.created_at) })} />`}
        <${Facts} of=${[
          [t("reports.received_at"), time(report.created_at)],
          [t("reports.marker"), html`<${MarkerLink} id=${report.marker_id} />`],
          [t("reports.contact"), report.has_contact && html`<${Contact} id=${id} />`],
          [t("field.note"), report.note],
          [t("maintenance.decided"), report.decided_by && `${report.decided_by}, ${time(report.decided_at)}`],
          [t("reports.item"), report.item_id && html`<a href=${`/operations/maintenance/${report.item_id}`}>${t("maintenance.one")}</a>`],
        ]} />
        ${report.status === "new" && may("POST /v1/damage-reports/{report_id}/approve") && html`<${Decision} id=${id} onDone=${changed} />`}
        ${may("DELETE /v1/damage-reports/{report_id}/photo") && html`<p class="buttons">
          ${report.has_photo && html`<button type="button" class="quiet danger" onClick=${() => setDeleting("photo")}>${t("reports.delete_photo")}</button>`}
          ${report.has_contact && html`<button type="button" class="quiet danger" onClick=${() => setDeleting("contact")}>${t("reports.delete_contact")}</button>`}
        </p>`}
      `}</${Shown}>
    </${Panel}>
    ${deleting && html`<${Confirm} title=${t(deleting === "photo" ? "reports.delete_photo" : "reports.delete_contact")} button=${t("action.delete")} onConfirm=${remove} onClose=${() => setDeleting(null)}><p>${t("reports.delete_text")}</p></${Confirm}>`}
  `;
}

/** @param {{ id: string }} props */
function MarkerLink({ id }) {
  const marker = useLoad((signal) => ok(api.GET("/v1/markers/{marker_id}", { params: { path: { marker_id: id } }, signal })), [id]);
  const found = /** @type {any} */ (marker.data);
  return html`<a href=${`/markers/${id}`}>${found ? html`${textOr(`family.${found.family}`, found.family)} <span class="code">${codeOf(found)}</span>` : t("list.marker")}</a>`;
}

/** The sender's address, when somebody asks for it. @param {{ id: string }} props */
function Contact({ id }) {
  const [email, setEmail] = useState("");
  if (email) return html`<a href=${`mailto:${email}`} data-native>${email}</a>`;
  if (!may("GET /v1/damage-reports/{report_id}/contact")) return t("reports.contact_left");
  const show = () => attempt(async () => setEmail((await ok(api.GET("/v1/damage-reports/{report_id}/contact", { params: { path: { report_id: id } } }))).email));
  return html`<button type="button" class="quiet" onClick=${show}>${t("reports.show_contact")}</button>`;
}

/** @param {{ id: string, onDone: () => void }} props */
function Decision({ id, onDone }) {
  const form = useForm({ note: "" });
  const decide = async (/** @type {"approve" | "reject"} */ what) => {
    const note = String(form.values.note).trim();
    const body = what === "reject" ? { reason: note } : note ? { note } : {};
    await request(`/v1/damage-reports/${id}/${what}`, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
    notify(t(what === "approve" ? "reports.is_approved" : "reports.is_rejected"));
    onDone();
  };
  const errors = form.errors.reason ? { note: form.errors.reason, ...form.errors } : form.errors;
  return html`
    <h3>${t("maintenance.decide")}</h3>
    <${FormFrame} form=${form} onSubmit=${() => decide("approve")} button=${t("reports.approve")}
      actions=${html`<button type="button" class="quiet" disabled=${form.busy} onClick=${form.submit(() => decide("reject"))}>${t("reports.reject")}</button>`}>
      <${TextField} form=${{ ...form, errors }} path="note" label=${t("field.note")} hint=${t("reports.note_hint")} />
    </${FormFrame}>
  `;
}
