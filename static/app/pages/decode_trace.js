// A trace on a plot that can be zoomed: the field, the magnets (peaks), the tags and the line crossings in it.

import { html } from "htm/preact";
import { useEffect, useRef, useState } from "preact/hooks";

import { request } from "../api/client.js";
import { isAborted } from "../components/load.js";
import { ProblemBox } from "../components/problem.js";
import { number } from "../format.js";
import { createChart } from "../plot/chart.js";
import { query, setQuery } from "../router.js";
import { t, textOr } from "../texts/index.js";

const POINTS = 100_000; // of each series at once; finer ones are loaded when the window is small
const FINER_AFTER_MS = 250;
const HEIGHT = 300;
const COLOURS = /** @type {((colours: import("../plot/chart.js").Colours) => string)[]} */ ([(c) => c.accent, (c) => c.warn, (c) => c.good, (c) => c.chosen, (c) => c.bad, (c) => c.soft]);

/**
 * @param {{ source: import("./decode_timeline.js").Source, timeline: import("./decode_timeline.js").Timeline }} props
 */
export function TracePlot({ source, timeline }) {
  const { decode, zero, shift } = source;
  const box = useRef(/** @type {HTMLDivElement | null} */ (null));
  const chart = useRef(/** @type {import("../plot/chart.js").Chart | null} */ (null));
  const [state, setState] = useState(/** @type {{ loading: boolean, error: unknown, samples: any }} */ ({ loading: true, error: null, samples: null }));
  const series = query.value.get("series") ?? "vertical,forward";
  useEffect(() => {
    const abort = new AbortController();
    let timer = 0;
    /** @type {import("../plot/chart.js").Chart | null} */
    let made = null;
    const load = async (/** @type {number | null} */ from = null, /** @type {number | null} */ to = null) => {
      const parameters = new URLSearchParams({ points: String(POINTS) });
      for (const name of series.split(",")) parameters.append("series", name);
      if (from !== null && to !== null) [["from_s", from], ["to_s", to]].forEach(([name, value]) => parameters.set(String(name), String(value)));
      return (await request(`${decode.links.samples}?${parameters}`, { signal: abort.signal })).json();
    };
    const columns = (/** @type {any} */ samples) => samples.series.map((/** @type {any} */ entry, /** @type {number} */ k) => ({ label: entry.name, values: entry.values, colour: COLOURS[k] }));
    const start = async () => {
      setState((old) => ({ ...old, loading: true, error: null }));
      const samples = await load();
      if (abort.signal.aborted || !box.current) return;
      box.current.replaceChildren();
      made = await createChart(box.current, {
        t: samples.t_s, columns: columns(samples), height: HEIGHT, unit: "µT", timeText: (at) => number(at - (samples.from_s > 1e9 ? samples.from_s : 0), 2, "s"),
        overlay: (paint) => drawFindings(paint, decode),
        onPick: (at) => {
          timeline.cursor.value = at + zero + shift;
        },
        onWindow: (from, to) => {
          setQuery({ zoom: from <= samples.from_s && to >= samples.to_s ? null : `${from.toFixed(3)},${to.toFixed(3)}` });
          if (!samples.thinned) return;
          clearTimeout(timer);
          timer = window.setTimeout(() => load(from - (to - from) / 2, to + (to - from) / 2).then((finer) => made?.setSamples(finer.t_s, columns(finer)), () => {}), FINER_AFTER_MS);
        },
      });
      if (abort.signal.aborted) return made.remove();
      chart.current = made;
      made.setLimits(samples.from_s, samples.to_s);
      const [from, to] = (query.peek().get("zoom") ?? "").split(",").map(Number);
      if (from !== undefined && to !== undefined && to > from) made.setWindow(from, to, true);
      made.setCursor(timeline.cursor.peek() - zero - shift);
      setState({ loading: false, error: null, samples });
    };
    start().catch((error) => isAborted(error) || abort.signal.aborted || setState({ loading: false, error, samples: null }));
    return () => {
      abort.abort();
      clearTimeout(timer);
      made?.remove();
      chart.current = null;
    };
  }, [decode.id, series]);
  useEffect(() => timeline.cursor.subscribe((at) => chart.current?.setCursor(at - zero - shift)), [timeline]);
  const act = (/** @type {(chart: import("../plot/chart.js").Chart) => void} */ work) => () => chart.current && work(chart.current);
  const tags = decode.tags.map((/** @type {any} */ tag) => ({ from: tag.start_s, to: tag.end_s, name: tag.tag ?? tag.polarities }));
  return html`
    <figure class="decode-picture chart-figure">
      <div class="frame-tools">
        <button type="button" class="quiet" aria-label=${t("decode.zoom_in")} onClick=${act((plot) => plot.zoom(0.5, middleOf(plot, timeline.cursor.peek() - zero - shift)))}>+</button>
        <button type="button" class="quiet" aria-label=${t("decode.zoom_out")} onClick=${act((plot) => plot.zoom(2))}>−</button>
        <button type="button" class="quiet" aria-label=${t("decode.pan_left")} onClick=${act((plot) => plot.pan(-0.4))}>‹</button>
        <button type="button" class="quiet" aria-label=${t("decode.pan_right")} onClick=${act((plot) => plot.pan(0.4))}>›</button>
        <button type="button" class="quiet" onClick=${act((plot) => plot.reset())}>${t("decode.zoom_all")}</button>
        ${tags.length > 0 && html`<label class="inline-choice"><span>${t("decode.go_to_tag")}</span> <select onChange=${(/** @type {any} */ event) => {
          const tag = tags[Number(event.currentTarget.value)];
          if (!tag) return;
          chart.current?.setWindow(tag.from - 0.6, tag.to + 0.6);
          timeline.cursor.value = tag.to + zero + shift;
        }}><option value="">–</option>${tags.map((/** @type {any} */ tag, /** @type {number} */ k) => html`<option value=${String(k)}>${tag.name}</option>`)}</select></label>`}
        <span class="spacer"></span>
        <${SeriesChoice} available=${state.samples?.available ?? ["vertical", "forward"]} chosen=${series.split(",")} />
      </div>
      <${ProblemBox} error=${state.error} />
      ${state.loading && html`<p class="loading" role="status">${t("load.loading")}</p>`}
      <div class="chart" ref=${box} role="img" aria-label=${t("decode.trace_alt", { text: decode.summary.text })}></div>
      <figcaption>
        <span class="chart-key">${series.split(",").map((name, k) => html`<span class=${`key key-${k}`}>${seriesName(name)}</span>`)}
          <span class="key key-n">N ●</span><span class="key key-s">S ●</span><span class="key key-noise">✕ ${t("decode.no_magnet")}</span></span>
        ${t("decode.zoom_hint")}
      </figcaption>
    </figure>
  `;
}

