// A question before something that cannot be undone, and a secret that is shown once.

import { html } from "htm/preact";
import { useId, useState } from "preact/hooks";

import { t } from "../texts/index.js";
import { Dialog } from "./dialog.js";
import { FormFrame, useForm } from "./form.js";
import { notify } from "./notices.js";

/**
 * @param {{ title: string, button: string, onConfirm: () => Promise<void>, onClose: () => void, children?: any }} props
 */
export function Confirm({ title, button, onConfirm, onClose, children }) {
  const form = useForm({});
  const submit = async () => {
    await onConfirm();
    onClose();
  };
  return html`
    <${Dialog} title=${title} onClose=${onClose}>
      <${FormFrame} form=${form} onSubmit=${submit} button=${button} actions=${html`<button type="button" class="quiet" onClick=${onClose}>${t("action.keep")}</button>`}>${children}</${FormFrame}>
    </${Dialog}>
  `;
}

/**
 * A secret that the server shows once: it can be copied, and the dialog does not close by chance.
 *
 * @param {{ title: string, label: string, secret: string, warning: string, onClose: () => void, children?: any }} props
 */
export function SecretOnce({ title, label, secret, warning, onClose, children }) {
  const id = useId();
  const [stored, setStored] = useState(false);
  const [copied, setCopied] = useState(false);
  const copy = async () => {
    try {
      await navigator.clipboard.writeText(secret);
      setCopied(true);
    } catch {
      const field = document.getElementById(id);
      if (field instanceof HTMLInputElement) field.select();
      notify(t("secret.copy_yourself"), { bad: true });
    }
  };
  return html`
    <${Dialog} title=${title} onClose=${onClose}>
      <p class="warning"><strong>${warning}</strong></p>
      <div class="field">
        <label for=${id}>${label}</label>
        <div class="copy-line"><input id=${id} class="code" readonly value=${secret} onFocus=${(/** @type {any} */ event) => event.currentTarget.select()} />
          <button type="button" onClick=${copy}>${copied ? t("secret.copied") : t("secret.copy")}</button></div>
        <p class="hint" role="status">${copied ? t("secret.copied_text") : ""}</p>
      </div>
      ${children}
      <label class="check"><input type="checkbox" checked=${stored} onChange=${(/** @type {any} */ event) => setStored(event.currentTarget.checked)} /> ${t("secret.stored")}</label>
      <p class="actions"><button type="button" disabled=${!stored} onClick=${onClose}>${t("action.close")}</button></p>
    </${Dialog}>
  `;
}
