// The audit log: who changed what and when, the newest first; what a change did; a check of the whole chain.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

import { api, ok } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Changes, nameOf, valueText } from "../components/changes.js";
import { Dialog } from "../components/dialog.js";
import { Facts } from "../components/facts.js";
import { JobProgress, oneJob } from "../components/job.js";
import { ChoiceFilter, closeTo, filterOf, linked, ListPage, TextFilter } from "../components/list_page.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { attempt } from "../components/notices.js";
import { usePages } from "../components/pages.js";
import { Panel, Section } from "../components/panel.js";
import { number, text, time } from "../format.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";

const BASE = "/operations/audit";
const GROUPS = ["marker", "import", "road", "plan", "alignment", "codebook", "vehicle", "calibration", "key", "webhook", "reprocessing", "damage-report", "public-page", "maintenance"];
const PAGES_OF = /** @type {Record<string, string>} */ ({
  marker: "/markers/", road: "/roads/", plan: "/plans/", vehicle: "/operations/vehicles/", key: "/operations/keys/", codebook: "/operations/codebooks/",
  webhook: "/operations/webhooks/", reprocessing: "/operations/reprocessings/", "damage-report": "/operations/reports/", packets: "/decodes/",
});

/** @typedef {import("../api/schema.js").components["schemas"]["AuditEntryDocument"]} Entry */

/** @param {{ id: string | null }} props */
export default function Audit({ id }) {
  const list = usePages("/v1/audit", {
    order: "newest", who: filterOf("who"), action: filterOf("action"), subject: filterOf("subject"), since: dayOf("since", 0), until: dayOf("until", 1),
  });
  const [checking, setChecking] = useState("");
  const check = () => attempt(async () => setChecking((await ok(api.POST("/v1/audit/verifications", { body: {} }))).id));
  const filters = html`
    <${TextFilter} name="who" label=${t("field.who")} />
    <${ChoiceFilter} name="action" label=${t("field.action")} options=${[["", t("filter.all")], ...actions()]} />
    <${TextFilter} name="subject" label=${t("audit.subject")} />
    <${TextFilter} name="since" label=${t("audit.since")} type="date" />
    <${TextFilter} name="until" label=${t("audit.until")} type="date" />
  `;
  const known = list.rows.find((row) => String(row.number) === id);
  return html`
    <${ListPage} title=${t("audit.title")} base=${BASE} list=${list} columns=${columns()} chosen=${id} filters=${filters} idOf=${idOf} lead=${t("audit.lead")}
      actions=${may("POST /v1/audit/verifications") && html`<button type="button" class="quiet" onClick=${check}>${t("audit.check")}</button>`}
      panel=${id !== null && html`<${One} key=${id} id=${id} known=${known} />`} />
    ${checking && html`<${Check} id=${checking} onClose=${() => setChecking("")} />`}
  `;
}

/** The chosen kind of action stays in the list, also one that a link named. @returns {[string, string][]} */
function actions() {
  const chosen = filterOf("action");
  const groups = /** @type {[string, string][]} */ (GROUPS.map((group) => [`${group}.*`, t(/** @type {any} */ (`action_group.${group}`))]));
  return !chosen || groups.some(([value]) => value === chosen) ? groups : [[chosen, actionText(chosen)], ...groups];
}

/** @param {Entry} row */
const idOf = (row) => String(row.number);

/** @param {string} action */
const actionText = (action) => textOr(`audit_action.${action}`, action);

/** A day of the address as a time; `until` includes its day. @param {string} name @param {number} days */
function dayOf(name, days) {
  const day = new Date(`${filterOf(name)}T00:00:00Z`);
  if (Number.isNaN(day.getTime())) return "";
  return new Date(day.getTime() + days * 86_400_000).toISOString();
}

/** @returns {import("../components/table.js").Column<any>[]} */
const columns = () => [
  linked(BASE, { name: "number", title: t("field.number"), order: (row) => row.number, cell: (row) => String(row.number) }, idOf),
  { name: "at", title: t("field.at"), order: (row) => row.at, cell: (row) => time(row.at) },
  { name: "who", title: t("field.who"), order: (row) => row.who, cell: (row) => text(row.who) },
  { name: "action", title: t("field.action"), order: (row) => actionText(row.action), cell: (row) => actionText(row.action) },
  { name: "subject", title: t("field.subject"), order: (row) => row.subject, cell: (row) => html`<span class="code small cut">${text(row.subject)}</span>` },
  { name: "versions", title: t("audit.markers"), number: true, order: (row) => row.versions, cell: (row) => (row.versions ? number(row.versions) : "") },
];

