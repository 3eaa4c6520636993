// API keys: make, replace and revoke them. The text of a key is shown once.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

import { api, ok } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Confirm, SecretOnce } from "../components/confirm.js";
import { Dialog } from "../components/dialog.js";
import { Facts } from "../components/facts.js";
import { FormFrame, SelectField, TextField, useForm } from "../components/form.js";
import { closeTo, linked, ListPage } from "../components/list_page.js";
import { Shown, useLoad } from "../components/load.js";
import { notify } from "../components/notices.js";
import { usePages } from "../components/pages.js";
import { Panel } from "../components/panel.js";
import { text, time } from "../format.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";

const BASE = "/operations/keys";
const SCOPES = /** @type {const} */ (["viewer", "vehicle", "surveyor", "planner", "admin"]);
const DAY_MS = 86_400_000;

/** @typedef {import("../api/schema.js").components["schemas"]["KeyDocument"]} Key */
/** @typedef {import("../api/schema.js").components["schemas"]["NewKeyDocument"]} NewKey */

/** @param {{ id: string | null }} props */
export default function Keys({ id }) {
  const list = usePages("/v1/keys");
  const [making, setMaking] = useState(false);
  const [made, setMade] = useState(/** @type {NewKey | null} */ (null));
  const show = (/** @type {NewKey} */ key) => {
    setMade(key);
    list.reload();
  };
  const actions = may("POST /v1/keys") && html`<button type="button" onClick=${() => setMaking(true)}>${t("keys.make")}</button>`;
  return html`
    <${ListPage} title=${t("keys.title")} base=${BASE} list=${list} columns=${columns()} chosen=${id} actions=${actions} lead=${t("keys.lead")}
      panel=${id !== null && html`<${One} key=${id} id=${id} onChanged=${list.reload} onMade=${show} />`} />
    ${making && html`<${MakeDialog} onClose=${() => setMaking(false)} onMade=${show} />`}
    ${made && html`
      <${SecretOnce} title=${t("keys.made", { label: made.label })} label=${t("signin.key")} secret=${made.key} warning=${t("keys.once")} onClose=${() => setMade(null)}>
        <${Facts} of=${[[t("field.scope"), textOr(`scope.${made.scope}`, made.scope)], [t("field.expires_at"), made.expires_at ? time(made.expires_at) : t("keys.never")]]} />
      </${SecretOnce}>
    `}
  `;
}

/** @returns {import("../components/table.js").Column<any>[]} */
const columns = () => [
  linked(BASE, { name: "label", title: t("field.label"), order: (row) => row.label, cell: (row) => text(row.label) }),
  { name: "state", title: t("field.state"), order: stateOf, cell: (row) => html`<${State} of=${row} />` },
  { name: "scope", title: t("field.scope"), order: (row) => SCOPES.indexOf(row.scope), cell: (row) => textOr(`scope.${row.scope}`, row.scope) },
  { name: "prefix", title: t("field.prefix"), cell: (row) => html`<span class="code">${row.prefix}…</span>` },
  { name: "expires", title: t("field.expires_at"), order: (row) => row.expires_at ?? "9", cell: (row) => (row.expires_at ? time(row.expires_at) : t("keys.never")) },
  { name: "used", title: t("field.last_used_at"), order: (row) => row.last_used_at, cell: (row) => (row.last_used_at ? time(row.last_used_at) : t("keys.unused")) },
  { name: "created", title: t("field.created_at"), order: (row) => row.created_at, cell: (row) => time(row.created_at) },
];

/** @param {Key} key */
const stateOf = (key) => (key.revoked_at ? "revoked" : key.valid ? "valid" : "expired");

/** @param {{ of: Key }} props */
function State({ of }) {
  const state = stateOf(of);
  return html`<${Verdict} level=${state === "valid" ? "good" : state === "expired" ? "warn" : "bad"}>${t(`keys.${state}`)}</${Verdict}>`;
}

