// One timeline for all decodes that are shown together: it moves the frame, the cursors of the plots, the packet and the
// position on the map.

import { signal } from "@preact/signals";
import { html } from "htm/preact";
import { useEffect, useMemo, useState } from "preact/hooks";

import { number } from "../format.js";
import { query, setQuery } from "../router.js";
import { t } from "../texts/index.js";
import { lowerBound } from "../plot/thin.js";

const EPOCH_S = 1e9; // times beyond are seconds since 1970
const STEP_MS = 50;
const SPEEDS = [0.25, 1, 4, 16];

/**
 * A decode on the timeline. Its own times (`t_s` of a trace, else those of its clock) become times of the timeline.
 *
 * @typedef {object} Source
 * @property {any} decode
 * @property {"utc" | "recording" | "frames"} clock
 * @property {number} zero Added to a trace's times for those of its clock.
 * @property {number} shift Added to times of its clock for those of the timeline.
 * @property {{ frame: any, at: number }[]} frames
 * @property {any[]} readings
 * @property {any[]} track
 * @property {any} packets
 * @property {any} lane
 */

/** @param {string | null | undefined} text */
const seconds = (text) => (text ? Date.parse(text) / 1000 : NaN);

/** @param {any} decode @returns {{ clock: Source["clock"], zero: number }} */
export function clockOf(decode) {
  if (decode.kind === "packets") return { clock: "utc", zero: 0 };
  const captured = seconds(decode.context.captured_at);
  if (decode.kind === "trace") {
    const start = decode.motion?.start_s ?? 0;
    if (start > EPOCH_S) return { clock: "utc", zero: 0 };
    return Number.isNaN(captured) ? { clock: "recording", zero: 0 } : { clock: "utc", zero: captured - start };
  }
  const frames = decode.frames ?? [];
  if (frames.some((/** @type {any} */ frame) => frame.captured_at) || (frames.length === 1 && !Number.isNaN(captured))) return { clock: "utc", zero: 0 };
  return { clock: frames.some((/** @type {any} */ frame) => frame.time_s !== null) ? "recording" : "frames", zero: 0 };
}

/** Time of a frame by the decode's clock. @param {any} decode @param {any} frame @param {Source["clock"]} clock */
export function frameTime(decode, frame, clock) {
  if (clock === "utc") return seconds(frame.captured_at ?? (decode.frames.length === 1 ? decode.context.captured_at : null));
  return clock === "recording" ? frame.time_s ?? NaN : frame.frame;
}

/**
 * The timeline of some sources: their times are shifted to one scale.
 *
 * @param {Source[]} sources
 */
export function useTimeline(sources) {
  const built = useMemo(() => build(sources), [sources]);
  const cursor = useMemo(() => signal(startAt(built)), [built]);
  return { ...built, cursor };
}

/** @typedef {ReturnType<typeof useTimeline>} Timeline */

/** The time in the address, else that of the first reading. @param {ReturnType<typeof build>} built */
function startAt({ from, to, first }) {
  const wanted = Number(query.peek().get("at") ?? NaN);
  return Math.min(Math.max(Number.isFinite(wanted) ? wanted : first ?? from, from), to);
}

/** @param {Source[]} sources */
function build(sources) {
  const together = sources.length > 1 && !sources.every(({ clock }) => clock === "utc");
  let [from, to] = [Infinity, -Infinity];
  /** @type {Set<number>} */
  const moments = new Set();
  for (const source of sources) {
    const times = timesOf(source).filter(Number.isFinite);
    source.shift = together && times.length ? -Math.min(...times.slice(0, 1), times[times.length - 1] ?? 0) : 0;
    for (const at of times) {
      from = Math.min(from, at + source.shift);
      to = Math.max(to, at + source.shift);
    }
    for (const reading of source.readings) if (Number.isFinite(reading.at)) moments.add(reading.at + source.shift);
    for (const { at } of source.frames) if (Number.isFinite(at)) moments.add(at + source.shift);
  }
  if (!(from <= to)) [from, to] = [0, 0];
  const read = sources.flatMap(({ readings, shift }) => readings.filter(({ at }) => Number.isFinite(at)).map(({ at, outcome }) => ({ at: at + shift, late: outcome === "read" || outcome === "unchecked" ? 0 : 1 })));
  const first = read.sort((a, b) => a.late - b.late || a.at - b.at)[0]?.at;
  const clock = together ? "recording" : sources[0]?.clock ?? "recording";
  return { sources, from, to, first, clock, moments: [...moments].sort((a, b) => a - b), text: textOf(clock, from) };
}