/** @param {{ id: string, known?: Entry }} props */
function One({ id, known }) {
  const found = useLoad(async (signal) => known ?? (await ok(api.GET("/v1/audit", { params: { query: { after: Math.max(Number(id) - 1, 0) || 0, limit: 1 } }, signal }))).items.find((entry) => idOf(entry) === id) ?? false, [id, known?.number]);
  const entry = /** @type {Entry | false | null} */ (found.data);
  return html`
    <${Panel} title=${entry ? actionText(entry.action) : t("audit.one")} label=${t("audit.one")} onClose=${closeTo(BASE)}>
      <${Shown} of=${found}>${() => (entry ? html`
        <${Facts} of=${[
          [t("field.number"), String(entry.number)],
          [t("field.at"), `${time(entry.at)} UTC`],
          [t("field.who"), html`<a href=${`${BASE}?who=${encodeURIComponent(entry.who)}`}>${entry.who}</a>`],
          [t("field.action"), html`<span class="code">${entry.action}</span>`],
          [t("field.subject"), entry.subject && html`<${Subject} entry=${entry} />`],
          ...Object.entries(entry.detail ?? {}).map(([name, value]) => /** @type {[string, any]} */ ([nameOf(name), valueText(value)])),
          [t("audit.markers"), entry.versions > 0 && number(entry.versions)],
        ]} />
        ${entry.action === "marker.changed" && entry.subject && html`<h3>${t("audit.change")}</h3><${MarkerChange} entry=${entry} />`}
        <${Section} title=${t("audit.hashes")}>${() => html`<${Facts} of=${[[t("audit.hash"), code(entry.hash)], [t("audit.previous"), code(entry.previous_hash)], [t("audit.digest"), code(entry.digest)]]} />`}</${Section}>
      ` : html`<${Empty} title=${t("audit.no_entry", { number: id })} />`)}</${Shown}>
    </${Panel}>
  `;
}

/** @param {string} value */
const code = (value) => html`<span class="code small wrap">${value}</span>`;

/** @param {{ entry: Entry }} props */
function Subject({ entry }) {
  const page = PAGES_OF[entry.action.split(".")[0] ?? ""];
  const shown = html`<span class="code small wrap">${entry.subject}</span>`;
  return html`${page ? html`<a href=${`${page}${encodeURIComponent(entry.subject ?? "")}`}>${shown}</a>` : shown} <a href=${`${BASE}?subject=${encodeURIComponent(entry.subject ?? "")}`}>${t("audit.of_this")}</a>`;
}

/** What a change did to its marker: the version that it wrote, beside the one before. @param {{ entry: Entry }} props */
function MarkerChange({ entry }) {
  const versions = useLoad(async (signal) => (await ok(api.GET("/v1/markers/{marker_id}/versions", { params: { path: { marker_id: entry.subject ?? "" } }, signal }))).items, [entry.number]);
  return html`<${Shown} of=${versions}>${(/** @type {any[]} */ items) => html`<${VersionChange} items=${items} number=${entry.number} />`}</${Shown}>`;
}

/** @param {{ items: any[], number: number }} props */
function VersionChange({ items, number: written }) {
  const at = items.findIndex((version) => version.audit_number === written);
  if (at < 1) return html`<p class="hint">${t("changes.none")}</p>`;
  const { version: _now, updated_at: _at, ...after } = items[at].marker;
  const { version: _before, updated_at: _then, ...before } = items[at - 1].marker;
  return html`${items[at].why && html`<p>${items[at].why}</p>`}<${Changes} before=${before} after=${after} label=${t("audit.change")} />`;
}

/** @param {{ id: string, onClose: () => void }} props */
function Check({ id, onClose }) {
  const found = useLoad((signal) => oneJob(id, "audit", signal), [id]);
  const result = found.data?.result;
  return html`
    <${Dialog} title=${t("audit.check")} onClose=${onClose}>
      <p>${t("audit.check_text")}</p>
      <${JobProgress} id=${id} onDone=${found.reload} />
      ${result && html`
        <p><${Verdict} level=${result.fault_count ? "bad" : "good"}>${result.fault_count ? t("audit.faults", { count: number(result.fault_count) }) : t("audit.sound")}</${Verdict}></p>
        <${Facts} of=${[[t("audit.entries"), number(result.entries)], [t("audit.versions"), number(result.versions)], [t("audit.head"), result.head && code(result.head)]]} />
        <p class="hint">${t("audit.head_hint")}</p>
        <ul class="plain">${result.faults.map((fault) => html`<li><strong>${fault.where}</strong>: ${fault.what}</li>`)}</ul>
      `}
    </${Dialog}>
  `;
}
