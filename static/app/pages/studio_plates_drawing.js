// A plate from above and from the side, to scale, with its dimensions in millimetres.

import { html } from "htm/preact";

import { number } from "../format.js";
import { t, textOr } from "../texts/index.js";

/** @typedef {import("./studio_plates_draft.js").PlateDraft} PlateDraft */
/** @typedef {{ x1: number, y1: number, x2: number, y2: number }} Line Ends of a dimension line. [mm] */

/**
 * The drawing. Its frame is in millimetres from the plate's upper left corner, y down.
 *
 * @param {{ plate: PlateDraft, chosen: string }} props `chosen`: name of the dimension that is emphasised.
 */
export function PlateDrawing({ plate, chosen }) {
  const { side_mm: side, thickness_mm: thick } = plate.geometry;
  const text = side * 0.04;
  const profile = side + text * 6.2;
  const box = [-text * 1.2, -text * 7.2, side + text * 6.4, profile + thick + text * 10.6];
  return html`
    <svg class="plate-drawing" viewBox=${box.join(" ")} role="img" aria-label=${t("studio.drawing_of", { digits: plate.code.grouped_digits, side: number(side, 0, "mm") })}>
      <${Face} plate=${plate} />
      <rect class="profile" x="0" y=${profile} width=${side} height=${thick} />
      <g class="travel"><path d=${arrow(side / 2, -text * 4.6, text)} /><text x=${side / 2 + text} y=${-text * 5.1} font-size=${text * 0.85}>${t("studio.travel")}</text></g>
      <text class="unit-note" x=${side + text * 5} y=${profile + thick + text * 2.6} font-size=${text * 0.85} text-anchor="end">${t("studio.in_mm")}</text>
      ${dimensionsOf(plate, text, profile).map((one) => html`<${Dimension} key=${one.name} ...${one} text=${text} chosen=${chosen === one.name} />`)}
    </svg>
  `;
}

/** Base, units and boundary markers. @param {{ plate: PlateDraft }} props */
export function Face({ plate }) {
  const { n, unit_mm: unit, gap_mm: gap, side_mm: side } = plate.geometry;
  const pitch = unit + gap;
  const colours = Object.fromEntries(plate.colours.map(({ layer, screen }) => [layer, screen]));
  const cells = plate.units.flatMap((row, r) => [...row].map((kind, c) => ({ kind, x: gap + c * pitch, y: gap + r * pitch })));
  const path = (/** @type {string} */ wanted) => cells.filter(({ kind }) => kind === wanted).map(({ x, y }) => `M${x} ${y}h${unit}v${unit}h${-unit}z`).join("");
  const mark = 2 * unit + gap;
  const far = gap + (n - 2) * pitch;
  return html`
    <rect width=${side} height=${side} fill=${colours.BASE} />
    <path d=${path("0")} fill=${colours.CODE_LIGHT} />
    <path d=${path("1")} fill=${colours.CODE_DARK} />
    <path d=${`M${gap} ${gap}h${mark}l${-mark} ${mark}z`} fill=${colours.MARK_RED} />
    ${[[far, gap], [far, far], [gap, far]].map(([x, y]) => html`<rect x=${x} y=${y} width=${mark} height=${mark} fill=${colours.MARK_GREEN} />`)}
    <rect class="edge" width=${side} height=${side} />
  `;
}

/**
 * Where each dimension is drawn: `from` and `to` on the plate, and its line beside it.
 *
 * @param {PlateDraft} plate
 * @param {number} text
 * @param {number} profile Top of the view from the side. [mm]
 */
