// Uploads that can be interrupted, by tus 1.0 (docs/uploads.md): a file goes in parts, and goes on where the server is.

import { pause } from "./follow_job.js";
import { Problem, request } from "./client.js";

const PART_BYTES = { least: 512 * 1024, most: 8 * 1024 * 1024 };
const PARTS = 24; // of a file, as far as the limits allow: each is a step of its progress
const TRIES = 5; // of a part, before a person has to decide
const TUS = { "Tus-Resumable": "1.0.0" };
const PASSING = [0, 423, 429, 502, 503, 504];

/** @typedef {{ received: number, state: string, decode_id: string | null, error: any }} UploadState */

/**
 * Start an upload; no bytes are sent yet.
 *
 * @param {{ name: string, size: number }} file
 * @param {any} context
 * @returns {Promise<string>} Its id.
 */
export async function createUpload(file, context) {
  const metadata = `filename ${base64(file.name)},context ${base64(JSON.stringify(context))}`;
  const headers = { ...TUS, "Upload-Length": String(file.size), "Upload-Metadata": metadata };
  return (await (await request("/v1/uploads", { method: "POST", headers })).json()).id;
}

/**
 * How far an upload is.
 *
 * @param {string} id
 * @param {AbortSignal} [signal]
 * @returns {Promise<UploadState>}
 */
export async function readUpload(id, signal) {
  const found = await (await request(place(id), { signal })).json();
  return { received: found.received, state: found.state, decode_id: found.decode_id ?? null, error: found.error ?? null };
}

/**
 * Send what the server does not have yet.
 *
 * @param {string} id
 * @param {Blob} file
 * @param {(sent: number) => void} onProgress
 * @param {AbortSignal} signal
 * @returns {Promise<string>} Id of the decode that the file became.
 */
export async function sendFile(id, file, onProgress, signal) {
  const size = Math.min(Math.max(Math.ceil(file.size / PARTS), PART_BYTES.least), PART_BYTES.most);
  let tries = 0;
  let at = -1;
  for (;;) {
    try {
      if (at < 0) {
        const known = await readUpload(id, signal);
        if (known.decode_id) return known.decode_id;
        if (known.error) throw new Problem(known.error);
        at = known.received;
      }
      onProgress(at);
      const answer = await request(place(id), {
        method: "PATCH",
        headers: { ...TUS, "Upload-Offset": String(at), "Content-Type": "application/offset+octet-stream" },
        body: file.slice(at, at + size),
        signal,
      });
      const decode = answer.headers.get("Waymark-Decode");
      if (decode) return decode.split("/").pop() ?? "";
      at = Number(answer.headers.get("Upload-Offset"));
      tries = 0;
    } catch (error) {
      const status = error instanceof Problem ? error.document.status ?? 0 : -1;
      const isBehind = status === 409; // another request, or one whose answer was lost, went on
      tries += 1;
      if (signal.aborted || tries > TRIES || !(isBehind || PASSING.includes(status))) throw error;
      await pause(isBehind ? 0 : 500 * 2 ** tries, signal);
      at = -1;
    }
  }
}

/** Give an upload up. @param {string} id */
export async function deleteUpload(id) {
  await request(place(id), { method: "DELETE", headers: TUS });
}

/** @param {string} id */
const place = (id) => `/v1/uploads/${encodeURIComponent(id)}`;

/** @param {string} text */
function base64(text) {
  let bytes = "";
  for (const byte of new TextEncoder().encode(text)) bytes += String.fromCharCode(byte);
  return btoa(bytes);
}
