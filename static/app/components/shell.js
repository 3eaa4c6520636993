// What surrounds every page: the menu, who is signed in, the language, and the page itself.

import { html } from "htm/preact";
import { useEffect, useState } from "preact/hooks";

import { api, ok } from "../api/client.js";
import { MENU } from "../menu.js";
import { match, path, query } from "../router.js";
import { ROUTES } from "../routes.js";
import { key, may, me, pageSettings, signOut } from "../session.js";
import { LANGUAGES, language, t, textOr, useLanguage } from "../texts/index.js";
import { Empty } from "./load.js";
import { Notices } from "./notices.js";
import { ProblemBox } from "./problem.js";
import { SignIn } from "./sign_in.js";

export function Shell() {
  const route = ROUTES.find(({ pattern }) => match(pattern, path.value));
  const error = useSession();
  const title = route ? titleOf(route) : t("shell.not_found");
  useEffect(() => {
    document.title = `${title} – Waymark`;
  }, [title, language.value]);
  return html`
    <a class="skip" href="#content" onClick=${(/** @type {Event} */ event) => {
      event.preventDefault();
      document.getElementById("content")?.focus();
    }}>${t("shell.skip")}</a>
    <${Bar} />
    <main id="content" tabindex="-1" class=${route?.wide ? "wide-page" : "page"}>
      ${error ? html`<${ProblemBox} error=${error} retry=${loadMe} />` : html`<${Page} route=${route} />`}
    </main>
    <${Notices} />
  `;
}

/** @param {import("../routes.js").Route} route */
function titleOf(route) {
  const section = match("/operations/:section", path.value)?.section ?? match("/operations/:section/:item_id", path.value)?.section;
  return section ? textOr(`${section}.title`, t(route.title)) : t(route.title);
}

/** @param {{ route?: import("../routes.js").Route }} props */
function Page({ route }) {
  if (!route) return html`<h1>${t("shell.not_found")}</h1><${Empty} title=${t("shell.not_found_text", { path: path.value })}><a href="/">${t("home.title")}</a></${Empty}>`;
  if (!route.open && !key.value) return html`<${SignIn} />`;
  if (!route.open && !me.value) return html`<p class="loading" role="status">${t("load.loading")}</p>`;
  return html`<${Loaded} key=${route.load} route=${route} />`;
}

/** The module of a page, and what it draws. @param {{ route: import("../routes.js").Route }} props */
function Loaded({ route }) {
  const [Content, setContent] = useState(/** @type {import("preact").ComponentType<any> | null} */ (null));
  const [error, setError] = useState(/** @type {unknown} */ (null));
  useEffect(() => {
    route.load().then((module) => setContent(() => module.default), setError);
  }, []);
  if (error) return html`<${ProblemBox} error=${error} />`;
  if (!Content) return html`<p class="loading" role="status">${t("load.loading")}</p>`;
  return html`<${Content} parameters=${match(route.pattern, path.value) ?? {}} query=${query.value} />`;
}

async function loadMe() {
  me.value = await ok(api.GET("/v1/me"));
}

/** Ask who is signed in whenever the key changes. */
function useSession() {
  const [error, setError] = useState(/** @type {unknown} */ (null));
  useEffect(() => {
    setError(null);
    if (key.value && !me.value) loadMe().catch((problem) => key.peek() && setError(problem));
  }, [key.value]);
  useEffect(() => {
    ok(api.GET("/v1/page-settings")).then((found) => {
      pageSettings.value = found;
    }, setError);
  }, []);
  return error;
}

function Bar() {
  const [open, setOpen] = useState(false);
  useEffect(() => setOpen(false), [path.value]);
  return html`
    <header class="bar">
      <a class="brand" href="/"><img src="/static/favicon.svg" alt="" width="28" height="28" /> <span class="brand-name">Waymark</span></a>
      ${me.value && html`<button type="button" class="icon menu-button" aria-expanded=${open} aria-controls="menu" aria-label=${t("shell.menu")} onClick=${() => setOpen(!open)}>☰</button>`}
      ${me.value && html`<nav id="menu" class=${open ? "menu open" : "menu"} aria-label=${t("shell.menu")}><${Menu} /></nav>`}
      <div class="bar-end"><${LanguageChoice} />${me.value && html`<${Account} />`}</div>
    </header>
  `;
}

function Menu() {
  return html`${MENU.map(({ text, entries }) => {
    const allowed = entries.filter(({ needs }) => !needs || may(needs));
    if (!allowed.length) return null;
    const current = allowed.some(({ href }) => isCurrent(href));
    return html`<${MenuGroup} key=${text} title=${t(text)} entries=${allowed} current=${current} />`;
  })}${pageSettings.value?.guide && html`<a class="menu-link" href="/guide/" data-native>${t("shell.guide")}</a>`}<a class="menu-link" href="/docs" data-native>API</a>`;
}

/** @param {{ title: string, entries: import("../menu.js").Entry[], current: boolean }} props */
function MenuGroup({ title, entries, current }) {
  const [open, setOpen] = useState(false);
  useEffect(() => setOpen(false), [path.value]);
  useEffect(() => {
    if (!open) return undefined;
    const close = (/** @type {Event} */ event) => {
      if (!(event.target instanceof Element && event.target.closest(".menu-group.open"))) setOpen(false);
      if (event instanceof KeyboardEvent && event.key === "Escape") setOpen(false);
    };
    document.addEventListener("click", close);
    document.addEventListener("keydown", close);
    return () => {
      document.removeEventListener("click", close);
      document.removeEventListener("keydown", close);
    };
  }, [open]);
  return html`
    <div class=${open ? "menu-group open" : "menu-group"}>
      <button type="button" class=${current ? "menu-title current" : "menu-title"} aria-expanded=${open} onClick=${() => setOpen(!open)}>${title} <span aria-hidden="true">▾</span></button>
      <ul>${entries.map(({ href, text }) => html`<li><a href=${href} aria-current=${isCurrent(href) ? "page" : undefined}>${t(text)}</a></li>`)}</ul>
    </div>
  `;
}

/** @param {string} href */
const isCurrent = (href) => path.value === href || path.value.startsWith(`${href}/`);

function LanguageChoice() {
  return html`
    <label class="language"><span class="hidden">${t("shell.language")}</span>
      <select value=${language.value} onChange=${(/** @type {any} */ event) => useLanguage(event.currentTarget.value)}>
        ${Object.entries(LANGUAGES).map(([name, text]) => html`<option value=${name} lang=${name}>${text}</option>`)}
      </select>
    </label>
  `;
}

function Account() {
  const who = me.value;
  if (!who) return null;
  return html`
    <details class="account">
      <summary><span class="hidden">${t("account.title")}: </span><span class="account-name">${who.label}</span></summary>
      <div class="account-box">
        <p><strong>${who.label}</strong></p>
        <p>${who.agency}</p>
        <p>${t("account.scope", { scope: textOr(`scope.${who.scope}`, who.scope) })}</p>
        <p class="hint">${textOr(`scope_text.${who.scope}`, "")}</p>
        <button type="button" onClick=${signOut}>${t("account.sign_out")}</button>
      </div>
    </details>
  `;
}
