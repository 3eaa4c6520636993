// A new plan: its road, its rules with a preview, its name. The road, the rules to begin with and what was changed are in
// the address.

import { html } from "htm/preact";
import { useEffect, useMemo, useRef, useState } from "preact/hooks";

import { api, ok, request, jsonBody, save } from "../api/client.js";
import { Facts } from "../components/facts.js";
import { FormFrame, TextField, useForm } from "../components/form.js";
import { JobProgress } from "../components/job.js";
import { Shown, useLoad } from "../components/load.js";
import { notify } from "../components/notices.js";
import { ProblemBox } from "../components/problem.js";
import { number } from "../format.js";
import { navigate, query, setQuery } from "../router.js";
import { t, textOr } from "../texts/index.js";
import { loadAlignments } from "./plans.js";
import { PreviewBox, usePreview } from "./plans_preview.js";
import { RoadForm } from "./plans_road.js";
import { loadRulesSchema, RulesFields, rulesOf, valuesOf } from "./plans_rules.js";
import { TEMPLATES } from "./plans_templates.js";
import { loadProfile, PlanView, thingsOf } from "./plans_view.js";

const MAX_IN_ADDRESS = 6000;

export default function NewPlan() {
  const alignment = query.value.get("alignment");
  return html`
    <h1>${t("plans.new")}</h1>
    <${RoadStep} alignment=${alignment} />
    ${alignment && html`<${RulesStep} key=${`${alignment} ${query.value.get("from") ?? ""}`} alignment=${alignment} from=${query.value.get("from") ?? "rural_plates"} />`}
  `;
}

/** @param {{ alignment: string | null }} props */
function RoadStep({ alignment }) {
  const roads = useLoad(loadAlignments, [alignment]);
  const way = query.value.get("way") ?? "";
  const chosen = roads.data?.find(({ id }) => id === alignment);
  return html`
    <section class="card step" aria-labelledby="step-road">
      <h2 id="step-road">${t("new.road")}</h2>
      <${Shown} of=${roads}>${(/** @type {any[]} */ rows) => html`
        ${rows.length > 0 && html`
          <div class="field"><label for="new-road">${t("new.existing")}</label>
            <select id="new-road" name="alignment_id" value=${alignment ?? ""} onChange=${(/** @type {any} */ event) => setQuery({ alignment: event.currentTarget.value, way: null, lane: null, strip: null, map: null }, { replace: false })}>
              <option value="">–</option>${rows.map(({ id, name, lane_length_m }) => html`<option value=${id} selected=${id === alignment}>${name} (${number(lane_length_m / 1000, 2, "km")})</option>`)}
            </select></div>`}
        ${chosen && html`<${RoadFacts} road=${chosen} />`}
        <details class="more" open=${rows.length === 0 || (way !== "" && !alignment)}>
          <summary>${t("new.another")}</summary>
          <${RoadForm} way=${way || "file"} onWay=${(/** @type {string} */ name) => setQuery({ way: name })} onDone=${(/** @type {any} */ made) => {
            notify(t("new.road_stored", { name: made.name }));
            setQuery({ alignment: made.id, way: null, lane: null, strip: null, map: null }, { replace: false });
          }} />
        </details>
      `}</${Shown}>
    </section>
  `;
}

/** What was read of a road. @param {{ road: any }} props */
export function RoadFacts({ road }) {
  return html`
    <${Facts} of=${[
      [t("road_facts.lanes"), t("road_facts.lanes_text", { count: road.lanes.length, length: number(road.lane_length_m / 1000, 3, "km") })],
      [t("road_facts.events"), road.events.length ? number(road.events.length) : null],
      [t("road_facts.format"), road.format], [t("field.crs"), [road.crs, road.realization].filter(Boolean).join(", ")],
      [t("field.grade"), textOr(`grade.${road.localization_grade}`, road.localization_grade)],
      [t("road_facts.surveyed"), road.surveyed ? null : t("road_facts.not_surveyed")],
    ]} />
    ${road.warnings.length > 0 && html`<details class="more warning"><summary>${t("road_facts.warnings", { count: road.warnings.length })}</summary><ul>${road.warnings.slice(0, 50).map((/** @type {string} */ text) => html`<li>${text}</li>`)}</ul></details>`}
  `;
}

/** @param {{ alignment: string, from: string }} props */
function RulesStep({ alignment, from }) {
  const loaded = useLoad(async () => {
    const schema = await loadRulesSchema();
    const kept = query.peek().get("rules");
    const rules = kept ? JSON.parse(kept) : TEMPLATES[from] ?? (await ok(api.GET("/v1/plans/{plan_id}", { params: { path: { plan_id: from } } }))).rules;
    return { schema, rules, profile: await loadProfile(alignment) };
  }, [alignment, from]);
  return html`<${Shown} of=${loaded}>${(/** @type {any} */ { schema, rules, profile }) => html`<${RulesForm} alignment=${alignment} from=${from} schema=${schema} start=${rules} profile=${profile} />`}</${Shown}>`;
}

