// All plans, with their counts, checks and costs; variants are ticked to be compared.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

import { api, page } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { Table } from "../components/table.js";
import { number, time } from "../format.js";
import { navigate, query, setQuery } from "../router.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";
import { costText, figureText, LEVELS } from "./plans_preview.js";

const STATUSES = ["draft", "checked", "proved", "approved", "committed", "built", "surveyed"];

/** All pages of a list. @template T @param {(after: string | undefined) => Promise<{ items: T[], after: string | null }>} load @returns {Promise<T[]>} */
export async function allOf(load) {
  /** @type {T[]} */
  const items = [];
  let after = /** @type {string | null} */ (null);
  do {
    const found = await load(after ?? undefined);
    items.push(...found.items);
    after = found.after;
  } while (after && items.length < 5000);
  return items;
}

/** @param {AbortSignal} signal */
export const loadAlignments = (signal) => allOf((after) => page(api.GET("/v1/alignments", { params: { query: { limit: 1000, ...(after ? { after } : {}) } }, signal })));

export default function Plans() {
  const alignment = query.value.get("alignment");
  const status = query.value.get("status") ?? "";
  const plans = useLoad((signal) => allOf((after) => page(api.GET("/v1/plans", {
    params: { query: { limit: 1000, ...(alignment ? { alignment_id: alignment } : {}), ...(status ? { status: /** @type {any} */ (status) } : {}), ...(after ? { after } : {}) } }, signal,
  }))), [alignment, status]);
  const roads = useLoad(loadAlignments, []);
  const [ticked, setTicked] = useState(() => new Set((query.peek().get("ticked") ?? "").split(",").filter(Boolean)));
  const names = new Map((roads.data ?? []).map(({ id, name }) => [id, name]));
  const chosen = (plans.data ?? []).filter(({ id }) => ticked.has(id));
  return html`
    <div class="title-line"><h1>${t("plans.title")}</h1>${may("POST /v1/plans") && html`<a class="button" href=${alignment ? `/plans/new?alignment=${alignment}` : "/plans/new"}>${t("plans.new")}</a>`}</div>
    <form class="filters" role="search" onSubmit=${(/** @type {Event} */ event) => event.preventDefault()}>
      <div class="filter"><label for="plans-road">${t("plans.road")}</label>
        <select id="plans-road" value=${alignment ?? ""} onChange=${(/** @type {any} */ event) => setQuery({ alignment: event.currentTarget.value }, { replace: false })}>
          <option value="">${t("plans.all_roads")}</option>${(roads.data ?? []).map(({ id, name }) => html`<option value=${id} selected=${id === alignment}>${name}</option>`)}
        </select></div>
      <div class="filter"><label for="plans-status">${t("field.status")}</label>
        <select id="plans-status" value=${status} onChange=${(/** @type {any} */ event) => setQuery({ status: event.currentTarget.value }, { replace: false })}>
          <option value="">${t("plans.all_statuses")}</option>${STATUSES.map((name) => html`<option value=${name} selected=${name === status}>${textOr(`option.${name}`, name)}</option>`)}
        </select></div>
      <span class="spacer"></span>
      <button type="button" class="quiet" disabled=${chosen.length < 2} onClick=${() => navigate(`/plans/compare?ids=${chosen.map(({ id }) => id).join(",")}`)}>${t("plans.compare", { count: chosen.length })}</button>
    </form>
    <${Shown} of=${plans}>${(/** @type {any[]} */ rows) => (rows.length ? html`
      <${Table} label=${t("plans.title")} rows=${rows} idOf=${(/** @type {any} */ row) => row.id} nameOf=${(/** @type {any} */ row) => row.name} columns=${columnsOf(names)} footer=${t("list.count", { count: number(rows.length) })}
        ticked=${ticked} onTick=${(/** @type {Set<string>} */ ids) => {
          setTicked(ids);
          setQuery({ ticked: ids.size <= 20 ? [...ids].join() : null });
        }} />` : html`
      <${Empty} title=${t(alignment || status ? "plans.none_found" : "plans.none")}>
        ${may("POST /v1/plans") && html`<p>${t("plans.none_text")}</p><p><a href="/plans/new">${t("plans.first")}</a></p>`}
      </${Empty}>`)}</${Shown}>
  `;
}

/** @param {Map<string, string>} roads @returns {import("../components/table.js").Column<any>[]} */
const columnsOf = (roads) => [
  { name: "name", title: t("field.name"), head: true, order: (row) => row.name, cell: (row) => html`<a href=${`/plans/${row.id}`}>${row.name}</a>` },
  { name: "status", title: t("field.status"), order: (row) => STATUSES.indexOf(row.status), cell: (row) => html`<${PlanStatus} status=${row.status} />` },
  { name: "verdict", title: t("field.verdict"), order: (row) => ["fail", "warn", "ok"].indexOf(row.verdict), cell: (row) => html`<${Verdict} level=${LEVELS[row.verdict] ?? "none"}>${textOr(`verdict.${row.verdict}`, row.verdict)}</${Verdict}>` },
  { name: "markers", title: t("markers.title"), order: (row) => totalOf(row), cell: (row) => countsText(row.counts) },
  { name: "read", title: t("plans.read_rate"), number: true, order: (row) => lowestRate(row)?.figure, cell: (row) => (lowestRate(row) ? figureText(lowestRate(row)) : "–") },
  { name: "cost", title: t("plan.cost"), number: true, order: (row) => row.cost, cell: (row) => costText({ ...row, findings: [] }) },
  { name: "road", title: t("plans.road"), order: (row) => roads.get(row.alignment_id), cell: (row) => html`<a href=${`/roads/lanes/${row.alignment_id}`}>${roads.get(row.alignment_id) ?? "–"}</a>` },
  { name: "length", title: t("field.lane_length_m"), number: true, hidden: true, order: (row) => row.lane_length_m, cell: (row) => number(row.lane_length_m) },
  { name: "left_out", title: t("plan.left_out"), number: true, hidden: true, order: (row) => row.left_out_count, cell: (row) => number(row.left_out_count) },
  { name: "updated", title: t("field.updated_at"), order: (row) => row.updated_at, cell: (row) => time(row.updated_at) },
];

/** @param {any} row */
const totalOf = (row) => Object.values(row.counts).reduce((sum, count) => sum + Number(count), 0);

/** The lowest predicted read rate of a plan. @param {any} row */
const lowestRate = (row) => row.checks.filter((/** @type {any} */ check) => check.name.startsWith("predicted-read-rate")).sort((/** @type {any} */ a, /** @type {any} */ b) => a.figure - b.figure)[0];

/** @param {Record<string, number>} counts */
export const countsText = (counts) => Object.entries(counts).map(([family, count]) => `${number(count)} ${textOr(`family_many.${family}`, family)}`).join(", ") || t("plan.no_markers");

/** A plan's status: how many steps of its way are done, and a word. @param {{ status: string }} props */
export function PlanStatus({ status }) {
  return html`<span class="badge"><span class=${`dot ${status}`} aria-hidden="true">${STATUSES.indexOf(status) < 1 ? "○" : STATUSES.indexOf(status) < 3 ? "◔" : STATUSES.indexOf(status) < 4 ? "◑" : "●"}</span> ${textOr(`option.${status}`, status)}</span>`;
}
