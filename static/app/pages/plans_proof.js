// The proof of a plan: simulated vehicles drive over it. It is started here, followed, and its result is shown.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

import { api, ok, request } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Facts } from "../components/facts.js";
import { bodyOf, FormFrame, loadSchema, SchemaField, TextField, useForm } from "../components/form.js";
import { JobProgress } from "../components/job.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { stationText } from "../components/strip_scale.js";
import { number, time } from "../format.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";
import { markerName } from "./plans_view.js";

/** @typedef {import("./plans_view.js").Plan} Plan @typedef {import("./plans_view.js").Marker} Marker */

const FIRST = ["drives", "conditions"];
const MORE = ["seed", "cameras", "speed_share", "lost_share", "clearance_m", "survey_rmse_m", "max_markers_per_drive", "max_sections_per_drive", "weak_below"];

/**
 * The unfinished job of a kind about a plan, so that a reload goes on following it.
 *
 * @param {Plan} plan
 * @param {"proof" | "package"} kind
 */
export function useUnfinished(plan, kind) {
  const found = useLoad(async (signal) => {
    const { items } = await ok(api.GET("/v1/jobs", { params: { query: { kind, subject_id: plan.id, limit: 50 } }, signal }));
    return items.find((job) => ["queued", "running"].includes(job.state))?.id ?? "";
  }, [plan.id]);
  const [started, setStarted] = useState("");
  return { job: started || found.data || "", start: setStarted, loading: found.loading };
}

/**
 * @param {{ plan: Plan, markers: Marker[], pointed: string | null, onPoint: (id: string | null) => void, onChanged: () => void }} props
 */
export function ProofTab({ plan, markers, pointed, onPoint, onChanged }) {
  const { job, start } = useUnfinished(plan, "proof");
  return html`
    <div class="beside">
      <div>${plan.proof ? html`<${Proof} plan=${plan} proof=${plan.proof} markers=${markers} pointed=${pointed} onPoint=${onPoint} />` : html`<${Empty} title=${t("plan.not_proved")}><p>${t("proof.text")}</p></${Empty}>`}</div>
      <div class="sticky">
        ${job && html`<section class="card"><h2>${t("proof.running")}</h2><${JobProgress} key=${job} id=${job} onDone=${onChanged} /></section>`}
        ${may("POST /v1/plans/{plan_id}/proof") && html`<section class="card"><h2>${t(plan.proof ? "proof.again" : "proof.start")}</h2><${ProofForm} plan=${plan} onStarted=${start} /></section>`}
      </div>
    </div>
  `;
}

/** @param {{ plan: Plan, onStarted: (job: string) => void }} props */
function ProofForm({ plan, onStarted }) {
  const form = useForm({ conditions: "day" });
  const schema = useLoad(() => loadSchema("ProofIn"), []);
  const submit = async () => {
    const response = await request(`/v1/plans/${encodeURIComponent(plan.id)}/proof`, {
      method: "POST", headers: { "Content-Type": "application/json", "If-Match": `"${plan.version}"` }, body: JSON.stringify(bodyOf(form.values, schema.data ?? undefined)),
    });
    onStarted((await response.json()).id);
  };
  /** @param {any} root @param {string} path */
  const field = (root, path) => (path === "conditions" || path === "cameras"
    ? html`<${TextField} form=${form} path=${path} label=${t(`proof.${path}`)} hint=${t(`proof.${path}_hint`)} />`
    : html`<${SchemaField} form=${form} schema=${root} path=${path} />`);
  return html`<${Shown} of=${schema}>${(/** @type {any} */ root) => html`
    <${FormFrame} form=${form} onSubmit=${submit} button=${t("proof.button")}>
      <div class="group">${FIRST.map((path) => field(root, path))}</div>
      <details class="more" open=${MORE.some((path) => form.errors[path])}><summary>${t("rules.more")}</summary><div class="group">${MORE.map((path) => field(root, path))}</div></details>
    </${FormFrame}>
  `}</${Shown}>`;
}

