// A form whose values are in the address, so that a link shows the same, and results that follow what is typed.

import { useEffect, useRef, useState } from "preact/hooks";

import { query, setQuery } from "../router.js";
import { fieldErrors } from "./problem.js";

const WRITE_MS = 250;

/**
 * The values of a form, kept in the address.
 *
 * @param {Record<string, string>} fields Paths of the fields in the body, by their names in the address.
 * @param {import("./form.js").Values} start Values that need not be in the address.
 * @param {unknown} error The problem whose faults are shown at the fields.
 */
export function useQueryForm(fields, start, error) {
  const address = query.value;
  const read = () => {
    const values = /** @type {import("./form.js").Values} */ ({ ...start });
    for (const [name, path] of Object.entries(fields)) {
      const text = address.get(name);
      if (text !== null) values[path] = typeof start[path] === "boolean" ? text === "yes" : text;
    }
    return values;
  };
  const [values, setValues] = useState(read);
  const written = useRef(address.toString());
  const timer = useRef(0);
  useEffect(() => {
    // the button for back, or a link of ours
    if (address.toString() === written.current || timer.current) return;
    written.current = address.toString();
    setValues(read());
  }, [address]);
  useEffect(() => () => clearTimeout(timer.current), []);
  /** @param {import("./form.js").Values} changes */
  const setMany = (changes) => {
    setValues((old) => {
      const next = { ...old, ...changes };
      clearTimeout(timer.current);
      timer.current = setTimeout(() => {
        timer.current = 0;
        setQuery(addressOf(fields, start, next));
        written.current = query.peek().toString();
      }, WRITE_MS);
      return next;
    });
  };
  return {
    values,
    error,
    busy: false,
    errors: fieldErrors(error),
    setError: () => {},
    setValues: (/** @type {any} */ next) => setMany(typeof next === "function" ? next(values) : next),
    setMany,
    /** @param {string} path @param {string | boolean} value */
    set: (path, value) => setMany({ [path]: value }),
    /** @param {() => Promise<void>} work @returns {(event: Event) => Promise<void>} */
    submit: (work) => async (event) => {
      event.preventDefault();
      await work();
    },
  };
}

/** @typedef {ReturnType<typeof useQueryForm>} QueryForm */

/** @param {Record<string, string>} fields @param {import("./form.js").Values} start @param {import("./form.js").Values} values */
function addressOf(fields, start, values) {
  /** @type {Record<string, string | null>} */
  const changes = {};
  for (const [name, path] of Object.entries(fields)) {
    const value = values[path];
    const usual = start[path] ?? "";
    if (typeof value === "boolean") changes[name] = value === usual ? null : value ? "yes" : "no";
    else changes[name] = value === usual || value === undefined ? null : String(value);
  }
  return changes;
}

/**
 * @template T
 * @typedef {{ data: T | null, error: unknown, loading: boolean }} Live `data` is the last result without a problem.
 */

/**
 * A result that follows its inputs: asked for when they stand still, and kept while the next one is under way or refused.
 *
 * @template T
 * @param {(signal: AbortSignal) => Promise<T>} load
 * @param {string | null} key The inputs as a text; null: nothing is asked for.
 * @param {number} [wait_ms]
 * @returns {Live<T>}
 */
export function useLive(load, key, wait_ms = 300) {
  const [state, setState] = useState(/** @type {Live<T>} */ ({ data: null, error: null, loading: true }));
  const first = useRef(true);
  const latest = useRef(load);
  latest.current = load;
  useEffect(() => {
    if (key === null) {
      setState({ data: null, error: null, loading: false });
      return undefined;
    }
    const abort = new AbortController();
    setState((old) => ({ ...old, loading: true }));
    const timer = setTimeout(() => {
      latest.current(abort.signal).then(
        (data) => abort.signal.aborted || setState({ data, error: null, loading: false }),
        (error) => abort.signal.aborted || setState((old) => ({ data: old.data, error, loading: false })),
      );
    }, first.current ? 0 : wait_ms);
    first.current = false;
    return () => {
      clearTimeout(timer);
      abort.abort();
    };
  }, [key]);
  return state;
}
