// The plate that is typed: from the fields to the body of a request, and the server's answer to it.

import { api, jsonBody, ok, Problem, request } from "../api/client.js";
import { bodyOf } from "../components/form.js";
import { useLoad } from "../components/load.js";
import { useLive } from "../components/query_form.js";
import { t } from "../texts/index.js";

/** @typedef {import("../api/schema.js").components["schemas"]["PlateDraftDocument"]} PlateDraft */

/** Fields of a plate, by their names in the address. */
export const PLATE_FIELDS = {
  lon: "position.lon_deg", lat: "position.lat_deg", scheme: "code.scheme", number: "number", digits: "code.digits",
  check: "code.check_digits", mismatch: "code.allow_mismatched_digits", n: "geometry.n", unit: "geometry.unit_mm",
  gap: "geometry.gap_mm", thickness: "geometry.thickness_mm",
};
/** @type {import("../components/form.js").Values} */
export const PLATE_START = {
  "position.lon_deg": "", "position.lat_deg": "", "code.scheme": "id", number: "", "code.digits": "", "code.check_digits": "",
  "code.allow_mismatched_digits": false, "geometry.n": "8", "geometry.unit_mm": "35", "geometry.gap_mm": "5", "geometry.thickness_mm": "20",
};
const ID = /^[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}$/i;
const NUMBER_HERE = '"@number"';

/** @param {import("../components/form.js").Values} values @returns {string} The id of a marker that was typed, or "". */
export function markerIdOf(values) {
  const text = String(values.number ?? "").trim();
  return values["code.scheme"] === "id" && ID.test(text) ? text.toLowerCase() : "";
}

/**
 * Parts of a body that describe the plate: position, code and geometry.
 *
 * @param {import("../components/form.js").Values} values
 * @param {any} schema
 * @returns {any} A registry number in it is a placeholder, see `plateText`: it may have more digits than a number keeps.
 */
export function plateBody(values, schema) {
  const { number: typed, ...others } = values;
  const scheme = values["code.scheme"];
  if (scheme !== "position-check") delete others["code.check_digits"];
  if (scheme === "id") delete others["code.allow_mismatched_digits"];
  const { position, code, geometry } = bodyOf(others, schema);
  const number = scheme === "id" && !code.digits ? numberOf(String(typed ?? "")) : "";
  return { ...(position && Object.keys(position).length ? { position } : {}), code: { ...code, ...(number ? { registry_number: number } : {}) }, geometry };
}

/** The JSON of a body with a plate. @param {any} body */
export function plateText(body) {
  const number = body.code?.registry_number;
  if (typeof number !== "bigint") return JSON.stringify(body);
  return JSON.stringify({ ...body, code: { ...body.code, registry_number: "@number" } }).replace(NUMBER_HERE, String(number));
}

/** A registry number, decimal or hexadecimal; other texts are sent as they are, and the server refuses them. @param {string} text @returns {bigint | string} */
function numberOf(text) {
  const plain = text.replace(/\s/g, "");
  if (!plain) return "";
  if (/^\d+$/.test(plain)) return BigInt(plain);
  if (/^(0x)?[0-9a-f]+$/i.test(plain)) return BigInt(`0x${plain.replace(/^0x/i, "")}`);
  return plain;
}

/**
 * @typedef {object} Draft
 * @property {PlateDraft | null} plate The last valid plate.
 * @property {unknown} error
 * @property {boolean} loading
 * @property {any} body Of requests about this plate, see `plateText`.
 * @property {any} marker The registered plate whose id was typed, or null.
 */

/**
 * The plate that is typed, as the server draws it.
 *
 * @param {import("../components/form.js").Values} values
 * @param {any} schema
 * @returns {Draft}
 */
export function useDraft(values, schema) {
  const id = markerIdOf(values);
  const marker = useLoad(async (signal) => (id ? findPlate(id, signal) : null), [id]);
  const known = id ? /** @type {any} */ (marker.data) : null;
  const body = id ? known && bodyOfMarker(known) : plateBody(values, schema);
  const draft = useLive(async (signal) => {
    const response = await request("/v1/plate-drafts", { ...jsonText(plateText(body)), signal });
    return /** @type {PlateDraft} */ (await response.json());
  }, body ? plateText(body) : null);
  return { plate: draft.data, error: id ? marker.error ?? draft.error : draft.error, loading: draft.loading || marker.loading, body, marker: known };
}

/** @param {string} id @param {AbortSignal} signal */
async function findPlate(id, signal) {
  const marker = /** @type {any} */ (await ok(api.GET("/v1/markers/{marker_id}", { params: { path: { marker_id: id } }, signal })));
  if (marker.family !== "plate") throw new Problem({ title: t("studio.no_plate"), field: "marker_id", detail: t("studio.no_plate"), cure: t("studio.no_plate_cure") });
  return marker;
}

/** @param {any} marker */
function bodyOfMarker(marker) {
  const { scheme, digits, check_digits } = marker.code;
  const { n, unit_mm, gap_mm, thickness_mm } = marker.geometry;
  const { lon_deg, lat_deg } = marker.position;
  return {
    position: { lon_deg, lat_deg },
    code: { scheme, digits, ...(check_digits ? { check_digits } : {}), ...(scheme === "id" ? {} : { allow_mismatched_digits: true }) },
    geometry: { n, unit_mm, gap_mm, thickness_mm },
  };
}

/** @param {string} body @returns {RequestInit} */
export const jsonText = (body) => ({ ...jsonBody(null), body });
