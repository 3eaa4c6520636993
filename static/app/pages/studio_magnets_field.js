// The field of a tag: a map at the height of a vehicle's sensors, and what one of them records as it passes.

import { html } from "htm/preact";
import { useEffect, useMemo, useRef } from "preact/hooks";

import { Facts } from "../components/facts.js";
import { Group, SelectField, TextField } from "../components/form.js";
import { useWidth } from "../components/width.js";
import { number } from "../format.js";
import { t } from "../texts/index.js";
import { componentOf, fieldAt, NOISE_UT, SAMPLE_RATE_HZ } from "./studio_magnets_model.js";

/** @typedef {import("./studio_magnets_model.js").Tag} Tag */

const AXES = /** @type {const} */ (["x", "y", "z", "total"]);
const AROUND_M = 0.8;
const MAP_PX = { width: 360, height: 96 };
const PLOT = { start_px: 720, height: 240, left: 52, bottom: 34, top: 12, right: 12 };
/** Blue to white to orange: also people who see no red or no green distinguish the ends. */
const COLD = [33, 90, 160];
const WARM = [190, 92, 10];

/** @param {import("../components/form.js").Values} values */
function placeOf(values) {
  const of = (/** @type {string} */ name, /** @type {number} */ usual) => {
    const found = Number(String(values[name] ?? "").replace(",", "."));
    return Number.isFinite(found) && String(values[name] ?? "").trim() ? found : usual;
  };
  return {
    clearance: Math.min(Math.max(of("clearance_m", 0.16), 0.05), 1), depth: Math.min(Math.max(of("depth_m", 0), 0), 0.3),
    lateral: Math.min(Math.max(of("lateral_m", 0), -2), 2), axis: String(values.axis),
    speed: Math.min(Math.max(of("rules.speed_m_s", 13.4), 0.5), 70),
  };
}

/** @param {{ typed: import("../components/query_form.js").QueryForm }} props */
export function FieldForm({ typed }) {
  const ranges = /** @type {Record<string, [number, number]>} */ ({ clearance_m: [0.05, 1], depth_m: [0, 0.3], lateral_m: [-2, 2] });
  const errors = Object.fromEntries(Object.entries(ranges).map(([name, [least, most]]) => {
    const value = Number(String(typed.values[name] ?? "").replace(",", "."));
    return [name, value >= least && value <= most ? "" : t("form.range", { least, most })];
  }));
  const form = { ...typed, errors };
  return html`
    <form class="card form" novalidate autocomplete="off" aria-label=${t("magnets.field")} onSubmit=${(/** @type {Event} */ event) => event.preventDefault()}>
      <${Group} title=${t("magnets.field")}>
        <${TextField} form=${form} path="clearance_m" label=${t("magnets.clearance")} hint=${t("form.range", { least: 0.05, most: 1 })} inputmode="decimal" />
        <${TextField} form=${form} path="depth_m" label=${t("magnets.depth")} hint=${t("form.range", { least: 0, most: 0.3 })} inputmode="decimal" />
        <${TextField} form=${form} path="lateral_m" label=${t("magnets.lateral")} hint=${t("form.range", { least: -2, most: 2 })} inputmode="decimal" />
        <${SelectField} form=${form} path="axis" label=${t("magnets.axis")} options=${AXES.map((name) => [name, t(`magnets.axis_${name}`)])} />
      </${Group}>
    </form>
  `;
}

/** @param {{ tag: Tag, typed: import("../components/query_form.js").QueryForm }} props */
export function TagField({ tag, typed }) {
  const place = placeOf(typed.values);
  const height = place.clearance + place.depth;
  const from = -AROUND_M;
  const to = tag.length + AROUND_M;
  const trace = useMemo(() => Array.from({ length: 481 }, (_, k) => {
    const x = from + ((to - from) * k) / 480;
    return { x, field: fieldAt(tag, x, place.lateral, height) };
  }), [JSON.stringify(tag), place.lateral, height]);
  const peak = Math.max(...trace.map(({ field }) => Math.hypot(...field)));
  return html`
    <section class="card" aria-label=${t("magnets.field")}>
      <h2>${t("magnets.map", { clearance: number(place.clearance, 2, "m") })}</h2>
      <${FieldMap} tag=${tag} height=${height} axis=${place.axis} lateral=${place.lateral} from=${from} to=${to} />
      <h2>${t("magnets.trace")}</h2>
      <${Trace} trace=${trace} from=${from} to=${to} />
      <${Facts} of=${[
        [t("magnets.peak"), number(peak, 1, "µT")],
        [t("magnets.noise"), t("magnets.noise_times", { noise: number(NOISE_UT, 1, "µT"), times: number(peak / NOISE_UT, 1) })],
        [t("magnets.samples"), t("magnets.samples_every", { every: number((place.speed / SAMPLE_RATE_HZ) * 1000, 0, "mm"), speed: number(place.speed, 1, "m/s"), rate: number(SAMPLE_RATE_HZ, 0, "Hz") })],
      ]} />
      <p class="hint">${t("magnets.model_note")}</p>
    </section>
  `;
}

