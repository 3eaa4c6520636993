// What the server runs with, what the agency's public pages show, and the reader's own rights.

import { html } from "htm/preact";

import { api, ok } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Facts } from "../components/facts.js";
import { FormFrame, useForm } from "../components/form.js";
import { Shown, useLoad } from "../components/load.js";
import { notify } from "../components/notices.js";
import { number, time } from "../format.js";
import { may, me, pageSettings } from "../session.js";
import { t, textOr } from "../texts/index.js";

const RELEASED = ["code", "agency", "status", "revision", "road", "measure"];

/** @typedef {import("../api/schema.js").components["schemas"]["ServerSettings"]} ServerSettings */
/** @typedef {import("../api/schema.js").components["schemas"]["PublicPageDocument"]} PublicPage */

export default function Settings() {
  const who = me.value;
  return html`
    <h1>${t("settings.title")}</h1>
    <div class="wide-tiles">
      <${Server} />
      <section class="card"><h2>${t("account.title")}</h2>
        <${Facts} of=${[[t("settings.agency"), who?.agency], [t("settings.name"), who?.label], [t("settings.scope"), textOr(`scope.${who?.scope}`, who?.scope ?? "")]]} />
        <details class="section"><summary><h3>${t("settings.permissions")}</h3></summary><ul class="plain code small">${who?.permissions.map((route) => html`<li>${route}</li>`)}</ul></details>
      </section>
      ${may("GET /v1/public-page") && html`<${PublicPageCard} />`}
    </div>
    ${may("GET /v1/server-settings") && html`<${InUse} />`}
  `;
}

/** What everybody may know of the server. */
function Server() {
  const ready = useLoad(async (signal) => (await fetch("/readyz", { signal })).json(), []);
  const settings = pageSettings.value;
  return html`
    <section class="card"><h2>${t("settings.server")}</h2>
      <${Facts} of=${[[t("settings.version"), settings?.version], [t("settings.base_map"), settings?.base_map ? t(`settings.${settings.base_map.kind}`) : t("settings.none")], [t("settings.sign_in"), settings?.sign_in?.issuer ?? t("settings.by_key")]]} />
      <${Shown} of=${ready}>${(/** @type {any} */ found) => html`<${Facts} of=${Object.entries(found.parts).map(([name, on]) => [textOr(`settings.part_${name}`, name), html`<${Verdict} level=${on ? "good" : "bad"}>${t(on ? "settings.ready" : "settings.not_ready")}</${Verdict}>`])} />`}</${Shown}>
    </section>
  `;
}

/** What the agency releases of its markers to everybody. */
function PublicPageCard() {
  const found = useLoad((signal) => ok(api.GET("/v1/public-page", { signal })), []);
  return html`
    <section class="card"><h2>${t("public_page.title")}</h2>
      <p>${t("public_page.lead")}</p>
      <${Shown} of=${found}>${(/** @type {PublicPage} */ page) => html`<${PublicPageForm} key=${page.version} page=${page} onDone=${found.reload} />`}</${Shown}>
    </section>
  `;
}

/** @param {{ page: PublicPage, onDone: () => void }} props */
function PublicPageForm({ page, onDone }) {
  const form = useForm({ ...Object.fromEntries(RELEASED.map((name) => [name, page.fields.includes(/** @type {any} */ (name))])), damage_reports: page.damage_reports });
  const allowed = may("PUT /v1/public-page");
  const check = (/** @type {string} */ name, /** @type {string} */ label) => html`<label class="check"><input type="checkbox" name=${name} checked=${form.values[name] === true} disabled=${!allowed}
    onChange=${(/** @type {any} */ event) => form.set(name, event.currentTarget.checked)} /> ${label}</label>`;
  const fields = RELEASED.filter((name) => form.values[name]);
  const submit = async () => {
    await ok(api.PUT("/v1/public-page", { params: { header: { "If-Match": `"${page.version}"` } }, body: { fields: /** @type {any} */ (fields), damage_reports: form.values.damage_reports === true } }));
    notify(t("public_page.saved"));
    onDone();
  };
  const content = html`
    <fieldset><legend>${t("public_page.fields")}</legend><div class="checks">${RELEASED.map((name) => check(name, t(/** @type {any} */ (`public_page.${name}`))))}</div></fieldset>
    ${!fields.length && html`<p class="warning">${t("public_page.nothing")}</p>`}
    ${check("damage_reports", t("public_page.damage_reports"))}
  `;
  if (!allowed) return html`${content}<p class="hint">${t("public_page.admins")}</p>`;
  return html`<${FormFrame} form=${form} onSubmit=${submit} button=${t("action.save")} actions=${page.updated_at && html`<span class="hint">${t("public_page.changed", { at: time(page.updated_at) })}</span>`}>${content}</${FormFrame}>`;
}

function InUse() {
  const found = useLoad((signal) => ok(api.GET("/v1/server-settings", { signal })), []);
  return html`
    <section class="card"><h2>${t("settings.in_use")}</h2>
      <p>${t("settings.in_use_text")}</p>
      <${Shown} of=${found}>${(/** @type {ServerSettings} */ settings) => html`
        <${Facts} of=${[
          [t("settings.engine"), t(`settings.engine_${settings.engine}`)],
          [t("settings.part_database"), t(`settings.database_${settings.database}`)],
          [t("settings.storage"), t(`settings.storage_${settings.storage}`)],
          [t("settings.broker"), settings.broker ? "RabbitMQ (AMQP)" : t("settings.no_broker")],
          [t("settings.public_url"), settings.public_url ?? t("settings.no_public_url")],
          [t("settings.sign_in"), settings.issuer ?? t("settings.by_key")],
          [t("settings.base_map"), settings.base_map ? t(`settings.${settings.base_map}`) : t("settings.none")],
          [t("settings.grids"), t(settings.grids ? "changes.yes" : "changes.no")],
          [t("settings.tracing"), t(settings.tracing ? "changes.yes" : "changes.no")],
          [t("settings.log"), `${settings.log_level}, ${settings.log_format}`],
        ]} />
        <h3>${t("settings.limits")}</h3>
        <div class="table-scroll plain-table tall" tabindex="0" role="region" aria-label=${t("settings.limits")}>
          <table>
            <thead><tr><th scope="col">${t("settings.setting")}</th><th scope="col" class="number">${t("settings.value")}</th><th scope="col">${t("settings.meaning")}</th></tr></thead>
            <tbody>${settings.numbers.map((setting) => html`
              <tr><th scope="row" class="code small wrap">${setting.name}</th>
                <td class="number">${valueOf(setting.value, setting.name)}${setting.value !== setting.default && html`<br /><small>${t("settings.default", { value: valueOf(setting.default, setting.name) })}</small>`}</td>
                <td lang="en">${setting.description}</td></tr>
            `)}</tbody>
          </table>
        </div>
      `}</${Shown}>
    </section>
  `;
}

/** @param {number | boolean} value @param {string} name */
function valueOf(value, name) {
  if (typeof value === "boolean") return t(value ? "changes.yes" : "changes.no");
  if (!name.endsWith("_BYTES") || value < 2 ** 20) return number(value, Number.isInteger(value) ? 0 : 2);
  const power = Math.min(Math.floor(Math.log2(value) / 10), 4);
  const scaled = value / 2 ** (10 * power);
  return number(scaled, Number.isInteger(scaled) ? 0 : 1, /** @type {string} */ (["B", "KiB", "MiB", "GiB", "TiB"][power]));
}