/** @param {{ plan: Plan, proof: NonNullable<Plan["proof"]>, markers: Marker[], pointed?: string | null, onPoint?: (id: string | null) => void }} props */
export function Proof({ plan, proof, markers, pointed = null, onPoint }) {
  const byNumber = new Map(markers.map((marker) => [marker.number, marker]));
  return html`
    <p><${Verdict} level=${proof.passed ? "good" : "bad"}>${proof.passed ? t("proof.passed") : t("proof.wrong", { count: proof.wrong })}</${Verdict}></p>
    <${Facts} of=${[
      [t("field.at"), `${time(proof.at)} UTC`], [t("proof.drives"), t("proof.drives_text", { drives: proof.terms.drives, conditions: proof.terms.conditions.map((name) => name.split("+").map((part) => textOr(`option.${part}`, part)).join(" + ")).join(", "), seed: proof.terms.seed })],
      [t("proof.markers"), number(proof.markers)], [t("plan.weak"), number(proof.weak)],
    ]} />
    <h3>${t("proof.rates")}</h3>
    <${RateTable} rates=${proof.rates} />
    ${proof.weak_markers.length > 0 && html`
      <h3>${t("plan.weak")}</h3>
      <div class="table-scroll plain-table" tabindex="0" role="region" aria-label=${t("plan.weak")}><table>
        <thead><tr><th scope="col">${t("proof.marker")}</th><th scope="col">${t("field.lane")}</th><th scope="col" class="number">${t("field.station")}</th><th scope="col" class="number">${t("proof.read")}</th><th scope="col">${t("proof.cause")}</th></tr></thead>
        <tbody>${proof.weak_markers.map((weak) => {
          const marker = byNumber.get(weak.number);
          return html`<tr class=${pointed === `w${weak.number}` ? "pointed" : undefined} onPointerEnter=${() => onPoint?.(`w${weak.number}`)} onPointerLeave=${() => onPoint?.(null)}><th scope="row">${marker ? markerName(marker) : weak.number}</th><td>${weak.lane}</td><td class="number">${weak.station_m == null ? number(weak.chainage_m, 2) : stationText(weak.station_m)}</td>
            <td class="number">${t("proof.read_of", { read: weak.read, passes: weak.passes })}</td><td>${weak.cause ?? "–"}</td></tr>`;
        })}</tbody>
      </table></div>`}
    <p class="hint">${t("proof.csv")} <a href=${`/plans/${plan.id}?tab=files`}>${t("plan.tab_files")}</a></p>
  `;
}

/** Read rates with their 95 % intervals, as bars and numbers. @param {{ rates: any[] }} props */
export function RateTable({ rates }) {
  return html`
    <table class="figures rates">
      <thead><tr><th scope="col">${t("proof.what")}</th><th scope="col" class="number">${t("proof.passes")}</th><th scope="col" class="number">${t("proof.rate")}</th><th scope="col">${t("proof.interval")}</th></tr></thead>
      <tbody>${rates.map((rate) => html`
        <tr><th scope="row">${textOr(`proof_kind.${rate.kind}`, rate.kind)}, ${rate.condition.split("+").map((/** @type {string} */ part) => textOr(`option.${part}`, part)).join(" + ")}</th><td class="number">${number(rate.passes)}</td><td class="number">${number(100 * rate.rate, 1, "%")}</td>
          <td><svg class="interval" viewBox="0 0 100 12" preserveAspectRatio="none" aria-hidden="true"><rect class="whole" x="0" y="5" width="100" height="2" /><rect class="range" x=${100 * rate.low} y="3" width=${Math.max(100 * (rate.high - rate.low), 1)} height="6" /></svg> ${t("proof.range", { low: number(100 * rate.low, 1), high: number(100 * rate.high, 1) })}</td></tr>`)}</tbody>
    </table>
  `;
}
