// Which codes a codebook or a format has, how many fit, and making a codebook of a format.

import { html } from "htm/preact";

import { api, ok, page } from "../api/client.js";
import { Verdict } from "../components/badges.js";
import { Facts } from "../components/facts.js";
import { bodyOf, CheckField, FormFrame, Group, SchemaField, SelectField, TextField, useForm } from "../components/form.js";
import { useLoad } from "../components/load.js";
import { notify } from "../components/notices.js";
import { fieldErrors, isAtField, ProblemBox } from "../components/problem.js";
import { useLive } from "../components/query_form.js";
import { number } from "../format.js";
import { may } from "../session.js";
import { t } from "../texts/index.js";

/** @typedef {import("../api/schema.js").components["schemas"]["CodebookDraftDocument"]} CodebookDraft */
/** @typedef {{ code: string, meaning: string }} Code */
/** @typedef {{ list: Code[], design: any, rules: any, figures: any, error: unknown, isDraft: boolean, body: any }} Codes */

/**
 * The codes of the chosen codebook, or those that fit the format that is typed.
 *
 * @param {import("../components/form.js").Values} values
 * @param {any} schema
 * @param {any[]} books
 * @returns {Codes}
 */
export function useCodes(values, schema, books) {
  const id = String(values.book ?? "");
  const book = books.find((one) => one.id === id);
  const entries = useLoad(async (signal) => (book ? (await page(api.GET("/v1/codebooks/{codebook_id}/entries", { params: { path: { codebook_id: id } }, signal }))).items : []), [id, Boolean(book)]);
  const { design, rules } = bodyOf(Object.fromEntries(Object.entries(values).filter(([path]) => /^(design|rules)\./.test(path))), schema);
  const body = { design: design ?? {}, rules: rules ?? {} };
  const draft = useLive((signal) => ok(api.POST("/v1/codebook-drafts", { body: /** @type {any} */ (body), signal })), id ? null : JSON.stringify(body), 400);
  if (book) {
    const list = (entries.data ?? []).map((/** @type {any} */ { code, meaning }) => ({ code, meaning: meaning.text }));
    return { list, design: book.design, rules: book.rules, figures: book.figures, error: entries.error, isDraft: false, body };
  }
  const { codes = [], figures = null, ...rest } = /** @type {any} */ (draft.data ?? {});
  const list = codes.map((/** @type {any} */ { code }) => ({ code, meaning: "" }));
  return { list, design: rest.design, rules: rest.rules, figures, error: draft.error, isDraft: true, body };
}

/** @param {{ schema: any, typed: import("../components/query_form.js").QueryForm, books: any[], codes: Codes, text: string, valid: boolean, reload: () => void }} props */
export function CodebookForm({ schema, typed, books, codes, text, valid, reload }) {
  const errors = { ...fieldErrors(codes.error), tag: valid ? "" : t("magnets.no_tag") };
  const form = { ...typed, errors, values: { ...typed.values, tag: text } };
  const field = (/** @type {string} */ path, more = {}) => html`<${SchemaField} form=${form} schema=${schema} path=${path} ...${more} />`;
  const known = codes.list.some(({ code }) => code === text);
  const options = [...(known || !text ? [] : [[text, t("magnets.other_code", { code: text })]]), ...codes.list.map(({ code, meaning }) => [code, meaning ? `${meaning}: ${code}` : code])];
  const unnamed = codes.error && !isAtField({ ...errors, tag: "" }, typed.values);
  return html`
    <form class="card form" novalidate autocomplete="off" aria-label=${t("magnets.tab_tag")} onSubmit=${(/** @type {Event} */ event) => event.preventDefault()}>
      <${Group} title=${t("magnets.codebook_group")}>
        <${SelectField} form=${form} path="book" label=${t("magnets.codebook")} options=${[["", t("magnets.own_format")], ...books.map(({ id, name }) => [id, name])]} onPick=${(/** @type {string} */ book) => typed.setMany({ book, tag: "" })} />
      </${Group}>
      ${codes.isDraft && html`
        <${Group} title=${t("magnets.format")}>
          ${field("design.magnets", { label: t("magnets.count"), hint: t("form.range", { least: 2, most: 7 }) })}
          ${field("design.length_m", { label: t("magnets.length"), hint: t("form.range", { least: 0.5, most: 30 }) })}
          ${field("design.segment_m", { label: t("magnets.segment"), hint: t("magnets.segment_hint") })}
          ${field("design.min_gap_m", { label: t("magnets.min_gap"), hint: "" })}
        </${Group}>
        <${Group} title=${t("magnets.rules")}>
          ${field("rules.speed_m_s", { label: t("magnets.speed"), hint: t("form.range", { least: 0.5, most: 70 }) })}
          ${field("rules.clearance_m", { label: t("magnets.read_clearance"), hint: t("form.range", { least: 0.05, most: 1 }) })}
          ${field("rules.confusion", { label: t("magnets.confusion"), hint: t("magnets.confusion_hint") })}
          <${CheckField} form=${form} path="rules.wrong_way_safe" label=${t("magnets.wrong_way_safe")} />
          <${CheckField} form=${form} path="rules.survive_missing" label=${t("magnets.survive_missing")} />
        </${Group}>
      `}
      <${Group} title=${t("magnets.tag")}>
        <${SelectField} form=${form} path="tag" label=${t("magnets.code")} options=${options} />
        <${TextField} form=${form} path="tag" label=${t("magnets.typed_code")} hint=${t("magnets.typed_hint")} />
      </${Group}>
      <div aria-live="polite">${unnamed && html`<${ProblemBox} error=${codes.error} />`}</div>
    </form>
    ${codes.isDraft && may("POST /v1/codebooks") && html`<${NewCodebook} codes=${codes} onMade=${(/** @type {string} */ id) => { reload(); typed.setMany({ book: id, tag: "" }); }} />`}
  `;
}

