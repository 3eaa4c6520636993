// A road with lanes, as plans are made for it: on the map, along its lanes, and its plans.

import { html } from "htm/preact";
import { useMemo, useState } from "preact/hooks";

import { api, download, ok, page } from "../api/client.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { attempt } from "../components/notices.js";
import { number } from "../format.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";
import { countsText, PlanStatus } from "./plans.js";
import { RoadFacts } from "./plans_new.js";
import { costText } from "./plans_preview.js";
import { loadProfile, PlanView, thingsOf } from "./plans_view.js";

/** @param {{ parameters: { alignment_id: string } }} props */
export default function RoadWithLanes({ parameters }) {
  const id = parameters.alignment_id;
  const found = useLoad(async (signal) => {
    const road = await ok(api.GET("/v1/alignments/{alignment_id}", { params: { path: { alignment_id: id } }, signal }));
    const plans = await page(api.GET("/v1/plans", { params: { query: { alignment_id: id, limit: 100 } }, signal }));
    return { road, plans: plans.items, profile: await loadProfile(id) };
  }, [id]);
  return html`
    <h1>${found.data?.road.name ?? t("roads.title")}</h1>
    <${Shown} of=${found}>${(/** @type {any} */ data) => html`<${Road} key=${id} road=${data.road} plans=${data.plans} profile=${data.profile} />`}</${Shown}>
  `;
}

/** @param {{ road: any, plans: any[], profile: any }} props */
function Road({ road, plans, profile }) {
  const [pointed, setPointed] = useState(/** @type {string | null} */ (null));
  const things = useMemo(() => thingsOf(profile, { markers: [] }), [profile]);
  const name = road.declaration.file_name ?? "road";
  const source = road.declaration.road_id;
  return html`
    <${RoadFacts} road=${road} />
    <div class="actions">
      ${may("POST /v1/plans") && html`<a class="button" href=${`/plans/new?alignment=${road.id}`}>${t("plans.new")}</a>`}
      ${plans.length > 1 && html`<a class="button quiet" href=${`/plans/compare?ids=${plans.slice(0, 6).map(({ id }) => id).join(",")}`}>${t("roads.compare")}</a>`}
      ${source && html`<a class="button quiet" href=${`/roads/${source}`}>${t("roads.source")}</a>`}
      ${["osm", "xodr"].map((form) => html`<button type="button" class="quiet" onClick=${() => attempt(() => download(`/v1/alignments/${road.id}/map.${form}`, `${road.name}.${form}`))}>${t(form === "osm" ? "roads.lanelet2" : "roads.opendrive")}</button>`)}
      ${!source && html`<button type="button" class="quiet" onClick=${() => attempt(() => download(`/v1/alignments/${road.id}/source`, name))}>${t("roads.file")}</button>`}
    </div>
    <${PlanView} profile=${profile} things=${things} pointedId=${pointed} onPoint=${setPointed} onChoose=${setPointed} note=${t("roads.lanes_on_map", { count: profile.lanes.length })} />
    <h2>${t("plans.title")}</h2>
    ${plans.length ? html`
      <div class="table-scroll plain-table" tabindex="0" role="region" aria-label=${t("plans.title")}><table>
        <thead><tr><th scope="col">${t("field.name")}</th><th scope="col">${t("field.status")}</th><th scope="col">${t("markers.title")}</th><th scope="col" class="number">${t("plan.cost")}</th></tr></thead>
        <tbody>${plans.map((plan) => html`<tr><th scope="row"><a href=${`/plans/${plan.id}`}>${plan.name}</a></th><td><${PlanStatus} status=${plan.status} /></td><td>${countsText(plan.counts)}</td><td class="number">${costText({ ...plan, findings: [] })}</td></tr>`)}</tbody>
      </table></div>` : html`<${Empty} title=${t("roads.no_plans")} />`}
    <h2>${t("road_facts.lanes")}</h2>
    <div class="table-scroll plain-table" tabindex="0" role="region" aria-label=${t("road_facts.lanes")}><table>
      <thead><tr><th scope="col">${t("field.name")}</th><th scope="col" class="number">${t("field.length_m")}</th><th scope="col" class="number">${t("field.width_m")}</th><th scope="col" class="number">${t("roads.speed")}</th><th scope="col" class="number">${t("roads.radius")}</th><th scope="col" class="number">${t("roads.slope")}</th><th scope="col">${t("roads.lines")}</th></tr></thead>
      <tbody>${road.lanes.map((/** @type {any} */ lane) => html`<tr><th scope="row">${lane.name}</th><td class="number">${number(lane.length_m, 2)}</td><td class="number">${range(lane.width_m, 2)}</td><td class="number">${range(lane.design_speed_kmh, 0)}</td><td class="number">${number(lane.min_radius_m, 1)}</td><td class="number">${number(100 * lane.max_grade, 1)}</td><td>${textOr(`option.${lane.left_style}`, lane.left_style)}, ${textOr(`option.${lane.right_style}`, lane.right_style)}</td></tr>`)}</tbody>
    </table></div>
  `;
}

/** @param {number[] | null} values @param {number} digits */
const range = (values, digits) => (!values ? "–" : values[0] === values[1] ? number(values[0], digits) : `${number(values[0], digits)} – ${number(values[1], digits)}`);
