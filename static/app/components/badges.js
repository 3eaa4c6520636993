// Status and family of a marker: a shape and a word, never a colour alone. The map draws the same shapes.

import { html } from "htm/preact";

import { FAMILIES, STATUSES, symbolPaths } from "../map/symbols.js";
import { t, textOr } from "../texts/index.js";

/**
 * The symbol of a marker.
 *
 * @param {{ family: string, status: string, size?: number }} props
 */
export function Symbol({ family, status, size = 18 }) {
  return html`
    <svg class=${`symbol status-${status}`} viewBox="0 0 24 24" width=${size} height=${size} aria-hidden="true">
      ${symbolPaths(family, status).map((part) => html`<path class=${part.kind} d=${part.d} />`)}
    </svg>
  `;
}

/** @param {{ status: string, family?: string }} props */
export function StatusBadge({ status, family = "plate" }) {
  return html`<span class="badge"><${Symbol} family=${family} status=${status} /> ${textOr(`status.${status}`, status)}</span>`;
}

/** @param {{ family: string }} props */
export function FamilyName({ family }) {
  return textOr(`family.${family}`, family);
}

/** All symbols with their names. */
export function Legend() {
  return html`
    <div class="legend">
      <h3>${t("legend.families")}</h3>
      <ul>${FAMILIES.map((family) => html`<li><${Symbol} family=${family} status="active" /> ${textOr(`family.${family}`, family)}</li>`)}</ul>
      <h3>${t("legend.statuses")}</h3>
      <ul>${STATUSES.map((status) => html`<li><${Symbol} family="plate" status=${status} /> ${textOr(`status.${status}`, status)}</li>`)}</ul>
    </div>
  `;
}

const SHAPES = { good: "✓", warn: "!", bad: "✕", none: "○" };

/**
 * A judgement: a sign and a word.
 *
 * @param {{ level: keyof typeof SHAPES, children?: any }} props
 */
export function Verdict({ level, children }) {
  return html`<span class=${`verdict ${level}`}><span aria-hidden="true">${SHAPES[level]}</span> ${children}</span>`;
}
