// Pairs of a name and a value. A pair without a value is left out.

import { html } from "htm/preact";

/**
 * @param {{ of: [string, any][] }} props
 */
export function Facts({ of }) {
  const pairs = of.filter(([, value]) => value !== null && value !== undefined && value !== "" && value !== false);
  if (!pairs.length) return null;
  return html`<dl class="facts">${pairs.map(([name, value]) => html`<dt>${name}</dt><dd>${value}</dd>`)}</dl>`;
}
