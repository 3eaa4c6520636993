// Imports: a new one, those that ran as jobs, and the report of one of them.

import { html } from "htm/preact";

import { Problem } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Facts } from "../components/facts.js";
import { JobProgress, oneJob } from "../components/job.js";
import { Shown, useLoad } from "../components/load.js";
import { PagesFoot, usePages } from "../components/pages.js";
import { ProblemBox } from "../components/problem.js";
import { number, time } from "../format.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";
import { NewImport, Stored } from "./imports_new.js";
import { Comparison, Detected, Downloads, Faults, Summary } from "./imports_report.js";
import { Rows } from "./imports_rows.js";

const UNFINISHED = ["queued", "running"];
const LEVELS = /** @type {Record<string, "good" | "bad" | "warn" | "none">} */ ({ done: "good", failed: "bad", cancelled: "warn" });

/** @param {{ parameters: { import_id?: string } }} props */
export default function Imports({ parameters }) {
  return parameters.import_id ? html`<${One} key=${parameters.import_id} id=${parameters.import_id} />` : html`<${All} />`;
}

function All() {
  const list = usePages("/v1/jobs", { kind: "import" });
  return html`
    <h1>${t("imports.title")}</h1>
    <p class="lead">${t("imports.lead")}</p>
    ${may("POST /v1/imports") && html`<${NewImport} onStored=${list.reload} />`}
    <section class="card"><h2>${t("imports.earlier")}</h2>
      <${ProblemBox} error=${list.error} retry=${list.reload} />
      ${!list.loaded && !list.error && html`<p class="loading" role="status">${t("load.loading")}</p>`}
      ${list.loaded && !list.rows.length && html`<p class="hint">${t("imports.no_jobs")}</p>`}
      ${list.rows.length > 0 && html`
        <div class="table-scroll plain-table" tabindex="0" role="region" aria-label=${t("imports.earlier")}><table>
          <thead><tr><th scope="col">${t("field.created_at")}</th><th scope="col">${t("field.state")}</th><th scope="col" class="number">${t("field.progress")}</th></tr></thead>
          <tbody>${list.rows.map((row) => html`<tr><th scope="row"><a href=${`/imports/${row.id}`}>${time(row.created_at)}</a></th><td><${State} state=${row.state} /></td><td class="number">${number(100 * row.progress)} %</td></tr>`)}</tbody>
        </table></div>
        <p class="hint"><${PagesFoot} of=${list} /></p>
      `}
    </section>
  `;
}

/** @param {{ state: string }} props */
const State = ({ state }) => html`<${Verdict} level=${LEVELS[state] ?? "none"}>${textOr(`job.${state}`, state)}</${Verdict}>`;

/** @param {{ id: string }} props */
function One({ id }) {
  const found = useLoad((signal) => oneJob(id, "import", signal), [id]);
  return html`
    <h1>${t("imports.one")}</h1>
    <p><a href="/imports">${t("imports.all")}</a></p>
    <${Shown} of=${found}>${(/** @type {import("../api/schema.js").components["schemas"]["ImportJob"]} */ job) => html`
      <section class="card">
        ${UNFINISHED.includes(job.state) ? html`<${JobProgress} id=${id} onDone=${found.reload} />` : html`<p><${State} state=${job.state} /></p>`}
        ${job.error && html`<${ProblemBox} error=${new Problem({ title: t("job.failed"), ...job.error })} />`}
        <${Facts} of=${[[t("field.created_at"), time(job.created_at)], [t("field.finished_at"), job.finished_at && time(job.finished_at)]]} />
        ${job.result && html`<${Summary} report=${job.result} /><p class="buttons"><${Downloads} report=${job.result} /></p>${job.result.outcome === "stored" && html`<${Stored} report=${job.result} />`}`}
      </section>
      ${job.result && html`
        ${job.result.listed.length > 0 && html`<section class="card"><h2>${t("imports.rows_title")}</h2><${Rows} report=${job.result} family="plate" /></section>`}
        <section class="card"><h2>${t("imports.faults")}</h2><${Faults} report=${job.result} /></section>
        <${Comparison} report=${job.result} />
        <section class="card"><h2>${t("imports.detected")}</h2><${Detected} report=${job.result} /></section>
      `}
    `}</${Shown}>
  `;
}
