// Details of a decode: the chosen readings cell by cell, positions with their accuracy, what was left out.

import { html } from "htm/preact";

import { Facts } from "../components/facts.js";
import { ProblemBox } from "../components/problem.js";
import { Problem } from "../api/client.js";
import { number } from "../format.js";
import { t, textOr } from "../texts/index.js";
import { frameAt } from "./decode_frames.js";
import { FrameFix, Readings } from "./decode_plates.js";
import { Lane, Packets } from "./decode_packets.js";
import { TagFix, Tags } from "./decode_traces.js";

const MAX_GAPS = 20;

/**
 * @param {{ source: import("./decode_timeline.js").Source, timeline: import("./decode_timeline.js").Timeline, chosen: any, image: HTMLImageElement | null }} props
 */
export function Details({ source, timeline, chosen, image }) {
  const { decode } = source;
  if (decode.kind === "trace") return html`<${Parts} decode=${decode} readings=${html`<${Tags} decode=${decode} />`} position=${html`<${TagFix} decode=${decode} />`} />`;
  if (decode.kind === "packets") return html`<${Parts} decode=${decode} readings=${html`<${Packets} decode=${decode} />`} position=${html`<${Lane} decode=${decode} />`} />`;
  const frame = frameAt(source, timeline.cursor.value);
  const readings = (decode.readings ?? []).filter((/** @type {any} */ reading) => reading.frame === frame?.frame);
  const first = readings.findIndex((/** @type {any} */ reading) => chosen && (reading.digits ?? reading.likely_digits ?? null) === chosen.code);
  if (first > 0) readings.unshift(...readings.splice(first, 1));
  return html`
    <${Parts} decode=${decode} readings=${html`<${Readings} readings=${readings} image=${image} /><${Seen} decode=${decode} />`}
      position=${html`<${FrameFix} decode=${{ fix: frame?.fix ?? null, readings }} /><${FrameTimes} frame=${frame} /><${Gaps} decode=${decode} />`} />
  `;
}

/** @param {{ decode: any, readings: any, position: any }} props */
function Parts({ decode, readings, position }) {
  return html`
    <div class="columns decode-part">
      <section class="card"><h2>${t(["trace", "packets"].includes(decode.kind) ? "decode.findings" : "decode.in_frame")}</h2><div class="findings">${readings}</div></section>
      <section class="card"><h2>${t("decode.position")}</h2><div class="fix">${position}</div></section>
    </div>
  `;
}

/** Plates of a video, each with its frames. @param {{ decode: any }} props */
function Seen({ decode }) {
  if (!decode.plates?.length) return null;
  return html`<h3>${t("decode.seen_plates")}</h3><ul class="plain">${decode.plates.map((/** @type {any} */ plate) => {
    const words = t("decode.video_plate", { code: plate.digits || textOr(`outcome.${plate.outcome}`, plate.outcome), frames: plate.frames.length, first: plate.frames[0] });
    return html`<li>${plate.marker_id ? html`<a href=${`/markers/${plate.marker_id}`}>${words}</a>` : words}${plate.reason && html` <span class="hint">${plate.reason}</span>`}</li>`;
  })}</ul>`;
}

/** @param {{ frame: any }} props */
function FrameTimes({ frame }) {
  if (!frame) return null;
  return html`
    ${frame.error && html`<${ProblemBox} error=${new Problem({ title: t("decode.failed"), ...frame.error })} />`}
    <${Facts} of=${[
      [t("field.captured_at"), frame.captured_at],
      [t("decode.pose"), frame.pose && `${frame.pose.lat_deg.toFixed(6)}, ${frame.pose.lon_deg.toFixed(6)} (${textOr(`decode.source_${frame.pose.source}`, frame.pose.source)})`],
      [t("decode.decode_ms"), number(frame.decode_ms, 1, "ms")],
    ]} />
  `;
}

/** Frames that could not be read, and stretches without any. @param {{ decode: any }} props */
function Gaps({ decode }) {
  const failed = (decode.frames ?? []).filter((/** @type {any} */ frame) => frame.error);
  const gaps = decode.gaps ?? [];
  if (!failed.length && !gaps.length) return null;
  return html`<h3>${t("decode.left_out")}</h3><ul class="plain small">
    ${failed.slice(0, MAX_GAPS).map((/** @type {any} */ frame) => html`<li>${frame.name ?? t("decode.frame_number", { number: frame.frame })}: ${frame.error.detail ?? frame.error.title} <span class="hint">${frame.error.cure}</span></li>`)}
    ${gaps.slice(0, MAX_GAPS).map((/** @type {any} */ gap) => html`<li>${gap.reason}${gap.seconds ? `, ${number(gap.seconds, 1, "s")}` : ""}</li>`)}
  </ul>`;
}

