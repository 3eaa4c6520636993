// Variants side by side: their figures and checks, what differs in their rules, and their markers along the same lane.

import { html } from "htm/preact";

import { api, ok, request } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { Strip } from "../components/strip.js";
import { MISSING, number } from "../format.js";
import { query, setQuery } from "../router.js";
import { t, textOr } from "../texts/index.js";
import { PlanStatus } from "./plans.js";
import { costText, figureText, LEVELS } from "./plans_preview.js";
import { checkName, loadProfile, thingsOf } from "./plans_view.js";

/** @typedef {import("./plans_view.js").Plan} Plan */

const MAX_PLANS = 6;

export default function Compare() {
  const ids = (query.value.get("ids") ?? "").split(",").filter(Boolean).slice(0, MAX_PLANS);
  const plans = useLoad((signal) => Promise.all(ids.map((id) => ok(api.GET("/v1/plans/{plan_id}", { params: { path: { plan_id: id } }, signal })))), [ids.join()]);
  return html`
    <h1>${t("compare.title")}</h1>
    ${ids.length === 0 ? html`<${Empty} title=${t("compare.none")}><p><a href="/plans">${t("plans.title")}</a></p></${Empty}>`
      : html`<${Shown} of=${plans}>${(/** @type {Plan[]} */ found) => html`<${Table} plans=${found} ids=${ids} /><${Rules} plans=${found} /><${Strips} plans=${found} />`}</${Shown}>`}
  `;
}

/** @param {{ plans: Plan[], ids: string[] }} props */
function Table({ plans, ids }) {
  const families = [...new Set(plans.flatMap((plan) => Object.keys(plan.counts)))];
  const checks = [...new Set(plans.flatMap((plan) => plan.findings.map(({ name }) => name)))];
  const conditions = [...new Set(plans.flatMap((plan) => (plan.proof?.rates ?? []).map(({ kind, condition }) => `${kind} ${condition}`)))];
  /** @param {string} id */
  const without = (id) => setQuery({ ids: ids.filter((other) => other !== id).join() }, { replace: false });
  return html`
    <div class="table-frame"><div class="table-scroll compare" tabindex="0" role="region" aria-label=${t("compare.title")}>
      <table>
        <thead><tr><th scope="col">${t("preview.figure")}</th>${plans.map((plan) => html`<th scope="col"><a href=${`/plans/${plan.id}`}>${plan.name}</a> <button type="button" class="icon" aria-label=${t("compare.remove", { name: plan.name })} onClick=${() => without(plan.id)}>✕</button></th>`)}</tr></thead>
        <tbody>
          <${Line} name=${t("field.status")} plans=${plans} of=${(/** @type {Plan} */ plan) => html`<${PlanStatus} status=${plan.status} />`} />
          <${Line} name=${t("plan.cost")} plans=${plans} of=${costText} less=${(/** @type {Plan} */ plan) => (plan.cost_complete ? plan.cost : null)} unit=${plans[0]?.currency ?? ""} />
          ${families.map((family) => html`<${Line} name=${textOr(`family_many.${family}`, family)} plans=${plans} of=${(/** @type {Plan} */ plan) => number(plan.counts[family] ?? 0)} less=${(/** @type {Plan} */ plan) => plan.counts[family] ?? 0} />`)}
          <${Line} name=${t("plan.left_out")} plans=${plans} of=${(/** @type {Plan} */ plan) => number(plan.left_out_count)} />
          ${checks.map((name) => html`<${Line} name=${checkName(name)} plans=${plans} of=${(/** @type {Plan} */ plan) => findingCell(plan, name)} />`)}
          ${conditions.map((name) => html`<${Line} name=${t("compare.proved", { name: name.split(" ").map((part) => textOr(`proof_kind.${part}`, textOr(`option.${part}`, part))).join(", ") })} plans=${plans} of=${(/** @type {Plan} */ plan) => rateCell(plan, name)} />`)}
        </tbody>
      </table>
    </div></div>
    ${plans.some((plan) => !plan.cost_complete) && html`<p class="hint">${t("plan.cost_incomplete")}</p>`}
  `;
}

/** @param {{ name: string, plans: Plan[], of: (plan: Plan) => any, less?: (plan: Plan) => number | null, unit?: string }} props */
function Line({ name, plans, of, less, unit = "" }) {
  const first = plans[0] && less ? less(plans[0]) : null;
  return html`<tr><th scope="row">${name}</th>${plans.map((plan, k) => {
    const own = less?.(plan) ?? null;
    const apart = k && own !== null && first !== null ? own - first : 0;
    return html`<td>${of(plan)}${apart !== 0 && html` <span class="hint">(${apart > 0 ? "+" : "−"}${number(Math.abs(apart), unit ? 2 : 0, unit)})</span>`}</td>`;
  })}</tr>`;
}

