// The progress of a job as it happens: server-sent events, read by fetch because they need the key.

import { Problem, request } from "./client.js";

const AGAIN_MS = 1500;
/** States of a job that has ended. */
export const ENDED = ["done", "failed", "cancelled"];

/** @typedef {import("./schema.js").components["schemas"]["JobSummary"]} Job */

/**
 * Follow a job until it has ended. A stream that breaks off is opened again.
 *
 * @param {string} id
 * @param {(job: Job) => void} onJob Called with each state of the job.
 * @param {AbortSignal} signal
 * @returns {Promise<Job>} The job as it ended.
 */
export async function followJob(id, onJob, signal) {
  for (;;) {
    const job = await readJob(id, signal);
    onJob(job);
    if (ENDED.includes(job.state)) return job;
    try {
      const last = await stream(id, onJob, signal);
      if (last) return last;
    } catch (error) {
      if (signal.aborted || (error instanceof Problem && ![0, 429, 503].includes(error.document.status ?? 0))) throw error;
    }
    await pause(AGAIN_MS, signal);
  }
}

/** @param {string} id @param {AbortSignal} signal @returns {Promise<Job>} */
const readJob = async (id, signal) => (await request(`/v1/jobs/${encodeURIComponent(id)}`, { signal })).json();

/**
 * @param {string} id
 * @param {(job: Job) => void} onJob
 * @param {AbortSignal} signal
 * @returns {Promise<Job | null>} The job if its end was in the stream.
 */
async function stream(id, onJob, signal) {
  const response = await request(`/v1/jobs/${encodeURIComponent(id)}/events`, { headers: { Accept: "text/event-stream" }, signal });
  if (!response.body || response.status === 204) return null;
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return null;
    text += value.replaceAll("\r\n", "\n");
    for (let end = text.indexOf("\n\n"); end >= 0; end = text.indexOf("\n\n")) {
      const job = jobOf(text.slice(0, end));
      text = text.slice(end + 2);
      if (!job) continue;
      onJob(job);
      if (ENDED.includes(job.state)) {
        reader.cancel().catch(() => {});
        return job;
      }
    }
  }
}

/** @param {string} event @returns {Job | null} */
function jobOf(event) {
  const data = event.split("\n").filter((line) => line.startsWith("data:")).map((line) => line.slice(5).trim()).join("\n");
  return data ? JSON.parse(data) : null;
}

/** @param {number} ms @param {AbortSignal} signal */
export function pause(ms, signal) {
  return new Promise((resolve, reject) => {
    const stop = () => reject(signal.reason);
    if (signal.aborted) return stop();
    const timer = setTimeout(() => {
      signal.removeEventListener("abort", stop);
      resolve(undefined);
    }, ms);
    signal.addEventListener("abort", () => {
      clearTimeout(timer);
      stop();
    }, { once: true });
    return undefined;
  });
}
