// Register a CERPM.

import { html } from "htm/preact";

import { api, ok } from "../api/client.js";
import { bodyOf, FormFrame, Group, loadSchema, SchemaField, useForm } from "../components/form.js";
import { Shown, useLoad } from "../components/load.js";
import { notify } from "../components/notices.js";
import { codeOf } from "../format.js";
import { navigate } from "../router.js";
import { t } from "../texts/index.js";

export default function StudioCerpms() {
  const schema = useLoad(() => loadSchema("CerpmIn"), []);
  return html`<h1>${t("cerpms.register")}</h1><${Shown} of=${schema}>${(/** @type {any} */ found) => html`<${CerpmForm} schema=${found} />`}</${Shown}>`;
}

/** @param {{ schema: any }} props */
function CerpmForm({ schema }) {
  const form = useForm({
    side: "left", status: "planned", "speed_limit.unit": "km/h", "radio.interval_s": "1", "radio.spreading_factor": "7",
    "radio.bandwidth_hz": "500000", "radio.frequency_hz": "915000000",
  });
  const submit = async () => {
    const body = /** @type {any} */ ({ family: "cerpm", position: {}, ...bodyOf(form.values, schema) });
    if (body.speed_limit?.value === undefined) delete body.speed_limit;
    const marker = await ok(api.POST("/v1/markers", { body }));
    notify(t("register.done", { code: codeOf(marker) }));
    navigate(`/markers/${marker.id}`);
  };
  const field = (/** @type {string} */ path, more = {}) => html`<${SchemaField} form=${form} schema=${schema} path=${path} ...${more} />`;
  return html`
    <${FormFrame} form=${form} onSubmit=${submit} button=${t("register.button")}>
      <${Group} title=${t("register.position")}>
        ${field("position.lon_deg", { required: true, placeholder: "-85.643600" })}
        ${field("position.lat_deg", { required: true, placeholder: "42.253100" })}
        ${field("position.height_m")}
        ${field("position.horizontal_rmse_m", { placeholder: "0.02" })}
        ${field("position.survey_method", { placeholder: "GNSS RTK" })}
      </${Group}>
      <${Group} title=${t("marker.message")}>
        ${field("number", { placeholder: t("cerpms.next_number"), hint: "" })}
        ${field("side")}
        ${field("speed_limit.value", { placeholder: t("cerpms.no_limit") })}
        ${field("speed_limit.unit")}
        ${field("status")}
        ${field("road")}
      </${Group}>
      <${Group} title=${t("cerpms.radio")}>
        ${field("radio.interval_s")}
        ${field("radio.spreading_factor")}
        ${field("radio.bandwidth_hz")}
        ${field("radio.frequency_hz", { hint: "" })}
        ${field("dev_eui")}
      </${Group}>
    </${FormFrame}>
  `;
}
