// Style sheets of libraries, loaded with them.

/** @type {Map<string, Promise<void>>} */
const added = new Map();

/**
 * Add a style sheet before our own, which may override it.
 *
 * @param {string} href
 * @returns {Promise<void>} Once it is there.
 */
export function addStyleSheet(href) {
  const known = added.get(href);
  if (known) return known;
  const loading = new Promise((/** @type {(value: void) => void} */ resolve, reject) => {
    const link = document.createElement("link");
    link.rel = "stylesheet";
    link.href = href;
    link.onload = () => resolve();
    link.onerror = () => reject(new Error(href));
    document.head.prepend(link);
  });
  added.set(href, loading);
  return loading;
}
