// All decodes, newest first: filters, what each is, how it ended. Several of one drive can be shown together.

import { html } from "htm/preact";
import { useEffect, useState } from "preact/hooks";

import { request } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { TextFilter } from "../components/list_page.js";
import { Empty, isAborted } from "../components/load.js";
import { ProblemBox } from "../components/problem.js";
import { Table } from "../components/table.js";
import { fileSize, MISSING, number, text, time } from "../format.js";
import { query, setQuery } from "../router.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";

const FILTERS = /** @type {const} */ (["kind", "state", "vehicle", "since", "until"]);
const KINDS = ["frame", "archive", "video", "trace", "packets"];
const STATES = ["queued", "running", "done", "failed", "cancelled"];
const LEVELS = /** @type {Record<string, "good" | "bad" | "warn" | "none">} */ ({ done: "good", failed: "bad", cancelled: "warn" });
const PAGE = 100;
const MAX_TOGETHER = 4;
const WATCH_MS = 4000;

export default function History() {
  const filters = Object.fromEntries(FILTERS.map((name) => [name, query.value.get(name) ?? ""]));
  const filtered = Object.values(filters).some(Boolean);
  const list = useDecodes(filters);
  const [ticked, setTicked] = useState(/** @type {Set<string>} */ (new Set()));
  const together = list.rows.filter(({ id }) => ticked.has(id));
  return html`
    <div class="title-line"><h1>${t("decodes.title")}</h1>${may("POST /v1/uploads") && html`<a class="button" href="/decode">${t("decodes.new")}</a>`}</div>
    <${Filters} filters=${filters} />
    <${ProblemBox} error=${list.error} retry=${list.reload} />
    ${!list.rows.length && !list.loading && !list.error ? html`
      <${Empty} title=${t(filtered ? "decodes.none_found" : "decodes.none")}>
        ${filtered ? html`<button type="button" class="quiet" onClick=${() => setQuery(Object.fromEntries(FILTERS.map((name) => [name, null])))}>${t("decodes.all")}</button>`
          : html`<p>${t("decodes.first")}</p>${may("POST /v1/uploads") && html`<p><a class="button" href="/decode">${t("decodes.new")}</a></p>`}`}
      </${Empty}>` : html`
      <div class="actions-bar">
        <span role="status">${list.loading && !list.rows.length ? t("load.loading") : t("list.count", { count: number(list.rows.length) })}</span>
        <span class="spacer"></span>
        ${together.length > 0 && html`<span>${t("decodes.ticked", { count: together.length })}</span>`}
        ${together.length > 1 && together.length <= MAX_TOGETHER && html`<a class="button" href=${`/decodes/${together[0]?.id}?with=${together.slice(1).map(({ id }) => id).join()}`}>${t("decode.show_together", { count: together.length })}</a>`}
        ${together.length > MAX_TOGETHER && html`<span class="hint">${t("decodes.too_many", { count: MAX_TOGETHER })}</span>`}
      </div>
      <${Table} label=${t("decodes.title")} rows=${list.rows} columns=${columnsOf()} idOf=${(/** @type {any} */ row) => row.id} nameOf=${nameOf} ticked=${ticked} onTick=${setTicked}
        footer=${list.next ? html`${t("table.sorted_loaded")} <button type="button" class="quiet" disabled=${list.loading} onClick=${list.more}>${t("table.more")}</button>` : t("list.count", { count: number(list.rows.length) })} />
    `}
  `;
}

/** @param {any} row */
const nameOf = (row) => row.file_name ?? `${textOr(`option.${row.kind}`, row.kind)} ${row.id.slice(-6)}`;

