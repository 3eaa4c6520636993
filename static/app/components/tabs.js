// Parts of a page, each with an address: links beside each other, the present one is marked.

import { html } from "htm/preact";

import { path, withQuery } from "../router.js";

/**
 * @param {{ label: string, of: [string, string][], chosen: string, name?: string, without?: string[] }} props `of`: value
 *   in the address and text; the first one needs no value. `without`: what the address of another part does not keep.
 */
export function Tabs({ label, of, chosen, name = "tab", without = [] }) {
  const dropped = Object.fromEntries(without.map((parameter) => [parameter, null]));
  return html`
    <nav class="tabs" aria-label=${label}>
      ${of.map(([value, text], k) => html`
        <a href=${withQuery(path.value, { ...dropped, [name]: k ? value : null })} aria-current=${value === chosen ? "page" : undefined}>${text}</a>
      `)}
    </nav>
  `;
}
