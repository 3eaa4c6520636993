// Files of one marker: artwork of plates and signs, layouts of magnets, messages of CERPMs.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

import { download, request } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Shown, useLoad } from "../components/load.js";
import { attempt } from "../components/notices.js";
import { Picture } from "../components/picture.js";
import { PlacePlot } from "../components/place_plot.js";
import { codeOf } from "../format.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";

/** @typedef {import("../api/schema.js").components["schemas"]} Schemas */

/** @param {{ marker: import("./markers_panel.js").MarkerDetail }} props */
export function FilesOf({ marker }) {
  if (marker.family === "magnet") return html`<${Layout} marker=${marker} />`;
  if (marker.family === "cerpm") return html`<${Message} marker=${marker} />`;
  return html`<${Artwork} marker=${marker} />`;
}

/** @param {{ forms: string[], label: string, path: (form: string) => string, name: (form: string) => string }} props */
function Downloads({ forms, label, path, name }) {
  return html`
    <div class="buttons" role="group" aria-label=${label}>
      ${forms.map((form) => html`<button type="button" class="quiet" onClick=${() => attempt(() => download(path(form), name(form)))}>${form.toUpperCase()}</button>`)}
    </div>
  `;
}

/** @param {{ marker: Schemas["PlateDocument"] | Schemas["FiducialDocument"] }} props */
function Artwork({ marker }) {
  const [proof, setProof] = useState("");
  const code = codeOf(marker);
  const path = (/** @type {string} */ form) => `/v1/markers/${marker.id}/artwork.${form}`;
  return html`
    <${Picture} kind="artwork" key=${marker.version} path=${path("svg")} alt=${t("marker.artwork_of", { code })} onResponse=${(/** @type {Response} */ response) => setProof(response.headers.get("Waymark-Proof") ?? "")} />
    ${proof && html`<p class="hint">${t("marker.proof", { proof })}</p>`}
    <${Downloads} forms=${["pdf", "svg", "dxf", "png"]} label=${t("marker.download_artwork")} path=${path} name=${(/** @type {string} */ form) => `${code}.${form}`} />
  `;
}

/** @param {{ marker: Schemas["MagnetDetailDocument"] }} props */
function Layout({ marker }) {
  const places = marker.magnets.map((magnet) => ({
    lon_deg: magnet.lon_deg, lat_deg: magnet.lat_deg, heading_deg: magnet.north_pole_bearing_deg,
    label: t("marker.magnet", { number: magnet.number, pole: magnet.north_pole }), kind: magnet.polarity === "N" ? "chosen" : "",
  }));
  return html`
    <${PlacePlot} places=${places} label=${t("marker.magnets_plot")} least_m=${4} />
    <${Downloads} forms=${["pdf", "csv", "geojson"]} label=${t("marker.download_layout")} path=${(/** @type {string} */ form) => `/v1/markers/${marker.id}/layout.${form}`}
      name=${(/** @type {string} */ form) => `${marker.id}-r${marker.version}.${form}`} />
    <h4>${t("marker.checks")}</h4>
    <ul class="plain">
      ${marker.checks.map((check) => html`
        <li title=${`${check.note} (${check.source})`}><${Verdict} level=${check.passed ? "good" : "warn"}>${t(check.passed ? "marker.check_passed" : "marker.check_warning")}</${Verdict}> ${check.name}: ${check.figure} ${check.relation} ${check.limit} ${check.unit}</li>
      `)}
    </ul>
  `;
}

/** @param {{ marker: Schemas["CerpmDocument"] }} props */
function Message({ marker }) {
  if (!may("GET /v1/markers/{marker_id}/payload.{form}")) return html`<p class="hint">${t("marker.message_hidden")}</p>`;
  return html`<${VisibleMessage} marker=${marker} />`;
}

/** @param {{ marker: Schemas["CerpmDocument"] }} props */
function VisibleMessage({ marker }) {
  const payload = useLoad(async (signal) => (await request(`/v1/markers/${marker.id}/payload.json`, { signal })).json(), [marker.id, marker.version]);
  return html`
    <${Shown} of=${payload}>${(/** @type {any} */ found) => html`
      <p class="code wrap">${found.hex}</p>
      <${Downloads} forms=${["bin", "hex", "json"]} label=${t("marker.download_message")} path=${(/** @type {string} */ form) => `/v1/markers/${marker.id}/payload.${form}`}
        name=${(/** @type {string} */ form) => `cerpm-${marker.code.number}.${form}`} />
      <div class="table-scroll plain-table" tabindex="0" role="region" aria-label=${t("marker.message")}>
        <table>
          <thead><tr>${["bytes", "hex", "field", "value"].map((name) => html`<th scope="col">${textOr(`message.${name}`, name)}</th>`)}</tr></thead>
          <tbody>${found.bytes.map((/** @type {any} */ part) => html`
            <tr><td>${part.length === 1 ? part.offset : `${part.offset}–${part.offset + part.length - 1}`}</td><td class="code">${part.hex}</td><td>${part.field}</td><td>${part.value}</td></tr>
          `)}</tbody>
        </table>
      </div>
      ${found.note && html`<p class="hint">${found.note}</p>`}
    `}</${Shown}>
  `;
}
