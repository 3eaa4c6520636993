// A strip along one lane: stations against curvature, with rows of markers, checks and events. It is a slider: arrow keys
// select the next item, and the slider's value describes it.

import { html } from "htm/preact";
import { useEffect, useMemo, useRef, useState } from "preact/hooks";

import { number } from "../format.js";
import { symbolPaths } from "../map/symbols.js";
import { query, setQuery } from "../router.js";
import { t } from "../texts/index.js";
import { stationText, stationTicks, valueAt } from "./strip_scale.js";

/**
 * @typedef {import("./strip_scale.js").Way} Way
 * @typedef {{ id: string, row: string, at_m: number, label: string, family?: string, status?: string, sign?: string, kind?: string }} Item
 * @typedef {{ id: string | null, lane: string, at_m: number }} Pointed
 */

const ROW_PX = 26;
const CURVE_PX = 84;
const AXIS_PX = 26;
const TOP_PX = 8;
const SYMBOL_PX = 8; // if there is less room for each, they are drawn as strokes
const ON_TOP = ["ok", "event", "weak", "warn", "fail"]; // of signs at the same place, the last one is seen
const NEAR_PX = 10;
const LEAST_M = 5; // of the lane in view

/**
 * @param {object} props
 * @param {Way} props.way
 * @param {{ id: string, title: string }[]} props.rows
 * @param {Item[]} props.items In any order.
 * @param {string} props.label
 * @param {Pointed | null} [props.pointed]
 * @param {(pointed: Pointed | null) => void} [props.onPoint]
 * @param {(id: string) => void} [props.onChoose]
 */
export function Strip({ way, rows, items, label, pointed: fromPage = null, onPoint: report, onChoose }) {
  const [own, setOwn] = useState(/** @type {Pointed | null} */ (null));
  const pointed = report ? fromPage : own;
  const onPoint = report ?? setOwn;
  const [box, width] = useWidth();
  const [from, to] = readWindow(way);
  const shown = rows.filter(({ id }) => items.some((item) => item.row === id));
  const left = width < 560 ? 8 : 120;
  const curve = way.curvature_per_m ? CURVE_PX : 0;
  const height = TOP_PX + (width < 560 ? 1.6 : 1) * ROW_PX * shown.length + curve + AXIS_PX;
  const scale = (width - left - 14) / (to - from);
  const xOf = (/** @type {number} */ at_m) => left + (at_m - from) * scale;
  const rowHeight = (width < 560 ? 1.6 : 1) * ROW_PX;
  const yOf = (/** @type {string} */ row) => TOP_PX + shown.findIndex(({ id }) => id === row) * rowHeight + (width < 560 ? rowHeight - 13 : rowHeight / 2);
  const sorted = useMemo(() => [...items].sort((a, b) => a.at_m - b.at_m), [items]);
  const drawn = useMemo(() => html`
    ${shown.map((row) => html`<${Row} row=${row} left=${left} right=${width - 14} y=${yOf(row.id)} narrow=${width < 560} items=${sorted.filter((item) => item.row === row.id && item.at_m >= from && item.at_m <= to)} xOf=${xOf} />`)}
    ${curve > 0 && html`<${Curve} way=${way} from=${from} to=${to} xOf=${xOf} top=${height - AXIS_PX - curve + 6} height=${curve - 12} left=${left} right=${width - 14} />`}
    <${Axis} way=${way} from=${from} to=${to} xOf=${xOf} y=${height - AXIS_PX} left=${left} right=${width - 14} />
  `, [way, sorted, shown.length, from, to, width, label]);
  const current = pointed && pointed.lane === way.name ? pointed : null;
  const item = current?.id ? sorted.find(({ id }) => id === current.id) : undefined;
  const at_m = item?.at_m ?? current?.at_m ?? null;
  const text = textOf(way, item, at_m);
  const point = (/** @type {Item | undefined} */ next) => next && onPoint({ id: next.id, lane: way.name, at_m: next.at_m });

  /** @param {PointerEvent} event */
  const under = (event) => {
    const frame = /** @type {SVGSVGElement} */ (event.currentTarget).getBoundingClientRect();
    const [x, y] = [event.clientX - frame.left, event.clientY - frame.top];
    const near = sorted.map((one) => ({ one, apart: Math.hypot(xOf(one.at_m) - x, (yOf(one.row) - y) / 2) }))
      .filter(({ apart, one }) => apart < NEAR_PX && one.at_m >= from && one.at_m <= to).sort((a, b) => a.apart - b.apart)[0];
    return { item: near?.one, at_m: Math.min(Math.max(from + (x - left) / scale, 0), way.length_m) };
  };
  /** @param {KeyboardEvent} event */
  const onKey = (event) => {
    const place = item ? sorted.indexOf(item) : -1;
    const here = at_m ?? -1;
    /** @type {Record<string, () => void>} */
    const keys = {
      ArrowRight: () => point(place >= 0 ? sorted[place + 1] : sorted.find((one) => one.at_m > here)),
      ArrowLeft: () => point(place >= 0 ? sorted[place - 1] : sorted.findLast((one) => one.at_m < here)),
      Home: () => point(sorted[0]),
      End: () => point(sorted[sorted.length - 1]),
      Enter: () => item && onChoose?.(item.id),
      Escape: () => onPoint(null),
      "+": () => zoom(way, 0.5, at_m),
      "-": () => zoom(way, 2, at_m),
    };
    const act = keys[event.key.replace("Up", "Right").replace("Down", "Left")];
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
  };
  return html`
    <div class="strip">
      <div class="strip-head">
        <h2>${label}</h2>
        <span class="strip-text" aria-hidden="true">${text}</span>
        <div class="strip-tools">
          <button type="button" class="quiet" aria-label=${t("strip.back")} disabled=${from <= 0} onClick=${() => pan(way, -0.6)}>◀</button>
          <button type="button" class="quiet" aria-label=${t("strip.closer")} onClick=${() => zoom(way, 0.5, at_m)}>+</button>
          <button type="button" class="quiet" aria-label=${t("strip.farther")} disabled=${from <= 0 && to >= way.length_m} onClick=${() => zoom(way, 2, at_m)}>−</button>
          <button type="button" class="quiet" aria-label=${t("strip.ahead")} disabled=${to >= way.length_m} onClick=${() => pan(way, 0.6)}>▶</button>
        </div>
      </div>
      <div class="strip-box" ref=${box} tabindex="0" role="slider" aria-label=${t("strip.slider", { name: label })} aria-valuemin="0" aria-valuemax=${Math.round(way.length_m)}
        aria-valuenow=${Math.round(at_m ?? 0)} aria-valuetext=${text || t("strip.nothing", { count: items.length })} onKeyDown=${onKey}>
        <svg class="strip-drawing" viewBox=${`0 0 ${width} ${height}`} height=${height} aria-hidden="true"
          onPointerMove=${(/** @type {PointerEvent} */ event) => {
            const found = under(event);
            onPoint({ id: found.item?.id ?? null, lane: way.name, at_m: found.item?.at_m ?? found.at_m });
          }}
          onPointerLeave=${() => onPoint(null)}
          onClick=${(/** @type {any} */ event) => {
            const found = under(event).item;
            if (found) onChoose?.(found.id);
          }}>
          ${drawn}
          ${at_m !== null && at_m >= from && at_m <= to && html`
            <line class="strip-cursor" x1=${xOf(at_m)} x2=${xOf(at_m)} y1="2" y2=${height - AXIS_PX} />
            ${item && html`<circle class="strip-ring" cx=${xOf(at_m)} cy=${yOf(item.row)} r="11" />`}
          `}
        </svg>
      </div>
    </div>
  `;
}

