// Packets over time with their strength, and those around the timeline's time.

import { html } from "htm/preact";
import { useEffect, useMemo, useRef } from "preact/hooks";

import { Verdict } from "../components/badges.js";
import { Empty } from "../components/load.js";
import { number } from "../format.js";
import { createChart } from "../plot/chart.js";
import { lowerBound } from "../plot/thin.js";
import { t, textOr } from "../texts/index.js";

const HEIGHT = 220;
const LISTED = 7;

/**
 * @param {{ source: import("./decode_timeline.js").Source, timeline: import("./decode_timeline.js").Timeline }} props
 */
export function Strengths({ source, timeline }) {
  const { packets, shift } = source;
  const box = useRef(/** @type {HTMLDivElement | null} */ (null));
  const rows = useMemo(() => rowsOf(packets), [packets]);
  const measured = useMemo(() => rows.filter((row) => row.rssi_dbm !== null), [rows]);
  useEffect(() => {
    if (!measured.length || !box.current) return undefined;
    let removed = false;
    /** @type {import("../plot/chart.js").Chart | null} */
    let chart = null;
    box.current.replaceChildren();
    const column = (/** @type {boolean} */ accepted) => measured.map((row) => (isAccepted(row) === accepted ? row.rssi_dbm : null));
    createChart(box.current, {
      t: measured.map((row) => row.time_s), height: HEIGHT, unit: "dBm", timeText: (at) => timeline.text(at + shift, 0),
      columns: [
        { label: t("packet.accepted"), values: column(true), colour: (colours) => colours.accent, points: true },
        { label: t("decode.refused"), values: column(false), colour: (colours) => colours.bad, points: true },
      ],
      onPick: (at) => {
        timeline.cursor.value = at + shift;
      },
    }).then((made) => {
      chart = made;
      if (removed) made.remove();
      else made.setCursor(timeline.cursor.peek() - shift);
    });
    const stop = timeline.cursor.subscribe((at) => chart?.setCursor(at - shift));
    return () => {
      removed = true;
      stop();
      chart?.remove();
    };
  }, [measured, timeline]);
  if (!rows.length) return html`<${Empty} title=${t("decode.no_packet_times")} />`;
  return html`
    <figure class="decode-picture chart-figure">
      ${measured.length > 0 && html`
        <div class="chart" ref=${box} role="img" aria-label=${t("decode.rssi_alt", { count: measured.length })}></div>
        <figcaption><span class="chart-key"><span class="key key-0">${t("packet.accepted")}</span><span class="key key-4">${t("decode.refused")}</span></span> ${t("decode.zoom_hint_short")}</figcaption>
      `}
    </figure>
    <${Around} rows=${rows} timeline=${timeline} shift=${shift} />
  `;
}

/** @param {any} packets @returns {any[]} Packets with a time. */
function rowsOf(packets) {
  const names = ["time_s", "number", "rssi_dbm", "snr_db", "verdict", "reason", "entry"];
  const count = packets?.time_s.length ?? 0;
  const rows = Array.from({ length: count }, (_, k) => Object.fromEntries(names.map((name) => [name, packets[name][k]])));
  return rows.filter((row) => row.time_s !== null);
}

/** @param {any} row */
const isAccepted = (row) => row.verdict === "accepted" || row.verdict === null;

/** The packet at the timeline's time, and its neighbours. @param {{ rows: any[], timeline: import("./decode_timeline.js").Timeline, shift: number }} props */
function Around({ rows, timeline, shift }) {
  const times = useMemo(() => rows.map((row) => row.time_s), [rows]);
  const at = timeline.cursor.value - shift;
  const now = Math.min(Math.max(lowerBound(times, at + 1e-3) - 1, 0), rows.length - 1);
  const first = Math.min(Math.max(now - Math.floor(LISTED / 2), 0), Math.max(rows.length - LISTED, 0));
  return html`
    <div class="table-scroll plain-table packets-now" tabindex="0" role="region" aria-label=${t("decode.packets")}>
      <table>
        <thead><tr><th scope="col">${t("decode.time")}</th><th scope="col">CERPM</th><th scope="col" class="number">RSSI</th><th scope="col" class="number">SNR</th><th scope="col">${t("decode.verdict")}</th></tr></thead>
        <tbody>
          ${rows.slice(first, first + LISTED).map((row, k) => html`
            <tr class=${first + k === now ? "chosen" : undefined} aria-current=${first + k === now ? "true" : undefined}>
              <td>${timeline.text(row.time_s + shift, 1)}</td><td class="code">${row.number ?? "–"}</td>
              <td class="number">${number(row.rssi_dbm, 0, "dBm")}</td><td class="number">${number(row.snr_db, 1, "dB")}</td>
              <td><${Verdict} level=${row.verdict === null ? "none" : isAccepted(row) ? "good" : "bad"}>${row.verdict === null ? t("decode.not_listed") : textOr(`packet.${row.verdict}`, row.verdict)}</${Verdict}>${row.reason && html` <span class="small">${row.reason}</span>`}</td>
            </tr>
          `)}
        </tbody>
      </table>
    </div>
  `;
}
