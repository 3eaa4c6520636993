// What is drawn over a frame: corners of a reading, the grid of a plate's units, its bits, and its label.

import { number } from "../format.js";
import { t, textOr } from "../texts/index.js";
import { outcomeOf } from "./decode_list.js";

const COLOURS = /** @type {Record<string, string>} */ ({ read: "#3cdc50", unchecked: "#fabe28", unsure: "#fabe28" });
const REFUSED = "#f05a5a";
const MARGIN = 2.2; // of the part of a frame around a reading, over its size
const PLAIN = { unit_mm: 35, gap_mm: 5 };

/**
 * The part of a frame around a reading, with the frame's proportions.
 *
 * @param {number[][] | null} corners
 * @param {HTMLImageElement} image
 */
export function viewOf(corners, image) {
  if (!corners?.length) return null;
  const [xs, ys] = [corners.map(([x = 0]) => x), corners.map(([, y = 0]) => y)];
  const [left, right, top, bottom] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const ratio = image.naturalWidth / image.naturalHeight;
  const width = Math.min(Math.max((right - left) * MARGIN, (bottom - top) * MARGIN * ratio, 32), image.naturalWidth);
  const height = width / ratio;
  return {
    x: Math.min(Math.max((left + right - width) / 2, 0), image.naturalWidth - width),
    y: Math.min(Math.max((top + bottom - height) / 2, 0), image.naturalHeight - height),
    width,
    height,
  };
}

/**
 * @param {CanvasRenderingContext2D} pen
 * @param {any} reading
 * @param {(point: number[]) => number[]} place Canvas from frame.
 * @param {Set<string>} layers
 * @param {boolean} isChosen
 * @param {number} size Of lines and letters.
 */
export function drawReading(pen, reading, place, layers, isChosen, size) {
  if (!reading.corners_px?.length) return;
  const corners = reading.corners_px.map(place);
  const colour = COLOURS[outcomeOf(reading)] ?? REFUSED;
  const units = unitsOf(reading);
  const at = units ? homography(corners) : null;
  if (units && at && layers.has("bits")) drawBits(pen, units, at);
  if (units && at && layers.has("grid")) drawGrid(pen, units, at, colour, size);
  if (layers.has("outlines")) {
    polygon(pen, corners);
    stroke(pen, "#15191c", 5 * size);
    stroke(pen, colour, (isChosen ? 4 : 2) * size);
    pen.fillStyle = colour; // the corner of the triangle, from which the code is read
    pen.beginPath();
    pen.arc(corners[0][0], corners[0][1], 5 * size, 0, 7);
    pen.fill();
  }
  if (layers.has("labels")) drawLabel(pen, reading, corners, colour, size);
}

/**
 * The units of a plate: dark ones are true. Each digit is a cell of two by two units, its highest bit first; the four
 * corner cells have no digit.
 *
 * @param {any} reading
 * @returns {{ n: number, unit_mm: number, gap_mm: number, dark: (boolean | null)[][], sure: (number | null)[][] } | null}
 */
export function unitsOf(reading) {
  const digits = reading.digits ?? reading.likely_digits;
  const geometry = reading.geometry ?? PLAIN;
  const across = Math.round(Math.sqrt((digits?.length ?? 0) + 4));
  if ((reading.family ?? "plate") !== "plate" || !digits || across * across !== digits.length + 4) return null;
  const n = 2 * across;
  const dark = Array.from({ length: n }, () => /** @type {(boolean | null)[]} */ (new Array(n).fill(null)));
  const sure = Array.from({ length: n }, () => /** @type {(number | null)[]} */ (new Array(n).fill(null)));
  let k = 0;
  for (let cell = 0; cell < across * across; cell += 1) {
    const [row, column] = [Math.floor(cell / across), cell % across];
    if ((row === 0 || row === across - 1) && (column === 0 || column === across - 1)) continue;
    const value = parseInt(digits[k], 16);
    for (let bit = 0; bit < 4; bit += 1) {
      const [i, j] = [2 * row + (bit >> 1), 2 * column + (bit & 1)];
      /** @type {any} */ (dark[i])[j] = Boolean((value >> (3 - bit)) & 1);
      /** @type {any} */ (sure[i])[j] = reading.cell_confidence?.[k] ?? null;
    }
    k += 1;
  }
  return { n, unit_mm: geometry.unit_mm, gap_mm: geometry.gap_mm, dark, sure };
}

/** @param {CanvasRenderingContext2D} pen @param {NonNullable<ReturnType<typeof unitsOf>>} units @param {(x: number, y: number) => number[]} at */
function drawBits(pen, units, at) {
  for (const [i, row] of units.dark.entries()) {
    for (const [j, dark] of row.entries()) {
      if (dark === null) continue;
      const centre = at(middle(units, j), middle(units, i));
      const [right, below] = [at(middle(units, j) + 0.25 / units.n, middle(units, i)), at(middle(units, j), middle(units, i) + 0.25 / units.n)];
      const radius = Math.max((Math.abs(apart(centre, right)) + Math.abs(apart(centre, below))) / 2, 1);
      pen.beginPath();
      pen.arc(centre[0] ?? 0, centre[1] ?? 0, radius, 0, 7);
      pen.fillStyle = dark ? "#10161b" : "#fff";
      pen.fill();
      const sure = units.sure[i]?.[j];
      stroke(pen, sure === null || sure === undefined || sure > 0.99 ? "#3cdc50" : sure > 0.9 ? "#fabe28" : REFUSED, Math.max(radius / 3, 1));
    }
  }
}

