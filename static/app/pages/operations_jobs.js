// Jobs of all kinds as they run: filters, progress, cancel, result, and why one failed.

import { html } from "htm/preact";
import { useEffect } from "preact/hooks";

import { api, download, ok, Problem } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Facts } from "../components/facts.js";
import { JobProgress } from "../components/job.js";
import { ChoiceFilter, closeTo, filterOf, linked, ListPage } from "../components/list_page.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { attempt, notify } from "../components/notices.js";
import { usePages } from "../components/pages.js";
import { Panel } from "../components/panel.js";
import { ProblemBox } from "../components/problem.js";
import { number, time } from "../format.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";

const BASE = "/operations/jobs";
const KINDS = /** @type {const} */ (["decode", "drive", "import", "plan", "proof", "package", "artwork", "export", "reprocess", "audit"]);
const STATES = /** @type {const} */ (["queued", "running", "done", "failed", "cancelled"]);
const LOOK_MS = 2000;
const LEVELS = /** @type {Record<string, "good" | "bad" | "warn" | "none">} */ ({ done: "good", failed: "bad", cancelled: "warn" });

/** @typedef {import("../components/job.js").Job} Job */

/** @param {{ id: string | null }} props */
export default function Jobs({ id }) {
  const list = usePages("/v1/jobs", { kind: filterOf("kind"), state: filterOf("state") });
  const running = list.rows.some(isRunning);
  useEffect(() => {
    if (!list.loaded) return undefined;
    // new jobs appear, and those that run move on; a failure is shown when the list is loaded again
    const timer = setInterval(() => document.visibilityState === "visible" && list.refresh().catch(() => {}), running ? LOOK_MS : 5 * LOOK_MS);
    return () => clearInterval(timer);
  }, [list.loaded, running, filterOf("kind"), filterOf("state")]);
  const filters = html`
    <${ChoiceFilter} name="kind" label=${t("field.kind")} options=${[["", t("filter.all")], ...KINDS.map((kind) => [kind, t(`job_kind.${kind}`)])]} />
    <${ChoiceFilter} name="state" label=${t("field.state")} options=${[["", t("filter.all")], ...STATES.map((state) => [state, t(`job.${state}`)])]} />
  `;
  const empty = html`<${Empty} title=${t("jobs.none")}><p>${t("jobs.none_text")}</p></${Empty}>`;
  return html`<${ListPage} title=${t("jobs.title")} base=${BASE} list=${list} columns=${columns()} chosen=${id} filters=${filters} empty=${empty}
    panel=${id !== null && html`<${One} key=${id} id=${id} onChanged=${list.refresh} />`} />`;
}

/** @param {Job} job */
const isRunning = (job) => job.state === "queued" || job.state === "running";

/** @returns {import("../components/table.js").Column<any>[]} */
const columns = () => [
  linked(BASE, { name: "kind", title: t("field.kind"), order: (row) => row.kind, cell: (row) => textOr(`job_kind.${row.kind}`, row.kind) }),
  { name: "state", title: t("field.state"), order: (row) => row.state, cell: (row) => html`<${State} job=${row} />` },
  { name: "progress", title: t("field.progress"), order: (row) => row.progress, cell: (row) => html`<${Progress} job=${row} />` },
  { name: "created", title: t("field.created_at"), order: (row) => row.created_at, cell: (row) => time(row.created_at) },
  { name: "took", title: t("jobs.took"), number: true, order: tookOf, cell: (row) => duration(tookOf(row)) },
  { name: "error", title: t("jobs.error"), order: (row) => row.error?.detail, cell: (row) => html`<span class="cut">${row.error?.detail ?? ""}</span>` },
  { name: "id", title: t("field.id"), hidden: true, cell: (row) => html`<span class="code small">${row.id}</span>` },
];

/** @param {{ job: Job }} props */
function State({ job }) {
  const text = textOr(`job.${job.state}`, job.state);
  return html`<${Verdict} level=${LEVELS[job.state] ?? "none"}>${job.cancel_requested && isRunning(job) ? t("jobs.cancelling") : text}</${Verdict}>`;
}

