// Plate studio: see a plate before it is made, what a camera sees of it, artwork of many, the grade of a print.

import { html } from "htm/preact";

import { Tabs } from "../components/tabs.js";
import { loadSchema } from "../components/form.js";
import { Shown, useLoad } from "../components/load.js";
import { useQueryForm } from "../components/query_form.js";
import { may } from "../session.js";
import { t } from "../texts/index.js";
import { ManyPlates } from "./studio_plates_bundle.js";
import { CameraTab } from "./studio_plates_camera.js";
import { PLATE_FIELDS, PLATE_START, useDraft } from "./studio_plates_draft.js";
import { PlateTab } from "./studio_plates_plate.js";
import { PrintTab } from "./studio_plates_print.js";

/** @param {{ query: URLSearchParams }} props */
export default function StudioPlates({ query }) {
  const schemas = useLoad(async () => ({ plate: await loadSchema("PlateIn"), pass: await loadSchema("DraftToPass") }), []);
  const tab = query.get("tab") ?? "plate";
  const tabs = /** @type {[string, string][]} */ ([
    ["plate", t("studio.tab_plate")], ["camera", t("studio.tab_camera")], ["many", t("studio.tab_many")],
    ...(may("POST /v1/print-grades") ? [["print", t("studio.tab_print")]] : []),
  ]);
  return html`
    <h1>${t("plates.studio")}</h1>
    <${Tabs} label=${t("plates.studio")} of=${tabs} chosen=${tab} />
    <${Shown} of=${schemas}>${(/** @type {any} */ found) => html`<${Studio} schemas=${found} tab=${tab} />`}</${Shown}>
  `;
}

/** @param {{ schemas: { plate: any, pass: any }, tab: string }} props */
function Studio({ schemas, tab }) {
  const typed = useQueryForm(PLATE_FIELDS, PLATE_START, null);
  const draft = useDraft(typed.values, schemas.pass);
  if (tab === "camera") return html`<${CameraTab} schema=${schemas.pass} plate=${typed} draft=${draft} />`;
  if (tab === "many") return html`<${ManyPlates} />`;
  if (tab === "print") return html`<${PrintTab} draft=${draft} />`;
  return html`<${PlateTab} schema=${schemas.plate} typed=${typed} draft=${draft} />`;
}
