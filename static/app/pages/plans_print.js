// A plan as a report on paper: everything below each other, without the parts that are for hands.

import { html } from "htm/preact";
import { useEffect, useState } from "preact/hooks";

import { Strip } from "../components/strip.js";
import { number } from "../format.js";
import { t, textOr } from "../texts/index.js";
import { Proof } from "./plans_proof.js";
import { ChecksTable, LeftOutTable } from "./plans_tables.js";

const MAX_MARKERS = 2000;

/** Whether the page is being printed. The components that use it are drawn again before the browser prints. */
export function usePrinting() {
  const [printing, setPrinting] = useState(false);
  useEffect(() => {
    const media = window.matchMedia("print");
    const on = () => setPrinting(true);
    const off = () => setPrinting(false);
    const change = () => setPrinting(media.matches);
    window.addEventListener("beforeprint", on);
    window.addEventListener("afterprint", off);
    media.addEventListener("change", change);
    return () => {
      window.removeEventListener("beforeprint", on);
      window.removeEventListener("afterprint", off);
      media.removeEventListener("change", change);
    };
  }, []);
  return printing;
}

/**
 * @param {{ plan: import("./plans_view.js").Plan, profile: import("./plans_view.js").Profile, markers: import("./plans_view.js").Marker[], things: import("./plans_view.js").Thing[] }} props
 */
export function PlanPrint({ plan, profile, markers, things }) {
  const lanes = profile.lanes.filter(({ name }) => things.some((thing) => thing.lane === name && thing.kind === "marker"));
  const families = [...new Set(markers.map(({ family }) => family))];
  const rows = [{ id: "checks", title: t("plan.checks") }, ...families.map((family) => ({ id: `family ${family}`, title: textOr(`family_many.${family}`, family) })), { id: "weak", title: t("plan.weak") }, { id: "events", title: t("plan.events") }];
  return html`
    <div class="report">
      ${lanes.slice(0, 20).map((lane) => html`<${Strip} key=${lane.name} way=${lane} rows=${rows} label=${t("plan.along", { lane: lane.name })}
        items=${things.filter((thing) => thing.lane === lane.name).map((thing) => ({ ...thing, kind: thing.level ?? thing.kind, ...(thing.kind === "marker" ? {} : { family: "" }) }))} />`)}
      <h2>${t("plan.checks")}</h2><${ChecksTable} plan=${plan} />
      ${plan.proof && html`<h2>${t("plan.proof")}</h2><${Proof} plan=${plan} proof=${plan.proof} markers=${markers} />`}
      ${plan.left_out.length > 0 && html`<h2>${t("plan.left_out")}</h2><${LeftOutTable} plan=${plan} />`}
      <h2>${t("markers.title")}</h2>
      <table>
        <thead><tr><th scope="col" class="number">${t("field.number")}</th><th scope="col">${t("field.family")}</th><th scope="col">${t("field.code")}</th><th scope="col">${t("field.lane")}</th><th scope="col" class="number">${t("field.station")}</th><th scope="col" class="number">${t("field.offset_m")}</th><th scope="col">${t("field.details")}</th></tr></thead>
        <tbody>${markers.slice(0, MAX_MARKERS).map((marker) => html`<tr><th scope="row" class="number">${marker.number}</th><td>${textOr(`family.${marker.family}`, marker.family)}</td><td class="code">${marker.code}</td><td>${marker.lane}</td><td class="number">${marker.station}</td><td class="number">${number(marker.offset_m, 2)}</td><td>${marker.details}</td></tr>`)}</tbody>
      </table>
      ${markers.length > MAX_MARKERS && html`<p>${t("print.more", { shown: MAX_MARKERS, count: markers.length })}</p>`}
      <h2>${t("plan.tab_rules")}</h2><pre>${JSON.stringify(plan.rules, null, 1)}</pre>
    </div>
  `;
}
