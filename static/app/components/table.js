// A table for many rows: only those in view are in the document. Columns can be sorted, and chosen.

import { html } from "htm/preact";
import { useEffect, useMemo, useRef, useState } from "preact/hooks";

import { query, setQuery } from "../router.js";
import { t } from "../texts/index.js";

const ROW_PX = 40; // as --row in style/components.css
const BEYOND = 12;

/**
 * @template Row
 * @typedef {object} Column
 * @property {string} name In the address, where the order and the chosen columns are kept.
 * @property {string} title
 * @property {(row: Row) => any} cell
 * @property {(row: Row) => string | number | null | undefined} [order] What rows are sorted by; without it they cannot.
 * @property {boolean} [number] Right-aligned.
 * @property {boolean} [hidden] Not shown unless it is chosen.
 * @property {boolean} [head] It names the row.
 */

/**
 * @param {object} props
 * @param {any[]} props.rows
 * @param {Column<any>[]} props.columns
 * @param {(row: any) => string} props.idOf
 * @param {string} props.label
 * @param {string | null} [props.chosen] Id of the row that is shown elsewhere.
 * @param {Set<string>} [props.ticked] Ids of the rows that are ticked; without it rows have no box.
 * @param {(ids: Set<string>) => void} [props.onTick]
 * @param {(row: any) => string} [props.nameOf] What a row is called, for its box.
 * @param {any} [props.footer]
 * @param {string | null} [props.pointed] Id of the row that is pointed at elsewhere.
 * @param {(row: any | null) => void} [props.onPoint] Called when the pointer or the focus is on a row, with null when it leaves.
 */
export function Table({ rows, columns, idOf, label, chosen = null, ticked, onTick, nameOf = idOf, footer, pointed = null, onPoint }) {
  const order = query.value.get("sort") ?? "";
  const shown = chosenColumns(columns, query.value.get("columns"));
  const sorted = useMemo(() => sortedRows(rows, columns, order), [rows, columns, order]);
  const [box, from, to] = useVisible(sorted.length, chosen ? sorted.findIndex((row) => idOf(row) === chosen) : -1);
  const all = ticked !== undefined && rows.length > 0 && rows.every((row) => ticked.has(idOf(row)));
  /** @param {Iterable<string>} ids @param {boolean} on */
  const tick = (ids, on) => {
    const next = new Set(ticked);
    for (const id of ids) if (on) next.add(id); else next.delete(id);
    onTick?.(next);
  };
  return html`
    <div class="table-frame">
      <div class="table-scroll" ref=${box} tabindex="0" role="region" aria-label=${label}>
        <table aria-rowcount=${sorted.length + 1}>
          <thead>
            <tr>
              ${ticked && html`<th scope="col" class="tick"><input type="checkbox" aria-label=${t("table.tick_all")} checked=${all} disabled=${!rows.length}
                onChange=${(/** @type {any} */ event) => tick(rows.map(idOf), event.currentTarget.checked)} /></th>`}
              ${shown.map((column) => html`<${Head} key=${column.name} column=${column} order=${order} />`)}
            </tr>
          </thead>
          <tbody>
            ${from > 0 && html`<${Space} rows=${from} span=${shown.length + 1} />`}
            ${sorted.slice(from, to).map((row, k) => {
              const id = idOf(row);
              return html`
                <tr key=${id} aria-rowindex=${from + k + 2} class=${id === chosen ? "chosen" : id === pointed ? "pointed" : undefined}
                  onPointerEnter=${onPoint && (() => onPoint(row))} onPointerLeave=${onPoint && (() => onPoint(null))} onFocusIn=${onPoint && (() => onPoint(row))}>
                  ${ticked && html`<td class="tick"><input type="checkbox" aria-label=${t("table.tick", { name: nameOf(row) })} checked=${ticked.has(id)}
                    onChange=${(/** @type {any} */ event) => tick([id], event.currentTarget.checked)} /></td>`}
                  ${shown.map((column) => (column.head
                    ? html`<th scope="row">${column.cell(row)}</th>`
                    : html`<td class=${column.number ? "number" : undefined}>${column.cell(row)}</td>`))}
                </tr>
              `;
            })}
            ${to < sorted.length && html`<${Space} rows=${sorted.length - to} span=${shown.length + 1} />`}
          </tbody>
        </table>
      </div>
      <div class="table-foot"><span>${footer}</span><${ColumnChoice} columns=${columns} shown=${shown} /></div>
    </div>
  `;
}

