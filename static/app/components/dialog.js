// Dialogs, by the browser's own element: it keeps the focus inside, closes on Escape, and gives the focus back.

import { html } from "htm/preact";
import { useEffect, useId, useRef } from "preact/hooks";

import { t } from "../texts/index.js";

/**
 * @param {{ title: string, onClose: () => void, children?: any }} props
 */
export function Dialog({ title, onClose, children }) {
  const dialog = useRef(/** @type {HTMLDialogElement | null} */ (null));
  const shown = useRef(true);
  const id = useId();
  useEffect(() => {
    const element = dialog.current;
    element?.showModal();
    return () => {
      shown.current = false;
      element?.close(); // gives the focus back; nothing where Escape has closed it, so a later focus stays
    };
  }, []);
  return html`
    <dialog ref=${dialog} aria-labelledby=${id} onClose=${() => shown.current && onClose()}>
      <header class="dialog-head">
        <h2 id=${id}>${title}</h2>
        <button type="button" class="icon" aria-label=${t("action.close")} onClick=${onClose}>✕</button>
      </header>
      ${children}
    </dialog>
  `;
}
