// Codebooks of information tags: their design and capacity, their entries, new meanings from a list or a file.

import { html } from "htm/preact";
import { useId, useState } from "preact/hooks";

import { api, ok, Problem, save } from "../api/client.js";
import { Dialog } from "../components/dialog.js";
import { Facts } from "../components/facts.js";
import { bodyOf, FormFrame, Group, loadSchema, SchemaField, TextField, useForm } from "../components/form.js";
import { closeTo, linked, ListPage } from "../components/list_page.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { notify } from "../components/notices.js";
import { usePages } from "../components/pages.js";
import { Panel } from "../components/panel.js";
import { number, text, time } from "../format.js";
import { navigate } from "../router.js";
import { may } from "../session.js";
import { t, textOr } from "../texts/index.js";

const BASE = "/operations/codebooks";
const AT_ONCE = 100; // meanings of one request
const EXAMPLE = "bend-right 125\nstop-line-ahead 20\narrow straight-left\nspeed-limit-kmh 50";
const WORDS = ["arrow", "notice"]; // kinds whose value is no number

/** @typedef {import("../api/schema.js").components["schemas"]["CodebookDocument"]} Codebook */

/** @param {{ id: string | null }} props */
export default function Codebooks({ id }) {
  const list = usePages("/v1/codebooks");
  const [making, setMaking] = useState(false);
  const button = may("POST /v1/codebooks") && html`<button type="button" onClick=${() => setMaking(true)}>${t("codebooks.make")}</button>`;
  const empty = html`<${Empty} title=${t("codebooks.none")}><p>${t("codebooks.none_text")}</p></${Empty}>`;
  return html`
    <${ListPage} title=${t("codebooks.title")} base=${BASE} list=${list} columns=${columns()} chosen=${id} actions=${button} empty=${empty} lead=${t("codebooks.lead")}
      panel=${id !== null && html`<${One} key=${id} id=${id} onChanged=${list.reload} />`} />
    ${making && html`<${MakeDialog} onClose=${() => setMaking(false)} onMade=${list.reload} />`}
  `;
}

/** @param {any} figures */
const capacityText = (figures) => `${number(figures.capacity_under_rules)}${figures.capacity_is_exact ? "" : "+"}`;

/** @param {any} design */
const designText = (design) => t("codebooks.design_text", { magnets: design.magnets, length: number(design.length_m, 1), segment: number(design.segment_m, 2) });

/** @returns {import("../components/table.js").Column<any>[]} */
const columns = () => [
  linked(BASE, { name: "name", title: t("field.name"), order: (row) => row.name, cell: (row) => text(row.name) }),
  { name: "entries", title: t("field.entry_count"), number: true, order: (row) => row.entry_count, cell: (row) => number(row.entry_count) },
  { name: "capacity", title: t("codebooks.capacity"), number: true, order: (row) => row.figures.capacity_under_rules, cell: (row) => capacityText(row.figures) },
  { name: "design", title: t("codebooks.design"), cell: (row) => designText(row.design) },
  { name: "updated", title: t("field.updated_at"), order: (row) => row.updated_at, cell: (row) => time(row.updated_at) },
];

