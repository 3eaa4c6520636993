// Signing in: at the identity provider if the server has one, else with a key.

import { html } from "htm/preact";

import { api, ok, Problem } from "../api/client.js";
import { keepKey, me, pageSettings, startSignIn } from "../session.js";
import { t } from "../texts/index.js";
import { FormFrame, TextField, useForm } from "./form.js";
import { attempt } from "./notices.js";

export function SignIn() {
  const options = pageSettings.value?.sign_in;
  return html`
    <div class="sign-in card">
      <h1>${t("signin.title")}</h1>
      ${options && html`
        <p><button type="button" onClick=${() => attempt(() => startSignIn(options, window.location.pathname + window.location.search))}>${t("signin.provider", { host: new URL(options.issuer).host })}</button></p>
        <details><summary>${t("signin.with_key")}</summary><${KeyForm} /></details>
      `}
      ${!options && html`<${KeyForm} />`}
    </div>
  `;
}

function KeyForm() {
  const form = useForm({ key: "" });
  const signIn = async () => {
    const text = String(form.values.key ?? "").trim();
    if (!text) throw new Problem({ title: t("signin.empty"), detail: t("signin.hint"), field: "key" });
    try {
      me.value = await ok(api.GET("/v1/me", { headers: { Authorization: `Bearer ${text}` } }));
      keepKey(text);
    } catch (error) {
      throw error instanceof Problem && error.document.status === 401 ? new Problem({ ...error.document, field: "key", errors: [] }) : error;
    }
  };
  return html`
    <${FormFrame} form=${form} onSubmit=${signIn} button=${t("signin.button")}>
      <${TextField} form=${form} path="key" type="password" label=${t("signin.key")} hint=${t("signin.hint")} required />
    </${FormFrame}>
  `;
}
