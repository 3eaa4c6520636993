// The first page: how many markers there are, by family and status, and where to go.

import { html } from "htm/preact";

import { api, page, request } from "../api/client.js";
import { Shown, useLoad } from "../components/load.js";
import { number } from "../format.js";
import { MENU } from "../menu.js";
import { may, me } from "../session.js";
import { t } from "../texts/index.js";

export default function Home() {
  const groups = MENU.map(({ text, entries }) => ({ text, entries: entries.filter(({ needs }) => !needs || may(needs)) })).filter(({ entries }) => entries.length);
  return html`
    <h1>${t("home.welcome", { agency: me.value?.agency ?? "" })}</h1>
    <div class="tiles">
      ${may("GET /v1/markers") && html`<${MarkersTile} />`}
      ${may("GET /v1/maintenance") && html`<${MaintenanceTile} />`}
      ${may("GET /v1/jobs") && html`<${JobsTile} />`}
    </div>
    <div class="tiles">
      ${groups.map(({ text, entries }) => html`
        <section class="card"><h2>${t(text)}</h2><ul class="plain">${entries.map((entry) => html`<li><a href=${entry.href}>${t(entry.text)}</a></li>`)}</ul></section>
      `)}
    </div>
  `;
}

/** @param {{ title: string, href: string, of: import("../components/load.js").Loaded<any>, text: (data: any) => string, figure: (data: any) => string }} props */
function Tile({ title, href, of, figure, text }) {
  return html`<section class="card tile"><h2><a href=${href}>${title}</a></h2><${Shown} of=${of}>${(/** @type {any} */ data) => html`<p class="figure">${figure(data)}</p><p class="hint">${text(data)}</p>`}</${Shown}></section>`;
}

function MarkersTile() {
  const count = useLoad(fetchCount, []);
  return html`<${Tile} title=${t("markers.title")} href="/markers" of=${count} figure=${(/** @type {number} */ all) => number(all)} text=${() => t("home.markers")} />`;
}

/** @param {AbortSignal} signal */
async function fetchCount(signal) {
  const response = await request("/ogc/collections/markers/items?resultType=hits", { signal });
  return Number((await response.json()).numberMatched);
}

function MaintenanceTile() {
  const items = useLoad((signal) => page(api.GET("/v1/maintenance", { params: { query: { status: "open", limit: 100 } }, signal })), []);
  return html`<${Tile} title=${t("maintenance.title")} href="/operations/maintenance" of=${items} figure=${(/** @type {any} */ found) => `${found.items.length}${found.after ? "+" : ""}`} text=${() => t("home.maintenance")} />`;
}

function JobsTile() {
  const jobs = useLoad((signal) => page(api.GET("/v1/jobs", { params: { query: { state: "running", limit: 100 } }, signal })), []);
  return html`<${Tile} title=${t("jobs.title")} href="/operations/jobs" of=${jobs} figure=${(/** @type {any} */ found) => String(found.items.length)} text=${() => t("home.jobs")} />`;
}