/** @param {Plan} plan @param {string} name */
function findingCell(plan, name) {
  const finding = plan.findings.find((one) => one.name === name);
  return finding ? html`<${Verdict} level=${LEVELS[finding.verdict] ?? "none"}>${textOr(`verdict.${finding.verdict}`, finding.verdict)}</${Verdict}> ${figureText(finding)}` : MISSING;
}

/** @param {Plan} plan @param {string} name */
function rateCell(plan, name) {
  const rate = plan.proof?.rates.find(({ kind, condition }) => `${kind} ${condition}` === name);
  return rate ? `${number(100 * rate.rate, 1, "%")} (${t("proof.range", { low: number(100 * rate.low, 0), high: number(100 * rate.high, 0) })})` : MISSING;
}

/** Rules that differ. @param {{ plans: Plan[] }} props */
function Rules({ plans }) {
  const flat = plans.map((plan) => flattened(plan.rules));
  const paths = [...new Set(flat.flatMap((rules) => [...rules.keys()]))].filter((path) => new Set(flat.map((rules) => rules.get(path) ?? "")).size > 1).sort();
  return html`
    <h2>${t("compare.rules")}</h2>
    ${paths.length === 0 ? html`<p>${t("compare.same_rules")}</p>` : html`
      <div class="table-frame"><div class="table-scroll compare" tabindex="0" role="region" aria-label=${t("compare.rules")}><table>
        <thead><tr><th scope="col">${t("compare.rule")}</th>${plans.map((plan) => html`<th scope="col">${plan.name}</th>`)}</tr></thead>
        <tbody>${paths.map((path) => html`<tr><th scope="row" class="code small">${path}</th>${flat.map((rules) => html`<td>${rules.get(path) ?? MISSING}</td>`)}</tr>`)}</tbody>
      </table></div></div>`}
  `;
}

/** @param {any} rules @param {string} [path] @param {Map<string, string>} [found] */
function flattened(rules, path = "", found = new Map()) {
  for (const [name, value] of Object.entries(rules)) {
    const place = path ? `${path}.${name}` : name;
    const list = Array.isArray(value) && value.every((item) => typeof item !== "object");
    if (value && typeof value === "object" && !list) flattened(value, place, found);
    else if (value !== null && value !== undefined) found.set(place, list ? value.join(", ") : String(value));
  }
  return found;
}

/** The markers of each plan along one lane. @param {{ plans: Plan[] }} props */
function Strips({ plans }) {
  const alignment = plans[0]?.alignment_id ?? "";
  const own = plans.filter((plan) => plan.alignment_id === alignment);
  const road = useLoad(async (signal) => {
    const [profile, ...sets] = await Promise.all([loadProfile(alignment), ...own.map(async (plan) => {
      const { features } = await (await request(`/v1/plans/${encodeURIComponent(plan.id)}/files/plan.geojson`, { signal })).json();
      const markers = features.filter((/** @type {any} */ feature) => feature.properties.kind === "marker").map((/** @type {any} */ { properties, geometry }) => ({ ...properties, lon_deg: geometry.coordinates[0], lat_deg: geometry.coordinates[1] }));
      return /** @type {[string, any[]]} */ ([plan.id, markers]);
    })]);
    return { profile, markers: new Map(sets) }; // by plan: another set of plans may be shown while theirs are loaded
  }, [own.map(({ id, version }) => `${id} ${version}`).join()]);
  return html`
    <h2>${t("compare.along")}</h2>
    ${own.length < plans.length && html`<p class="hint">${t("compare.other_roads")}</p>`}
    <${Shown} of=${road}>${(/** @type {any} */ { profile, markers }) => {
      const lane = profile.lanes.find((/** @type {any} */ one) => one.name === query.value.get("lane")) ?? profile.lanes[0];
      return html`
        ${profile.lanes.length > 1 && html`<label class="lane-choice">${t("plan.lane")} <select value=${lane.name} onChange=${(/** @type {any} */ event) => setQuery({ lane: event.currentTarget.value, strip: null })}>${profile.lanes.map((/** @type {any} */ { name }) => html`<option value=${name} selected=${name === lane.name}>${name}</option>`)}</select></label>`}
        ${own.map((plan, k) => {
          const things = thingsOf(profile, { markers: markers.get(plan.id) ?? [], findings: plan.findings }).filter((thing) => thing.lane === lane.name);
          const rows = [{ id: "checks", title: t("plan.checks") }, ...Object.keys(plan.counts).map((family) => ({ id: `family ${family}`, title: textOr(`family_many.${family}`, family) }))];
          return html`<${Strip} key=${plan.id} way=${k ? { ...lane, curvature_per_m: null } : lane} rows=${rows} label=${plan.name} items=${things.map((thing) => ({ ...thing, kind: thing.level ?? thing.kind, ...(thing.kind === "marker" ? {} : { family: "" }) }))} />`;
        })}
      `;
    }}</${Shown}>
  `;
}
