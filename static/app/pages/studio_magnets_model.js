// A magnet tag as a value, and the field of its magnets as point dipoles.
// Frame: metres from the first magnet, x in the direction of travel, y to the left, z up from the road's surface.

/** @typedef {{ x: number, sign: 1 | -1, up: boolean }} Magnet */
/** @typedef {{ magnets: Magnet[], gaps: number[], length: number, segment: number | null }} Tag Lengths in metres. */

const MOMENT_AM2 = 2.47; // of METRO's magnet: MOMENT_AM2 of app/markers/magnet.py
const FIELD_UT_M3 = 0.1; // mu0 / (4 pi): FIELD_UT_M3 of app/markers/magnet.py
export const NOISE_UT = 1.5; // of a sample: noise_ut of app/markers/magnet_design.py
export const SAMPLE_RATE_HZ = 350; // of the magnetometers: sample_rate_hz of app/markers/magnet_design.py
const MAGNETS = 7;
const INFORMATION = /^([NS]{2,7})_(\d{1,3}(?:\.\d{1,4})?)_(\d{1,3}(?:\.\d{1,4})?)_(\d{1,5}(?:-\d{1,5}){0,5})$/;

/**
 * A tag of its canonical text, e.g. `SNS_4_0.1_10-30` or `N_90`; null if it is none.
 *
 * @param {string} text
 * @returns {Tag | null}
 */
export function parseTag(text) {
  if (text === "N_90" || text === "S_90") return { magnets: [{ x: 0, sign: signOf(text[0]), up: true }], gaps: [], length: 0, segment: null };
  const [, polarities, length, segment, gaps] = INFORMATION.exec(text) ?? [];
  if (!polarities || !gaps) return null;
  const steps = gaps.split("-").map(Number);
  const whole = steps.reduce((sum, step) => sum + step, 0);
  if (steps.length !== polarities.length - 1 || polarities.length > MAGNETS || steps.some((step) => step < 1)) return null;
  if (Math.abs(whole * Number(segment) - Number(length)) > 1e-6) return null;
  let x = 0;
  const places = [0, ...steps.map((step) => (x += step * Number(segment)))];
  return {
    magnets: [...polarities].map((letter, k) => ({ x: places[k] ?? 0, sign: signOf(letter), up: false })),
    gaps: steps.map((step) => step * Number(segment)),
    length: Number(length),
    segment: Number(segment),
  };
}

/** @param {string | undefined} letter @returns {1 | -1} */
const signOf = (letter) => (letter === "N" ? 1 : -1);

/**
 * The field of a tag at a place: B = mu0 / (4 pi) (3 r (r.m) / r^2 - m) / r^3.
 *
 * @param {Tag} tag
 * @param {number} x
 * @param {number} y
 * @param {number} height_m Of the place above the magnets.
 * @returns {[number, number, number]} Forward, left, up. [uT]
 */
export function fieldAt(tag, x, y, height_m) {
  let [bx, by, bz] = [0, 0, 0];
  for (const magnet of tag.magnets) {
    const dx = x - magnet.x;
    const square = dx * dx + y * y + height_m * height_m;
    const moment = magnet.sign * MOMENT_AM2;
    const along = (3 * moment * (magnet.up ? height_m : dx)) / square;
    const scale = FIELD_UT_M3 / (square * Math.sqrt(square));
    bx += scale * (along * dx - (magnet.up ? 0 : moment));
    by += scale * along * y;
    bz += scale * (along * height_m - (magnet.up ? moment : 0));
  }
  return [bx, by, bz];
}

/** One of the components, or the strength. @param {[number, number, number]} field @param {string} axis */
export function componentOf(field, axis) {
  if (axis === "total") return Math.hypot(...field);
  return field[axis === "x" ? 0 : axis === "y" ? 1 : 2];
}
