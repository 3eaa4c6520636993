// What is done with a plan: approve, commit, print, a variant. Both steps ask before they act, and are offered where the
// reader may take them.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

import { api, ok, page } from "../api/client.js";
import { Dialog } from "../components/dialog.js";
import { FormFrame, useForm } from "../components/form.js";
import { Shown, useLoad } from "../components/load.js";
import { notify } from "../components/notices.js";
import { time } from "../format.js";
import { may, me } from "../session.js";
import { t, textOr } from "../texts/index.js";
import { costText } from "./plans_preview.js";
import { countsText } from "./plans.js";

/** @typedef {import("./plans_view.js").Plan} Plan */

/** @param {{ plan: Plan, onChanged: () => void }} props */
export function PlanActions({ plan, onChanged }) {
  const [dialog, setDialog] = useState(/** @type {"approve" | "commit" | null} */ (null));
  const approvable = ["checked", "proved"].includes(plan.status) && may("POST /v1/plans/{plan_id}/approve");
  const committable = plan.status === "approved" && may("POST /v1/plans/{plan_id}/commit");
  return html`
    <div class="actions">
      ${approvable && html`<button type="button" onClick=${() => setDialog("approve")}>${t("plan.approve")}</button>`}
      ${committable && html`<button type="button" onClick=${() => setDialog("commit")}>${t("plan.commit")}</button>`}
      ${may("POST /v1/plans") && html`<a class="button quiet" href=${`/plans/new?alignment=${plan.alignment_id}&from=${plan.id}`}>${t("plan.variant")}</a>`}
      <button type="button" class="quiet" onClick=${() => window.print()}>${t("plan.print")}</button>
    </div>
    ${dialog && html`<${StepDialog} key=${dialog} step=${dialog} plan=${plan} onClose=${() => setDialog(null)} onChanged=${onChanged} />`}
  `;
}

/** @param {{ step: "approve" | "commit", plan: Plan, onClose: () => void, onChanged: () => void }} props */
function StepDialog({ step, plan, onClose, onChanged }) {
  const form = useForm({});
  const options = { params: { path: { plan_id: plan.id }, header: { "If-Match": `"${plan.version}"` } } };
  const submit = async () => {
    if (step === "approve") {
      await ok(api.POST("/v1/plans/{plan_id}/approve", options));
      notify(t("plan.approved", { name: plan.name }));
    } else {
      const done = await ok(api.POST("/v1/plans/{plan_id}/commit", options));
      notify(t("plan.committed", { count: done.markers }));
    }
    onClose();
    onChanged();
  };
  return html`
    <${Dialog} title=${t(`plan.${step}_title`, { name: plan.name })} onClose=${onClose}>
      <p>${t(`plan.${step}_text`)}</p>
      <ul><li>${countsText(plan.counts)}</li><li>${t("plan.cost")}: ${costText(plan)}</li><li>${t("plan.checks")}: ${textOr(`verdict.${plan.verdict}`, plan.verdict)}</li>
        ${plan.left_out_count > 0 && html`<li>${t("plan.left_out")}: ${plan.left_out_count}</li>`}<li>${plan.proof ? t("plan.is_proved") : t("plan.not_proved")}</li></ul>
      ${step === "approve" && plan.author === me.value?.label && html`<p class="warning">${t("plan.own")}</p>`}
      <${FormFrame} form=${form} onSubmit=${submit} button=${t(`plan.${step}`)} actions=${html`<button type="button" class="quiet" onClick=${onClose}>${t("action.cancel")}</button>`} />
    </${Dialog}>
  `;
}

/** @param {{ plan: Plan }} props */
export function PlanHistory({ plan }) {
  const versions = useLoad((signal) => page(api.GET("/v1/plans/{plan_id}/versions", { params: { path: { plan_id: plan.id }, query: { limit: 100 } }, signal })), [plan.id, plan.version]);
  return html`<${Shown} of=${versions}>${(/** @type {any} */ { items }) => html`
    <ol class="history">${[...items].reverse().map((/** @type {any} */ version) => html`
      <li><p><strong>${t("marker.version", { version: version.version })}</strong>, ${time(version.at)} UTC, ${version.who}</p>
        <p>${textOr(`option.${version.plan.status}`, version.plan.status)}${version.plan.name !== plan.name ? `, ${version.plan.name}` : ""}${version.why ? `: ${version.why}` : ""}</p></li>`)}</ol>
  `}</${Shown}>`;
}