/** @param {{ id: string, onChanged: () => void, onMade: (key: NewKey) => void }} props */
function One({ id, onChanged, onMade }) {
  const found = useLoad((signal) => ok(api.GET("/v1/keys/{key_id}", { params: { path: { key_id: id } }, signal })), [id]);
  const [dialog, setDialog] = useState(/** @type {"revoke" | "rotate" | null} */ (null));
  const key = /** @type {Key | null} */ (found.data);
  const revoke = async () => {
    await ok(api.DELETE("/v1/keys/{key_id}", { params: { path: { key_id: id } } }));
    notify(t("keys.is_revoked", { label: key?.label ?? "" }));
    found.reload();
    onChanged();
  };
  return html`
    <${Panel} title=${key ? key.label : t("keys.one")} label=${t("keys.one")} onClose=${closeTo(BASE)}>
      <${Shown} of=${found}>${() => key && html`
        <p><${State} of=${key} /></p>
        <${Facts} of=${[
          [t("field.scope"), textOr(`scope.${key.scope}`, key.scope)],
          [t("keys.may"), textOr(`scope_text.${key.scope}`, "")],
          [t("field.prefix"), html`<span class="code">${key.prefix}…</span>`],
          [t("field.created_at"), time(key.created_at)],
          [t("field.expires_at"), key.expires_at ? time(key.expires_at) : t("keys.never")],
          [t("field.last_used_at"), key.last_used_at ? time(key.last_used_at) : t("keys.unused")],
          [t("keys.revoked_at"), key.revoked_at && time(key.revoked_at)],
          [t("field.id"), html`<span class="code small">${key.id}</span>`],
        ]} />
        <p class="buttons"><a href=${`/operations/audit?subject=${key.id}`}>${t("audit.of_this")}</a> <a href=${`/operations/audit?who=${encodeURIComponent(key.label)}`}>${t("keys.did")}</a></p>
        ${key.valid && html`<p class="buttons">
          ${may("POST /v1/keys/{key_id}/rotate") && html`<button type="button" class="quiet" onClick=${() => setDialog("rotate")}>${t("keys.rotate")}</button>`}
          ${may("DELETE /v1/keys/{key_id}") && html`<button type="button" class="quiet danger" onClick=${() => setDialog("revoke")}>${t("keys.revoke")}</button>`}
        </p>`}
      `}</${Shown}>
    </${Panel}>
    ${dialog === "revoke" && key && html`
      <${Confirm} title=${t("keys.revoke_title", { label: key.label })} button=${t("keys.revoke")} onConfirm=${revoke} onClose=${() => setDialog(null)}>
        <p>${t("keys.revoke_text")}</p>
      </${Confirm}>`}
    ${dialog === "rotate" && key && html`<${RotateDialog} of=${key} onClose=${() => setDialog(null)} onMade=${onMade} />`}
  `;
}

/** @param {{ onClose: () => void, onMade: (key: NewKey) => void }} props */
function MakeDialog({ onClose, onMade }) {
  const form = useForm({ label: "", scope: "viewer", expires_at: new Date(Date.now() + 365 * DAY_MS).toISOString().slice(0, 10) });
  const submit = async () => {
    const { label, scope, expires_at } = form.values;
    const key = await ok(api.POST("/v1/keys", { body: /** @type {any} */ ({ label: String(label).trim(), scope, expires_at: expires_at ? `${expires_at}T00:00:00Z` : null }) }));
    onClose();
    onMade(/** @type {NewKey} */ (key));
  };
  return html`
    <${Dialog} title=${t("keys.make")} onClose=${onClose}>
      <${FormFrame} form=${form} onSubmit=${submit} button=${t("keys.make")}>
        <${TextField} form=${form} path="label" label=${t("field.label")} hint=${t("keys.label_hint")} placeholder="BUS-7" required />
        <${SelectField} form=${form} path="scope" label=${t("field.scope")} hint=${textOr(`scope_text.${form.values.scope}`, "")} options=${SCOPES.map((scope) => [scope, t(`scope.${scope}`)])} />
        <${TextField} form=${form} path="expires_at" type="date" label=${t("field.expires_at")} hint=${t("keys.expiry_hint")} />
      </${FormFrame}>
    </${Dialog}>
  `;
}

/** @param {{ of: Key, onClose: () => void, onMade: (key: NewKey) => void }} props */
function RotateDialog({ of, onClose, onMade }) {
  const form = useForm({ overlap: "86400" });
  const submit = async () => {
    const key = await ok(api.POST("/v1/keys/{key_id}/rotate", { params: { path: { key_id: of.id } }, body: { overlap_s: Number(form.values.overlap) } }));
    onClose();
    onMade(/** @type {NewKey} */ (key));
  };
  return html`
    <${Dialog} title=${t("keys.rotate_title", { label: of.label })} onClose=${onClose}>
      <p>${t("keys.rotate_text")}</p>
      <${FormFrame} form=${form} onSubmit=${submit} button=${t("keys.rotate")}>
        <${SelectField} form=${form} path="overlap" label=${t("keys.overlap")} options=${[["0", t("keys.overlap_none")], ["3600", t("keys.overlap_hour")], ["86400", t("keys.overlap_day")], ["604800", t("keys.overlap_week")]]} />
      </${FormFrame}>
    </${Dialog}>
  `;
}
