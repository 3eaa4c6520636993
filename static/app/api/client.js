// Requests to the API, with the types of its OpenAPI document. Every failure is a Problem (RFC 9457).

import createClient from "openapi-fetch";

import { key, signOut } from "../session.js";

/**
 * A problem document of the server, or one that this page makes.
 *
 * @typedef {object} ProblemDocument
 * @property {string} [title]
 * @property {string} [detail]
 * @property {number} [status]
 * @property {string | null} [field]
 * @property {string | null} [limit]
 * @property {string | null} [cure]
 * @property {string} [request_id]
 * @property {{ detail?: string, field?: string | null, limit?: string | null, cure?: string | null }[]} [errors]
 */

/** Why a request failed. */
export class Problem extends Error {
  /** @param {ProblemDocument} document */
  constructor(document) {
    super(document.detail || document.title || "");
    this.document = document;
  }
}

/** @type {ReturnType<typeof createClient<import("./schema.js").paths>>} */
export const api = createClient({ fetch: (request) => send(request) });

/**
 * Send a request with the key.
 *
 * @param {Request} request
 * @returns {Promise<Response>} Any response, also one that reports a problem.
 */
async function send(request) {
  const sent = key.peek();
  if (sent && !request.headers.has("Authorization")) request.headers.set("Authorization", `Bearer ${sent}`);
  let response;
  try {
    // without "omit" a browser asks for a password of its own when the key is refused
    response = await fetch(new Request(request, { cache: "no-store", credentials: "omit" }));
  } catch (error) {
    if (request.signal.aborted) throw error;
    throw new Problem({ title: "unreachable", detail: "", status: 0 });
  }
  if (response.status === 401 && sent && sent === key.peek()) signOut();
  return response;
}

/**
 * The document of a response; throws the problem if there is none.
 *
 * @template T
 * @param {Promise<{ data?: T, error?: unknown, response: Response }>} answer
 * @returns {Promise<T>}
 */
export async function ok(answer) {
  const { data, error, response } = await answer;
  if (!response.ok) throw problemOf(error, response);
  return /** @type {T} */ (data);
}

/**
 * A page of a list, with the cursor of the next one.
 *
 * @template T
 * @param {Promise<{ data?: { items: T[] }, error?: unknown, response: Response }>} answer
 * @returns {Promise<{ items: T[], after: string | null }>}
 */
export async function page(answer) {
  const { data, error, response } = await answer;
  if (!response.ok || !data) throw problemOf(error, response);
  const next = /<([^>]+)>; rel="next"/.exec(response.headers.get("Link") ?? "");
  return { items: data.items, after: next ? new URL(next[1] ?? "", window.location.href).searchParams.get("after") : null };
}

/**
 * A file, or a response that openapi-fetch does not describe well (uploads, lists by a path that is data).
 *
 * @param {string} path
 * @param {RequestInit} [options]
 * @returns {Promise<Response>} A response of success.
 */
export async function request(path, options = {}) {
  const response = await send(new Request(new URL(path, window.location.href), options));
  if (!response.ok) throw problemOf(await response.json().catch(() => null), response);
  return response;
}

/**
 * @param {unknown} document
 * @param {Response} response
 */
function problemOf(document, response) {
  const known = document && typeof document === "object" ? /** @type {ProblemDocument} */ (document) : {};
  return new Problem({ title: `HTTP ${response.status}`, ...known, status: response.status });
}

/**
 * Save a file: the browser's download.
 *
 * @param {Blob} blob
 * @param {string} name
 */
export function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

/**
 * Fetch a file and save it.
 *
 * @param {string} path
 * @param {string} name Empty: as the server calls it.
 * @param {RequestInit} [options]
 * @returns {Promise<Response>}
 */
export async function download(path, name, options) {
  const response = await request(path, options);
  const theirs = /filename="([^"]+)"/.exec(response.headers.get("Content-Disposition") ?? "")?.[1];
  save(await response.clone().blob(), name || (theirs ?? "waymark"));
  return response;
}

/** @param {unknown} body */
export const jsonBody = (body) => ({
  method: "POST",
  headers: { "Content-Type": "application/json" },
  body: JSON.stringify(body),
});
