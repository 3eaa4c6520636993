// A picture of the API, which needs the key: it is fetched, and shown from memory.

import { html } from "htm/preact";
import { useEffect, useState } from "preact/hooks";

import { request } from "../api/client.js";
import { t } from "../texts/index.js";
import { ProblemBox } from "./problem.js";

/**
 * @param {{ path: string, alt: string, options?: RequestInit, kind?: string, onLoad?: (image: HTMLImageElement) => void, onResponse?: (response: Response) => void }} props
 */
export function Picture({ path, alt, options, kind = "picture", onLoad, onResponse }) {
  const [url, setUrl] = useState("");
  const [error, setError] = useState(/** @type {unknown} */ (null));
  useEffect(() => {
    const abort = new AbortController();
    let made = "";
    setUrl("");
    setError(null);
    request(path, { ...options, signal: abort.signal }).then(async (response) => {
      made = URL.createObjectURL(await response.blob());
      if (abort.signal.aborted) return;
      onResponse?.(response);
      setUrl(made);
    }).catch((problem) => abort.signal.aborted || setError(problem));
    return () => {
      abort.abort();
      if (made) URL.revokeObjectURL(made);
    };
  }, [path, options?.body]);
  if (error) return html`<${ProblemBox} error=${error} />`;
  if (!url) return html`<p class="loading" role="status">${t("load.loading")}</p>`;
  return html`<img class=${kind} src=${url} alt=${alt} onLoad=${(/** @type {any} */ event) => onLoad?.(event.currentTarget)} />`;
}
