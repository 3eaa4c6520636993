// The details of what is chosen: beside the list on a wide window, a sheet over it on a phone.

import { html } from "htm/preact";
import { useEffect, useRef, useState } from "preact/hooks";

import { t } from "../texts/index.js";

/**
 * @param {{ title: any, label: string, onClose: () => void, children?: any }} props
 */
export function Panel({ title, label, onClose, children }) {
  const panel = useRef(/** @type {HTMLElement | null} */ (null));
  useEffect(() => {
    /** @param {KeyboardEvent} event */
    const onKey = (event) => {
      if (event.key === "Escape" && !document.querySelector("dialog[open]")) onClose();
    };
    document.addEventListener("keydown", onKey);
    return () => document.removeEventListener("keydown", onKey);
  }, [onClose]);
  useEffect(() => {
    panel.current?.focus({ preventScroll: true });
    panel.current?.scrollTo(0, 0);
  }, [label]);
  return html`
    <aside class="panel" aria-label=${label} tabindex="-1" ref=${panel}>
      <header class="panel-head">
        <h2>${title}</h2>
        <button type="button" class="icon" aria-label=${t("action.close")} onClick=${onClose}>✕</button>
      </header>
      <div class="panel-body">${children}</div>
    </aside>
  `;
}

/**
 * A part of a panel that can be closed; what it contains is drawn when it is opened first.
 *
 * @param {{ title: string, open?: boolean, children: () => any }} props
 */
export function Section({ title, open = false, children }) {
  const [seen, setSeen] = useState(open);
  return html`
    <details class="section" open=${open} onToggle=${(/** @type {Event} */ event) => {
      if (event.currentTarget instanceof HTMLDetailsElement && event.currentTarget.open) setSeen(true);
    }}>
      <summary><h3>${title}</h3></summary>
      ${seen && children()}
    </details>
  `;
}
