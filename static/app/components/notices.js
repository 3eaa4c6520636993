// Short notices at the edge of the window: what was done, and what failed outside of a form.

import { signal } from "@preact/signals";
import { html } from "htm/preact";

import { t } from "../texts/index.js";
import { isAborted } from "./load.js";
import { documentOf } from "./problem.js";

const SHOWN_MS = 8000;

/** @typedef {{ id: number, text: string, detail?: string, bad: boolean }} Notice */

/** @type {import("@preact/signals").Signal<Notice[]>} */
const notices = signal([]);
let last = 0;

/**
 * Show a notice for some seconds; a failure stays until it is closed.
 *
 * @param {string} text
 * @param {{ bad?: boolean, detail?: string }} [options]
 */
export function notify(text, { bad = false, detail = "" } = {}) {
  last += 1;
  const id = last;
  notices.value = [...notices.value.slice(-3), { id, text, detail, bad }];
  if (!bad) setTimeout(() => close(id), SHOWN_MS);
}

/**
 * Do something, and show a notice if it fails.
 *
 * @template T
 * @param {() => Promise<T>} work
 * @returns {Promise<T | undefined>}
 */
export async function attempt(work) {
  try {
    return await work();
  } catch (error) {
    if (isAborted(error)) return undefined;
    const problem = documentOf(error);
    const title = problem.status === 0 ? t("problem.unreachable") : problem.title ?? "";
    notify(title, { bad: true, detail: [problem.detail, problem.cure].filter(Boolean).join(". ") });
    return undefined;
  }
}

/** @param {number} id */
function close(id) {
  notices.value = notices.value.filter((notice) => notice.id !== id);
}

export function Notices() {
  return html`
    <div class="notices" role="status" aria-live="polite">
      ${notices.value.map((notice) => html`
        <div key=${notice.id} class=${notice.bad ? "notice bad" : "notice"}>
          <div><strong>${notice.text}</strong>${notice.detail && html`<p>${notice.detail}</p>`}</div>
          <button type="button" class="icon" aria-label=${t("action.close")} onClick=${() => close(notice.id)}>✕</button>
        </div>
      `)}
    </div>
  `;
}