/** First and last time of a source, by its clock. @param {Source} source @returns {number[]} */
function timesOf({ decode, zero, frames, packets, track }) {
  const times = frames.map(({ at }) => at);
  if (decode.kind === "trace") {
    const { start_s, step_s, speed_m_s, heading_deg } = decode.motion ?? { start_s: 0, step_s: 0, speed_m_s: [], heading_deg: [] };
    const lasts = decode.report.duration_s || step_s * Math.max(speed_m_s.length, heading_deg.length);
    times.push(zero + start_s, zero + start_s + lasts);
  }
  if (packets) times.push(...packets.time_s.filter((/** @type {any} */ at) => at !== null));
  for (const { properties } of track) times.push(...properties.time_s.filter((/** @type {any} */ at) => at !== null));
  const known = times.filter(Number.isFinite);
  if (!known.length) return [];
  return [known.reduce((a, b) => Math.min(a, b)), known.reduce((a, b) => Math.max(a, b))];
}

/** How a time is written. @param {Source["clock"]} clock @param {number} from @returns {(at: number, places?: number) => string} */
function textOf(clock, from) {
  if (clock === "frames") return (at) => t("decode.frame_number", { number: number(Math.round(at)) });
  if (clock === "recording") return (at, places = 2) => number(at - (from > EPOCH_S ? from : 0), places, "s");
  return (at, places = 2) => new Date(at * 1000).toISOString().slice(11, places ? 20 + Math.min(places, 3) : 19);
}

/** The bar with the slider. @param {{ timeline: Timeline }} props */
export function TimelineBar({ timeline }) {
  const { from, to, cursor, moments, text, clock } = timeline;
  const [playing, setPlaying] = useState(false);
  const [speed, setSpeed] = useState(1);
  useEffect(() => setPlaying(false), [timeline.from, timeline.to]);
  useEffect(() => {
    if (!playing) return undefined;
    const rate = clock === "frames" ? 5 * speed : speed;
    const timer = setInterval(() => {
      const next = cursor.peek() + (rate * STEP_MS) / 1000;
      cursor.value = Math.min(next, to);
      if (next >= to) setPlaying(false);
    }, STEP_MS);
    return () => clearInterval(timer);
  }, [playing, speed, timeline]);
  const keep = () => setQuery({ at: String(Number(cursor.peek().toFixed(3))) });
  const go = (/** @type {number} */ at) => {
    setPlaying(false);
    cursor.value = Math.min(Math.max(at, from), to);
    keep();
  };
  const toggle = () => {
    if (!playing && cursor.peek() >= to) cursor.value = from;
    if (playing) keep();
    setPlaying(!playing);
  };
  const next = () => go(moments[lowerBound(moments, cursor.peek() + 1e-3)] ?? to);
  const last = () => go(moments[lowerBound(moments, cursor.peek() - 1e-3) - 1] ?? from);
  if (!(to > from)) return null;
  return html`
    <section class="timeline" aria-label=${t("decode.timeline")}>
      <button type="button" class="play" aria-label=${t(playing ? "decode.pause_play" : "decode.play")} onClick=${toggle}><span aria-hidden="true">${playing ? "❚❚" : "▶"}</span></button>
      <button type="button" class="quiet" aria-label=${t("decode.earlier")} onClick=${last}><span aria-hidden="true">◀</span></button>
      <button type="button" class="quiet" aria-label=${t("decode.later")} onClick=${next}><span aria-hidden="true">▶</span></button>
      <${Slider} timeline=${timeline} onInput=${(/** @type {number} */ at) => {
        setPlaying(false);
        cursor.value = at;
      }} onChange=${keep} />
      <output class="timeline-time">${text(cursor.value)}</output>
      <label class="timeline-speed"><span class="hidden">${t("decode.speed")}</span>
        <select value=${String(speed)} onChange=${(/** @type {any} */ event) => setSpeed(Number(event.currentTarget.value))}>
          ${SPEEDS.map((rate) => html`<option value=${String(rate)}>${number(rate, rate < 1 ? 2 : 0)} ×</option>`)}
        </select>
      </label>
    </section>
  `;
}

