// Lists that come in pages: the first one at once, the others when they are asked for.

import { html } from "htm/preact";
import { useEffect, useRef, useState } from "preact/hooks";

import { request } from "../api/client.js";
import { number } from "../format.js";
import { t } from "../texts/index.js";
import { isAborted } from "./load.js";

/**
 * @typedef {{ rows: any[], next: string, loading: boolean, error: unknown, loaded: boolean }} State
 * @typedef {State & { more: () => void, reload: () => void, refresh: () => Promise<void> }} Pages
 */

/** @type {State} */
const START = { rows: [], next: "", loading: true, error: null, loaded: false };

/**
 * Rows of a list of the API, page by page.
 *
 * @param {string} route Path of the list.
 * @param {Record<string, string | number | null | undefined>} [filters] Empty ones are left out.
 * @returns {Pages}
 */
export function usePages(route, filters = {}) {
  const address = addressOf(route, { limit: 100, ...filters });
  const [state, setState] = useState(START);
  const [turn, setTurn] = useState(0);
  const abort = useRef(new AbortController());
  /** @param {string} place */
  const fetchPage = async (place) => {
    const response = await request(place, { signal: abort.current.signal });
    const { items } = await response.json();
    const link = /<([^>]+)>; rel="next"/.exec(response.headers.get("Link") ?? "")?.[1];
    const next = link ? new URL(link, window.location.href) : null;
    return { items: /** @type {any[]} */ (items), next: next ? next.pathname + next.search : "" };
  };
  /** @param {any[]} before @param {string} place */
  const load = async (before, place) => {
    const { signal } = abort.current;
    setState((old) => ({ ...old, loading: true, error: null }));
    try {
      const { items, next } = await fetchPage(place);
      if (!signal.aborted) setState({ rows: [...before, ...items], next, loading: false, error: null, loaded: true });
    } catch (error) {
      if (!signal.aborted && !isAborted(error)) setState((old) => ({ ...old, loading: false, error }));
    }
  };
  useEffect(() => {
    abort.current = new AbortController();
    load([], address);
    return () => abort.current.abort();
  }, [address, turn]);
  return {
    ...state,
    more: () => load(state.rows, state.next),
    reload: () => setTurn((old) => old + 1),
    // the first page again, without a note that it loads: rows that are known already change in their place
    refresh: async () => {
      const { signal } = abort.current;
      const { items } = await fetchPage(address);
      if (signal.aborted) return;
      const fresh = new Set(items.map(({ id }) => id));
      setState((old) => ({ ...old, rows: [...items, ...old.rows.filter(({ id }) => !fresh.has(id))] }));
    },
  };
}

/**
 * @param {string} route
 * @param {Record<string, string | number | null | undefined>} filters
 */
export function addressOf(route, filters) {
  const parameters = new URLSearchParams();
  for (const [name, value] of Object.entries(filters)) if (value !== null && value !== undefined && value !== "") parameters.set(name, String(value));
  const text = parameters.toString();
  return text ? `${route}?${text}` : route;
}

/** What stands below a list: how many rows there are, and the button for more. @param {{ of: Pages }} props */
export function PagesFoot({ of }) {
  if (!of.next) return t("list.count", { count: number(of.rows.length) });
  return html`${t("table.sorted_loaded")} <button type="button" class="quiet" disabled=${of.loading} onClick=${of.more}>${t("table.more")}</button>`;
}
