// A new road: a registered axis with its measures, or lanes for plans.

import { html } from "htm/preact";

import { notify } from "../components/notices.js";
import { navigate, query, setQuery } from "../router.js";
import { t } from "../texts/index.js";
import { RoadForm } from "./plans_road.js";
import { AxisForm } from "./roads_axis.js";

export default function NewRoad() {
  const lanes = query.value.get("kind") === "lanes";
  return html`
    <h1>${t(lanes ? "roads.new_lanes" : "roads.new")}</h1>
    <div class="segments" role="group" aria-label=${t("roads.kind")}>
      ${/** @type {const} */ (["registered", "lanes"]).map((name) => html`<button type="button" class="quiet" aria-pressed=${lanes === (name === "lanes")} onClick=${() => setQuery({ kind: name === "lanes" ? name : null }, { replace: false })}>${t(`roads.kind_${name}`)}</button>`)}
    </div>
    <p class="hint">${t(lanes ? "roads.text_lanes" : "roads.text_registered")}</p>
    ${lanes ? html`<section class="card"><${RoadForm} way=${query.value.get("way") ?? "file"} onWay=${(/** @type {string} */ way) => setQuery({ way })} onDone=${(/** @type {any} */ made) => {
      notify(t("new.road_stored", { name: made.name }));
      navigate(`/roads/lanes/${made.id}`);
    }} /></section>` : html`<${AxisForm} onStored=${(/** @type {any} */ road) => {
      notify(t("axis.registered", { name: road.name }));
      navigate(`/roads/${road.id}`);
    }} />`}
  `;
}
