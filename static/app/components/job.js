// The progress of a job, until it has ended.

import { html } from "htm/preact";
import { useEffect, useRef, useState } from "preact/hooks";

import { api, ok, Problem } from "../api/client.js";
import { ENDED, followJob } from "../api/follow_job.js";
import { number } from "../format.js";
import { t, textOr } from "../texts/index.js";
import { ProblemBox } from "./problem.js";

/**
 * @typedef {import("../api/follow_job.js").Job} Job
 * @typedef {import("../api/schema.js").paths["/v1/jobs/{job_id}"]["get"]["responses"][200]["content"]["application/json"]} AnyJob
 */

/**
 * A job with its result.
 *
 * @template {AnyJob["kind"]} Kind
 * @param {string} id
 * @param {Kind} kind Another one is refused, as if there were none.
 * @param {AbortSignal} [signal]
 * @returns {Promise<Extract<AnyJob, { kind: Kind }>>}
 */
export async function oneJob(id, kind, signal) {
  const job = await ok(api.GET("/v1/jobs/{job_id}", { params: { path: { job_id: id } }, signal }));
  if (job.kind !== kind) throw new Problem({ title: t("job.none"), status: 404 });
  return /** @type {any} */ (job);
}

/**
 * @param {{ id: string, onDone?: (job: Job) => void, onChange?: (job: Job) => void }} props `onDone` is called once, `onChange` whenever
 *   the job has changed.
 */
export function JobProgress({ id, onDone, onChange }) {
  const [job, setJob] = useState(/** @type {Job | null} */ (null));
  const [error, setError] = useState(/** @type {unknown} */ (null));
  const done = useRef(onDone);
  done.current = onDone;
  const latest = useRef(onChange);
  latest.current = onChange;
  useEffect(() => {
    const abort = new AbortController();
    const show = (/** @type {Job} */ current) => {
      setJob(current);
      latest.current?.(current);
    };
    followJob(id, show, abort.signal).then((last) => {
      if (last.state === "done") done.current?.(last);
    }).catch((problem) => abort.signal.aborted || setError(problem));
    return () => abort.abort();
  }, [id]);
  if (error) return html`<${ProblemBox} error=${error} />`;
  if (!job) return html`<p class="loading" role="status">${t("load.loading")}</p>`;
  const running = !ENDED.includes(job.state);
  const cancel = () => ok(api.POST("/v1/jobs/{job_id}/cancel", { params: { path: { job_id: id } } })).catch(setError);
  return html`
    <div class="job">
      <p role="status">${textOr(`job.${job.state}`, job.state)}${job.total ? ` ${t("job.steps", { done: job.done ?? 0, total: job.total })}` : ""}${running && job.rate_per_s ? `, ${t("job.rate", { rate: number(job.rate_per_s, 1) })}` : ""}</p>
      ${running && html`
        <progress aria-label=${t("job.progress")} max="1" value=${job.progress}></progress>
        <button type="button" class="quiet" disabled=${job.cancel_requested} onClick=${cancel}>${t("action.cancel")}</button>
      `}
      ${job.error && html`<${ProblemBox} error=${new Problem({ title: t("job.failed"), ...job.error })} />`}
    </div>
  `;
}
