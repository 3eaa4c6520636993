// The pages below /operations: one module for each section.

import { html } from "htm/preact";
import { useEffect, useState } from "preact/hooks";

import { Empty } from "../components/load.js";
import { ProblemBox } from "../components/problem.js";
import { path } from "../router.js";
import { t } from "../texts/index.js";

/** @type {Record<string, () => Promise<{ default: import("preact").ComponentType<any> }>>} */
const SECTIONS = {
  audit: () => import("./operations_audit.js"),
  codebooks: () => import("./operations_codebooks.js"),
  jobs: () => import("./operations_jobs.js"),
  keys: () => import("./operations_keys.js"),
  maintenance: () => import("./operations_maintenance.js"),
  reports: () => import("./operations_reports.js"),
  reprocessings: () => import("./operations_reprocessings.js"),
  settings: () => import("./operations_settings.js"),
  snapshots: () => import("./operations_snapshots.js"),
  webhooks: () => import("./operations_webhooks.js"),
};

/** @param {{ parameters: { section: string, item_id?: string } }} props */
export default function Operations({ parameters }) {
  const { section, item_id } = parameters;
  if (!(section in SECTIONS)) return html`<h1>${t("shell.not_found")}</h1><${Empty} title=${t("shell.not_found_text", { path: path.value })} />`;
  return html`<${Section} key=${section} section=${section} id=${item_id ?? null} />`;
}

/** @param {{ section: string, id: string | null }} props */
function Section({ section, id }) {
  const [Content, setContent] = useState(/** @type {import("preact").ComponentType<any> | null} */ (null));
  const [error, setError] = useState(/** @type {unknown} */ (null));
  useEffect(() => {
    SECTIONS[section]?.().then((module) => setContent(() => module.default), setError);
  }, []);
  if (error) return html`<${ProblemBox} error=${error} />`;
  if (!Content) return html`<p class="loading" role="status">${t("load.loading")}</p>`;
  return html`<${Content} id=${id} />`;
}
