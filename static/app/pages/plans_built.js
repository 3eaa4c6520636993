// A committed plan beside what was built and surveyed.

import { html } from "htm/preact";

import { api, ok } from "../api/client.js";
import { StatusBadge, Verdict } from "../components/badges.js";
import { Facts } from "../components/facts.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { number } from "../format.js";
import { t, textOr } from "../texts/index.js";
import { figureText, LEVELS } from "./plans_preview.js";
import { checkName } from "./plans_view.js";

/** @param {{ plan: import("./plans_view.js").Plan }} props */
export function BuiltTab({ plan }) {
  const built = useLoad((signal) => ok(api.GET("/v1/plans/{plan_id}/as-built", { params: { path: { plan_id: plan.id } }, signal })), [plan.id, plan.version]);
  return html`<${Shown} of=${built}>${(/** @type {any} */ found) => (found.surveyed === 0 ? html`<${Empty} title=${t("built.none")}><p>${t("built.none_text", { count: found.not_surveyed })}</p></${Empty}>` : html`
    <${Facts} of=${[
      [t("built.surveyed"), t("built.surveyed_text", { surveyed: found.surveyed, all: found.surveyed + found.not_surveyed })],
      [t("built.out"), html`<${Verdict} level=${found.out_of_tolerance ? "bad" : "good"}>${number(found.out_of_tolerance)}</${Verdict}>`],
      [t("built.rms"), t("built.rms_text", { along: number(found.rms_along_m, 3, "m"), across: number(found.rms_across_m, 3, "m") })],
    ]} />
    <div class="columns">
      <div class="table-scroll plain-table" tabindex="0" role="region" aria-label=${t("built.markers")}><table>
        <thead><tr><th scope="col" class="number">${t("field.number")}</th><th scope="col">${t("field.status")}</th><th scope="col" class="number">${t("built.along")}</th><th scope="col" class="number">${t("built.across")}</th><th scope="col">${t("built.tolerance")}</th></tr></thead>
        <tbody>${found.markers.map((/** @type {any} */ marker) => html`<tr><th scope="row" class="number"><a href=${`/markers/${marker.marker_id}`}>${marker.number}</a></th><td><${StatusBadge} status=${marker.status} /></td><td class="number">${number(marker.along_m, 3)}</td><td class="number">${number(marker.across_m, 3)}</td>
          <td><${Verdict} level=${marker.in_tolerance ? "good" : "bad"}>${t(marker.in_tolerance ? "built.in" : "built.outside")}</${Verdict}></td></tr>`)}</tbody>
      </table></div>
      <div class="table-scroll plain-table" tabindex="0" role="region" aria-label=${t("plan.checks")}><table>
        <thead><tr><th scope="col">${t("checks.check")}</th><th scope="col">${t("built.planned")}</th><th scope="col">${t("built.built")}</th></tr></thead>
        <tbody>${found.checks.map((/** @type {any} */ check) => html`<tr class=${check.verdict_changed ? "changed" : undefined}><th scope="row">${checkName(check.name)}</th>${[check.planned, check.built].map((finding) => html`<td>${finding ? html`<${Verdict} level=${LEVELS[finding.verdict] ?? "none"}>${textOr(`verdict.${finding.verdict}`, finding.verdict)}</${Verdict}> ${figureText(finding)}` : "–"}</td>`)}</tr>`)}</tbody>
      </table></div>
    </div>
  `)}</${Shown}>`;
}