/** @param {{ alignment: string, from: string, schema: any, start: any, profile: import("./plans_view.js").Profile }} props */
function RulesForm({ alignment, from, schema, start, profile }) {
  const form = useForm(valuesOf(start, schema));
  const named = useForm({ name: query.peek().get("name") ?? "" });
  const rules = useMemo(() => rulesOf(form.values, schema), [form.values]);
  const preview = usePreview(alignment, rules);
  const [job, setJob] = useState("");
  const [pointed, setPointed] = useState(/** @type {string | null} */ (null));
  useKept(rules, String(named.values.name ?? ""));
  const things = useMemo(() => (preview.preview ? thingsOf(profile, preview.preview) : thingsOf(profile, { markers: [] })), [preview.preview, profile]);
  const submit = async () => {
    const response = await request("/v1/plans", jsonBody({ name: String(named.values.name ?? "").trim(), alignment_id: alignment, rules }));
    const made = await response.json();
    if (response.status === 202) setJob(made.id);
    else navigate(`/plans/${made.id}`);
  };
  const fields = { ...form, errors: { ...preview.errors, ...without(named.errors, "name") } };
  return html`
    <section class="card step" aria-labelledby="step-rules">
      <div class="title-line"><h2 id="step-rules">${t("new.rules")}</h2>
        <div class="field inline"><label for="new-from">${t("new.from")}</label>
          <select id="new-from" value=${from in TEMPLATES ? from : "plan"} onChange=${(/** @type {any} */ event) => event.currentTarget.value !== "plan" && setQuery({ from: event.currentTarget.value, rules: null }, { replace: false })}>
            ${!(from in TEMPLATES) && html`<option value="plan">${t("new.from_plan")}</option>`}
            ${Object.keys(TEMPLATES).map((name) => html`<option value=${name} selected=${name === from}>${textOr(`template.${name}`, name)}</option>`)}
          </select></div>
      </div>
      <${RulesFile} rules=${rules} onRules=${(/** @type {any} */ read) => form.setValues(valuesOf(read, schema))} />
      <div class="beside">
        <div class="form"><${RulesFields} form=${fields} schema=${schema} /></div>
        <div class="sticky"><${PreviewBox} preview=${preview} /></div>
      </div>
    </section>
    <section class="card step" aria-labelledby="step-view"><h2 id="step-view">${t("new.view")}</h2>
      <${PlanView} profile=${profile} things=${things} pointedId=${pointed} onPoint=${setPointed} onChoose=${setPointed} note=${t("plan.preview_on_map")} />
    </section>
    <section class="card step" aria-labelledby="step-make"><h2 id="step-make">${t("new.make")}</h2>
      ${job ? html`<${JobProgress} id=${job} onDone=${(/** @type {import("../api/follow_job.js").Job} */ done) => navigate(`/plans/${done.subject_id}`)} />` : html`
        <${FormFrame} form=${named} onSubmit=${submit} button=${t("new.make_button")}>
          <div class="group"><${TextField} form=${named} path="name" label=${t("new.name")} hint=${t("new.name_hint")} required /></div>
        </${FormFrame}>`}
    </section>
  `;
}

/** Rules from a file into the form, and the rules of the form into a file. @param {{ rules: any, onRules: (rules: any) => void }} props */
function RulesFile({ rules, onRules }) {
  const [error, setError] = useState(/** @type {unknown} */ (null));
  /** @param {File | undefined} file */
  const read = async (file) => {
    if (!file) return;
    try {
      const answer = await ok(api.POST("/v1/plan-rules", { body: { text: await file.text() } }));
      onRules(answer.rules);
      setError(null);
      notify(t("new.rules_read", { name: file.name }));
    } catch (problem) {
      setError(problem);
    }
  };
  return html`
    <div class="rules-file">
      <div class="field"><label for="rules-file">${t("new.rules_file")}</label>
        <input id="rules-file" type="file" accept=".yaml,.yml,.json" onChange=${(/** @type {any} */ event) => read(event.currentTarget.files[0]).finally(() => { event.target.value = ""; })} /></div>
      <button type="button" class="quiet" onClick=${() => save(new Blob([JSON.stringify(rules, null, 2)], { type: "application/json" }), "rules.json")}>${t("new.rules_save")}</button>
    </div>
    <${ProblemBox} error=${error} />
  `;
}

/** @param {Record<string, string>} errors @param {string} name */
const without = (errors, name) => Object.fromEntries(Object.entries(errors).filter(([path]) => path !== name));

/** Keep what was changed in the address, so that a reload shows it again. @param {any} rules @param {string} name */
function useKept(rules, name) {
  const first = useRef(query.peek().get("rules") ? "" : JSON.stringify(rules));
  useEffect(() => {
    const timer = setTimeout(() => {
      const text = JSON.stringify(rules);
      setQuery({ rules: text !== first.current && text.length < MAX_IN_ADDRESS ? text : null, name: name.slice(0, 80) });
    }, 300);
    return () => clearTimeout(timer);
  }, [rules, name]);
}
