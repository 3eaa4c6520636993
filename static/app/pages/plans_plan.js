// One plan: its status and what comes next, its figures, the road with markers and checks, and what is behind the tabs.

import { html } from "htm/preact";
import { useEffect, useMemo, useState } from "preact/hooks";

import { api, ok, request } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Shown, useLoad } from "../components/load.js";
import { chainageNear } from "../components/strip_scale.js";
import { Tabs } from "../components/tabs.js";
import { number, time } from "../format.js";
import { query, setQuery } from "../router.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";
import { countsText, PlanStatus } from "./plans.js";
import { BuiltTab } from "./plans_built.js";
import { PlanFiles } from "./plans_files.js";
import { costText, figureText, LEVELS, predictions } from "./plans_preview.js";
import { PlanPrint, usePrinting } from "./plans_print.js";
import { ProofTab } from "./plans_proof.js";
import { ChangeRules } from "./plans_spacing.js";
import { PlanActions, PlanHistory } from "./plans_steps.js";
import { ChecksTable, LeftOutTable, MarkersTable } from "./plans_tables.js";
import { loadProfile, PlanView, thingsOf } from "./plans_view.js";

/** @typedef {import("./plans_view.js").Plan} Plan @typedef {import("./plans_view.js").Profile} Profile @typedef {import("./plans_view.js").Marker} Marker */

const WAY = ["checked", "proved", "approved", "committed", "built", "surveyed"];
const TABS = /** @type {const} */ (["checks", "markers", "left_out", "rules", "proof", "built", "files", "history"]);

/** @param {{ parameters: { plan_id: string } }} props */
export default function PlanPage({ parameters }) {
  const id = parameters.plan_id;
  const found = useLoad((signal) => ok(api.GET("/v1/plans/{plan_id}", { params: { path: { plan_id: id } }, signal })), [id]);
  return html`<${Shown} of=${found}>${(/** @type {Plan} */ plan) => html`<${Loaded} key=${plan.id} plan=${plan} onChanged=${found.reload} />`}</${Shown}>
    ${found.error !== null && html`<h1 class="hidden">${t("plans.title")}</h1>`}`;
}

/** The road and the markers of a plan. @param {Plan} plan @param {AbortSignal} signal */
async function loadRoad(plan, signal) {
  const [profile, response] = await Promise.all([
    loadProfile(plan.alignment_id),
    request(`/v1/plans/${encodeURIComponent(plan.id)}/files/plan.geojson`, { signal }),
  ]);
  const { features } = await response.json();
  const lanes = new Map(profile.lanes.map((lane) => [lane.name, lane]));
  /** @type {Marker[]} */
  const markers = [];
  const events = [];
  for (const { properties, geometry } of features) {
    const lane = lanes.get(properties.lane);
    const [lon_deg, lat_deg] = geometry.coordinates;
    if (properties.kind === "marker") markers.push({ ...properties, lon_deg, lat_deg, details: detailsOf(properties) });
    if (properties.kind === "event" && lane) events.push({ kind: properties.event, lane: properties.lane, value: properties.value, lon_deg, lat_deg, chainage_m: chainageNear(lane, lon_deg, lat_deg) });
  }
  return { profile: { ...profile, events }, markers };
}

/** @param {any} properties */
const detailsOf = ({ scheme, side_mm, meaning, magnets, side, line, speed_limit }) =>
  [scheme, side_mm && number(side_mm, 0, "mm"), meaning, magnets && t("plan.magnets", { count: magnets }), side && textOr(`option.${side}`, side), line && textOr(`option.${line}`, line), speed_limit].filter(Boolean).join(", ");

