// Files on their way to a decode. They stay while one looks at other pages; what the server has of a file is
// remembered, so that an upload goes on after a reload when the file is chosen again.

import { signal } from "@preact/signals";

import { followJob } from "../api/follow_job.js";
import { Problem, request } from "../api/client.js";
import { createUpload, deleteUpload, readUpload, sendFile } from "../api/upload.js";
import { isAborted } from "../components/load.js";
import { t } from "../texts/index.js";
import { recognise } from "./decode_kind.js";

const STORED = "waymark-uploads";
const MAX_STORED = 30;
const PRINT_BYTES = 65_536;

/**
 * @typedef {"ready" | "sending" | "paused" | "missing" | "decoding" | "done" | "failed"} State
 * @typedef {object} Row
 * @property {number} key
 * @property {File | null} file
 * @property {string} name
 * @property {number} size
 * @property {import("./decode_kind.js").Kind} kind
 * @property {string} label What it was recognised as.
 * @property {boolean} sure
 * @property {State} state
 * @property {number} sent
 * @property {string | null} upload Id of the upload.
 * @property {string | null} decode Id of the decode.
 * @property {string} print Hash of its beginning.
 * @property {string} summary
 * @property {{ progress: number, done: number | null, total: number | null }} job
 * @property {unknown} error
 */

/** @type {import("@preact/signals").Signal<Row[]>} */
export const rows = signal(/** @type {Row[]} */ ([]));
/** @type {Map<number, AbortController>} */
const running = new Map();
let last = 0;
let restored = false;

/** @param {number} key @param {Partial<Row>} changes */
export function change(key, changes) {
  rows.value = rows.value.map((row) => (row.key === key ? { ...row, ...changes } : row));
  store();
}

/** @param {number} key */
const rowOf = (key) => rows.peek().find((row) => row.key === key);

/**
 * Take files: those that an upload waits for go on, others are new.
 *
 * @param {Iterable<File>} files
 */
export async function addFiles(files) {
  for (const file of files) {
    const print = await fingerprint(file);
    const waiting = rows.peek().find((row) => row.state === "missing" && row.size === file.size && row.print === print);
    if (waiting) {
      change(waiting.key, { file, name: file.name, error: null });
      send(waiting.key);
      continue;
    }
    const guess = await recognise(file);
    last += 1;
    rows.value = [...rows.value, newRow({ key: last, file, name: file.name, size: file.size, print, kind: guess.kind, label: guess.label, sure: guess.sure })];
  }
}

/**
 * The file of an upload that waits for it; another one is refused.
 *
 * @param {number} key
 * @param {File | undefined} file
 */
export async function supply(key, file) {
  const row = rowOf(key);
  if (!row || !file) return;
  const same = file.size === row.size && (await fingerprint(file)) === row.print;
  if (!same) {
    change(key, { error: new Problem({ title: t("decode.other_file"), detail: t("decode.other_file_text", { name: file.name }), field: "file", cure: t("decode.other_file_cure", { name: row.name }) }) });
    return;
  }
  change(key, { file, error: null });
  await send(key);
}

/** @param {Partial<Row> & { key: number }} values @returns {Row} */
const newRow = (values) => ({
  file: null, name: "", size: 0, kind: "frame", label: "", sure: true, state: "ready", sent: 0, upload: null, decode: null, print: "", summary: "",
  job: { progress: 0, done: null, total: null }, error: null, ...values,
});

/**
 * Send the files that are ready, one after the other.
 *
 * @param {(kind: import("./decode_kind.js").Kind) => any} contextOf Throws what is wrong with the options.
 */
export async function sendAll(contextOf) {
  for (const { key } of rows.peek().filter((row) => row.state === "ready" || (row.state === "failed" && !row.upload))) {
    const row = rowOf(key);
    if (row) await send(key, contextOf(row.kind));
  }
}

/**
 * Send a file, or what the server has not got of it, and follow its decode.
 *
 * @param {number} key
 * @param {any} [context] For a new upload.
 */