/** @param {CanvasRenderingContext2D} pen @param {NonNullable<ReturnType<typeof unitsOf>>} units @param {(x: number, y: number) => number[]} at @param {string} colour @param {number} size */
function drawGrid(pen, units, at, colour, size) {
  pen.beginPath();
  for (let cell = 0; cell <= units.n / 2; cell += 1) {
    const share = edge(units, 2 * cell);
    for (const [from, to] of [[at(share, 0), at(share, 1)], [at(0, share), at(1, share)]]) {
      pen.moveTo(from?.[0] ?? 0, from?.[1] ?? 0);
      pen.lineTo(to?.[0] ?? 0, to?.[1] ?? 0);
    }
  }
  stroke(pen, colour, size);
}

/** Middle of a unit as a share of the side. @param {{ n: number, unit_mm: number, gap_mm: number }} units @param {number} k */
const middle = ({ n, unit_mm, gap_mm }, k) => (gap_mm + k * (unit_mm + gap_mm) + unit_mm / 2) / (n * unit_mm + (n + 1) * gap_mm);

/** Middle of the gap before a unit. @param {{ n: number, unit_mm: number, gap_mm: number }} units @param {number} k */
const edge = ({ n, unit_mm, gap_mm }, k) => (gap_mm / 2 + k * (unit_mm + gap_mm)) / (n * unit_mm + (n + 1) * gap_mm);

/** @param {CanvasRenderingContext2D} pen @param {any} reading @param {number[][]} corners @param {string} colour @param {number} size */
function drawLabel(pen, reading, corners, colour, size) {
  const code = reading.digits ?? reading.likely_digits ?? "";
  const sure = reading.digits ? number(100 * reading.confidence, reading.confidence > 0.9995 ? 0 : 1, "%") : textOr(`outcome.${reading.outcome}`, reading.outcome);
  const words = [code, sure].filter(Boolean).join("  ") || t("decode.readings");
  pen.font = `600 ${Math.round(17 * size)}px ui-monospace, monospace`;
  const width = pen.measureText(words).width + 12 * size;
  const x = Math.min(Math.max(Math.min(...corners.map(([u = 0]) => u)), 0), Math.max(pen.canvas.width - width, 0));
  const y = Math.max(Math.min(...corners.map(([, v = 0]) => v)) - 10 * size, 26 * size);
  pen.fillStyle = "rgb(16 20 24 / 82%)";
  pen.fillRect(x, y - 24 * size, width, 28 * size);
  pen.fillStyle = colour;
  pen.fillText(words, x + 6 * size, y - 4 * size);
}

/** @param {CanvasRenderingContext2D} pen @param {number[][]} corners */
function polygon(pen, corners) {
  pen.beginPath();
  for (const [x = 0, y = 0] of corners) pen.lineTo(x, y);
  pen.closePath();
}

/** @param {CanvasRenderingContext2D} pen @param {string} colour @param {number} width */
function stroke(pen, colour, width) {
  pen.lineWidth = width;
  pen.strokeStyle = colour;
  pen.stroke();
}

/** @param {number[]} a @param {number[]} b */
const apart = ([x0 = 0, y0 = 0], [x1 = 0, y1 = 0]) => Math.hypot(x1 - x0, y1 - y0);

/**
 * The projective map of the unit square (right, down) on four corners, clockwise from the upper left one. Heckbert 1989,
 * section 2.2.3.
 *
 * @param {number[][]} corners
 * @returns {(x: number, y: number) => number[]}
 */
export function homography(corners) {
  const [[x0 = 0, y0 = 0], [x1 = 0, y1 = 0], [x2 = 0, y2 = 0], [x3 = 0, y3 = 0]] = /** @type {[number[], number[], number[], number[]]} */ (corners);
  const [dx1, dx2, sx] = [x1 - x2, x3 - x2, x0 - x1 + x2 - x3];
  const [dy1, dy2, sy] = [y1 - y2, y3 - y2, y0 - y1 + y2 - y3];
  const determinant = dx1 * dy2 - dx2 * dy1 || 1e-12;
  const g = (sx * dy2 - dx2 * sy) / determinant;
  const h = (dx1 * sy - sx * dy1) / determinant;
  return (x, y) => {
    const w = g * x + h * y + 1;
    return [((x1 - x0 + g * x1) * x + (x3 - x0 + h * x3) * y + x0) / w, ((y1 - y0 + g * y1) * x + (y3 - y0 + h * y3) * y + y0) / w];
  };
}
