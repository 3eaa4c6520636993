// Reprocessings: stored uploads are decoded again; what differs is read before it becomes current.

import { html } from "htm/preact";
import { useEffect, useState } from "preact/hooks";

import { api, download, ok } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { nameOf, valueText } from "../components/changes.js";
import { Confirm } from "../components/confirm.js";
import { Dialog } from "../components/dialog.js";
import { Facts } from "../components/facts.js";
import { FormFrame, SelectField, TextField, useForm } from "../components/form.js";
import { closeTo, linked, ListPage } from "../components/list_page.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { attempt, notify } from "../components/notices.js";
import { PagesFoot, usePages } from "../components/pages.js";
import { Panel } from "../components/panel.js";
import { number, text, time } from "../format.js";
import { navigate } from "../router.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";

const BASE = "/operations/reprocessings";
const LOOK_MS = 2000;
const LEVELS = /** @type {const} */ ({ running: "none", ready: "warn", cancelled: "none", failed: "bad", approved: "good" });
const KINDS = ["frame", "archive", "video", "trace", "packets"];

/** @typedef {import("../api/schema.js").components["schemas"]["ReprocessingDocument"]} Reprocessing */

/** @param {{ id: string | null }} props */
export default function Reprocessings({ id }) {
  const list = usePages("/v1/reprocessings");
  const [starting, setStarting] = useState(false);
  const button = may("POST /v1/reprocessings") && html`<button type="button" onClick=${() => setStarting(true)}>${t("reprocessings.start")}</button>`;
  return html`
    <${ListPage} title=${t("reprocessings.title")} base=${BASE} list=${list} columns=${columns()} chosen=${id} actions=${button} lead=${t("reprocessings.lead")}
      empty=${html`<${Empty} title=${t("reprocessings.none")}><p>${t("reprocessings.none_text")}</p></${Empty}>`}
      panel=${id !== null && html`<${One} key=${id} id=${id} onChanged=${list.reload} />`} />
    ${starting && html`<${StartDialog} onClose=${() => setStarting(false)} onDone=${list.reload} />`}
  `;
}

/** @returns {import("../components/table.js").Column<any>[]} */
const columns = () => [
  linked(BASE, { name: "created", title: t("field.created_at"), order: (row) => row.created_at, cell: (row) => time(row.created_at) }),
  { name: "state", title: t("field.state"), order: (row) => row.state, cell: (row) => html`<${State} of=${row} />` },
  { name: "done", title: t("field.uploads"), number: true, order: (row) => row.total, cell: (row) => t("jobs.steps", { done: number(row.done), total: number(row.total) }) },
  ...["gained", "lost", "changed", "failed"].map((name) => ({ name, title: t(/** @type {any} */ (`reprocessings.${name}`)), number: true, order: (/** @type {any} */ row) => row.summary[name], cell: (/** @type {any} */ row) => number(row.summary[name]) })),
  { name: "who", title: t("field.who"), order: (row) => row.who, cell: (row) => text(row.who) },
];

/** @param {{ of: Reprocessing }} props */
const State = ({ of }) => html`<${Verdict} level=${LEVELS[of.state]}>${t(`reprocessings.state_${of.state}`)}</${Verdict}>`;

