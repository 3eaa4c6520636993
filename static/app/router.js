// Addresses of the pages: the path selects the page, the query its contents. Both are signals, so what depends on them
// is drawn again when they change, also by the browser's buttons for back and forward.

import { computed, signal } from "@preact/signals";

const address = signal(new URL(window.location.href));

/** The path of the address, without a slash at its end. */
export const path = computed(() => address.value.pathname.replace(/(.)\/+$/, "$1"));

/** The parameters of the address. */
export const query = computed(() => address.value.searchParams);

window.addEventListener("popstate", () => {
  address.value = new URL(window.location.href);
});

/**
 * Go to an address of ours.
 *
 * @param {string} href
 * @param {{ replace?: boolean }} [options] `replace`: the browser's button for back skips the present address.
 */
export function navigate(href, { replace = false } = {}) {
  const target = new URL(href, window.location.href);
  if (target.href === window.location.href) return;
  if (replace) window.history.replaceState(null, "", target);
  else window.history.pushState(null, "", target);
  address.value = target;
}

/**
 * Change parameters of the address; null and "" remove one. Others stay.
 *
 * @param {Record<string, string | number | null | undefined>} changes
 * @param {{ replace?: boolean }} [options] By default the button for back does not stop at each change.
 */
export function setQuery(changes, { replace = true } = {}) {
  navigate(withQuery(window.location.pathname, changes), { replace });
}

/**
 * An address with the present parameters and some changes.
 *
 * @param {string} pathname
 * @param {Record<string, string | number | null | undefined>} [changes]
 */
export function withQuery(pathname, changes = {}) {
  const parameters = new URLSearchParams(address.peek().search);
  for (const [name, value] of Object.entries(changes)) {
    if (value === null || value === undefined || value === "") parameters.delete(name);
    else parameters.set(name, String(value));
  }
  const text = parameters.toString();
  return text ? `${pathname}?${text}` : pathname;
}

/**
 * Whether a path is that of a pattern such as `/markers/:id`.
 *
 * @param {string} pattern
 * @param {string} pathname
 * @returns {Record<string, string> | null} The parameters, or null.
 */
export function match(pattern, pathname) {
  const wanted = pattern.split("/");
  const parts = pathname.split("/");
  if (wanted.length !== parts.length) return null;
  /** @type {Record<string, string>} */
  const found = {};
  for (const [k, part] of wanted.entries()) {
    if (part.startsWith(":")) {
      if (!parts[k]) return null;
      found[part.slice(1)] = decoded(parts[k]);
    } else if (part !== parts[k]) return null;
  }
  return found;
}

/** @param {string} part */
function decoded(part) {
  try {
    return decodeURIComponent(part);
  } catch {
    return part;
  }
}

/** Links to our pages are followed without loading the page again. */
export function followLinks() {
  document.addEventListener("click", (event) => {
    if (event.defaultPrevented || event.button || event.metaKey || event.ctrlKey || event.shiftKey || event.altKey) return;
    const link = event.target instanceof Element ? event.target.closest("a[href]") : null;
    if (!(link instanceof HTMLAnchorElement) || link.target || link.hasAttribute("download")) return;
    const target = new URL(link.href);
    if (target.origin !== window.location.origin || link.dataset.native !== undefined || target.hash) return;
    event.preventDefault();
    navigate(target.href);
  });
}