/** @param {Way} way @param {Item | undefined} item @param {number | null} at_m */
function textOf(way, item, at_m) {
  if (at_m === null) return "";
  const station = stationText(valueAt(way.chainage_m, way.station_m, at_m));
  if (item) return `${item.label}, ${t("strip.station", { station })}`;
  return t("strip.station", { station });
}

/** What is in view, as the address has it. @param {Way} way @returns {[number, number]} */
function readWindow(way) {
  const [from = NaN, to = NaN] = (query.value.get("strip") ?? "").split(",").map(Number);
  const isThere = Number.isFinite(from) && Number.isFinite(to) && to - from >= LEAST_M / 2 && from < way.length_m && from >= 0;
  return isThere ? [from, Math.min(to, way.length_m)] : [0, way.length_m];
}

/** @param {Way} way @param {number} from @param {number} length */
function show(way, from, length) {
  const whole = length >= way.length_m * 0.999;
  const start = Math.min(Math.max(from, 0), way.length_m - length);
  setQuery({ strip: whole ? null : `${start.toFixed(1)},${(start + length).toFixed(1)}` });
}

/** @param {Way} way @param {number} factor @param {number | null} at_m */
function zoom(way, factor, at_m) {
  const [from, to] = readWindow(way);
  const length = Math.min(Math.max((to - from) * factor, LEAST_M), way.length_m);
  const middle = at_m !== null && at_m >= from && at_m <= to ? at_m : (from + to) / 2;
  show(way, middle - ((middle - from) / (to - from)) * length, length);
}

/** @param {Way} way @param {number} share */
function pan(way, share) {
  const [from, to] = readWindow(way);
  show(way, from + share * (to - from), to - from);
}