/** Rows that are not in the document leave their space. @param {{ rows: number, span: number }} props */
function Space({ rows, span }) {
  const cell = useRef(/** @type {HTMLTableCellElement | null} */ (null));
  useEffect(() => {
    if (cell.current) cell.current.style.height = `${rows * ROW_PX}px`;
  });
  return html`<tr aria-hidden="true" class="space"><td ref=${cell} colspan=${span}></td></tr>`;
}

/** @param {{ column: Column<any>, order: string }} props */
function Head({ column, order }) {
  const down = order === `-${column.name}`;
  const up = order === column.name;
  const sort = up ? "ascending" : down ? "descending" : undefined;
  return html`
    <th scope="col" class=${column.number ? "number" : undefined} aria-sort=${sort}>
      ${column.order
        ? html`<button type="button" class="sort" onClick=${() => setQuery({ sort: up ? `-${column.name}` : down ? null : column.name })}>
            ${column.title}<span aria-hidden="true">${up ? " ▲" : down ? " ▼" : ""}</span></button>`
        : column.title}
    </th>
  `;
}

/** @param {{ columns: Column<any>[], shown: Column<any>[] }} props */
function ColumnChoice({ columns, shown }) {
  const names = new Set(shown.map((column) => column.name));
  /** @param {string} name @param {boolean} on */
  const choose = (name, on) => {
    const next = columns.filter((column) => (column.name === name ? on : names.has(column.name))).map((column) => column.name);
    const plain = columns.filter((column) => !column.hidden).map((column) => column.name);
    setQuery({ columns: next.join() === plain.join() ? null : next.join() });
  };
  return html`
    <details class="choice">
      <summary>${t("table.columns")}</summary>
      <div class="choice-list">
        ${columns.map((column) => html`
          <label class="check"><input type="checkbox" checked=${names.has(column.name)} disabled=${column.head}
            onChange=${(/** @type {any} */ event) => choose(column.name, event.currentTarget.checked)} /> ${column.title}</label>
        `)}
      </div>
    </details>
  `;
}

/** @param {Column<any>[]} columns @param {string | null} names */
function chosenColumns(columns, names) {
  const wanted = names?.split(",");
  return columns.filter((column) => column.head || (wanted ? wanted.includes(column.name) : !column.hidden));
}

/** @param {any[]} rows @param {Column<any>[]} columns @param {string} order */
function sortedRows(rows, columns, order) {
  const column = columns.find(({ name }) => name === order.replace(/^-/, ""));
  if (!column?.order) return rows;
  const value = column.order;
  const sign = order.startsWith("-") ? -1 : 1;
  return [...rows].sort((a, b) => {
    const [x, y] = [value(a) ?? null, value(b) ?? null];
    if (x === null || y === null) return x === y ? 0 : x === null ? 1 : -1; // what is missing comes last
    if (typeof x === "number" && typeof y === "number") return sign * (x - y);
    return sign * String(x).localeCompare(String(y), undefined, { numeric: true });
  });
}

/**
 * Which rows are in view.
 *
 * @param {number} count
 * @param {number} chosen Row to scroll to when it changes; -1 for none.
 * @returns {[{ current: HTMLDivElement | null }, number, number]}
 */
function useVisible(count, chosen) {
  const box = useRef(/** @type {HTMLDivElement | null} */ (null));
  const [range, setRange] = useState([0, 60]);
  useEffect(() => {
    const frame = box.current;
    if (!frame) return undefined;
    const measure = () => {
      const first = Math.max(0, Math.floor(frame.scrollTop / ROW_PX) - BEYOND);
      const last = Math.ceil((frame.scrollTop + frame.clientHeight) / ROW_PX) + BEYOND;
      setRange((old) => (old[0] === first && old[1] === last ? old : [first, last]));
    };
    measure();
    frame.addEventListener("scroll", measure, { passive: true });
    const observer = new ResizeObserver(measure);
    observer.observe(frame);
    return () => {
      frame.removeEventListener("scroll", measure);
      observer.disconnect();
    };
  }, []);
  useEffect(() => {
    const frame = box.current;
    if (!frame || chosen < 0) return;
    const top = chosen * ROW_PX;
    if (top < frame.scrollTop || top + 2 * ROW_PX > frame.scrollTop + frame.clientHeight) frame.scrollTop = top - frame.clientHeight / 2;
  }, [chosen >= 0]);
  const [first = 0, last = 0] = range;
  return [box, Math.min(first, count), Math.min(last, count)];
}
