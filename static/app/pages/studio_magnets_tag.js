// A tag from above: magnets with their poles, the distances between them, and the direction of travel.

import { html } from "htm/preact";

import { number } from "../format.js";
import { useWidth } from "../components/width.js";
import { t } from "../texts/index.js";

/** @typedef {import("./studio_magnets_model.js").Tag} Tag */

const START_PX = 720;
const SIDE = 36;
const MAGNET = 15; // [mm] side of METRO's magnet, drawn larger than to scale

/** @param {{ tag: Tag }} props */
export function TagDrawing({ tag }) {
  const [box, width] = useWidth(START_PX);
  const scale = (width - 2 * SIDE) / Math.max(tag.length, 1);
  const start = tag.length ? SIDE : width / 2;
  const x = (/** @type {number} */ along) => start + along * scale;
  const row = 96;
  return html`
    <div ref=${box}>
    <svg class="tag-drawing" viewBox=${`0 0 ${width} 216`} role="img" aria-label=${describe(tag)}>
      <rect class="lane" x="0" y=${row - 44} width=${width} height="88" />
      <path class="grid" d=${gridOf(tag, x, row)} />
      <path class="axis" d=${`M8 ${row}H${width - 8}`} />
      <path class="way" d=${`M${width - 8} ${row}l-12 -5v10z`} />
      <text class="note" x=${width - 8} y=${row - 52} text-anchor="end">${t("studio.travel")} →</text>
      ${tag.magnets.map((magnet, k) => html`
        <g class=${magnet.sign > 0 ? "magnet north" : "magnet south"}>
          ${magnet.up ? upright(x(magnet.x), row) : lying(x(magnet.x), row, magnet.sign)}
          <text x=${x(magnet.x)} y=${row - 24} text-anchor="middle">${magnet.sign > 0 ? "N" : "S"}</text>
          <text class="note" x=${x(magnet.x)} y=${row + 36} text-anchor="middle">${k + 1}</text>
        </g>
      `)}
      ${tag.gaps.map((gap, k) => html`<${Distance} from=${x(tag.magnets[k]?.x ?? 0)} to=${x(tag.magnets[k + 1]?.x ?? 0)} y=${164} text=${number(gap, 2, "m")} />`)}
      ${tag.length > 0 && html`<${Distance} from=${x(0)} to=${x(tag.length)} y=${200} text=${number(tag.length, 2, "m")} />`}
    </svg>
    </div>
    <p class="hint">${t(tag.length ? "magnets.drawing_note" : "magnets.line_note", { side: MAGNET })}</p>
  `;
}

/** @param {Tag} tag */
function describe(tag) {
  const poles = tag.magnets.map(({ sign }) => (sign > 0 ? "N" : "S")).join(", ");
  return t("magnets.drawing_alt", { count: tag.magnets.length, poles, gaps: tag.gaps.map((gap) => number(gap, 2, "m")).join(", ") || "–" });
}

/** A magnet that lies along the lane: its north half is filled. @param {number} x @param {number} y @param {1 | -1} sign */
function lying(x, y, sign) {
  return html`
    <rect class="body" x=${x - 16} y=${y - 9} width="32" height="18" />
    <rect class="pole" x=${sign > 0 ? x : x - 16} y=${y - 9} width="16" height="18" />
    <path class="arrow" d=${`M${x - 9 * sign} ${y}H${x + 5 * sign}M${x + 11 * sign} ${y}l${-7 * sign} -4v8z`} />
  `;
}

/** @param {number} x @param {number} y */
function upright(x, y) {
  return html`<circle class="body" cx=${x} cy=${y} r="12" /><circle class="pole" cx=${x} cy=${y} r="5" />`;
}

/** Ticks of the segments, where they are not too close. @param {Tag} tag @param {(along: number) => number} x @param {number} y */
function gridOf(tag, x, y) {
  const { segment, length } = tag;
  if (!segment || x(segment) - x(0) < 3) return "";
  return Array.from({ length: Math.round(length / segment) + 1 }, (_, k) => `M${x(k * segment)} ${y - 5}v10`).join("");
}

/** @param {{ from: number, to: number, y: number, text: string }} props */
function Distance({ from, to, y, text }) {
  return html`
    <g class="dimension">
      <path class="extension" d=${`M${from} 140V${y + 5}M${to} 140V${y + 5}`} />
      <path d=${`M${from} ${y}H${to}`} />
      <path class="heads" d=${`M${from} ${y}l8 -3.5v7zM${to} ${y}l-8 -3.5v7z`} />
      <text x=${(from + to) / 2} y=${y - 5} text-anchor="middle">${text}</text>
    </g>
  `;
}
