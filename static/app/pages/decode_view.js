// What was read in an upload, or in several at once: frames, traces and packets, the map, one timeline, the readings.

import { html } from "htm/preact";
import { useEffect, useMemo, useState } from "preact/hooks";

import { followJob } from "../api/follow_job.js";
import { api, ok, Problem, request } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Empty, isAborted } from "../components/load.js";
import { attempt } from "../components/notices.js";
import { ProblemBox } from "../components/problem.js";
import { fileSize, number, text, time } from "../format.js";
import { query, setQuery } from "../router.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";
import { Details } from "./decode_details.js";
import { DriveTrack } from "./decode_drive.js";
import { Exports } from "./decode_exports.js";
import { Frames } from "./decode_frames.js";
import { ReadingList } from "./decode_list.js";
import { DecodeMap } from "./decode_map.js";
import { Strengths } from "./decode_strengths.js";
import { clockOf, frameTime, TimelineBar, useTimeline } from "./decode_timeline.js";
import { TracePlot } from "./decode_trace.js";

const PART_MS = 5000; // between two looks at the result so far
const SHOWN_WARNINGS = 3; // others are in a list that is opened
const ENDED = ["done", "failed", "cancelled"];

/** @typedef {import("./decode_timeline.js").Source} Source */

/** @param {{ id: string }} props */
export function DecodeView({ id }) {
  const others = (query.value.get("with") ?? "").split(",").filter(Boolean);
  const ids = [id, ...others.filter((other) => other !== id)];
  const [turn, setTurn] = useState(0);
  const [state, setState] = useState(/** @type {{ sources: Source[], error: unknown, loading: boolean }} */ ({ sources: [], error: null, loading: true }));
  useEffect(() => {
    const abort = new AbortController();
    Promise.all(ids.map((one) => loadSource(one, abort.signal))).then(
      (sources) => abort.signal.aborted || setState({ sources, error: null, loading: false }),
      (error) => isAborted(error) || abort.signal.aborted || setState({ sources: [], error, loading: false }),
    );
    return () => abort.abort();
  }, [ids.join(), turn]);
  const again = () => setTurn((old) => old + 1);
  const waiting = state.sources.find(({ decode }) => !ENDED.includes(decode.state));
  const first = state.sources[0]?.decode;
  return html`
    <div class="title-line"><h1>${first ? titleOf(first) : t("decode.result")}</h1>
      <p class="small"><a href="/decodes">${t("decodes.title")}</a> · <a href="/decode">${t("decode.another")}</a></p></div>
    <${ProblemBox} error=${state.error} retry=${again} />
    ${state.loading && html`<p class="loading" role="status">${t("load.loading")}</p>`}
    ${state.sources.map(({ decode, track }) => html`<${Head} key=${decode.id} decode=${decode} hasTrack=${track.length > 0} removable=${ids.length > 1 && decode.id !== id}
      onRemove=${() => setQuery({ with: others.filter((other) => other !== decode.id).join() || null }, { replace: false })} />`)}
    ${waiting && html`<${Progress} key=${waiting.decode.id} decode=${waiting.decode} onChange=${again} />`}
    ${state.sources.some(({ decode }) => decode.decoder) && html`<${Together} sources=${state.sources.filter(({ decode }) => decode.decoder)} />`}
  `;
}

/** @param {any} decode */
const titleOf = (decode) => decode.file_name ?? t("decode.title_kind", { kind: textOr(`option.${decode.kind}`, decode.kind) });