/** @param {{ row: { id: string, title: string }, items: Item[], left: number, right: number, y: number, narrow: boolean, xOf: (at_m: number) => number }} props */
function Row({ row, items, left, right, y, narrow, xOf }) {
  const many = items.length * SYMBOL_PX > right - left && items.every(({ family }) => family);
  const ordered = [...items].sort((a, b) => ON_TOP.indexOf(a.kind ?? "") - ON_TOP.indexOf(b.kind ?? ""));
  const strokes = many ? items.map(({ at_m }) => `M${xOf(at_m).toFixed(1)} ${y - 7}v14`).join("") : "";
  return html`
    <text class="strip-name" x=${narrow ? left : left - 12} y=${narrow ? y - 14 : y + 4} text-anchor=${narrow ? "start" : "end"}>${row.title}</text>
    <line class="strip-line" x1=${left} x2=${right} y1=${y} y2=${y} />
    ${many ? html`<path class="strip-strokes" d=${strokes} />` : ordered.map((item) => html`<${Mark} key=${item.id} item=${item} x=${xOf(item.at_m)} y=${y} />`)}
  `;
}

/** @param {{ item: Item, x: number, y: number }} props */
function Mark({ item, x, y }) {
  if (!item.family) return html`<g class=${`strip-sign ${item.kind ?? ""}`} transform=${`translate(${x} ${y})`}><circle r="8" /><text y="4.5" text-anchor="middle">${item.sign ?? "•"}</text></g>`;
  return html`
    <g class=${`symbol status-${item.status ?? "planned"}`} transform=${`translate(${x - 7.2} ${y - 7.2}) scale(.6)`}>
      ${symbolPaths(item.family, item.status ?? "planned").map((part) => html`<path class=${part.kind} d=${part.d} />`)}
    </g>
  `;
}

/** @param {{ way: Way, from: number, to: number, xOf: (at_m: number) => number, top: number, height: number, left: number, right: number }} props */
function Curve({ way, from, to, xOf, top, height, left, right }) {
  const curvature = way.curvature_per_m ?? [];
  const most = Math.max(...curvature.map(Math.abs), 1e-3);
  const middle = top + height / 2;
  const yOf = (/** @type {number} */ value) => middle - (value / most) * (height / 2);
  const points = way.chainage_m.map((at_m, k) => [at_m, curvature[k] ?? 0]).filter(([at_m = 0]) => at_m > from && at_m < to);
  const ends = [[from, valueAt(way.chainage_m, curvature, from)], ...points, [to, valueAt(way.chainage_m, curvature, to)]];
  const line = ends.map(([at_m = 0, value = 0], k) => `${k ? "L" : "M"}${xOf(at_m).toFixed(1)} ${yOf(value).toFixed(1)}`).join("");
  const radius = number(1 / most, 0, "m");
  const narrow = left < 50;
  return html`
    ${narrow ? html`<text class="strip-name" x=${left} y=${top + 4}>${t("strip.curvature")}</text>` : html`
      <text class="strip-name" x=${left - 12} y=${top + 8} text-anchor="end">${t("strip.left", { radius })}</text>
      <text class="strip-name" x=${left - 12} y=${middle + 4} text-anchor="end">${t("strip.curvature")}</text>
      <text class="strip-name" x=${left - 12} y=${top + height} text-anchor="end">${t("strip.right", { radius })}</text>
    `}
    <path class="strip-curve" d=${`${line}L${xOf(to).toFixed(1)} ${middle}L${xOf(from).toFixed(1)} ${middle}Z`} />
    <line class="strip-line" x1=${left} x2=${right} y1=${middle} y2=${middle} />
  `;
}

/** @param {{ way: Way, from: number, to: number, xOf: (at_m: number) => number, y: number, left: number, right: number }} props */
function Axis({ way, from, to, xOf, y, left, right }) {
  return html`
    <line class="strip-axis" x1=${left} x2=${right} y1=${y} y2=${y} />
    ${stationTicks(way, from, to, (right - left) / 90).map(({ at_m, text }) => html`
      <line class="strip-axis" x1=${xOf(at_m)} x2=${xOf(at_m)} y1=${y} y2=${y + 5} />
      <text class="strip-station" x=${Math.min(Math.max(xOf(at_m), left + 14), right - 14)} y=${y + 18} text-anchor="middle">${text}</text>
    `)}
  `;
}

/** The width of a box, whenever it changes. @returns {[{ current: HTMLDivElement | null }, number]} */
function useWidth() {
  const box = useRef(/** @type {HTMLDivElement | null} */ (null));
  const [width, setWidth] = useState(800);
  useEffect(() => {
    const frame = box.current;
    if (!frame) return undefined;
    const measure = () => frame.clientWidth && setWidth(Math.max(240, frame.clientWidth));
    measure();
    const observer = new ResizeObserver(measure);
    observer.observe(frame);
    return () => observer.disconnect();
  }, []);
  return [box, width];
}