/** @param {{ tag: Tag, height: number, axis: string, lateral: number, from: number, to: number }} props */
function FieldMap({ tag, height, axis, lateral, from, to }) {
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  const across = ((to - from) * MAP_PX.height) / MAP_PX.width / 2;
  const values = useMemo(() => Array.from({ length: MAP_PX.width * MAP_PX.height }, (_, k) => {
    const x = from + ((to - from) * ((k % MAP_PX.width) + 0.5)) / MAP_PX.width;
    const y = across - (2 * across * (Math.floor(k / MAP_PX.width) + 0.5)) / MAP_PX.height;
    return componentOf(fieldAt(tag, x, y, height), axis);
  }), [JSON.stringify(tag), height, axis]);
  const largest = values.reduce((most, value) => Math.max(most, Math.abs(value)), 1e-9);
  useEffect(() => {
    const context = canvas.current?.getContext("2d");
    if (!context) return;
    const image = context.createImageData(MAP_PX.width, MAP_PX.height);
    values.forEach((value, k) => image.data.set([...colourOf(value / largest), 255], 4 * k));
    context.putImageData(image, 0, 0);
  }, [values]);
  const row = ((across - lateral) / (2 * across)) * 100;
  return html`
    <div class="field-map">
      <canvas ref=${canvas} width=${MAP_PX.width} height=${MAP_PX.height} role="img" aria-label=${t("magnets.map_alt", { largest: number(largest, 1, "µT") })}></canvas>
      <svg viewBox="0 0 100 100" preserveAspectRatio="none" aria-hidden="true">
        ${row >= 0 && row <= 100 && html`<path class="path" d=${`M0 ${row}H100`} />`}
        ${tag.magnets.map(({ x }) => html`<path class="spot" d=${`M${((x - from) / (to - from)) * 100} 46V54`} />`)}
      </svg>
    </div>
    <div class="field-scale">
      <span>${axis === "total" ? "0" : number(-largest, 1)}</span><${Scale} both=${axis !== "total"} /><span>${number(largest, 1, "µT")}</span>
    </div>
    <p class="hint">${t("magnets.map_note", { wide: number(2 * across, 1, "m"), long: number(to - from, 1, "m") })}</p>
  `;
}

/** @param {{ both: boolean }} props */
function Scale({ both }) {
  const steps = Array.from({ length: 41 }, (_, k) => (both ? (k - 20) / 20 : k / 40));
  return html`<svg class="scale" viewBox="0 0 41 4" preserveAspectRatio="none" aria-hidden="true">${steps.map((share, k) => html`<rect x=${k} width="1.05" height="4" fill=${`rgb(${colourOf(share).join(" ")})`} />`)}</svg>`;
}

/** Colour of a share of the largest value, -1 to 1; weak fields are raised, so that they show. @param {number} share */
function colourOf(share) {
  const strength = Math.sqrt(Math.min(Math.abs(share), 1));
  const end = share < 0 ? COLD : WARM;
  return end.map((part) => Math.round(250 + (part - 250) * strength));
}

/** @param {{ trace: { x: number, field: [number, number, number] }[], from: number, to: number }} props */
function Trace({ trace, from, to }) {
  const { start_px, height, left, bottom, top, right } = PLOT;
  const [box, width] = useWidth(start_px);
  const largest = Math.max(...trace.flatMap(({ field }) => field.map(Math.abs)), 1);
  const step = niceStep((2 * largest) / 5);
  const limit = Math.ceil(largest / step) * step;
  const across = (/** @type {number} */ x) => left + ((x - from) / (to - from)) * (width - left - right);
  const up = (/** @type {number} */ value) => top + ((limit - value) / (2 * limit)) * (height - top - bottom);
  const ticks = Array.from({ length: Math.round((2 * limit) / step) + 1 }, (_, k) => -limit + k * step);
  const metres = niceStep((to - from) / 8);
  const marks = Array.from({ length: Math.floor(to / metres) - Math.ceil(from / metres) + 1 }, (_, k) => (Math.ceil(from / metres) + k) * metres);
  const line = (/** @type {number} */ axis) => trace.map(({ x, field }, k) => `${k ? "L" : "M"}${across(x).toFixed(1)} ${up(field[axis] ?? 0).toFixed(1)}`).join("");
  const digits = step < 1 ? 1 : 0;
  return html`
    <div ref=${box}>
    <svg class="trace" viewBox=${`0 0 ${width} ${height}`} role="img" aria-label=${t("magnets.trace_alt", { largest: number(largest, 1, "µT") })}>
      ${ticks.map((value) => html`<path class=${Math.abs(value) < 1e-9 ? "axis" : "grid"} d=${`M${left} ${up(value)}H${width - right}`} /><text x=${left - 6} y=${up(value) + 4} text-anchor="end">${number(value, digits)}</text>`)}
      ${marks.map((x) => html`<text x=${across(x)} y=${height - 16} text-anchor="middle">${number(x, metres < 1 ? 1 : 0)}</text>`)}
      <text x=${width - right} y=${height - 2} text-anchor="end">${t("magnets.along")}</text>
      <text x="2" y=${height - 2}>µT</text>
      ${[0, 1, 2].map((axis) => html`<path class=${`line axis-${AXES[axis]}`} d=${line(axis)} />`)}
    </svg>
    </div>
    <ul class="trace-legend">${AXES.slice(0, 3).map((name) => html`<li><svg viewBox="0 0 36 8" aria-hidden="true"><path class=${`line axis-${name}`} d="M0 4H36" /></svg> ${t(`magnets.axis_${name}`)}</li>`)}</ul>
  `;
}

/** 1, 2 or 5 times a power of ten. @param {number} least */
function niceStep(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return power * ([1, 2, 5].find((times) => times * power >= least) ?? 10);
}