/** A decode with everything that is shown of it. @param {string} id @param {AbortSignal} signal @returns {Promise<Source>} */
async function loadSource(id, signal) {
  const get = async (/** @type {string} */ path) => (await request(path, { signal })).json();
  const decode = await get(`/v1/decodes/${encodeURIComponent(id)}`);
  if (!decode.decoder) return { decode, clock: "recording", zero: 0, shift: 0, frames: [], readings: [], track: [], packets: null, lane: [] };
  const { clock, zero } = clockOf(decode);
  const [readings, track, packets, lane] = await Promise.all([
    get(decode.links.readings), get(decode.links.track), decode.links.packets ? get(decode.links.packets) : null,
    decode.links.lane && decode.lane && !decode.lane.refusal ? get(decode.links.lane) : { features: [] },
  ]);
  const frames = (decode.frames ?? []).filter((/** @type {any} */ frame) => !frame.error).map((/** @type {any} */ frame) => ({ frame, at: frameTime(decode, frame, clock) }));
  const heard = firstHeard(packets);
  const rows = readings.features.map((/** @type {any} */ { properties }, /** @type {number} */ k) => ({
    ...properties, key: `${id}-${k}`, decode_id: id,
    at: properties.time_s ?? (clock === "frames" ? properties.frame : heard.get(Number(properties.code))) ?? NaN,
  }));
  return { decode, clock, zero, shift: 0, frames, readings: rows, track: track.features, packets, lane: lane.features };
}

/** When each CERPM was received best. @param {any} packets @returns {Map<number, number>} */
function firstHeard(packets) {
  const found = new Map();
  const best = new Map();
  for (const [k, name] of (packets?.number ?? []).entries()) {
    const strength = packets.rssi_dbm[k] ?? -1000;
    if (name === null || packets.time_s[k] === null || strength <= (best.get(name) ?? -Infinity)) continue;
    best.set(name, strength);
    found.set(name, packets.time_s[k]);
  }
  return found;
}

/** @param {{ decode: any, hasTrack: boolean, removable: boolean, onRemove: () => void }} props */
function Head({ decode, hasTrack, removable, onRemove }) {
  const level = decode.state === "done" ? "good" : decode.state === "failed" ? "bad" : "none";
  const parts = [
    textOr(`option.${decode.kind}`, decode.kind), `${time(decode.created_at)} UTC`, decode.upload_bytes && fileSize(decode.upload_bytes), decode.context.vehicle?.name,
    decode.decoder,
  ].filter(Boolean);
  return html`
    <section class="decode-head">
      <div>
        <p class="decode-summary"><${Verdict} level=${level}>${textOr(`job.${decode.state}`, decode.state)}</${Verdict}> ${removable && html`<strong>${titleOf(decode)}: </strong>`}${decode.summary?.text ?? ""}</p>
        <p class="hint">${parts.join(" · ")}</p>
      </div>
      <div class="actions">${decode.decoder && html`<${Exports} decode=${decode} hasTrack=${hasTrack} />`}
        ${removable && html`<button type="button" class="quiet" onClick=${onRemove}>${t("action.remove")}</button>`}</div>
    </section>
    ${decode.error && html`<${ProblemBox} error=${new Problem({ title: t("decode.failed"), ...decode.error })} />`}
    <${Warnings} of=${[...(decode.warnings ?? []), ...(decode.report?.warnings ?? []), ...(decode.lane?.localization_warnings ?? [])]} />
  `;
}

/** What a reader must know before using the readings; of many, the first ones. @param {{ of: string[] }} props */
function Warnings({ of }) {
  const rest = of.slice(SHOWN_WARNINGS);
  return html`
    ${of.slice(0, SHOWN_WARNINGS).map((warning) => html`<p class="warning">${warning}</p>`)}
    ${rest.length > 0 && html`<details class="more warning"><summary>${t("decode.more_warnings", { count: rest.length })}</summary><ul>${rest.map((warning) => html`<li>${warning}</li>`)}</ul></details>`}
  `;
}

/** The job of a decode that is not done. @param {{ decode: any, onChange: () => void }} props */
function Progress({ decode, onChange }) {
  const [job, setJob] = useState(/** @type {import("../api/follow_job.js").Job | null} */ (null));
  const [error, setError] = useState(/** @type {unknown} */ (null));
  useEffect(() => {
    const abort = new AbortController();
    let last = Date.now();
    followJob(decode.id, (found) => {
      setJob(found);
      if (found.progress > 0 && Date.now() - last > PART_MS && found.total) {
        last = Date.now();
        onChange(); // what has been read so far
      }
    }, abort.signal).then(onChange, (problem) => abort.signal.aborted || setError(problem));
    return () => abort.abort();
  }, [decode.id]);
  const cancel = () => attempt(() => ok(api.POST("/v1/jobs/{job_id}/cancel", { params: { path: { job_id: decode.id } } })));
  return html`
    <section class="card job">
      <${ProblemBox} error=${error} />
      <p role="status">${textOr(`job.${job?.state ?? decode.state}`, decode.state)}${job?.total ? ` ${t("job.steps", { done: job.done ?? 0, total: job.total })}` : ""}${job?.rate_per_s ? `, ${t("decode.rate", { rate: number(job.rate_per_s, 1) })}` : ""}</p>
      <progress aria-label=${t("job.progress")} max="1" value=${job?.progress ?? decode.progress}></progress>
      ${may("POST /v1/decodes") && html`<p><button type="button" class="quiet" onClick=${cancel}>${t("action.cancel")}</button></p>`}
      <p class="hint">${t("decode.leave")}</p>
    </section>
  `;
}

