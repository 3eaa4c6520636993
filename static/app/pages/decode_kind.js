// What a file is, by its first bytes and its name. Only a proposal: it can be changed, and the server decides by the
// bytes alone.

import { t } from "../texts/index.js";

const HEAD_BYTES = 4096;
const TAIL_BYTES = 66_000; // a ZIP ends with its directory's place, and a comment of 64 KiB at most
const MAX_DIRECTORY_BYTES = 4 * 1024 * 1024;

/**
 * @typedef {"frame" | "trace" | "packets"} Kind
 * @typedef {{ kind: Kind, label: string, sure: boolean }} Guess
 */

/** @type {[(head: string) => boolean, Kind, string][]} */
const SIGNATURES = [
  [(head) => head.startsWith("\xff\xd8\xff"), "frame", "JPEG"],
  [(head) => head.startsWith("\x89PNG"), "frame", "PNG"],
  [(head) => head.slice(4, 8) === "ftyp", "frame", "MP4"],
  [(head) => head.startsWith("RIFF") && head.slice(8, 12) === "AVI ", "frame", "AVI"],
  [(head) => head.startsWith("\x89MCAP"), "frame", "MCAP"],
  [(head) => head.startsWith("#ROSBAG"), "frame", "ROS 1"],
  [(head) => head.startsWith("SQLite format 3"), "frame", "ROS 2"],
  [(head) => head.startsWith("PAR1"), "trace", "Parquet"],
];

/**
 * @param {File} file
 * @returns {Promise<Guess>}
 */
export async function recognise(file) {
  const head = latin1(await file.slice(0, HEAD_BYTES).arrayBuffer());
  const known = SIGNATURES.find(([fits]) => fits(head));
  if (known) return { kind: known[1], label: known[2], sure: true };
  if (head.startsWith("PK")) return ofArchive(await namesIn(file), file.name);
  return ofText(head, file.name);
}

/** @param {string} head @param {string} name @returns {Guess} */
function ofText(head, name) {
  const first = head.trimStart();
  const line = (first.split("\n")[0] ?? "").toLowerCase();
  if (/\.(jsonl|ndjson)$/i.test(name) || first.startsWith("{") || first.startsWith("[")) return { kind: "packets", label: "JSON", sure: true };
  if (/\.(gpx|nmea|nma)$/i.test(name) || /^\$G[PNL]/.test(first)) return { kind: "packets", label: t("decode.file_track"), sure: false };
  if (/payload|rssi|snr|dev_?eui|frm_?payload/.test(line)) return { kind: "packets", label: "CSV", sure: true };
  if (/(^|[,;\t ])(t_s|s1_x|bx|mag_?x)([,;\t ]|$)/.test(line)) return { kind: "trace", label: "CSV", sure: true };
  if (/packet|uplink|cerpm|lora/i.test(name)) return { kind: "packets", label: "CSV", sure: false };
  if (/\.(bin|dat|log|asc|blf|dbc|csv|txt)$/i.test(name)) return { kind: "trace", label: /\.csv$/i.test(name) ? "CSV" : t("decode.file_recording"), sure: false };
  return { kind: "frame", label: t("decode.file_unknown"), sure: false };
}

/** @param {string[]} names @param {string} name @returns {Guess} */
function ofArchive(names, name) {
  const files = names.filter((entry) => !entry.endsWith("/") && !/(^|\/)[.]|__MACOSX/.test(entry));
  const count = (/** @type {RegExp} */ pattern) => files.filter((entry) => pattern.test(entry)).length;
  const pictures = count(/\.(jpe?g|png)$/i);
  if (count(/\.(mp4|mov|avi|m4v)$/i)) return { kind: "frame", label: t("decode.file_zip_video"), sure: true };
  const packets = count(/\.(jsonl|ndjson)$/i) + count(/packet|uplink|cerpm|lora/i);
  if (packets) return { kind: "packets", label: t("decode.file_zip", { count: files.length }), sure: true };
  if (pictures && !count(/\.(bin|dat|parquet|blf|asc)$/i)) return { kind: "frame", label: t("decode.file_zip_pictures", { count: pictures }), sure: true };
  const isPackets = !files.length && /packet|uplink|cerpm|lora/i.test(name);
  return { kind: isPackets ? "packets" : "trace", label: t("decode.file_zip", { count: files.length }), sure: files.length > 0 };
}

/**
 * Names of the files in a ZIP, by its directory (APPNOTE 4.3.12 and 4.3.16).
 *
 * @param {File} file
 * @returns {Promise<string[]>}
 */
async function namesIn(file) {
  const from = Math.max(file.size - TAIL_BYTES, 0);
  const tail = latin1(await file.slice(from).arrayBuffer());
  const end = tail.lastIndexOf("PK\x05\x06");
  if (end < 0 || end + 22 > tail.length) return [];
  const [size, start] = [uint(tail, end + 12, 4), uint(tail, end + 16, 4)];
  const directory = latin1(await file.slice(start, start + Math.min(size, MAX_DIRECTORY_BYTES)).arrayBuffer());
  const names = [];
  for (let at = 0; directory.startsWith("PK\x01\x02", at) && at + 46 <= directory.length;) {
    const [name, extra, comment] = [28, 30, 32].map((place) => uint(directory, at + place, 2));
    names.push(directory.slice(at + 46, at + 46 + (name ?? 0)));
    at += 46 + (name ?? 0) + (extra ?? 0) + (comment ?? 0);
  }
  return names;
}

/** @param {string} bytes @param {number} at @param {number} count */
function uint(bytes, at, count) {
  let value = 0;
  for (let k = count - 1; k >= 0; k -= 1) value = value * 256 + (bytes.charCodeAt(at + k) || 0);
  return value;
}

/** One sign for each byte. @param {ArrayBuffer} buffer */
function latin1(buffer) {
  const bytes = new Uint8Array(buffer);
  let text = "";
  for (let k = 0; k < bytes.length; k += 8192) text += String.fromCharCode(...bytes.subarray(k, k + 8192));
  return text;
}
