// Loading data: what is shown while it loads, when it failed, and when there is nothing.

import { html } from "htm/preact";
import { useCallback, useEffect, useRef, useState } from "preact/hooks";

import { t } from "../texts/index.js";
import { ProblemBox } from "./problem.js";

/**
 * @template T
 * @typedef {{ data: T | null, error: unknown, loading: boolean, reload: () => void }} Loaded
 */

/**
 * Data that are loaded when the component appears, and again when `inputs` change. An answer that comes after a newer
 * request is dropped.
 *
 * @template T
 * @param {(signal: AbortSignal) => Promise<T>} load
 * @param {unknown[]} inputs
 * @returns {Loaded<T>}
 */
export function useLoad(load, inputs) {
  const [state, setState] = useState(/** @type {{ data: T | null, error: unknown, loading: boolean }} */ ({
    data: null, error: null, loading: true,
  }));
  const [turn, setTurn] = useState(0);
  const latest = useRef(load);
  latest.current = load;
  useEffect(() => {
    const abort = new AbortController();
    setState((old) => ({ ...old, error: null, loading: true }));
    latest.current(abort.signal).then(
      (data) => abort.signal.aborted || setState({ data, error: null, loading: false }),
      (error) => abort.signal.aborted || setState({ data: null, error, loading: false }),
    );
    return () => abort.abort();
  }, [...inputs, turn]);
  return { ...state, reload: useCallback(() => setTurn((old) => old + 1), []) };
}

/**
 * Draw loaded data: a note while they load, the problem if there is one, else `children(data)`.
 *
 * @param {{ of: Loaded<any>, children: (data: any) => any }} props
 */
export function Shown({ of, children }) {
  if (of.error) return html`<${ProblemBox} error=${of.error} retry=${of.reload} />`;
  if (of.data === null) return html`<p class="loading" role="status">${t("load.loading")}</p>`;
  return children(of.data);
}

/** @param {{ title: string, children?: any }} props */
export function Empty({ title, children }) {
  return html`<div class="empty"><p class="empty-title">${title}</p>${children}</div>`;
}

/** @param {unknown} error */
export const isAborted = (error) => error instanceof DOMException && error.name === "AbortError";