/** @returns {import("../components/table.js").Column<any>[]} */
function columnsOf() {
  return [
    { name: "file", title: t("decodes.file"), head: true, order: nameOf, cell: (row) => html`<a href=${`/decodes/${row.id}`}>${nameOf(row)}</a>` },
    { name: "kind", title: t("field.kind"), order: (row) => row.kind, cell: (row) => textOr(`option.${row.kind}`, row.kind) },
    {
      name: "state", title: t("field.state"), order: (row) => row.state,
      cell: (row) => html`<${Verdict} level=${LEVELS[row.state] ?? "none"}>${textOr(`job.${row.state}`, row.state)}</${Verdict}>${row.state === "running" ? ` ${number(100 * row.progress, 0, "%")}` : ""}`,
    },
    { name: "created", title: t("decodes.uploaded"), order: (row) => row.created_at, cell: (row) => time(row.created_at) },
    { name: "taken", title: t("decodes.took"), number: true, order: tookS, cell: (row) => number(tookS(row), 1, "s") },
    { name: "size", title: t("decodes.size"), number: true, order: (row) => row.upload_bytes, cell: (row) => (row.upload_bytes === null ? MISSING : fileSize(row.upload_bytes)) },
    { name: "vehicle", title: t("decode.vehicle"), order: (row) => row.context.vehicle?.name, cell: (row) => text(row.context.vehicle?.name) },
    { name: "captured", title: t("field.captured_at"), order: (row) => row.context.captured_at, cell: (row) => time(row.context.captured_at) },
    { name: "error", title: t("field.reason"), hidden: true, order: (row) => row.error?.detail, cell: (row) => html`<span class="reason">${text(row.error?.detail)}</span>` },
  ];
}

/** Time from the upload to the result. [s] @param {any} row */
const tookS = (row) => (row.finished_at ? (Date.parse(row.finished_at) - Date.parse(row.created_at)) / 1000 : null);

/** @param {{ filters: Record<string, string> }} props */
function Filters({ filters }) {
  const set = (/** @type {string} */ name) => (/** @type {any} */ event) => setQuery({ [name]: event.currentTarget.value || null });
  const choice = (/** @type {string} */ name, /** @type {string} */ label, /** @type {string[]} */ options, /** @type {string} */ words) => html`
    <div class="filter"><label for=${`filter-${name}`}>${label}</label>
      <select id=${`filter-${name}`} name=${name} value=${filters[name]} onChange=${set(name)}><option value="">${t("decodes.any")}</option>
        ${options.map((option) => html`<option value=${option}>${textOr(`${words}.${option}`, option)}</option>`)}</select></div>`;
  return html`
    <div class="filters history-filters">
      ${choice("kind", t("field.kind"), KINDS, "option")}
      ${choice("state", t("field.state"), STATES, "job")}
      <${TextFilter} name="vehicle" label=${t("decode.vehicle")} />
      <${TextFilter} name="since" label=${t("decodes.since")} type="date" />
      <${TextFilter} name="until" label=${t("decodes.until")} type="date" />
    </div>
  `;
}

/** Decodes of a filter, page by page; those that are not done are looked at again. @param {Record<string, string>} filters */
function useDecodes(filters) {
  const [state, setState] = useState({ rows: /** @type {any[]} */ ([]), next: "", loading: true, error: /** @type {unknown} */ (null) });
  const [turn, setTurn] = useState(0);
  const address = addressOf(filters);
  /** @param {any[]} rows @param {string} from @param {AbortSignal} [signal] */
  const load = async (rows, from, signal) => {
    try {
      const response = await request(from, { signal });
      const next = /<([^>]+)>; rel="next"/.exec(response.headers.get("Link") ?? "")?.[1] ?? "";
      const { items } = await response.json();
      const link = next ? new URL(next, window.location.href) : null;
      setState({ rows: [...rows, ...items], next: link ? link.pathname + link.search : "", loading: false, error: null });
    } catch (error) {
      if (!isAborted(error)) setState((old) => ({ ...old, loading: false, error }));
    }
  };
  useEffect(() => {
    const abort = new AbortController();
    load([], address, abort.signal);
    return () => abort.abort();
  }, [address, turn]);
  const unfinished = state.rows.some((row) => ["queued", "running"].includes(row.state));
  useEffect(() => {
    if (!unfinished) return undefined;
    const timer = setTimeout(() => setTurn((old) => old + 1), WATCH_MS);
    return () => clearTimeout(timer);
  }, [state]);
  return { ...state, more: () => load(state.rows, state.next), reload: () => setTurn((old) => old + 1) };
}

/** @param {Record<string, string>} filters */
function addressOf({ since, until, ...plain }) {
  const parameters = new URLSearchParams({ limit: String(PAGE) });
  for (const [name, value] of Object.entries(plain)) if (value) parameters.set(name, value);
  if (since) parameters.set("since", `${since}T00:00:00Z`);
  if (until) parameters.set("until", new Date(Date.parse(`${until}T00:00:00Z`) + 86_400_000).toISOString());
  return `/v1/decodes?${parameters}`;
}
