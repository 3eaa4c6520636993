// Starts the pages: the language first, then what the address names.

import { html } from "htm/preact";
import { render } from "preact";

import { Shell } from "./components/shell.js";
import { followLinks } from "./router.js";
import { useLanguage } from "./texts/index.js";

const root = /** @type {HTMLElement} */ (document.getElementById("app"));

useLanguage().then(() => {
  root.replaceChildren();
  followLinks();
  render(html`<${Shell} />`, root);
});