/** @param {{ sources: Source[] }} props */
function Together({ sources }) {
  const timeline = useTimeline(sources);
  const [image, setImage] = useState(/** @type {HTMLImageElement | null} */ (null));
  const [track, setTrack] = useState(/** @type {any[]} */ ([]));
  const placed = useMemo(() => (track.length ? [driveSource(track, sources), ...sources] : sources), [track, sources]);
  const wanted = query.value.get("reading");
  const chosen = useMemo(() => sources.flatMap(({ readings }) => readings).find(({ key }) => key === wanted) ?? null, [sources, wanted]);
  const own = chosen && sources.find(({ decode }) => decode.id === chosen.decode_id);
  const detail = own && chosen.frame !== null ? own.decode.readings?.find((/** @type {any} */ reading) => reading.frame === chosen.frame && (reading.digits ?? reading.likely_digits ?? null) === chosen.code) : null;
  const choose = (/** @type {any} */ row) => {
    setQuery({ reading: row.key });
    const source = sources.find(({ decode }) => decode.id === row.decode_id);
    if (Number.isFinite(row.at)) timeline.cursor.value = row.at + (source?.shift ?? 0);
  };
  const chooseInFrame = (/** @type {Source} */ source) => (/** @type {any} */ reading) => {
    const row = source.readings.find(({ frame, code }) => frame === reading.frame && code === (reading.digits ?? reading.likely_digits ?? null));
    if (row) choose(row);
  };
  return html`
    <div class="decode-grid">
      <div class="decode-signals">
        ${sources.map((source) => html`
          <section key=${source.decode.id} class="card" aria-label=${text(source.decode.file_name ?? source.decode.kind)}>
            <h2>${t(/** @type {any} */ (`decode.part_${source.decode.kind}`))}${sources.length > 1 && html` <span class="hint">${source.decode.file_name}</span>`}</h2>
            ${source.decode.kind === "trace" ? html`<${TracePlot} source=${source} timeline=${timeline} />`
              : source.decode.kind === "packets" ? html`<${Strengths} source=${source} timeline=${timeline} />`
                : html`<${Frames} source=${source} timeline=${timeline} chosen=${own === source ? detail : null} onChoose=${chooseInFrame(source)} onImage=${setImage} />`}
          </section>`)}
      </div>
      <section class="card decode-place"><h2>${t("decode.on_map")}</h2><${DecodeMap} sources=${placed} timeline=${timeline} />
        ${sources.length > 1 && sources.every(({ clock }) => clock === "utc") && html`<${DriveTrack} sources=${sources} onTrack=${setTrack} />`}</section>
    </div>
    <${TimelineBar} timeline=${timeline} />
    <section class="card decode-part"><h2>${t("decode.readings")}</h2><${ReadingList} timeline=${timeline} chosen=${wanted} onChoose=${choose} /></section>
    ${sources.map((source) => html`<${Details} key=${source.decode.id} source=${source} timeline=${timeline} chosen=${own === source ? chosen : null} image=${image} />`)}
    ${!sources.length && html`<${Empty} title=${t("decode.no_readings")} />`}
  `;
}

/** The track of a drive, on the timeline of its decodes. @param {any[]} track @param {Source[]} sources @returns {Source} */
const driveSource = (track, sources) => ({
  decode: { id: "drive", kind: "drive", frames: [] }, clock: "utc", zero: 0, shift: sources[0]?.shift ?? 0, frames: [], readings: [], track, packets: null, lane: [],
});