/** @param {{ id: string, onChanged: () => void }} props */
function One({ id, onChanged }) {
  const found = useLoad((signal) => ok(api.GET("/v1/codebooks/{codebook_id}", { params: { path: { codebook_id: id } }, signal })), [id]);
  const book = /** @type {Codebook | null} */ (found.data);
  const changed = () => {
    found.reload();
    onChanged();
  };
  return html`
    <${Panel} title=${book ? book.name : t("codebooks.one")} label=${t("codebooks.one")} onClose=${closeTo(BASE)}>
      <${Shown} of=${found}>${() => book && html`
        <${Used} book=${book} />
        <${Facts} of=${[
          [t("codebooks.design"), designText(book.design)],
          [t("codebooks.read_at"), t("codebooks.read_at_text", { speed: number(book.rules.speed_m_s * 3.6), clearance: number(book.rules.clearance_m, 2) })],
          [t("codebooks.wrong_way"), book.rules.wrong_way_safe && t("changes.yes")],
          [t("codebooks.missing"), book.rules.survive_missing && t("changes.yes")],
          [t("codebooks.confusion"), t("codebooks.confusion_text", { one: number(1 / book.rules.confusion) })],
          [t("codebooks.ideal"), number(book.figures.ideal_capacity)],
          [t("field.updated_at"), `${time(book.updated_at)}, ${t("marker.version", { version: book.version })}`],
          [t("field.id"), html`<span class="code small">${book.id}</span>`],
        ]} />
        <div class="title-line"><h3>${t("field.entry_count")}</h3>${book.entries.length > 0 && html`<button type="button" class="quiet" onClick=${() => saveEntries(book)}>${t("maintenance.csv")}</button>`}</div>
        ${book.entries.length ? html`<${Entries} of=${book.entries} />` : html`<p class="hint">${t("codebooks.no_entries")}</p>`}
        ${may("POST /v1/codebooks/{codebook_id}/entries") && html`<${AddMeanings} book=${book} onDone=${changed} />`}
      `}</${Shown}>
    </${Panel}>
  `;
}

/** How much of a book is used. @param {{ book: Codebook }} props */
function Used({ book }) {
  const { capacity_under_rules: capacity, capacity_is_exact: exact } = book.figures;
  return html`
    <p>${t(exact ? "codebooks.used" : "codebooks.used_at_least", { used: number(book.entries.length), capacity: number(capacity) })}</p>
    <meter aria-label=${t("codebooks.capacity")} min="0" max=${Math.max(capacity, book.entries.length, 1)} value=${book.entries.length}></meter>
  `;
}

/** @param {{ of: Codebook["entries"] }} props */
function Entries({ of }) {
  return html`
    <div class="table-scroll plain-table" tabindex="0" role="region" aria-label=${t("field.entry_count")}>
      <table>
        <thead><tr><th scope="col">${t("marker.meaning")}</th><th scope="col">${t("field.code")}</th></tr></thead>
        <tbody>${of.map((entry) => html`<tr><th scope="row">${entry.meaning.text}</th><td class="code">${entry.code}</td></tr>`)}</tbody>
      </table>
    </div>
  `;
}

/** @param {Codebook} book */
function saveEntries(book) {
  const cell = (/** @type {unknown} */ value) => `"${String(value).replace(/^[=+\-@]/, "'$&").replaceAll('"', '""')}"`;
  const rows = book.entries.map((entry) => [entry.code, entry.meaning.kind, entry.meaning.value, entry.meaning.text].map(cell).join(","));
  save(new Blob([["code,kind,value,text", ...rows].join("\r\n")], { type: "text/csv" }), `${book.name}.csv`);
}

/**
 * Meanings from lines of a kind and a value, also of CSV with these columns.
 *
 * @param {string} lines
 */
function readMeanings(lines) {
  return lines.split("\n").map((line) => line.trim().replace(/^\ufeff/, "")).filter((line) => line && !/^(#|kind\b)/.test(line)).map((line, k) => {
    const found = /^"?([a-z-]+)"?\s*[\s,;:]\s*"?(.+?)"?$/.exec(line);
    if (!found) throw new Problem({ title: t("codebooks.bad_line"), detail: t("codebooks.bad_line_text", { number: k + 1, line }), field: "meanings", cure: t("codebooks.bad_line_cure") });
    const [, kind = "", value = ""] = found;
    const numeric = Number(value.replace(",", "."));
    return { kind, value: WORDS.includes(kind) || !Number.isFinite(numeric) ? value : numeric };
  });
}

