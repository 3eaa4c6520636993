// Webhooks: addresses that events are sent to, what was sent, and how that ended.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

import { api, ok } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Confirm, SecretOnce } from "../components/confirm.js";
import { Dialog } from "../components/dialog.js";
import { Facts } from "../components/facts.js";
import { FormFrame, TextField, useForm } from "../components/form.js";
import { closeTo, linked, ListPage } from "../components/list_page.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { attempt, notify } from "../components/notices.js";
import { PagesFoot, usePages } from "../components/pages.js";
import { Panel, Section } from "../components/panel.js";
import { ProblemBox } from "../components/problem.js";
import { text, time } from "../format.js";
import { navigate } from "../router.js";
import { may } from "../session.js";
import { t } from "../texts/index.js";

const BASE = "/operations/webhooks";
const GROUPS = ["job", "maintenance", "report"];
const LEVELS = /** @type {const} */ ({ delivered: "good", waiting: "none", failed: "bad" });

/** @typedef {import("../api/schema.js").components["schemas"]["WebhookDocument"]} Webhook */
/** @typedef {import("../api/schema.js").components["schemas"]["DeliveryDocument"]} Delivery */

/** @param {{ id: string | null }} props */
export default function Webhooks({ id }) {
  const list = usePages("/v1/webhooks", { limit: null });
  const [adding, setAdding] = useState(false);
  const [made, setMade] = useState(/** @type {any} */ (null));
  const button = may("POST /v1/webhooks") && html`<button type="button" onClick=${() => setAdding(true)}>${t("webhooks.add")}</button>`;
  return html`
    <${ListPage} title=${t("webhooks.title")} base=${BASE} list=${list} columns=${columns()} chosen=${id} actions=${button} lead=${t("webhooks.lead")}
      empty=${html`<${Empty} title=${t("webhooks.none")}><p>${t("webhooks.none_text")}</p></${Empty}>`}
      panel=${id !== null && html`<${One} key=${id} id=${id} onChanged=${list.reload} />`} />
    ${adding && html`<${AddDialog} onClose=${() => setAdding(false)} onMade=${(/** @type {any} */ webhook) => {
      setMade(webhook);
      list.reload();
    }} />`}
    ${made && html`<${SecretOnce} title=${t("webhooks.made")} label=${t("webhooks.secret")} secret=${made.secret} warning=${t("webhooks.once")} onClose=${() => setMade(null)}><p class="wrap">${made.url}</p></${SecretOnce}>`}
  `;
}

/** @returns {import("../components/table.js").Column<any>[]} */
const columns = () => [
  linked(BASE, { name: "url", title: t("webhooks.url"), order: (row) => row.url, cell: (row) => html`<span class="cut">${row.url}</span>` }),
  { name: "state", title: t("field.state"), order: (row) => row.state, cell: (row) => html`<${State} of=${row} />` },
  { name: "events", title: t("webhooks.events"), cell: (row) => html`<span class="code small">${row.events.join(", ")}</span>` },
  { name: "success", title: t("webhooks.last_success"), order: (row) => row.last_success_at, cell: (row) => time(row.last_success_at) },
  { name: "who", title: t("field.who"), order: (row) => row.who, cell: (row) => text(row.who) },
];

/** @param {{ of: Webhook }} props */
const State = ({ of }) => html`<${Verdict} level=${of.state === "active" ? "good" : "bad"}>${t(`webhooks.${of.state}`)}</${Verdict}>`;

