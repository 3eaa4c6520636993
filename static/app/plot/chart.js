// A chart over time that can be zoomed: uPlot, loaded when a page needs it. It holds all samples and draws those of the
// window, thinned to the pixels.

import { addStyleSheet } from "../components/style_sheet.js";
import { pageColours } from "../map/symbols.js";
import { thin } from "./thin.js";

/**
 * @typedef {ReturnType<typeof pageColours> & { good: string, bad: string }} Colours
 * @typedef {{ label: string, values: import("./thin.js").Values, colour: (colours: Colours) => string, points?: boolean }} Column
 * @typedef {object} Options
 * @property {ArrayLike<number>} t Rising.
 * @property {Column[]} columns
 * @property {number} height
 * @property {string} unit
 * @property {(t: number) => string} timeText
 * @property {(paint: Paint) => void} [overlay] Draws over the samples.
 * @property {(from: number, to: number) => void} [onWindow] Called when the window has changed.
 * @property {(t: number) => void} [onPick] Called when a place is clicked.
 * @typedef {{ pen: CanvasRenderingContext2D, x: (t: number) => number, y: (value: number) => number, top: number, bottom: number, from: number, to: number, px: number, colours: Colours }} Paint
 */

/** @returns {Colours} */
function chartColours() {
  const style = getComputedStyle(document.documentElement);
  return { ...pageColours(), good: style.getPropertyValue("--good").trim(), bad: style.getPropertyValue("--bad").trim() };
}

/**
 * @param {HTMLElement} box
 * @param {Options} options
 */
export async function createChart(box, options) {
  const [{ default: UPlot }] = await Promise.all([import("uplot"), addStyleSheet(import.meta.resolve("uplot/style"))]);
  let { t, columns } = options;
  const whole = () => /** @type {[number, number]} */ ([t[0] ?? 0, Math.max(t[t.length - 1] ?? 1, (t[0] ?? 0) + 1e-3)]);
  let window_ = whole();
  let limits = whole();
  let colours = chartColours();
  const width = () => Math.max(box.clientWidth, 200);
  const shown = () => thin(t, columns.map(({ values }) => values), window_[0], window_[1], width() * devicePixelRatio);
  const axis = { stroke: () => colours.soft, grid: { stroke: () => colours.line, width: 1 }, ticks: { stroke: () => colours.line, width: 1 }, font: "12px system-ui, sans-serif" };
  const plot = new UPlot({
    width: width(),
    height: options.height,
    legend: { show: false },
    cursor: { drag: { x: true, y: false, setScale: false }, points: { show: false }, y: false },
    scales: { x: { time: false, range: () => window_ } },
    axes: [
      { ...axis, space: 96, values: (_, ticks) => ticks.map(options.timeText) },
      { ...axis, size: 76, values: (_, ticks) => ticks.map((value) => `${value} ${options.unit}`.replace("-", "−")) },
    ],
    series: [{}, ...columns.map((column) => ({
      label: column.label,
      stroke: () => column.colour(colours),
      width: column.points ? 0 : 1,
      ...(column.points ? { paths: () => null, points: { show: true, size: 6, width: 0, fill: () => column.colour(colours) } } : { points: { show: false }, spanGaps: false }),
    }))],
    hooks: {
      draw: [(u) => {
        const paint = { pen: u.ctx, x: (/** @type {number} */ at) => u.valToPos(at, "x", true), y: (/** @type {number} */ at) => u.valToPos(at, "y", true), top: u.bbox.top, bottom: u.bbox.top + u.bbox.height, from: window_[0], to: window_[1], px: devicePixelRatio, colours };
        u.ctx.save();
        u.ctx.beginPath();
        u.ctx.rect(u.bbox.left, 0, u.bbox.width, u.bbox.top + u.bbox.height);
        u.ctx.clip();
        options.overlay?.(paint);
        u.ctx.restore();
      }],
      setSelect: [(u) => {
        if (u.select.width < 4) return;
        const [from, to] = [u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x")];
        u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
        setWindow(from, to);
      }],
    },
  }, shown(), box);
  const line = document.createElement("div");
  line.className = "chart-cursor";
  plot.over.append(line);
  let cursor = NaN;
  const placeCursor = () => {
    const inside = cursor >= window_[0] && cursor <= window_[1];
    line.hidden = !inside;
    if (inside) line.style.transform = `translateX(${plot.valToPos(cursor, "x")}px)`;
  };

  /** @param {number} from @param {number} to @param {boolean} [quiet] */
  function setWindow(from, to, quiet = false) {
    const least = (limits[1] - limits[0]) / 1e5;
    const span = Math.min(Math.max(to - from, least), limits[1] - limits[0]);
    const start = Math.min(Math.max((from + to - span) / 2, limits[0]), limits[1] - span);
    window_ = [start, start + span];
    plot.setData(shown());
    placeCursor();
    if (!quiet) options.onWindow?.(...window_);
  }

  let downAt = 0;
  plot.over.addEventListener("mousedown", (event) => {
    downAt = event.clientX;
  });
  plot.over.addEventListener("click", (event) => {
    if (Math.abs(event.clientX - downAt) < 4) options.onPick?.(plot.posToVal(event.offsetX, "x"));
  });
  plot.over.addEventListener("dblclick", () => setWindow(...limits));
  plot.over.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.shiftKey) return; // the page scrolls
    event.preventDefault();
    zoom(event.deltaY > 0 ? 1.4 : 1 / 1.4, plot.posToVal(event.offsetX, "x"));
  }, { passive: false });

  /** @param {number} factor @param {number} [around] */
  function zoom(factor, around = (window_[0] + window_[1]) / 2) {
    setWindow(around - (around - window_[0]) * factor, around + (window_[1] - around) * factor);
  }

  const observer = new ResizeObserver(() => {
    if (Math.abs(plot.width - width()) < 2) return;
    plot.setSize({ width: width(), height: options.height });
    plot.setData(shown());
    placeCursor();
  });
  observer.observe(box);
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const recolour = () => {
    colours = chartColours();
    plot.redraw(false);
  };
  dark.addEventListener("change", recolour);

  return {
    setWindow,
    zoom,
    reset: () => setWindow(...limits),
    /** @param {number} by Share of the window. */
    pan: (by) => setWindow(window_[0] + by * (window_[1] - window_[0]), window_[1] + by * (window_[1] - window_[0])),
    window: () => window_,
    /** @param {number} at */
    setCursor: (at) => {
      cursor = at;
      placeCursor();
    },
    /** Samples of a part, finer; the limits of the zoom stay. @param {ArrayLike<number>} times @param {Column[]} values */
    setSamples: (times, values) => {
      [t, columns] = [times, values];
      plot.setData(shown());
      placeCursor();
    },
    /** @param {number} from @param {number} to */
    setLimits: (from, to) => {
      limits = [from, to];
    },
    remove: () => {
      observer.disconnect();
      dark.removeEventListener("change", recolour);
      plot.destroy();
    },
  };
}

/** @typedef {Awaited<ReturnType<typeof createChart>>} Chart */