/** @param {{ id: string, onChanged: () => void }} props */
function One({ id, onChanged }) {
  const path = { path: { reprocessing_id: id } };
  const found = useLoad((signal) => ok(api.GET("/v1/reprocessings/{reprocessing_id}", { params: path, signal })), [id]);
  const [approving, setApproving] = useState(false);
  const run = /** @type {Reprocessing | null} */ (found.data);
  const running = run?.state === "running";
  useEffect(() => {
    if (!running) return undefined;
    const timer = setInterval(found.reload, LOOK_MS);
    return () => clearInterval(timer);
  }, [running]);
  const changed = () => {
    found.reload();
    onChanged();
  };
  const cancel = () => attempt(async () => {
    await ok(api.POST("/v1/reprocessings/{reprocessing_id}/cancel", { params: path }));
    changed();
  });
  const approve = async () => {
    await ok(api.POST("/v1/reprocessings/{reprocessing_id}/approve", { params: path }));
    notify(t("reprocessings.is_approved"));
    changed();
  };
  return html`
    <${Panel} title=${t("reprocessings.one")} label=${t("reprocessings.one")} onClose=${closeTo(BASE)}>
      <${Shown} of=${found}>${() => run && html`
        <p><${State} of=${run} /> ${t("jobs.steps", { done: number(run.done), total: number(run.total) })}</p>
        ${running && html`<progress aria-label=${t("job.progress")} max=${Math.max(run.total, 1)} value=${run.done}></progress>`}
        <p class="buttons">
          ${running && may("POST /v1/reprocessings/{reprocessing_id}/cancel") && html`<button type="button" class="quiet" onClick=${cancel}>${t("action.cancel")}</button>`}
          ${run.state === "ready" && may("POST /v1/reprocessings/{reprocessing_id}/approve") && html`<button type="button" onClick=${() => setApproving(true)}>${t("reprocessings.approve")}</button>`}
          <button type="button" class="quiet" onClick=${() => attempt(() => download(run.links.csv, `reprocessing-${id}.csv`))}>${t("maintenance.csv")}</button>
        </p>
        <${Facts} of=${[
          [t("field.created_at"), `${time(run.created_at)}, ${run.who}`],
          ...Object.entries(run.criteria).filter(([, value]) => value !== null).map(([name, value]) => /** @type {[string, any]} */ ([textOr(`reprocessings.by_${name}`, nameOf(name)), valueText(value)])),
          ...["gained", "lost", "changed", "same", "failed"].map((name) => /** @type {[string, any]} */ ([t(/** @type {any} */ (`reprocessings.${name}`)), number(run.summary[/** @type {"same"} */ (name)])])),
          [t("reprocessings.approved"), run.approved_at && `${time(run.approved_at)}, ${run.approved_by}`],
        ]} />
        <h3>${t("reprocessings.report")}</h3>
        <${Report} key=${`${run.state} ${run.done}`} id=${id} />
      `}</${Shown}>
    </${Panel}>
    ${approving && html`<${Confirm} title=${t("reprocessings.approve")} button=${t("reprocessings.approve")} onConfirm=${approve} onClose=${() => setApproving(false)}><p>${t("reprocessings.approve_text")}</p></${Confirm}>`}
  `;
}

/** @param {{ id: string }} props */
function Report({ id }) {
  const list = usePages(`/v1/reprocessings/${encodeURIComponent(id)}/report`);
  if (!list.loaded) return html`<p class="loading" role="status">${t("load.loading")}</p>`;
  if (!list.rows.length) return html`<p class="hint">${t("reprocessings.no_changes")}</p>`;
  return html`
    <ul class="plain">${list.rows.map((row) => html`<li><a href=${`/decodes/${row.decode_id}`} class="code small">${row.decode_id}</a><br />
      ${row.error ? html`<${Verdict} level="bad">${row.error.detail}</${Verdict}>` : t("reprocessings.row", { gained: row.gained, lost: row.lost, changed: row.changed })}</li>`)}</ul>
    <p class="hint"><${PagesFoot} of=${list} /></p>
  `;
}

/** @param {{ onClose: () => void, onDone: () => void }} props */
function StartDialog({ onClose, onDone }) {
  const form = useForm({ kind: "", since: "", until: "", older_than: "", vehicle_id: "" });
  const vehicles = useLoad(async (signal) => (await ok(api.GET("/v1/vehicles", { params: { query: { limit: 1000 } }, signal }))).items, []);
  const submit = async () => {
    const { kind, since, until, older_than, vehicle_id } = form.values;
    const body = {
      ...(kind ? { kinds: [kind] } : {}), ...(since ? { since: `${since}T00:00:00Z` } : {}), ...(until ? { until: `${until}T00:00:00Z` } : {}),
      ...(older_than ? { older_than: String(older_than).trim() } : {}), ...(vehicle_id ? { vehicle_id } : {}),
    };
    const made = await ok(api.POST("/v1/reprocessings", { body: /** @type {any} */ (body) }));
    onDone();
    onClose();
    navigate(`${BASE}/${made.id}`);
  };
  return html`
    <${Dialog} title=${t("reprocessings.start")} onClose=${onClose}>
      <p>${t("reprocessings.start_text")}</p>
      <${FormFrame} form=${form} onSubmit=${submit} button=${t("reprocessings.start")}>
        <div class="group">
          <${SelectField} form=${form} path="kind" label=${t("field.kind")} options=${[["", t("filter.all")], ...KINDS.map((kind) => [kind, textOr(`upload_kind.${kind}`, kind)])]} />
          <${SelectField} form=${form} path="vehicle_id" label=${t("decode.vehicle")} options=${[["", t("filter.all")], ...(vehicles.data ?? []).map((vehicle) => [vehicle.id, vehicle.name])]} />
          <${TextField} form=${form} path="since" type="date" label=${t("reprocessings.by_since")} />
          <${TextField} form=${form} path="until" type="date" label=${t("reprocessings.by_until")} />
          <${TextField} form=${form} path="older_than" label=${t("reprocessings.by_older_than")} placeholder="0.3.0" />
        </div>
      </${FormFrame}>
    </${Dialog}>
  `;
}