/** @param {{ codes: Codes, onMade: (id: string) => void }} props */
function NewCodebook({ codes, onMade }) {
  const form = useForm({ name: "", meanings: "" });
  const submit = async () => {
    const meanings = String(form.values.meanings).split("\n").map((line) => line.trim()).filter(Boolean).map((line) => {
      const [kind = "", ...rest] = line.split(/\s+/);
      const value = rest.join(" ");
      return { kind, value: value && Number.isFinite(Number(value)) && kind !== "notice" ? Number(value) : value };
    });
    const made = await ok(api.POST("/v1/codebooks", { body: /** @type {any} */ ({ name: form.values.name, ...codes.body, meanings }) }));
    notify(t("magnets.codebook_made", { name: String(form.values.name), count: meanings.length }));
    onMade(/** @type {any} */ (made).id);
  };
  return html`
    <details class="card more">
      <summary><h2>${t("magnets.make_codebook")}</h2></summary>
      <${FormFrame} form=${form} onSubmit=${submit} button=${t("magnets.make_codebook")}>
        <${TextField} form=${form} path="name" label=${t("magnets.name")} required />
        <${TextField} form=${form} path="meanings" label=${t("magnets.meanings")} hint=${t("magnets.meanings_hint")} rows=${5} placeholder=${"bend-right 125\nstop-line-ahead 20\narrow straight-left"} />
      </${FormFrame}>
    </details>
  `;
}

/** @param {{ codes: Codes }} props */
export function Capacity({ codes }) {
  const { figures, design, rules, list, isDraft } = codes;
  if (!figures || !design) return null;
  const under = figures.capacity_under_rules;
  const apart = figures.distinguishable;
  return html`
    <section class=${codes.error ? "card stale" : "card"} aria-label=${t("magnets.capacity")}>
      <h2>${t("magnets.capacity")}</h2>
      <div class="figure-tiles">
        <div class="tile"><p class="hint">${t("magnets.fit")}</p><p class="figure">${figures.capacity_is_exact ? number(under) : `≥ ${number(under)}`}</p>
          <p class="hint"><${Verdict} level=${under ? "good" : "bad"}>${t(under ? "magnets.fits" : "magnets.fits_none")}</${Verdict}>${!figures.capacity_is_exact && ` ${t("magnets.counted", { most: number(under) })}`}</p></div>
        ${!isDraft && html`<div class="tile"><p class="hint">${t("magnets.used")}</p><p class="figure">${number(list.length)}</p><p class="hint">${t("magnets.used_note")}</p></div>`}
        <div class="tile"><p class="hint">${t("magnets.distinguished")}</p><p class="figure">${number(apart.codes)}</p><p class="hint">${t("magnets.distinguished_note", { accuracy: number(apart.accuracy * 100, 0, "%"), share: number(apart.share * 100, 0, "%") })}</p></div>
      </div>
      <${Facts} of=${[
        [t("magnets.ideal"), number(figures.ideal_capacity)],
        [t("magnets.coupled", { gap: number(design.min_gap_m, 2, "m") }), number(figures.coupled_capacity)],
        [t("magnets.safe"), number(figures.wrong_way_safe_capacity)],
        [t("magnets.mean_worst"), `${number(apart.mean_accuracy * 100, 2, "%")} / ${number(apart.worst_accuracy * 100, 2, "%")}`],
        [t("magnets.format"), t("magnets.format_of", { magnets: design.magnets, length: number(design.length_m, 1, "m"), segment: number(design.segment_m, 2, "m") })],
        [t("magnets.rules"), rules && t("magnets.rules_of", { speed: number(rules.speed_m_s, 1, "m/s"), clearance: number(rules.clearance_m, 2, "m"), confusion: String(rules.confusion) })],
        [t("magnets.checks"), rules && [rules.wrong_way_safe && t("magnets.wrong_way_safe"), rules.survive_missing && t("magnets.survive_missing"), t("magnets.confusion_check")].filter(Boolean).join("; ")],
      ]} />
      ${list.length > 0 && html`
        <h3>${t(isDraft ? "magnets.first_codes" : "magnets.entries", { count: list.length })}</h3>
        <div class="table-scroll plain-table" tabindex="0" role="region" aria-label=${t("magnets.codes")}>
          <table><thead><tr><th scope="col">${t("magnets.code")}</th>${!isDraft && html`<th scope="col">${t("marker.meaning")}</th>`}</tr></thead>
            <tbody>${list.map(({ code, meaning }) => html`<tr><td class="code">${code}</td>${!isDraft && html`<td>${meaning}</td>`}</tr>`)}</tbody></table>
        </div>
      `}
    </section>
  `;
}