function dimensionsOf(plate, text, profile) {
  const { n, unit_mm: unit, gap_mm: gap, side_mm: side, thickness_mm: thick } = plate.geometry;
  const pitch = unit + gap;
  const at = (/** @type {number} */ k) => gap + k * pitch; // where unit k begins
  const top = -text * 1.6;
  const right = side + text * 1.8;
  const across = (/** @type {number} */ x1, /** @type {number} */ x2, /** @type {number} */ y) => ({ x1, y1: y, x2, y2: y });
  const down = (/** @type {number} */ y1, /** @type {number} */ y2, /** @type {number} */ x) => ({ x1: x, y1, x2: x, y2 });
  const middle = n / 2;
  return [
    { name: "marker", value: 2 * unit + gap, line: across(gap, gap + 2 * unit + gap, top), to: 0 },
    { name: "unit", value: unit, line: across(at(middle), at(middle) + unit, top), to: 0 },
    { name: "gap", value: gap, line: across(at(middle + 1) + unit, at(middle + 2), top), to: 0 },
    { name: "side", value: side, line: across(0, side, side + text * 2), to: side },
    { name: "pitch", value: pitch, line: down(at(2), at(3), right), to: side },
    { name: "border", value: gap, line: down(side - gap, side, right), to: side },
    { name: "thickness", value: thick, line: down(profile, profile + thick, right), to: side },
    { name: "diagonal", value: side * Math.SQRT2, line: { x1: 0, y1: side, x2: side, y2: 0 }, to: null },
  ];
}

/** @param {{ name: string, value: number, line: Line, to: number | null, text: number, chosen: boolean }} props */
function Dimension({ name, value, line, to, text, chosen }) {
  const { x1, y1, x2, y2 } = line;
  if (to === null) {
    return chosen && html`<g class="dimension chosen"><path d=${`M${x1} ${y1}L${x2} ${y2}`} /><text x=${(x1 + x2) / 2 + text} y=${(y1 + y2) / 2} font-size=${text}>${millimetres(value)}</text></g>`;
  }
  const flat = y1 === y2;
  const length = flat ? x2 - x1 : y2 - y1;
  const narrow = length < text * 1.6;
  const over = text * 0.5;
  const ends = flat
    ? `M${x1} ${to}L${x1} ${y1 + Math.sign(y1 - to) * over}M${x2} ${to}L${x2} ${y1 + Math.sign(y1 - to) * over}`
    : `M${to} ${y1}L${x1 + over} ${y1}M${to} ${y2}L${x1 + over} ${y2}`;
  const out = narrow ? text * 1.1 : 0;
  const main = flat ? `M${x1 - out} ${y1}L${x2 + out} ${y1}` : `M${x1} ${y1 - out}L${x1} ${y2 + out}`;
  const side = flat ? (y1 < to ? -0.45 : 1.25) : 0.35;
  return html`
    <g class=${chosen ? "dimension chosen" : "dimension"}>
      <title>${textOr(`dimension.${name}`, name)}</title>
      <path class="extension" d=${ends} />
      <path d=${main} />
      <path class="heads" d=${heads(line, flat, narrow, text * 0.45)} />
      <text x=${flat ? (x1 + x2) / 2 : x1 + text * 0.6} y=${flat ? y1 + side * text : (y1 + y2) / 2 + side * text} font-size=${text} text-anchor=${flat ? "middle" : "start"}>${millimetres(value)}</text>
    </g>
  `;
}

/** Arrow heads, from outside where the line is short. @param {Line} line @param {boolean} flat @param {boolean} narrow @param {number} size */
function heads({ x1, y1, x2, y2 }, flat, narrow, size) {
  const way = narrow ? -1 : 1;
  return [[x1, y1, way], [x2, y2, -way]].map((end) => {
    const [x, y, sign] = /** @type {[number, number, number]} */ (end);
    return flat
      ? `M${x} ${y}L${x + sign * size * 1.8} ${y - size * 0.6}V${y + size * 0.6}z`
      : `M${x} ${y}L${x - size * 0.6} ${y + sign * size * 1.8}H${x + size * 0.6}z`;
  }).join("");
}

/** @param {number} x @param {number} bottom @param {number} size */
const arrow = (x, bottom, size) => `M${x} ${bottom - size * 2}l${size * 0.6} ${size}h${-size * 0.4}v${size}h${-size * 0.4}v${-size}h${-size * 0.4}z`;

/** @param {number} value */
const millimetres = (value) => number(value, Number.isInteger(Math.round(value * 1000) / 1000) ? 0 : 1);