/** @param {import("../plot/chart.js").Chart} plot @param {number} at */
function middleOf(plot, at) {
  const [from, to] = plot.window();
  return at > from && at < to ? at : (from + to) / 2;
}

/** @param {string} name */
function seriesName(name) {
  const sensor = /^s(\d+)_([xyz])$/.exec(name);
  return sensor ? t("decode.series_sensor", { sensor: sensor[1] ?? "", axis: sensor[2] ?? "" }) : textOr(`decode.series_${name}`, name);
}

/** @param {{ available: string[], chosen: string[] }} props */
function SeriesChoice({ available, chosen }) {
  const choose = (/** @type {string} */ name, /** @type {boolean} */ on) => {
    const next = available.filter((entry) => (entry === name ? on : chosen.includes(entry))).slice(0, COLOURS.length);
    setQuery({ series: next.join() === "vertical,forward" || !next.length ? null : next.join() });
  };
  return html`
    <details class="choice"><summary>${t("decode.series")}</summary>
      <div class="choice-list">${available.map((name) => html`<label class="check"><input type="checkbox" checked=${chosen.includes(name)}
        disabled=${!chosen.includes(name) && chosen.length >= COLOURS.length} onChange=${(/** @type {any} */ event) => choose(name, event.currentTarget.checked)} /> ${seriesName(name)}</label>`)}</div>
    </details>
  `;
}

/** Tags as bands, line crossings as lines, magnets and noise as signs along the upper edge. @param {import("../plot/chart.js").Paint} paint @param {any} decode */
function drawFindings(paint, { tags, crossings, magnets, noise }) {
  const { pen, x, top, bottom, from, to, px, colours } = paint;
  const inView = (/** @type {{ t_s: number }} */ { t_s }) => t_s >= from && t_s <= to;
  pen.font = `${12 * px}px system-ui, sans-serif`;
  pen.textAlign = "left";
  pen.textBaseline = "alphabetic";
  pen.lineWidth = px;
  for (const tag of tags) {
    if (tag.end_s < from || tag.start_s > to) continue;
    const [left, right] = [x(tag.start_s), Math.max(x(tag.end_s), x(tag.start_s) + 2 * px)];
    pen.globalAlpha = 0.14;
    pen.fillStyle = tag.direction === "wrong-way" ? colours.bad : colours.good;
    pen.fillRect(left, top, right - left, bottom - top);
    pen.globalAlpha = 1;
    pen.fillText(tag.tag ?? tag.polarities, left + 3 * px, top + 40 * px);
  }
  pen.strokeStyle = colours.warn;
  pen.setLineDash([4 * px, 3 * px]);
  for (const crossing of crossings.filter(inView)) {
    pen.beginPath();
    pen.moveTo(x(crossing.t_s), top);
    pen.lineTo(x(crossing.t_s), bottom);
    pen.stroke();
  }
  pen.setLineDash([]);
  for (const finding of noise.filter(inView)) sign(pen, x(finding.t_s), top + 8 * px, 3 * px, colours.soft, "cross");
  for (const magnet of magnets.filter(inView)) {
    const colour = magnet.polarity === "N" ? colours.bad : colours.accent;
    pen.globalAlpha = 0.5;
    pen.strokeStyle = colour;
    pen.beginPath();
    pen.moveTo(x(magnet.t_s), top + 22 * px);
    pen.lineTo(x(magnet.t_s), bottom);
    pen.stroke();
    pen.globalAlpha = 1;
    sign(pen, x(magnet.t_s), top + 20 * px, 5 * px, colour, "dot");
    pen.fillText(magnet.polarity, x(magnet.t_s) + 7 * px, top + 24 * px);
  }
}

/** @param {CanvasRenderingContext2D} pen @param {number} x @param {number} y @param {number} size @param {string} colour @param {"dot" | "cross"} shape */
function sign(pen, x, y, size, colour, shape) {
  pen.fillStyle = pen.strokeStyle = colour;
  pen.beginPath();
  if (shape === "dot") {
    pen.arc(x, y, size, 0, 7);
    pen.fill();
    return;
  }
  pen.moveTo(x - size, y - size);
  pen.lineTo(x + size, y + size);
  pen.moveTo(x + size, y - size);
  pen.lineTo(x - size, y + size);
  pen.stroke();
}
