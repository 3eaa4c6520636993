// Other rules for a plan: what they would change is shown before they are stored, in this plan or in a new variant.

import { html } from "htm/preact";
import { useEffect, useMemo, useState } from "preact/hooks";

import { api, jsonBody, ok, request } from "../api/client.js";
import { FormFrame, TextField, useForm } from "../components/form.js";
import { JobProgress } from "../components/job.js";
import { Shown, useLoad } from "../components/load.js";
import { notify } from "../components/notices.js";
import { navigate, setQuery } from "../router.js";
import { may } from "../session.js";
import { t } from "../texts/index.js";
import { PreviewBox, usePreview } from "./plans_preview.js";
import { loadRulesSchema, RulesFields, rulesOf, valuesOf } from "./plans_rules.js";

/** @typedef {import("./plans_view.js").Plan} Plan */

const CHANGEABLE = ["draft", "checked", "proved", "approved"];

/** @param {{ plan: Plan, onChanged: () => void, onPreview: (preview: any) => void }} props */
export function ChangeRules({ plan, onChanged, onPreview }) {
  const schema = useLoad(() => loadRulesSchema(), []);
  return html`<${Shown} of=${schema}>${(/** @type {any} */ root) => html`<${RulesForm} key=${plan.version} plan=${plan} schema=${root} onChanged=${onChanged} onPreview=${onPreview} />`}</${Shown}>`;
}

/** @param {{ plan: Plan, schema: any, onChanged: () => void, onPreview: (preview: any) => void }} props */
function RulesForm({ plan, schema, onChanged, onPreview }) {
  const form = useForm(valuesOf(plan.rules, schema));
  const sent = useForm({ reason: "" });
  const other = useForm({ name: "" });
  const start = useMemo(() => JSON.stringify(rulesOf(valuesOf(plan.rules, schema), schema)), []);
  const rules = useMemo(() => rulesOf(form.values, schema), [form.values]);
  const changed = JSON.stringify(rules) !== start;
  const preview = usePreview(plan.alignment_id, changed && may("POST /v1/plan-previews") ? rules : null);
  const [job, setJob] = useState("");
  useEffect(() => {
    onPreview(preview.error ? null : preview.preview);
  }, [preview.preview, preview.error]);
  useEffect(() => () => onPreview(null), []);
  const here = may("PATCH /v1/plans/{plan_id}") && CHANGEABLE.includes(plan.status);
  const save = async () => {
    const reason = String(sent.values.reason ?? "").trim();
    await ok(api.PATCH("/v1/plans/{plan_id}", {
      params: { path: { plan_id: plan.id }, header: { "If-Match": `"${plan.version}"` } }, body: /** @type {any} */ ({ rules, ...(reason ? { reason } : {}) }),
    }));
    notify(t("rules.saved"));
    setQuery({ tab: null });
    onChanged();
  };
  const variant = async () => {
    const response = await request("/v1/plans", jsonBody({ name: String(other.values.name ?? "").trim(), alignment_id: plan.alignment_id, rules }));
    const made = await response.json();
    if (response.status === 202) return setJob(made.id);
    notify(t("rules.variant_made", { name: made.name }));
    return navigate(`/plans/compare?ids=${plan.id},${made.id}`);
  };
  const made = (/** @type {import("../api/follow_job.js").Job} */ done) => navigate(`/plans/compare?ids=${plan.id},${done.subject_id}`);
  const { name: _name, ...wrong } = other.errors;
  const fields = { ...form, errors: { ...preview.errors, ...sent.errors, ...wrong } };
  return html`
    <div class="beside">
      <div class="form"><p class="hint">${t(changed ? "rules.changed" : "rules.change_hint")}</p><${RulesFields} form=${fields} schema=${schema} /></div>
      <div class="sticky">
        <${PreviewBox} preview=${changed ? preview : { preview: plan, error: null, errors: {}, loading: false }} base=${changed ? plan : null} />
        ${job ? html`<${JobProgress} id=${job} onDone=${made} />` : changed && html`
          ${here && html`<${FormFrame} form=${sent} onSubmit=${save} button=${t("rules.save")}>
            <${TextField} form=${sent} path="reason" label=${t("field.reason")} hint=${t(plan.status === "approved" ? "rules.takes_approval" : "rules.reason_hint")} />
          </${FormFrame}>`}
          ${may("POST /v1/plans") && html`<${FormFrame} form=${other} onSubmit=${variant} button=${t("rules.variant")}>
            <${TextField} form=${other} path="name" label=${t("rules.variant_name")} required />
          </${FormFrame}>`}
        `}
      </div>
    </div>
  `;
}
