// Small things every view needs: elements, problems, forms.

import { Problem } from "./api.js";

export const $ = (selector) => document.querySelector(selector);

export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

export function facts(pairs) {
  const rows = pairs.filter(([, value]) => value !== null && value !== undefined && value !== "");
  return make("dl", { class: "facts" }, ...rows.flatMap(([name, value]) => [make("dt", {}, name), make("dd", {}, value)]));
}

export function say(text) {
  $("#status").textContent = text;
}

export function clearProblem() {
  $("#problem").hidden = true;
  for (const field of document.querySelectorAll("[aria-invalid]")) field.removeAttribute("aria-invalid");
}

export function showProblem(error, form) {
  const told = error instanceof Problem ? error.document : { title: "Something went wrong in this page", detail: String(error) };
  const faults = told.errors && told.errors.length ? told.errors : [told];
  const box = $("#problem");
  box.replaceChildren(make("h2", {}, told.title));
  for (const fault of faults) {
    box.append(make("p", {}, fault.detail || told.detail || ""));
    const named = [["Field", fault.field], ["Limit", fault.limit], ["Cure", fault.cure]];
    if (named.some(([, value]) => value)) box.append(facts(named));
    mark(form, fault.field);
  }
  if (told.request_id && told.status >= 500) box.append(make("p", {}, `Request ${told.request_id}`));
  box.hidden = false;
  box.scrollIntoView({ block: "nearest" });
}

function mark(form, path) {
  if (!form || !path) return;
  const inputs = [...form.elements].filter((element) => element.name);
  const bare = path.replace(/^context\./, "");
  const input = inputs.find((element) => element.name === bare) || inputs.find((element) => element.name.endsWith(`.${bare}`));
  if (input) input.setAttribute("aria-invalid", "true");
}

// While `work` runs the button waits; a problem is shown where everybody looks.
export async function attempt(button, form, work) {
  clearProblem();
  if (button) button.disabled = true;
  try {
    return await work();
  } catch (error) {
    say("");
    showProblem(error, form);
    return undefined;
  } finally {
    if (button) button.disabled = false;
  }
}

// Inputs are named by their path in the JSON body; empty ones are left out.
export function readForm(form) {
  const body = {};
  for (const input of form.elements) {
    if (!input.name || input.type === "file") continue;
    const value = valueOf(input);
    if (value === undefined) continue;
    const parts = input.name.split(".");
    const last = parts.pop();
    let place = body;
    for (const part of parts) place = place[part] ??= {};
    place[last] = value;
  }
  return body;
}

function valueOf(input) {
  if (input.dataset.kind === "flag") return input.checked ? true : undefined;
  const text = input.value.trim();
  if (!text) return undefined;
  if (input.dataset.kind !== "number") return text;
  const value = Number(text.replace(",", "."));
  return Number.isFinite(value) ? value : text; // what is no number is for the server to name
}

export function fillForm(form, body) {
  for (const input of form.elements) {
    if (!input.name || input.type === "file") continue;
    const value = input.name.split(".").reduce((place, part) => (place ? place[part] : undefined), body);
    if (input.dataset.kind === "flag") input.checked = Boolean(value);
    else input.value = value === undefined || value === null ? "" : value;
  }
}
