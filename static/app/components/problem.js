// A problem as the server describes it: what is wrong, the field, the limit and the cure.

import { html } from "htm/preact";
import { useEffect, useRef } from "preact/hooks";

import { Problem } from "../api/client.js";
import { t } from "../texts/index.js";
import { Facts } from "./facts.js";

/**
 * @param {{ error: unknown, retry?: () => void }} props
 */
export function ProblemBox({ error, retry }) {
  const box = useRef(/** @type {HTMLElement | null} */ (null));
  useEffect(() => {
    if (error) box.current?.scrollIntoView({ block: "nearest" });
  }, [error]);
  if (!error) return null;
  const problem = documentOf(error);
  const faults = problem.errors?.length ? problem.errors : [problem];
  const title = problem.status === 0 ? t("problem.unreachable") : problem.title;
  return html`
    <div class="problem" role="alert" ref=${box}>
      <h2>${title}</h2>
      ${faults.map((fault) => html`
        <p>${fault.detail || (fault === problem ? "" : problem.detail)}</p>
        <${Facts} of=${[
          [t("problem.field"), fault.field],
          [t("problem.limit"), fault.limit],
          [t("problem.cure"), fault.cure],
        ]} />
      `)}
      ${problem.request_id && (problem.status ?? 0) >= 500 && html`<p>${t("problem.request", { id: problem.request_id })}</p>`}
      ${retry && html`<p><button type="button" class="quiet" onClick=${retry}>${t("problem.retry")}</button></p>`}
    </div>
  `;
}

/**
 * Problems of fields by their path in the body, for the fields of a form.
 *
 * @param {unknown} error
 * @returns {Record<string, string>}
 */
export function fieldErrors(error) {
  if (!error) return {};
  const problem = documentOf(error);
  /** @type {Record<string, string>} */
  const found = {};
  for (const fault of problem.errors?.length ? problem.errors : [problem]) {
    if (fault.field) found[fault.field.replace(/^(body|context|declaration|rules)\./, "")] = [fault.detail, fault.cure].filter(Boolean).join(". ");
  }
  return found;
}

/**
 * Whether a form shows one of the problems at a field of its own; if not, a `ProblemBox` is needed.
 *
 * @param {Record<string, string>} errors By field; "" is none.
 * @param {import("./form.js").Values} values Of the form.
 */
export const isAtField = (errors, values) => Object.entries(errors).some(([path, text]) => text && path in values);

/**
 * An error as a problem document.
 *
 * @param {unknown} error
 * @returns {import("../api/client.js").ProblemDocument}
 */
export function documentOf(error) {
  if (error instanceof Problem) return error.document;
  return { title: t("problem.page"), detail: String(error) };
}
