// The files of a plan: each by itself, or all of them in one package with drilling sheets and artwork.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

import { api, download, jsonBody, ok, request } from "../api/client.js";
import { bodyOf, CheckField, ChecksField, FormFrame, Group, loadSchema, SchemaField, SelectField, TextField, useForm } from "../components/form.js";
import { JobProgress, oneJob } from "../components/job.js";
import { Shown, useLoad } from "../components/load.js";
import { attempt } from "../components/notices.js";
import { fileSize } from "../format.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";
import { useUnfinished } from "./plans_proof.js";

/** @typedef {import("./plans_view.js").Plan} Plan */

const SCALES = ["250", "500", "1000", "2000", "5000"];
const TITLE = ["owner", "number", "date", "creator", "approver", "title"];
const FILES = /** @type {Record<string, string[]>} */ ({
  reading: ["report.md", "bill.csv", "schedule.csv", "drawings.pdf", "trade-off.csv", "trade-off.svg"],
  crew: ["stakeout-pnezd.csv", "stakeout-penzd.csv", "stakeout.dxf", "stakeout.xml", "stakeout.geojson", "stakeout.gpkg", "stakeout-README.txt", "cerpm-programs.csv", "cerpm-programs.json"],
  maps: ["map.osm", "map.xodr", "plan.geojson", "plan.json"],
  proof: ["proof.json", "proof.csv"],
});

/** Whether a plan has a file. @param {Plan} plan @param {string} name */
function isThere(plan, name) {
  if (name.startsWith("cerpm-")) return "cerpm" in plan.counts;
  if (name.startsWith("proof.")) return plan.proof !== null;
  if (name.startsWith("trade-off.")) return Boolean(plan.rules.quality);
  return !/^(drawings|stakeout)/.test(name) || Object.keys(plan.counts).length > 0;
}

/** @param {{ plan: Plan }} props */
export function PlanFiles({ plan }) {
  const form = useForm({ crs: "", unit: "" });
  const stakeout = () => {
    const wanted = new URLSearchParams(Object.entries(form.values).map(([name, value]) => [name, String(value).trim()]).filter(([, value]) => value));
    return wanted.size ? `?${wanted}` : "";
  };
  /** @param {string} name */
  const get = (name) => attempt(() => download(`/v1/plans/${encodeURIComponent(plan.id)}/files/${name}${name.startsWith("stakeout") ? stakeout() : ""}`, `${name}`));
  return html`
    <div class="columns">
      <section class="card"><h2>${t("files.package")}</h2><p>${t("files.package_text")}</p><${Package} plan=${plan} /></section>
      ${Object.entries(FILES).map(([group, names]) => {
        const own = names.filter((name) => isThere(plan, name));
        return own.length > 0 && html`<section class="card"><h2>${textOr(`files.${group}`, group)}</h2>
          ${group === "crew" && html`<div class="group"><${TextField} form=${form} path="crs" label=${t("files.crs")} placeholder="EPSG:25832" hint=${t("files.crs_hint")} /><${SelectField} form=${form} path="unit" label=${t("field.unit")} options=${[["", "–"], ["m", "m"], ["ft-us", "ft-us"], ["ft-intl", "ft-intl"]]} /></div>`}
          <ul class="plain files">${own.map((name) => html`<li><button type="button" class="quiet" onClick=${() => get(name)}>${name}</button> <span class="hint">${textOr(`file.${name}`, "")}</span></li>`)}</ul></section>`;
      })}
    </div>
  `;
}

/** @param {{ plan: Plan }} props */
function Package({ plan }) {
  const { job, start } = useUnfinished(plan, "package");
  const [turn, setTurn] = useState(0);
  const form = useForm({ formats: "pdf, svg" });
  const schema = useLoad(() => loadSchema("PackageOptions"), []);
  const packed = useLoad(async (signal) => {
    const { items: [last] } = await ok(api.GET("/v1/jobs", { params: { query: { kind: "package", subject_id: plan.id, state: "done", limit: 1 } }, signal }));
    return last ? (await oneJob(last.id, "package", signal)).result : null;
  }, [plan.id, plan.version, turn]);
  const submit = async () => {
    const body = bodyOf(form.values, schema.data ?? undefined);
    if (body.scale) body.scale = Number(body.scale);
    start((await (await request(`/v1/plans/${encodeURIComponent(plan.id)}/package`, jsonBody(body))).json()).id);
  };
  const result = packed.data;
  return html`
    ${job && html`<${JobProgress} key=${job} id=${job} onDone=${() => setTurn((old) => old + 1)} />`}
    ${result && html`<p><button type="button" onClick=${() => attempt(() => download(`/v1/plans/${encodeURIComponent(plan.id)}/package`, `plan-${plan.id}.zip`))}>${t("files.get_package")}</button>
      <span class="hint"> ${t("files.package_size", { files: result.files ?? 0, size: fileSize(result.size_bytes ?? 0) })}</span></p>`}
    ${may("POST /v1/plans/{plan_id}/package") && html`<${Shown} of=${schema}>${(/** @type {any} */ root) => html`
      <details class="more" open=${!result}><summary>${t(result ? "files.pack_again" : "files.pack")}</summary>
        <${FormFrame} form=${form} onSubmit=${submit} button=${t("files.pack_button")}>
          <div class="group">
            <${TextField} form=${form} path="crs" label=${t("files.crs")} placeholder="EPSG:25832" hint=${t("files.crs_hint")} />
            <${SchemaField} form=${form} schema=${root} path="unit" />
            <${SelectField} form=${form} path="scale" label=${t("files.scale")} options=${[["", t("files.scale_auto")], ...SCALES.map((scale) => [scale, `1:${scale}`])]} />
          </div>
          <${ChecksField} form=${form} path="formats" label=${t("files.formats")} options=${["pdf", "svg", "dxf", "png"]} start=${["pdf", "svg"]} />
          <div class="checks"><${CheckField} form=${form} path="heaters" label=${t("artwork.heaters")} /><${CheckField} form=${form} path="leds" label=${t("artwork.leds")} /></div>
          <${Group} title=${t("files.title_block")}>${TITLE.map((name) => html`<${TextField} form=${form} path=${`title_block.${name}`} label=${textOr(`files.block_${name}`, name)} />`)}</${Group}>
        </${FormFrame}>
      </details>`}</${Shown}>`}
  `;
}
