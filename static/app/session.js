// Who is signed in. The key or token stays in sessionStorage: it is gone when the tab is closed.

import { computed, signal } from "@preact/signals";

const KEY = "waymark-key";
const PKCE = "waymark-pkce";

/**
 * @typedef {import("./api/schema.js").components["schemas"]["MeDocument"]} Me
 * @typedef {import("./api/schema.js").components["schemas"]["PageSettings"]} PageSettings
 */

/** The key or token of requests; empty: nobody is signed in. */
export const key = signal(sessionStorage.getItem(KEY) ?? "");

/** The owner of the key; null until the server has answered. @type {import("@preact/signals").Signal<Me | null>} */
export const me = signal(/** @type {Me | null} */ (null));

/** The server's settings for the pages, public. @type {import("@preact/signals").Signal<PageSettings | null>} */
export const pageSettings = signal(/** @type {PageSettings | null} */ (null));

const permissions = computed(() => new Set(me.value?.permissions ?? []));

/**
 * Whether the caller may use a route, e.g. `may("PATCH /v1/markers/{marker_id}")`.
 *
 * @param {string} route Method and path template, as in /openapi.json.
 */
export function may(route) {
  return permissions.value.has(route);
}

/** @param {string} text */
export function keepKey(text) {
  sessionStorage.setItem(KEY, text);
  key.value = text;
}

export function signOut() {
  sessionStorage.removeItem(KEY);
  sessionStorage.removeItem(PKCE);
  me.value = null;
  key.value = "";
}

/**
 * Leave for the identity provider: OAuth 2.0 authorization code with PKCE (RFC 7636).
 *
 * @param {NonNullable<PageSettings["sign_in"]>} options
 * @param {string} back Address to return to.
 */
export async function startSignIn(options, back) {
  const verifier = randomText();
  const state = randomText();
  sessionStorage.setItem(PKCE, JSON.stringify({ verifier, state, back }));
  const digest = await crypto.subtle.digest("SHA-256", new TextEncoder().encode(verifier));
  const target = new URL(options.authorize_url);
  for (const [name, value] of Object.entries({
    response_type: "code",
    client_id: options.client_id,
    redirect_uri: redirectUri(),
    scope: options.scopes,
    state,
    code_challenge: base64url(new Uint8Array(digest)),
    code_challenge_method: "S256",
  })) target.searchParams.set(name, value);
  window.location.assign(target);
}

/**
 * Exchange the code with which the identity provider sent the browser back.
 *
 * @param {NonNullable<PageSettings["sign_in"]>} options
 * @param {URLSearchParams} answer
 * @returns {Promise<string>} Address to return to.
 */
export async function finishSignIn(options, answer) {
  const kept = JSON.parse(sessionStorage.getItem(PKCE) ?? "null");
  sessionStorage.removeItem(PKCE);
  if (answer.get("error")) throw new Error(answer.get("error_description") || answer.get("error") || "");
  if (!kept || kept.state !== answer.get("state")) throw new Error("state");
  const response = await fetch(options.token_url, {
    method: "POST",
    body: new URLSearchParams({
      grant_type: "authorization_code",
      client_id: options.client_id,
      redirect_uri: redirectUri(),
      code: answer.get("code") ?? "",
      code_verifier: kept.verifier,
    }),
  });
  const tokens = await response.json().catch(() => ({}));
  if (!response.ok || typeof tokens.access_token !== "string") {
    throw new Error(tokens.error_description || tokens.error || `HTTP ${response.status}`);
  }
  keepKey(tokens.access_token);
  return typeof kept.back === "string" && kept.back.startsWith("/") && !kept.back.startsWith("//") ? kept.back : "/";
}

const redirectUri = () => new URL("/sign-in", window.location.href).href;

const randomText = () => base64url(crypto.getRandomValues(new Uint8Array(32)));

/** @param {Uint8Array} bytes */
const base64url = (bytes) =>
  btoa(String.fromCharCode(...bytes)).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
