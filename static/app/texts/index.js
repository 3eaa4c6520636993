// Texts in the language of the reader. All of them are in en.js and de.js; a test compares their keys.

import { signal } from "@preact/signals";

/** @typedef {keyof typeof import("./en.js").default} TextKey */
/** @typedef {"en" | "de"} Language */

const CHOICE = "waymark-language";
export const LANGUAGES = /** @type {const} */ ({ en: "English", de: "Deutsch" });

/** @type {import("@preact/signals").Signal<Language>} */
export const language = signal(preferred());

/** @type {import("@preact/signals").Signal<Partial<Record<string, string>>>} */
const texts = signal({});

/** @returns {Language} */
function preferred() {
  const chosen = localStorage.getItem(CHOICE);
  const wanted = [chosen ?? "", ...navigator.languages].map((name) => name.slice(0, 2).toLowerCase());
  return /** @type {Language} */ (wanted.find((name) => name in LANGUAGES) ?? "en");
}

/**
 * Use a language from now on; without one, that which was chosen before or the browser's.
 *
 * @param {Language} [wanted]
 */
export async function useLanguage(wanted) {
  if (wanted) localStorage.setItem(CHOICE, wanted);
  const name = wanted ?? preferred();
  texts.value = (await (name === "de" ? import("./de.js") : import("./en.js"))).default;
  language.value = name;
  document.documentElement.lang = name;
}

/**
 * A text with its parameters filled in: `t("list.count", { count: 3 })`. `{count:row|rows}` is the first word for 1, else the second.
 *
 * @param {TextKey} name
 * @param {Record<string, string | number>} [parameters]
 * @returns {string}
 */
export function t(name, parameters = {}) {
  const text = texts.value[name] ?? name;
  return text.replace(/\{(\w+)(?::([^|{}]*)\|([^{}]*))?\}/g, (whole, part, one, other) => {
    const value = parameters[part];
    if (value === undefined) return whole;
    return one === undefined ? String(value) : String(value) === "1" ? one : other;
  });
}

/**
 * A text whose name is made from data, or something else if there is none.
 *
 * @param {string} name
 * @param {string} otherwise
 */
export function textOr(name, otherwise) {
  return texts.value[name] ?? otherwise;
}
