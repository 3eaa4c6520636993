// Artwork of many registered plates as a ZIP: chosen by filters or by the ids in the address.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

import { api, download, jsonBody, page, Problem, request, save } from "../api/client.js";
import { StatusBadge } from "../components/badges.js";
import { CheckField, FormFrame, Group, SelectField, TextField, useForm } from "../components/form.js";
import { JobProgress } from "../components/job.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { attempt, notify } from "../components/notices.js";
import { useQueryForm } from "../components/query_form.js";
import { Table } from "../components/table.js";
import { codeOf, number, text } from "../format.js";
import { STATUSES } from "../map/symbols.js";
import { query, setQuery } from "../router.js";
import { t, textOr } from "../texts/index.js";

const FORMATS = ["pdf", "svg", "dxf", "png"];
const PAGE = 1000;
const MAX_PAGES = 5; // as many plates as one request for artwork takes
const FILTERS = { road: "road", status: "status" };

export function ManyPlates() {
  const typed = useQueryForm(FILTERS, { road: "", status: "" }, null);
  const road = query.value.get("road") ?? "";
  const status = query.value.get("status") ?? "";
  const plates = useLoad((signal) => listPlates(road, status, signal), [road, status]);
  const ticked = new Set((query.value.get("ids") ?? "").split(",").filter(Boolean));
  const columns = [
    { name: "code", title: t("field.code"), head: true, cell: (/** @type {any} */ row) => html`<a class="code" href=${`/markers/${row.id}`}>${codeOf(row)}</a>`, order: codeOf },
    { name: "status", title: t("field.status"), cell: (/** @type {any} */ row) => html`<${StatusBadge} status=${row.status} />`, order: (/** @type {any} */ row) => row.status },
    { name: "road", title: t("field.road"), cell: (/** @type {any} */ row) => text(row.road), order: (/** @type {any} */ row) => row.road },
    { name: "measure", title: t("field.measure_m"), number: true, cell: (/** @type {any} */ row) => number(row.measure_m, 1, "m"), order: (/** @type {any} */ row) => row.measure_m },
    { name: "size", title: t("studio.side"), number: true, cell: (/** @type {any} */ row) => number(row.geometry.side_mm, 0, "mm"), order: (/** @type {any} */ row) => row.geometry.side_mm },
  ];
  return html`
    <div class="studio">
      <div class="studio-form">
        <${BundleForm} ids=${[...ticked]} plates=${plates.data ?? []} />
      </div>
      <div class="studio-view">
        <div class="card form"><div class="group">
          <${TextField} form=${typed} path="road" label=${t("field.road")} />
          <${SelectField} form=${typed} path="status" label=${t("field.status")} options=${[["", t("studio.any_status")], ...STATUSES.map((name) => [name, textOr(`status.${name}`, name)])]} />
        </div></div>
        <${Shown} of=${plates}>${(/** @type {any[]} */ rows) => (rows.length
          ? html`<${Table} rows=${rows} columns=${columns} idOf=${(/** @type {any} */ row) => row.id} nameOf=${codeOf} label=${t("studio.plates")} ticked=${ticked}
              onTick=${(/** @type {Set<string>} */ ids) => setQuery({ ids: [...ids].join(",") })} footer=${t("studio.ticked", { count: ticked.size, total: rows.length })} />`
          : html`<div class="card"><${Empty} title=${t("studio.no_plates")}><p><a href="/studio/plates">${t("plates.register")}</a></p></${Empty}></div>`)}</${Shown}>
      </div>
    </div>
  `;
}

/** @param {string} road @param {string} status @param {AbortSignal} signal @returns {Promise<any[]>} */
async function listPlates(road, status, signal) {
  /** @type {any[]} */
  const found = [];
  let after = undefined;
  for (let k = 0; k < MAX_PAGES; k += 1) {
    const parameters = /** @type {any} */ ({ family: "plate", limit: PAGE, ...(road ? { road } : {}), ...(status ? { status } : {}), ...(after ? { after } : {}) });
    const next = await page(api.GET("/v1/markers", { params: { query: parameters }, signal }));
    found.push(...next.items);
    if (!next.after) break;
    after = next.after;
  }
  return found;
}

/** @param {{ ids: string[], plates: any[] }} props */
function BundleForm({ ids, plates }) {
  const form = useForm({ pdf: true, svg: true, dxf: false, png: false, heaters: false, leds: false, resolution_dpi: "150", width: "", height: "" });
  const [job, setJob] = useState("");
  const count = ids.length || plates.length;
  const submit = async () => {
    const wanted = ids.length ? ids : plates.map(({ id }) => id);
    if (!wanted.length) throw new Problem({ title: t("studio.no_plates") });
    const formats = FORMATS.filter((name) => form.values[name]);
    if (!formats.length) throw new Problem({ title: t("artwork.none"), cure: t("artwork.choose") });
    const [width, height] = [form.values.width, form.values.height].map((value) => Number(String(value).replace(",", ".")));
    const sheet = form.values.width || form.values.height ? { sheet: { width_mm: width, height_mm: height } } : {};
    const { heaters, leds } = form.values;
    const body = { marker_ids: wanted, formats, heaters, leds, resolution_dpi: Number(form.values.resolution_dpi), ...sheet };
    const response = await request("/v1/artwork", jsonBody(body));
    if (response.status === 202) return setJob((await response.json()).id);
    save(await response.blob(), "waymark-artwork.zip");
    return notify(t("artwork.done", { count: wanted.length }), { detail: response.headers.get("Waymark-Note") ?? "" });
  };
  const done = (/** @type {import("../components/job.js").Job} */ ended) => attempt(async () => {
    await download(ended.links.result ?? "", "waymark-artwork.zip");
    notify(t("artwork.done", { count }));
    setJob("");
  });
  const errors = { width: form.errors["sheet.width_mm"] ?? "", height: form.errors["sheet.height_mm"] ?? "" };
  const shown = { ...form, errors: { ...form.errors, ...errors } };
  return html`
    <section class="card">
      <h2>${t("studio.zip")}</h2>
      <p role="status">${t(ids.length ? "studio.zip_ticked" : "studio.zip_all", { count })}</p>
      ${job ? html`<${JobProgress} id=${job} onDone=${done} />` : html`
        <${FormFrame} form=${form} onSubmit=${submit} button=${t("artwork.make")}>
          <fieldset><legend>${t("artwork.formats")}</legend><div class="checks">
            ${FORMATS.map((name) => html`<${CheckField} form=${form} path=${name} label=${name.toUpperCase()} />`)}
          </div></fieldset>
          <div class="checks">
            <${CheckField} form=${form} path="heaters" label=${t("artwork.heaters")} />
            <${CheckField} form=${form} path="leds" label=${t("artwork.leds")} />
          </div>
          <${SelectField} form=${form} path="resolution_dpi" label=${t("studio.dpi")} options=${["72", "150", "300"].map((value) => [value, value])} />
          <${Group} title=${t("studio.nest")}>
            <${TextField} form=${shown} path="width" label=${t("studio.sheet_width")} inputmode="decimal" placeholder="1500" />
            <${TextField} form=${shown} path="height" label=${t("studio.sheet_height")} inputmode="decimal" placeholder="3000" />
          </${Group}>
        </${FormFrame}>
      `}
    </section>
  `;
}
