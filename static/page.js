// Shared by all views: creating elements, showing problems, reading forms.

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

export function showStatus(text) {
  $("#status").textContent = text;
}

export function clearProblem() {
  $("#problem").hidden = true;
  for (const field of document.querySelectorAll("[aria-invalid]")) field.removeAttribute("aria-invalid");
}

export function showProblem(error, form) {
  const problem = error instanceof Problem ? error.document : { title: "This page failed", detail: String(error) };
  const faults = problem.errors && problem.errors.length ? problem.errors : [problem];
  const box = $("#problem");
  box.replaceChildren(make("h2", {}, problem.title));
  for (const fault of faults) {
    box.append(make("p", {}, fault.detail || problem.detail || ""));
    const details = [["Field", fault.field], ["Limit", fault.limit], ["How to fix it", fault.cure]];
    if (details.some(([, value]) => value)) box.append(facts(details));
    markInvalid(form, fault.field);
  }
  if (problem.request_id && problem.status >= 500) box.append(make("p", {}, `Request ${problem.request_id}`));
  box.hidden = false;
  box.scrollIntoView({ block: "nearest" });
}

function markInvalid(form, path) {
  if (!form || !path) return;
  const inputs = [...form.elements].filter((element) => element.name);
  const bare = path.replace(/^context\./, "");
  const input = inputs.find((element) => element.name === bare) || inputs.find((element) => element.name.endsWith(`.${bare}`));
  if (input) input.setAttribute("aria-invalid", "true");
}

// Runs `work` with the button disabled, and shows the problem if it fails.
export async function attempt(button, form, work) {
  clearProblem();
  if (button) button.disabled = true;
  try {
    return await work();
  } catch (error) {
    showStatus("");
    showProblem(error, form);
    return undefined;
  } finally {
    if (button) button.disabled = false;
  }
}

// Reads a form into a JSON body. The names of the inputs are paths in the body; empty inputs are left out.
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
  return Number.isFinite(value) ? value : text; // the server names the field that is not a number
}

export function fillForm(form, body) {
  for (const input of form.elements) {
    if (!input.name || input.type === "file") continue;
    const value = input.name.split(".").reduce((place, part) => (place ? place[part] : undefined), body);
    if (input.dataset.kind === "flag") input.checked = Boolean(value);
    else input.value = value === undefined || value === null ? "" : value;
  }
}