/** @param {{ id: string, onChanged: () => void }} props */
function One({ id, onChanged }) {
  const path = { path: { webhook_id: id } };
  const found = useLoad((signal) => ok(api.GET("/v1/webhooks/{webhook_id}", { params: path, signal })), [id]);
  const [deleting, setDeleting] = useState(false);
  const webhook = /** @type {Webhook | null} */ (found.data);
  const enable = () => attempt(async () => {
    await ok(api.POST("/v1/webhooks/{webhook_id}/enable", { params: path }));
    found.reload();
    onChanged();
  });
  const remove = async () => {
    await ok(api.DELETE("/v1/webhooks/{webhook_id}", { params: path }));
    notify(t("webhooks.deleted"));
    navigate(BASE);
    onChanged();
  };
  return html`
    <${Panel} title=${t("webhooks.one")} label=${t("webhooks.one")} onClose=${closeTo(BASE)}>
      <${Shown} of=${found}>${() => webhook && html`
        <p><${State} of=${webhook} /></p>
        ${webhook.reason && html`<p class="warning">${webhook.reason}</p>`}
        ${webhook.state === "disabled" && may("POST /v1/webhooks/{webhook_id}/enable") && html`<p><button type="button" onClick=${enable}>${t("webhooks.enable")}</button> <span class="hint">${t("webhooks.enable_text")}</span></p>`}
        <${Facts} of=${[
          [t("webhooks.url"), html`<span class="code small wrap">${webhook.url}</span>`],
          [t("webhooks.events"), html`<span class="code small">${webhook.events.join(", ")}</span>`],
          [t("webhooks.last_success"), webhook.last_success_at && time(webhook.last_success_at)],
          [t("field.who"), webhook.who],
          [t("field.created_at"), time(webhook.created_at)],
        ]} />
        <h3>${t("webhooks.deliveries")}</h3>
        <${Deliveries} id=${id} />
        ${may("DELETE /v1/webhooks/{webhook_id}") && html`<p><button type="button" class="quiet danger" onClick=${() => setDeleting(true)}>${t("action.delete")}</button></p>`}
      `}</${Shown}>
    </${Panel}>
    ${deleting && html`<${Confirm} title=${t("webhooks.delete")} button=${t("action.delete")} onConfirm=${remove} onClose=${() => setDeleting(false)}><p>${t("webhooks.delete_text")}</p></${Confirm}>`}
  `;
}

/** @param {{ id: string }} props */
function Deliveries({ id }) {
  const list = usePages(`/v1/webhooks/${encodeURIComponent(id)}/deliveries`);
  const again = (/** @type {Delivery} */ delivery) => attempt(async () => {
    await ok(api.POST("/v1/webhooks/{webhook_id}/deliveries/{delivery_id}/redeliver", { params: { path: { webhook_id: id, delivery_id: delivery.id } } }));
    notify(t("webhooks.sent_again"));
    list.reload();
  });
  if (list.error) return html`<${ProblemBox} error=${list.error} retry=${list.reload} />`;
  if (!list.loaded) return html`<p class="loading" role="status">${t("load.loading")}</p>`;
  if (!list.rows.length) return html`<p class="hint">${t("webhooks.no_deliveries")}</p>`;
  return html`
    ${list.rows.map((delivery) => html`
      <${Section} key=${delivery.id} title=${html`<span class="code small">${delivery.kind}</span>, ${time(delivery.created_at)}: <${Verdict} level=${LEVELS[/** @type {Delivery} */ (delivery).state]}>${t(`webhooks.${/** @type {Delivery} */ (delivery).state}`)}</${Verdict}>`}>${() => html`
        <${Facts} of=${[[t("jobs.attempts"), delivery.attempts], [t("webhooks.status"), delivery.status], [t("jobs.error"), delivery.error], [t("webhooks.due"), delivery.due_at && time(delivery.due_at)]]} />
        <pre tabindex="0">${pretty(delivery.body)}</pre>
        ${may("POST /v1/webhooks/{webhook_id}/deliveries/{delivery_id}/redeliver") && delivery.state !== "waiting" && html`<p><button type="button" class="quiet" onClick=${() => again(delivery)}>${t("webhooks.again")}</button></p>`}
      `}</${Section}>
    `)}
    <p class="hint"><${PagesFoot} of=${list} /></p>
  `;
}

/** @param {string} body */
function pretty(body) {
  try {
    return JSON.stringify(JSON.parse(body), null, 1);
  } catch {
    return body;
  }
}

/** @param {{ onClose: () => void, onMade: (webhook: any) => void }} props */
function AddDialog({ onClose, onMade }) {
  const form = useForm({ url: "", job: true, maintenance: true, report: true });
  const submit = async () => {
    const groups = GROUPS.filter((group) => form.values[group]).map((group) => `${group}.*`);
    const webhook = await ok(api.POST("/v1/webhooks", { body: { url: String(form.values.url).trim(), events: groups } }));
    onClose();
    onMade(webhook);
  };
  return html`
    <${Dialog} title=${t("webhooks.add")} onClose=${onClose}>
      <${FormFrame} form=${form} onSubmit=${submit} button=${t("webhooks.add")}>
        <${TextField} form=${form} path="url" type="url" label=${t("webhooks.url")} hint=${t("webhooks.url_hint")} required />
        <fieldset><legend>${t("webhooks.events")}</legend><div class="checks">${GROUPS.map((group) => html`
          <label class="check"><input type="checkbox" name=${group} checked=${form.values[group] === true} onChange=${(/** @type {any} */ event) => form.set(group, event.currentTarget.checked)} /> ${t(/** @type {any} */ (`webhooks.group_${group}`))}</label>`)}
        </div></fieldset>
      </${FormFrame}>
    </${Dialog}>
  `;
}
