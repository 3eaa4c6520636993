// Magnet studio: codebooks and their capacity, a tag from above with its field, and planning a tag on a lane.

import { html } from "htm/preact";

import { api, page } from "../api/client.js";
import { loadSchema } from "../components/form.js";
import { Shown, useLoad } from "../components/load.js";
import { useQueryForm } from "../components/query_form.js";
import { Tabs } from "../components/tabs.js";
import { may } from "../session.js";
import { t } from "../texts/index.js";
import { Capacity, CodebookForm, useCodes } from "./studio_magnets_codes.js";
import { FieldForm, TagField } from "./studio_magnets_field.js";
import { PlanForm } from "./studio_magnets_plan.js";
import { TagDrawing } from "./studio_magnets_tag.js";
import { parseTag } from "./studio_magnets_model.js";

const FIELDS = {
  book: "book", tag: "tag", magnets: "design.magnets", length: "design.length_m", segment: "design.segment_m", min_gap: "design.min_gap_m",
  speed: "rules.speed_m_s", read_clearance: "rules.clearance_m", confusion: "rules.confusion", safe: "rules.wrong_way_safe", missing: "rules.survive_missing",
  clearance: "clearance_m", depth: "depth_m", lateral: "lateral_m", axis: "axis",
};
/** @type {import("../components/form.js").Values} */
const START = {
  book: "", tag: "", "design.magnets": "3", "design.length_m": "4", "design.segment_m": "0.1", "design.min_gap_m": "0.5",
  "rules.speed_m_s": "13.4", "rules.clearance_m": "0.3", "rules.confusion": "0.001", "rules.wrong_way_safe": false, "rules.survive_missing": false,
  clearance_m: "0.16", depth_m: "0", lateral_m: "0", axis: "x",
};

/** @param {{ query: URLSearchParams }} props */
export default function StudioMagnets({ query }) {
  const found = useLoad(async (signal) => {
    const [plan, draft, books] = await Promise.all([
      loadSchema("MagnetIn"), loadSchema("CodebookDraftIn"), page(api.GET("/v1/codebooks", { params: { query: { limit: 100 } }, signal })),
    ]);
    return { plan, draft, books: books.items };
  }, []);
  const tab = query.get("tab") ?? "tag";
  const tabs = /** @type {[string, string][]} */ ([["tag", t("magnets.tab_tag")], ...(may("POST /v1/markers") ? [["plan", t("magnets.plan")]] : [])]);
  return html`
    <h1>${t("magnets.studio")}</h1>
    <${Tabs} label=${t("magnets.studio")} of=${tabs} chosen=${tab} />
    <${Shown} of=${found}>${(/** @type {any} */ { plan, draft, books }) => (tab === "plan"
      ? html`<${PlanForm} schema=${plan} books=${books} />`
      : html`<${Tag} schema=${draft} books=${books} reload=${found.reload} />`)}</${Shown}>
  `;
}

/** @param {{ schema: any, books: any[], reload: () => void }} props */
function Tag({ schema, books, reload }) {
  const typed = useQueryForm(FIELDS, START, null);
  const codes = useCodes(typed.values, schema, books);
  const text = String(typed.values.tag ?? "").trim() || codes.list[0]?.code || "";
  const tag = parseTag(text);
  return html`
    <div class="studio">
      <div class="studio-form">
        <${CodebookForm} schema=${schema} typed=${typed} books=${books} codes=${codes} text=${text} valid=${Boolean(tag) || !text} reload=${reload} />
        ${tag && html`<${FieldForm} typed=${typed} />`}
      </div>
      <div class="studio-view">
        ${tag && html`
          <section class="card" aria-label=${t("magnets.from_above")}>
            <div class="title-line"><h2 class="code">${text}</h2><p class="hint">${codes.list.find(({ code }) => code === text)?.meaning ?? ""}</p></div>
            <${TagDrawing} tag=${tag} />
          </section>
          <${TagField} tag=${tag} typed=${typed} />
        `}
        ${!codes.figures && !codes.error && html`<p class="loading" role="status">${t("load.loading")}</p>`}
        <${Capacity} codes=${codes} />
      </div>
    </div>
  `;
}