/** The field for meanings; a file fills it. @param {{ form: import("../components/form.js").Form, required?: boolean }} props */
function MeaningsField({ form, required }) {
  const id = useId();
  const shown = { ...form, errors: { ...form.errors, meanings: form.errors.meanings ?? Object.entries(form.errors).find(([path]) => path.startsWith("meanings"))?.[1] ?? "" } };
  const read = async (/** @type {File | undefined} */ file) => file && form.set("meanings", await file.text());
  return html`
    <${TextField} form=${shown} path="meanings" label=${t("codebooks.meanings")} hint=${t("codebooks.meanings_hint")} rows=${5} placeholder=${EXAMPLE} required=${required} />
    <div class="field"><label for=${id}>${t("codebooks.file")}</label><input id=${id} type="file" accept=".csv,.txt,text/csv,text/plain" onChange=${(/** @type {any} */ event) => read(event.currentTarget.files[0])} /></div>
  `;
}

/** @param {{ book: Codebook, onDone: () => void }} props */
function AddMeanings({ book, onDone }) {
  const form = useForm({ meanings: "" });
  const submit = async () => {
    const meanings = readMeanings(String(form.values.meanings));
    if (!meanings.length) throw new Problem({ title: t("codebooks.no_meanings"), detail: "", field: "meanings", cure: t("codebooks.bad_line_cure") });
    await add(book.id, meanings);
    form.set("meanings", "");
    notify(t("codebooks.added", { count: meanings.length, name: book.name }));
    onDone();
  };
  return html`<h3>${t("codebooks.add")}</h3><${FormFrame} form=${form} onSubmit=${submit} button=${t("codebooks.add_button")}><${MeaningsField} form=${form} required /></${FormFrame}>`;
}

/** @param {string} id @param {{ kind: string, value: string | number }[]} meanings */
async function add(id, meanings) {
  for (let start = 0; start < meanings.length; start += AT_ONCE) {
    await ok(api.POST("/v1/codebooks/{codebook_id}/entries", { params: { path: { codebook_id: id } }, body: { meanings: /** @type {any} */ (meanings.slice(start, start + AT_ONCE)) } }));
  }
}

/** @param {{ onClose: () => void, onMade: () => void }} props */
function MakeDialog({ onClose, onMade }) {
  const found = useLoad(() => loadSchema("CodebookIn"), []);
  const form = useForm({ name: "", meanings: "", "design.magnets": "3", "design.length_m": "4", "design.segment_m": "0.1", "rules.wrong_way_safe": true });
  const submit = async () => {
    const { meanings: lines, ...values } = form.values;
    const meanings = readMeanings(String(lines));
    const body = { ...bodyOf(values, found.data ?? undefined), meanings: meanings.slice(0, AT_ONCE) };
    const book = await ok(api.POST("/v1/codebooks", { body: /** @type {any} */ (body) }));
    await add(book.id, meanings.slice(AT_ONCE));
    notify(t("codebooks.made", { name: book.name }));
    onMade();
    onClose();
    navigate(`${BASE}/${book.id}`);
  };
  return html`
    <${Dialog} title=${t("codebooks.make")} onClose=${onClose}>
      <${Shown} of=${found}>${(/** @type {any} */ schema) => {
        const field = (/** @type {string} */ path, label = "") => html`<${SchemaField} form=${form} schema=${schema} path=${path} label=${label || undefined} />`;
        return html`
          <${FormFrame} form=${form} onSubmit=${submit} button=${t("codebooks.make")}>
            <${TextField} form=${form} path="name" label=${t("field.name")} required />
            <${Group} title=${t("codebooks.design")}>${["magnets", "length_m", "segment_m", "min_gap_m"].map((name) => field(`design.${name}`, textOr(`codebooks.${name}`, name)))}</${Group}>
            <${Group} title=${t("codebooks.rules")}>${["speed_m_s", "clearance_m", "confusion", "wrong_way_safe", "survive_missing"].map((name) => field(`rules.${name}`, textOr(`codebooks.${name}`, name)))}</${Group}>
            <${MeaningsField} form=${form} />
          </${FormFrame}>
        `;
      }}</${Shown}>
    </${Dialog}>
  `;
}
