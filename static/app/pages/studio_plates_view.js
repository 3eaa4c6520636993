// A picture of one frame: what the camera sees, the plate enlarged, and what the decoder reads in it.

import { html } from "htm/preact";
import { useEffect, useRef } from "preact/hooks";

import { request } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { ProblemBox } from "../components/problem.js";
import { useLive } from "../components/query_form.js";
import { SelectField } from "../components/form.js";
import { number } from "../format.js";
import { t, textOr } from "../texts/index.js";
import { jsonText, plateText } from "./studio_plates_draft.js";

const CONDITIONS = ["day", "night", "rain", "shade", "wear", "dirt"];
const FAR_M = 18;
const LENS_PX = 480; // of the enlarged part
const READINGS = /** @type {const} */ ({ alone: "good", "with-registry": "good", "not-read": "bad" });

/** @typedef {{ bitmap: ImageBitmap, corners: number[][], reading: keyof typeof READINGS, confidence: number, exposure_s: number }} View */

/**
 * @param {{ typed: import("../components/query_form.js").QueryForm, body: any, draft: import("./studio_plates_draft.js").Draft,
 *   pass: import("../api/schema.js").components["schemas"]["CameraPass"] }} props
 */
export function CameraPicture({ typed, body, draft, pass }) {
  const ahead = Number(String(typed.values.ahead_m).replace(",", ".")) || 4;
  const condition = String(typed.values.condition);
  const key = plateText({ ...body, ahead_m: ahead, condition });
  const view = useLive((signal) => loadView(key, signal), key, 500);
  const sees = view.data;
  return html`
    <section class=${view.error ? "card camera-view stale" : "card camera-view"} aria-busy=${view.loading}>
      <h2>${t("studio.picture")}</h2>
      <div class="group">
        <div class="field">
          <label for="ahead">${t("studio.ahead", { ahead: number(ahead, 1, "m") })}</label>
          <input id="ahead" name="ahead_m" type="range" min="0.5" max=${FAR_M} step="0.1" value=${ahead} onInput=${(/** @type {any} */ event) => typed.set("ahead_m", event.currentTarget.value)} />
          <p class="hint">${pass.near_m === null ? t("studio.never_readable") : t("studio.readable_between", { near: number(pass.near_m, 1, "m"), far: number(pass.far_m, 1, "m") })}</p>
        </div>
        <${SelectField} form=${typed} path="condition" label=${t("studio.condition")} options=${CONDITIONS.map((name) => [name, textOr(`condition.${name}`, name)])} />
      </div>
      <${ProblemBox} error=${view.error} />
      ${sees ? html`
        <p role="status"><${Verdict} level=${READINGS[sees.reading]}>${t(`studio.reading_${sees.reading}`, { confidence: number(sees.confidence * 100, 1, "%") })}</${Verdict}>
          <span class="hint"> ${t("studio.picture_exposure", { exposure: number(sees.exposure_s * 1000, 2, "ms") })}</span></p>
        <div class="camera-pictures">
          <${Canvas} view=${sees} label=${t("studio.picture_alt", { digits: draft.plate?.code.grouped_digits ?? "", ahead: number(ahead, 1, "m") })} draw=${drawFrame} />
          ${sees.corners.length > 0 && html`<${Canvas} view=${sees} label=${t("studio.enlarged_alt")} draw=${drawEnlarged} />`}
        </div>
        <p class="hint">${t(sees.corners.length ? "studio.picture_note" : "studio.out_of_view")}</p>
      ` : !view.error && html`<p class="loading" role="status">${t("studio.rendering")}</p>`}
    </section>
  `;
}

/** @param {string} body @param {AbortSignal} signal @returns {Promise<View>} */
async function loadView(body, signal) {
  const response = await request("/v1/plate-drafts/view", { ...jsonText(body), signal });
  const [reading, confidence] = (response.headers.get("Waymark-Reading") ?? "not-read").split(" confidence=");
  const corners = (response.headers.get("Waymark-Corners") ?? "").split(" ").filter(Boolean).map((pair) => pair.split(",").map(Number));
  return {
    bitmap: await createImageBitmap(await response.blob()),
    corners,
    reading: /** @type {keyof typeof READINGS} */ (reading),
    confidence: Number(confidence),
    exposure_s: Number(response.headers.get("Waymark-Exposure")),
  };
}

/** @param {{ view: View, label: string, draw: (context: CanvasRenderingContext2D, view: View) => void }} props */
function Canvas({ view, label, draw }) {
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  useEffect(() => {
    const context = canvas.current?.getContext("2d");
    if (context) draw(context, view);
  }, [view]);
  return html`<canvas class="picture" role="img" aria-label=${label} ref=${canvas}></canvas>`;
}

/** The whole frame; a frame around the enlarged part. @param {CanvasRenderingContext2D} context @param {View} view */
function drawFrame(context, view) {
  const { width, height } = view.bitmap;
  Object.assign(context.canvas, { width, height });
  context.drawImage(view.bitmap, 0, 0);
  const part = partOf(view);
  if (!part) return;
  for (const [colour, line] of [["#000", 5], ["#ffd34d", 3]]) {
    context.strokeStyle = String(colour);
    context.lineWidth = (Number(line) * width) / 1400;
    context.strokeRect(part.x, part.y, part.size, part.size);
  }
}

/** The plate, each pixel of the camera as a square. @param {CanvasRenderingContext2D} context @param {View} view */
function drawEnlarged(context, view) {
  const part = partOf(view);
  if (!part) return;
  Object.assign(context.canvas, { width: LENS_PX, height: LENS_PX });
  context.imageSmoothingEnabled = false;
  context.drawImage(view.bitmap, part.x, part.y, part.size, part.size, 0, 0, LENS_PX, LENS_PX);
}

/** A square around the plate. @param {View} view */
function partOf({ corners }) {
  if (!corners.length) return null;
  const xs = corners.map(([x]) => x ?? 0);
  const ys = corners.map(([, y]) => y ?? 0);
  const size = Math.ceil(1.15 * Math.max(Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys)));
  return { x: Math.round((Math.max(...xs) + Math.min(...xs) - size) / 2), y: Math.round((Math.max(...ys) + Math.min(...ys) - size) / 2), size };
}
