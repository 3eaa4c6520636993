// Calibrate the camera of a vehicle from photos of a printed board.

import { html } from "htm/preact";
import { useId, useState } from "preact/hooks";

import { api, download, ok, Problem, request } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Facts } from "../components/facts.js";
import { FormFrame, Group, TextField, useForm } from "../components/form.js";
import { attempt, notify } from "../components/notices.js";
import { MISSING, number } from "../format.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";

const BOARD = { columns: "7", rows: "10", square_mm: "25", marker_mm: "18" };
const GOOD_PX = 0.5;

/** @param {{ vehicle: any, onChanged: () => void }} props */
export function Calibration({ vehicle, onChanged }) {
  const id = useId();
  const form = useForm(Object.fromEntries(Object.entries(BOARD).map(([name, value]) => [`board.${name}`, value])));
  const [photos, setPhotos] = useState(/** @type {File[]} */ ([]));
  const [found, setFound] = useState(/** @type {any} */ (null));
  const board = () => Object.fromEntries(Object.keys(BOARD).map((name) => {
    const text = String(form.values[`board.${name}`] ?? "");
    return [name, Number.isFinite(Number(text)) ? Number(text) : text];
  }));
  const submit = async () => {
    if (!photos.length) throw new Problem({ title: t("calibration.no_photos"), detail: "", field: "photos", limit: t("calibration.limit"), cure: t("calibration.cure") });
    const parts = new FormData();
    for (const photo of photos) parts.append("photos", photo, photo.name);
    parts.append("declaration", JSON.stringify({ board: board() }));
    setFound(null);
    setFound(await (await request("/v1/calibrations", { method: "POST", body: parts })).json());
  };
  const print = html`<button type="button" class="quiet" onClick=${() => attempt(() => download(`/v1/calibration-boards/board.pdf?${new URLSearchParams(/** @type {any} */ (board()))}`, "waymark-board.pdf"))}>${t("calibration.board")}</button>`;
  return html`
    <${FormFrame} form=${form} onSubmit=${submit} button=${t("calibration.button")} actions=${print}>
      <div class="field">
        <label for=${id}>${t("calibration.photos")}</label>
        <input id=${id} type="file" name="photos" multiple accept="image/jpeg,image/png,.zip" onChange=${(/** @type {any} */ event) => setPhotos([...event.currentTarget.files])} />
      </div>
      <${Group} title=${t("calibration.board_size")}>
        ${Object.keys(BOARD).map((name) => html`<${TextField} form=${form} path=${`board.${name}`} label=${textOr(`calibration.${name}`, name)} inputmode="decimal" />`)}
      </${Group}>
    </${FormFrame}>
    ${found && html`<${Result} vehicle=${vehicle} found=${found} onChanged=${onChanged} />`}
  `;
}

/** @param {{ vehicle: any, found: any, onChanged: () => void }} props */
function Result({ vehicle, found, onChanged }) {
  const { camera, sigma, views } = found;
  const used = views.filter((/** @type {any} */ view) => view.used).length;
  const pixels = (/** @type {string} */ name) => `${number(camera[name], 2)} ± ${number(sigma[name], 2, "px")}`;
  const use = () => attempt(async () => {
    const changed = await ok(api.PUT("/v1/vehicles/{vehicle_id}/calibration", {
      params: { path: { vehicle_id: vehicle.id }, header: { "If-Match": `"${vehicle.version}"` } }, body: { calibration_id: found.id },
    }));
    notify(t("calibration.stored", { name: changed.name }));
    onChanged();
  });
  return html`
    <div class="calibration">
      <p><${Verdict} level=${found.rms_px < GOOD_PX ? "good" : "warn"}>${t("calibration.error", { px: number(found.rms_px, 3), used, all: views.length })}</${Verdict}></p>
      <${Facts} of=${[
        ["fx", pixels("fx_px")], ["fy", pixels("fy_px")], ["cx", pixels("cx_px")], ["cy", pixels("cy_px")],
        [t("calibration.distortion"), camera.distortion.map((/** @type {number} */ value) => number(value, 4)).join("; ")],
        [t("calibration.tilt"), t("calibration.tilt_text", { deg: number(found.tilt_spread_deg) })],
        [t("calibration.covered"), t("calibration.covered_text", { percent: number(100 * found.coverage.share) })],
      ]} />
      <div class="coverage" role="img" aria-label=${t("calibration.coverage")}>${found.coverage.cells.flat().map((/** @type {number} */ on) => html`<span class=${on ? "on" : undefined}></span>`)}</div>
      ${may("PUT /v1/vehicles/{vehicle_id}/calibration") && html`<p class="actions"><button type="button" onClick=${use}>${t("calibration.use", { name: vehicle.name })}</button></p>`}
      <div class="table-scroll plain-table" tabindex="0" role="region" aria-label=${t("calibration.photos")}>
        <table>
          <thead><tr><th scope="col">${t("calibration.photo")}</th><th scope="col">${t("calibration.is_used")}</th><th scope="col" class="number">${t("calibration.error_px")}</th><th scope="col" class="number">${t("calibration.tilt_deg")}</th></tr></thead>
          <tbody>${views.map((/** @type {any} */ view) => html`
            <tr title=${view.detail}><th scope="row">${view.name}</th><td><${Verdict} level=${view.used ? "good" : "bad"}>${view.used ? t("calibration.yes") : view.reason}</${Verdict}></td>
              <td class="number">${view.rms_px === null ? MISSING : number(view.rms_px, 3)}</td><td class="number">${view.tilt_deg === null ? MISSING : number(view.tilt_deg)}</td></tr>
          `)}</tbody>
        </table>
      </div>
    </div>
  `;
}
