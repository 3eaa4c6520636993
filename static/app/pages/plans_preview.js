// What rules would place and cost, while they are changed: asked from the server after a pause, beside the plan as it is.

import { html } from "htm/preact";
import { useEffect, useState } from "preact/hooks";

import { api, ok } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { isAborted } from "../components/load.js";
import { fieldErrors, ProblemBox } from "../components/problem.js";
import { MISSING, number } from "../format.js";
import { t, textOr } from "../texts/index.js";
import { checkName } from "./plans_view.js";

const PAUSE_MS = 600;
const PAGE = 10_000;
export const LEVELS = /** @type {Record<string, "good" | "warn" | "bad">} */ ({ ok: "good", warn: "warn", fail: "bad" });

/** @typedef {import("../api/schema.js").components["schemas"]["PlanPreview"]} Preview */
/** @typedef {{ counts: Record<string, number>, findings: any[], cost: number, cost_complete: boolean, currency: string, verdict: string, left_out_count: number }} Figures */

/**
 * The preview of rules; the one before stays while the next is made.
 *
 * @param {string | null} alignmentId
 * @param {any} rules Null: nothing to preview.
 * @returns {{ preview: Preview | null, error: unknown, errors: Record<string, string>, loading: boolean }}
 */
export function usePreview(alignmentId, rules) {
  const [state, setState] = useState({ preview: /** @type {Preview | null} */ (null), error: /** @type {unknown} */ (null), loading: false });
  const text = rules ? JSON.stringify(rules) : "";
  useEffect(() => {
    if (!alignmentId || !text) {
      setState({ preview: null, error: null, loading: false });
      return undefined;
    }
    const abort = new AbortController();
    setState((old) => ({ ...old, loading: true }));
    const timer = setTimeout(() => {
      allPages({ alignment_id: alignmentId, rules: JSON.parse(text) }, abort.signal).then(
        (preview) => abort.signal.aborted || setState({ preview, error: null, loading: false }),
        (error) => abort.signal.aborted || isAborted(error) || setState((old) => ({ preview: old.preview, error, loading: false })),
      );
    }, PAUSE_MS);
    return () => {
      clearTimeout(timer);
      abort.abort();
    };
  }, [alignmentId, text]);
  return { ...state, errors: fieldErrors(state.error) };
}

/**
 * A preview with the markers of all its pages.
 *
 * @param {{ alignment_id: string, rules: any }} body
 * @param {AbortSignal} signal
 * @returns {Promise<Preview>}
 */
async function allPages(body, signal) {
  const page = (/** @type {number} */ after) => ok(api.POST("/v1/plan-previews", { body, signal, params: { query: { after, limit: PAGE } } }));
  const first = await page(0);
  const markers = [...first.markers];
  for (let length = markers.length; length === PAGE; ) {
    const next = (await page(markers.length)).markers;
    markers.push(...next);
    length = next.length;
  }
  return { ...first, markers };
}

/** @param {Figures} figures */
export const costText = (figures) => (figures.cost === 0 && !figures.cost_complete ? MISSING : `${number(figures.cost, 2, figures.currency)}${figures.cost_complete ? "" : " *"}`);

/** Predicted figures of the checks: read rates, path error. @param {Figures} figures @returns {any[]} */
export const predictions = (figures) => figures.findings.filter(({ name }) => name.startsWith("predicted-"));

/** A check's figure as people read it. @param {any} finding */
export function figureText(finding) {
  if (finding.unit === "share") return number(100 * finding.figure, 2, "%");
  return number(finding.figure, Math.abs(finding.figure) >= 100 || Number.isInteger(finding.figure) ? 0 : 3, textOr(`unit.${finding.unit}`, finding.unit));
}

/**
 * Figures of a preview, beside those of the plan as it is.
 *
 * @param {{ preview: ReturnType<typeof usePreview>, base?: Figures | null }} props
 */
export function PreviewBox({ preview, base = null }) {
  const { preview: found, loading, error } = preview;
  const named = Object.keys(preview.errors).length > 0;
  return html`
    <section class="card preview" aria-label=${t("preview.title")} aria-busy=${loading ? "true" : "false"}>
      <div class="title-line"><h2>${t("preview.title")}</h2><span class="hint" role="status">${loading ? t("preview.loading") : found && !error ? t("preview.current") : ""}</span></div>
      ${error && !loading && (named ? html`<p class="warning">${t("preview.at_field")}</p>` : html`<${ProblemBox} error=${error} />`)}
      ${!found && !error && html`<p class="hint">${t("preview.nothing")}</p>`}
      ${found && html`<${Comparison} found=${found} base=${base} />`}
      ${found && !found.cost_complete && html`<p class="hint">${t("plan.cost_incomplete")}</p>`}
    </section>
  `;
}

/** @param {{ found: Figures, base: Figures | null }} props */
function Comparison({ found, base }) {
  const families = [...new Set([...Object.keys(found.counts), ...Object.keys(base?.counts ?? {})])];
  const before = new Map((base ? predictions(base) : []).map((finding) => [finding.name, finding]));
  return html`
    <table class="figures">
      <thead><tr><th scope="col"><span class="hidden">${t("preview.figure")}</span></th>${base && html`<th scope="col" class="number">${t("preview.before")}</th>`}<th scope="col" class="number">${t("preview.after")}</th></tr></thead>
      <tbody>
        ${families.map((family) => html`<${Line} name=${textOr(`family_many.${family}`, family)} before=${base && number(base.counts[family] ?? 0)} after=${number(found.counts[family] ?? 0)} />`)}
        <${Line} name=${t("plan.cost")} before=${base && costText(base)} after=${costText(found)} />
        ${predictions(found).map((finding) => html`<${Line} name=${checkName(finding.name)} before=${base && (before.has(finding.name) ? figureText(before.get(finding.name)) : MISSING)} after=${figureText(finding)} />`)}
        <${Line} name=${t("plan.left_out")} before=${base && number(base.left_out_count)} after=${number(found.left_out_count)} />
        <${Line} name=${t("plan.checks")} before=${base && verdictOf(base)} after=${verdictOf(found)} />
      </tbody>
    </table>
    <${Unmet} findings=${found.findings} />
  `;
}

/** @param {{ name: string, before: any, after: any }} props */
function Line({ name, before, after }) {
  const changed = typeof before === "string" && before !== after;
  return html`<tr class=${changed ? "changed" : undefined}><th scope="row">${name}</th>${before !== null && html`<td class="number">${before}</td>`}<td class="number">${after}${changed && html`<span class="hidden"> ${t("preview.changed")}</span>`}</td></tr>`;
}

/** @param {Figures} figures */
const verdictOf = (figures) => html`<${Verdict} level=${LEVELS[figures.verdict] ?? "none"}>${textOr(`verdict.${figures.verdict}`, figures.verdict)}</${Verdict}>`;

/** Checks that are not met. @param {{ findings: any[] }} props */
export function Unmet({ findings }) {
  const unmet = findings.filter(({ verdict }) => verdict !== "ok");
  if (!unmet.length) return null;
  return html`<ul class="plain unmet">${unmet.map((finding) => html`<li><${Verdict} level=${LEVELS[finding.verdict] ?? "none"}>${checkName(finding.name)}</${Verdict}> ${figureText(finding)}: ${finding.sentence}</li>`)}</ul>`;
}
