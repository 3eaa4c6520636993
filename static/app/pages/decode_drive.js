// One track from the decodes that are shown together: a drive of the API, estimated on demand.

import { html } from "htm/preact";
import { useEffect, useState } from "preact/hooks";

import { followJob } from "../api/follow_job.js";
import { download, jsonBody, Problem, request } from "../api/client.js";
import { isAborted } from "../components/load.js";
import { attempt } from "../components/notices.js";
import { ProblemBox } from "../components/problem.js";
import { query, setQuery } from "../router.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";

/**
 * @param {{ sources: import("./decode_timeline.js").Source[], onTrack: (track: any[]) => void }} props
 */
export function DriveTrack({ sources, onTrack }) {
  const id = query.value.get("drive");
  const [drive, setDrive] = useState(/** @type {any} */ (null));
  const [error, setError] = useState(/** @type {unknown} */ (null));
  useEffect(() => {
    if (!id) return undefined;
    const abort = new AbortController();
    const load = async () => {
      const get = async () => (await request(`/v1/drives/${encodeURIComponent(id)}`, { signal: abort.signal })).json();
      let found = await get();
      setDrive(found);
      if (["queued", "running"].includes(found.state)) {
        await followJob(id, (job) => setDrive((/** @type {any} */ old) => ({ ...old, state: job.state, progress: job.progress })), abort.signal);
        found = await get();
        setDrive(found);
      }
      if (found.state !== "done") throw new Problem({ title: t("decode.drive_failed"), ...found.error });
      onTrack(trackOf(await (await request(found.links.geojson, { signal: abort.signal })).json()));
    };
    setError(null);
    load().catch((problem) => isAborted(problem) || abort.signal.aborted || setError(problem));
    return () => abort.abort();
  }, [id]);
  const make = async () => {
    setError(null);
    try {
      const body = { decodes: sources.map(({ decode }) => ({ id: decode.id })) };
      const made = await (await request("/v1/drives", jsonBody(body))).json();
      setQuery({ drive: made.id });
    } catch (problem) {
      setError(problem);
    }
  };
  if (!may("POST /v1/drives") && !id) return null;
  const isDone = id && drive?.state === "done";
  return html`
    <div class="drive-track">
      ${!id && html`<button type="button" class="quiet" onClick=${make}>${t("decode.one_track")}</button> <span class="hint">${t("decode.one_track_hint")}</span>`}
      ${id && drive && !isDone && !error && html`<p role="status">${t("decode.one_track")}: ${textOr(`job.${drive.state}`, drive.state)}</p><progress aria-label=${t("job.progress")} max="1" value=${drive.progress ?? 0}></progress>`}
      ${isDone && html`<p>${drive.report?.summary ?? t("job.done")}</p>
        <p class="buttons">${["gpx", "geojson", "csv"].map((form) => html`<button type="button" class="quiet" onClick=${() => attempt(() => download(drive.links[form], `drive-${id}.${form}`))}>${t("decode.export_track", { form: form === "geojson" ? "GeoJSON" : form.toUpperCase() })}</button>`)}
          <button type="button" class="quiet" onClick=${() => {
            setQuery({ drive: null });
            onTrack([]);
          }}>${t("decode.without_track")}</button></p>`}
      <${ProblemBox} error=${error} />
    </div>
  `;
}

/** Lines of a drive's track, with times as the timeline has them. @param {any} collection @returns {any[]} */
function trackOf(collection) {
  return collection.features.filter((/** @type {any} */ feature) => feature.geometry?.type === "LineString").map((/** @type {any} */ { geometry, properties }) => ({
    type: "Feature", geometry, properties: { ...properties, time_s: properties.times.map((/** @type {string} */ time) => Date.parse(time) / 1000) },
  }));
}