/** @param {{ plan: Plan, onChanged: () => void }} props */
function Loaded({ plan, onChanged }) {
  const road = useLoad((signal) => loadRoad(plan, signal), [plan.id, plan.version]);
  const alignment = useLoad((signal) => ok(api.GET("/v1/alignments/{alignment_id}", { params: { path: { alignment_id: plan.alignment_id } }, signal })), [plan.alignment_id]);
  const [pointed, setPointed] = useState(/** @type {string | null} */ (null));
  const [preview, setPreview] = useState(/** @type {any} */ (null));
  const printing = usePrinting();
  const tab = TABS.find((name) => name === query.value.get("tab")) ?? "checks";
  useEffect(() => {
    document.title = `${plan.name} – Waymark`;
  }, [plan.name]);
  const previewed = tab === "rules" ? preview : null;
  const things = useMemo(() => {
    if (!road.data) return [];
    const weak = plan.proof?.weak_markers ?? [];
    return thingsOf(road.data.profile, previewed ? { markers: previewed.markers, findings: previewed.findings } : { markers: road.data.markers, findings: plan.findings, weak });
  }, [road.data, previewed, plan]);
  const choose = (/** @type {string} */ id) => {
    const name = { m: "markers", c: "checks", w: "proof" }[id.slice(0, 1)];
    if (name && tab !== "rules") setQuery({ tab: name, item: id });
    setPointed(id);
  };
  const item = query.value.get("item");
  return html`
    <div class="title-line"><h1>${plan.name}</h1><${PlanActions} plan=${plan} onChanged=${onChanged} /></div>
    <${Way} plan=${plan} />
    <p class="plan-line"><${PlanStatus} status=${plan.status} /> · <a href=${`/roads/lanes/${plan.alignment_id}`}>${alignment.data?.name ?? t("plans.road")}</a>${" · "}<a href=${`/plans?alignment=${plan.alignment_id}`}>${t("plan.variants")}</a> · ${t("plan.by", { author: plan.author, version: plan.version, at: time(plan.updated_at) })}${plan.approver && ` · ${t("plan.approved_by", { name: plan.approver })}`}</p>
    <${Figures} plan=${plan} />
    <${Shown} of=${road}>${(/** @type {any} */ { profile, markers }) => html`
      ${printing ? html`<${PlanPrint} plan=${plan} profile=${profile} markers=${markers} things=${things} />` : html`
        <${PlanView} profile=${profile} things=${things} pointedId=${pointed ?? item} onPoint=${setPointed} onChoose=${choose} note=${previewed ? t("plan.preview_on_map") : ""} />
        <${Tabs} label=${t("plan.parts")} of=${tabsOf(plan)} chosen=${tab} without=${["item", "sort", "columns"]} />
        <div class="tab">
          ${tab === "checks" && html`<${ChecksTable} plan=${plan} pointed=${pointed ?? item} onPoint=${setPointed} />`}
          ${tab === "markers" && html`<${MarkersTable} markers=${markers} proof=${plan.proof} chosen=${item} pointed=${pointed} onPoint=${setPointed} />`}
          ${tab === "left_out" && html`<${LeftOutTable} plan=${plan} />`}
          ${tab === "rules" && html`<${ChangeRules} plan=${plan} onChanged=${onChanged} onPreview=${setPreview} />`}
          ${tab === "proof" && html`<${ProofTab} plan=${plan} markers=${markers} pointed=${pointed ?? item} onPoint=${setPointed} onChanged=${onChanged} />`}
          ${tab === "built" && html`<${BuiltTab} plan=${plan} />`}
          ${tab === "files" && html`<${PlanFiles} plan=${plan} />`}
          ${tab === "history" && html`<${PlanHistory} plan=${plan} />`}
        </div>`}
    `}</${Shown}>
  `;
}

/** The steps of a plan from check to survey; the present one is marked. @param {{ plan: Plan }} props */
function Way({ plan }) {
  const at = WAY.indexOf(plan.status);
  return html`
    <ol class="way" aria-label=${t("plan.way")}>
      ${WAY.map((name, k) => html`<li class=${k <= at ? "done" : undefined} aria-current=${k === at ? "step" : undefined}><span aria-hidden="true">${k <= at ? "✓" : "○"}</span> ${textOr(`option.${name}`, name)}</li>`)}
    </ol>
  `;
}

/** @param {{ plan: Plan }} props */
function Figures({ plan }) {
  const unmet = plan.findings.filter(({ verdict }) => verdict !== "ok").length;
  const rates = predictions(plan).filter(({ name }) => name.startsWith("predicted-read-rate"));
  const lowest = [...rates].sort((a, b) => a.figure - b.figure)[0];
  const total = Object.values(plan.counts).reduce((sum, count) => sum + count, 0);
  const proved = plan.proof?.rates[0];
  return html`
    <div class="tiles plan-figures">
      <section class="card tile"><h2>${t("plan.checks")}</h2><p class="figure"><${Verdict} level=${LEVELS[plan.verdict] ?? "none"}>${textOr(`verdict.${plan.verdict}`, plan.verdict)}</${Verdict}></p>
        <p class="hint">${t(unmet ? "plan.unmet" : "plan.all_met", { count: unmet, all: plan.findings.length })}</p></section>
      <section class="card tile"><h2>${t("markers.title")}</h2><p class="figure">${number(total)}</p><p class="hint">${countsText(plan.counts)}; ${t("plan.on_length", { length: number(plan.lane_length_m / 1000, 3, "km") })}</p></section>
      <section class="card tile"><h2>${t("plan.cost")}</h2><p class="figure">${costText(plan)}</p><p class="hint">${plan.cost_complete ? t("plan.cost_per_km", { cost: number(plan.cost / (plan.lane_length_m / 1000), 0, plan.currency) }) : t("plan.cost_incomplete")}</p></section>
      <section class="card tile"><h2>${t("plans.read_rate")}</h2><p class="figure">${lowest ? figureText(lowest) : "–"}</p>
        <p class="hint">${proved ? t("plan.proved_rate", { rate: number(100 * proved.rate, 1, "%"), low: number(100 * proved.low, 0), high: number(100 * proved.high, 0), passes: proved.passes }) : t("plan.not_proved")}</p></section>
    </div>
  `;
}

/** The parts of the page that the reader may see, with their numbers. @param {Plan} plan @returns {[string, string][]} */
function tabsOf(plan) {
  const shown = TABS.filter((name) => (name !== "built" || ["committed", "built", "surveyed"].includes(plan.status)) && (name !== "rules" || may("PATCH /v1/plans/{plan_id}") || may("POST /v1/plans")));
  const count = /** @type {Record<string, number>} */ ({ checks: plan.findings.length, markers: Object.values(plan.counts).reduce((sum, value) => sum + value, 0), left_out: plan.left_out_count });
  return shown.map((name) => [name, `${t(`plan.tab_${name}`)}${count[name] !== undefined ? ` (${number(count[name])})` : ""}`]);
}