/** @param {{ job: Job }} props */
function Progress({ job }) {
  if (!isRunning(job)) return job.total ? t("jobs.steps", { done: number(job.done ?? 0), total: number(job.total) }) : "";
  const text = job.total ? t("jobs.steps", { done: number(job.done ?? 0), total: number(job.total) }) : `${number(100 * job.progress)} %`;
  return html`<span class="row-progress"><progress max="1" value=${job.progress} aria-label=${t("job.progress")}></progress> ${text}</span>`;
}

/** Seconds that a job has run. @param {Job} job */
function tookOf(job) {
  if (!job.started_at) return null;
  const end = job.finished_at ? new Date(job.finished_at) : new Date();
  return Math.max(0, (end.getTime() - new Date(job.started_at).getTime()) / 1000);
}

/** @param {number | null} seconds */
function duration(seconds) {
  if (seconds === null) return number(null);
  if (seconds < 120) return number(seconds, seconds < 10 ? 1 : 0, "s");
  return seconds < 7200 ? number(seconds / 60, 0, "min") : number(seconds / 3600, 1, "h");
}

/** @param {{ id: string, onChanged: () => Promise<void> }} props */
function One({ id, onChanged }) {
  const found = useLoad((signal) => ok(api.GET("/v1/jobs/{job_id}", { params: { path: { job_id: id } }, signal })), [id]);
  const job = /** @type {Job | null} */ (found.data);
  const changed = () => {
    found.reload();
    onChanged().catch(() => {});
  };
  return html`
    <${Panel} title=${job ? textOr(`job_kind.${job.kind}`, job.kind) : t("jobs.one")} label=${t("jobs.one")} onClose=${closeTo(BASE)}>
      <${Shown} of=${found}>${() => job && html`
        ${isRunning(job)
          ? html`<${JobProgress} id=${id} onChange=${(/** @type {Job} */ current) => isRunning(current) || changed()} />`
          : html`<p><${State} job=${job} /></p>`}
        ${job.error && html`<${ProblemBox} error=${new Problem({ title: t("job.failed"), ...job.error })} />`}
        ${job.dead_letter && html`<p class="warning">${t("jobs.dead_letter")}</p>`}
        <${Result} job=${job} />
        <${Facts} of=${[
          [t("field.created_at"), time(job.created_at)],
          [t("jobs.started_at"), job.started_at && time(job.started_at)],
          [t("field.finished_at"), job.finished_at && time(job.finished_at)],
          [t("jobs.took"), job.started_at && duration(tookOf(job))],
          [t("jobs.attempts"), job.attempts > 1 && job.attempts],
          [t("field.progress"), job.total && t("jobs.steps", { done: number(job.done ?? 0), total: number(job.total) })],
          [t("field.id"), html`<span class="code small">${job.id}</span>`],
        ]} />
      `}</${Shown}>
    </${Panel}>
  `;
}

/** The result of a job: a page of ours, or a file. @param {{ job: Job }} props */
function Result({ job }) {
  const path = job.links.result;
  if (!path) return null;
  const page = job.kind === "import" ? `/imports/${job.id}` : pageOf(path);
  if (page) return html`<p><a class="button" href=${page}>${t("jobs.result")}</a></p>`;
  const isFile = path.endsWith("/result") || path.endsWith("/package");
  if (isFile && !may(path.endsWith("/package") ? "GET /v1/plans/{plan_id}/package" : "GET /v1/jobs/{job_id}/result")) return null;
  const save = () => attempt(async () => {
    await download(path, isFile ? "" : `${job.kind}.json`);
    notify(t("jobs.saved"));
  });
  return html`<p><button type="button" onClick=${save}>${t("jobs.download")}</button></p>`;
}

/** The page that shows a resource of the API. @param {string} path */
function pageOf(path) {
  const found = /^\/v1\/(decodes|plans|reprocessings)\/([^/]+)(?:\/(?:proof))?$/.exec(path);
  if (!found) return null;
  return found[1] === "reprocessings" ? `/operations/reprocessings/${found[2]}` : `/${found[1]}/${found[2]}`;
}
