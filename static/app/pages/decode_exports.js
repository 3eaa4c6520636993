// Results as files: readings and the track, as CSV, GeoJSON and GPX, pictures and the whole document.

import { html } from "htm/preact";

import { download, save } from "../api/client.js";
import { attempt } from "../components/notices.js";
import { t } from "../texts/index.js";

/** @param {{ decode: any, hasTrack: boolean }} props */
export function Exports({ decode, hasTrack }) {
  const { links, id } = decode;
  const base = (decode.file_name ?? `decode-${id}`).replace(/\.[^.]+$/, "");
  /** @type {[string, string, string][]} */
  const files = [
    [t("decode.export_readings", { form: "CSV" }), `${links.self}/readings.csv`, `${base}-readings.csv`],
    [t("decode.export_readings", { form: "GeoJSON" }), `${links.self}/readings.geojson`, `${base}-readings.geojson`],
  ];
  if (hasTrack) {
    for (const form of ["GPX", "GeoJSON", "CSV"]) files.push([t("decode.export_track", { form }), `${links.self}/track.${form.toLowerCase()}`, `${base}-track.${form.toLowerCase()}`]);
  }
  if (links.lane && !decode.lane?.refusal) files.push([t("decode.download_path"), links.lane, `${base}-lane.geojson`]);
  if (links.plot) files.push([t("decode.export_plot"), links.plot, `${base}.svg`]);
  if (links.overlay) files.push([t("decode.export_overlay"), links.overlay, `${base}-overlay.jpg`]);
  if (links.annotated && decode.frames?.length) files.push([t("decode.export_frame"), links.annotated, `${base}-annotated.jpg`]);
  const json = () => save(new Blob([JSON.stringify(decode, null, 1)], { type: "application/json" }), `${base}.json`);
  return html`
    <details class="choice exports">
      <summary>${t("decode.export")}</summary>
      <div class="choice-list">
        ${files.map(([words, path, name]) => html`<button type="button" class="quiet" onClick=${() => attempt(() => download(path, name))}>${words}</button>`)}
        <button type="button" class="quiet" onClick=${json}>${t("decode.export_json")}</button>
      </div>
    </details>
  `;
}
