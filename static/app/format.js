// How values are written. A value that is not there is a dash, never the word null.

import { language } from "./texts/index.js";

export const MISSING = "–";

/**
 * A number with a fixed count of decimals, in the language's notation.
 *
 * @param {number | null | undefined} value
 * @param {number} [digits]
 * @param {string} [unit]
 */
export function number(value, digits = 0, unit = "") {
  if (value === null || value === undefined || !Number.isFinite(value)) return MISSING;
  const text = value.toLocaleString(language.value, { minimumFractionDigits: digits, maximumFractionDigits: digits });
  return unit ? `${text}${unit === "°" ? "" : "\u00a0"}${unit}` : text;
}

/**
 * Degrees with a point and without groups, as they are copied into other programs.
 *
 * @param {number | null | undefined} value
 * @param {number} [digits]
 */
export function degrees(value, digits = 7) {
  return value === null || value === undefined ? MISSING : value.toFixed(digits);
}

/**
 * A time in UTC, to the minute.
 *
 * @param {string | null | undefined} value
 */
export function time(value) {
  return value ? `${value.slice(0, 10)} ${value.slice(11, 16)}` : MISSING;
}

/**
 * A text, or a dash.
 *
 * @param {string | number | null | undefined} value
 */
export function text(value) {
  return value === null || value === undefined || value === "" ? MISSING : String(value);
}

/** @param {number} bytes */
export function fileSize(bytes) {
  return bytes < 1e6 ? number(Math.ceil(bytes / 1000), 0, "kB") : number(bytes / 1e6, 1, "MB");
}

/**
 * The code of a marker as people write it.
 *
 * @param {any} marker
 * @returns {string}
 */
export function codeOf(marker) {
  const { code } = marker;
  return String(code.digits ?? code.text ?? code.number ?? code.id ?? MISSING);
}