/** @param {{ timeline: Timeline, onInput: (at: number) => void, onChange: () => void }} props */
function Slider({ timeline, onInput, onChange }) {
  const { from, to, cursor, clock, text, moments } = timeline;
  const span = to - from;
  const width = 1000;
  const marks = useMemo(() => {
    const places = new Set(moments.map((at) => Math.round(((at - from) / span) * width)));
    return [...places].map((x) => `M${x} 0v10`).join("");
  }, [timeline]);
  return html`
    <span class="timeline-slider">
      <svg viewBox="0 0 ${width} 10" preserveAspectRatio="none" aria-hidden="true"><path d=${marks} /></svg>
      <input type="range" aria-label=${t("decode.timeline")} aria-valuetext=${text(cursor.value)} min="0" max=${span} step=${clock === "frames" ? 1 : Math.max(span / 2000, 0.01)}
        value=${cursor.value - from} onInput=${(/** @type {any} */ event) => onInput(from + Number(event.currentTarget.value))} onChange=${onChange} />
    </span>
  `;
}

/**
 * Where the vehicle was: between the positions of the tracks, the most accurate one first.
 *
 * @param {Source[]} sources
 * @param {number} at
 * @returns {{ lon_deg: number, lat_deg: number, heading_deg: number | null } | null}
 */
export function positionAt(sources, at) {
  for (const { track, shift, decode } of sources) {
    for (const { geometry, properties } of track) {
      const times = properties.time_s;
      const places = geometry.type === "Point" ? [geometry.coordinates] : geometry.coordinates;
      const alone = times.length === 1 && (times[0] === null || Math.abs(times[0] + shift - at) < 1);
      if (alone || (decode.frames?.length === 1 && places.length)) return { lon_deg: places[0][0], lat_deg: places[0][1], heading_deg: properties.heading_deg[0] };
      if (times[0] === null || at < times[0] + shift - 1e-6 || at > times[times.length - 1] + shift + 1e-6) continue;
      const k = Math.min(Math.max(lowerBound(times, at - shift), 1), times.length - 1);
      const share = Math.min(Math.max((at - shift - times[k - 1]) / Math.max(times[k] - times[k - 1], 1e-9), 0), 1);
      const [[lon0, lat0], [lon1, lat1]] = [places[k - 1], places[k]];
      const heading = properties.heading_deg[share < 0.5 ? k - 1 : k] ?? courseOf([lon0, lat0], [lon1, lat1]);
      return { lon_deg: lon0 + share * (lon1 - lon0), lat_deg: lat0 + share * (lat1 - lat0), heading_deg: heading };
    }
  }
  return null;
}

/** Direction from one place to another. [deg] @param {number[]} from @param {number[]} to @returns {number | null} */
function courseOf([lon0 = 0, lat0 = 0], [lon1 = 0, lat1 = 0]) {
  const [east, north] = [(lon1 - lon0) * Math.cos((lat0 * Math.PI) / 180), lat1 - lat0];
  return east || north ? ((Math.atan2(east, north) * 180) / Math.PI + 360) % 360 : null;
}