export async function send(key, context) {
  const row = rowOf(key);
  if (!row?.file || running.has(key)) return;
  const abort = new AbortController();
  running.set(key, abort);
  try {
    change(key, { state: "sending", error: null });
    const upload = row.upload ?? (await createUpload({ name: row.name, size: row.size }, context ?? {}));
    change(key, { upload });
    const decode = await sendFile(upload, row.file, (sent) => change(key, { sent }), abort.signal);
    change(key, { sent: row.size, decode, state: "decoding" });
  } catch (error) {
    const isOver = error instanceof Problem && [404, 410].includes(error.document.status ?? 0) && row.upload;
    if (abort.signal.aborted || isAborted(error)) change(key, { state: "paused" });
    else change(key, { state: "failed", error, ...(isOver || isRefused(error) ? { upload: null, sent: 0 } : {}) });
  } finally {
    running.delete(key);
  }
  if (rowOf(key)?.state === "decoding") follow(key);
}

/** Whether the server does not want this file at all. @param {unknown} error */
const isRefused = (error) => error instanceof Problem && [400, 413, 415, 422].includes(error.document.status ?? 0);

/** @param {number} key */
async function follow(key) {
  const row = rowOf(key);
  if (!row?.decode || running.has(key)) return;
  const abort = new AbortController();
  running.set(key, abort);
  try {
    let decode = await (await request(`/v1/decodes/${row.decode}`, { signal: abort.signal })).json();
    if (["queued", "running"].includes(decode.state)) {
      await followJob(row.decode, (job) => change(key, { job: { progress: job.progress, done: job.done ?? null, total: job.total ?? null } }), abort.signal);
      decode = await (await request(`/v1/decodes/${row.decode}`, { signal: abort.signal })).json();
    }
    if (decode.state === "done") change(key, { state: "done", summary: decode.summary?.text ?? "" });
    else change(key, { state: "failed", error: new Problem({ title: t("decode.failed"), ...decode.error }) });
  } catch (error) {
    if (!abort.signal.aborted) change(key, { state: "failed", error });
  } finally {
    running.delete(key);
  }
}

/** @param {number} key */
export const pauseRow = (key) => running.get(key)?.abort();

/** Take a row away; an upload that is not complete is cancelled. @param {number} key */
export function removeRow(key) {
  const row = rowOf(key);
  running.get(key)?.abort();
  rows.value = rows.value.filter((other) => other.key !== key);
  store();
  if (row?.upload && !row.decode) deleteUpload(row.upload).catch(() => {}); // it expires by itself
}

// --- what is remembered -----------------------------------------------------------------------------------------------

function store() {
  const kept = rows.peek().filter((row) => row.upload && !row.decode).slice(-MAX_STORED)
    .map(({ upload, name, size, print, kind, label }) => ({ upload, name, size, print, kind, label }));
  if (kept.length) localStorage.setItem(STORED, JSON.stringify(kept));
  else localStorage.removeItem(STORED);
}

/** Uploads of an earlier visit that can go on, and where they are. */
export async function restore() {
  if (restored) return;
  restored = true;
  /** @type {any[]} */
  let kept = [];
  try {
    kept = JSON.parse(localStorage.getItem(STORED) ?? "[]");
  } catch {
    return;
  }
  for (const entry of Array.isArray(kept) ? kept : []) {
    const found = await readUpload(String(entry.upload)).catch(() => null); // expired, or of another key
    if (!found || found.state === "expired" || found.error) continue;
    last += 1;
    const { name, size, print, kind, label, upload } = entry;
    rows.value = [...rows.value, newRow({ key: last, name, size, print, kind, label, upload, sent: found.received, decode: found.decode_id, state: found.decode_id ? "decoding" : "missing" })];
    if (found.decode_id) follow(last);
  }
  store();
}

/** @param {Blob} file */
async function fingerprint(file) {
  const digest = await crypto.subtle.digest("SHA-256", await file.slice(0, PRINT_BYTES).arrayBuffer());
  return [...new Uint8Array(digest).slice(0, 12)].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}
