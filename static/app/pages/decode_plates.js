// Plates that were read in a frame, cell by cell, and the position that follows.

import { html } from "htm/preact";
import { useEffect, useRef } from "preact/hooks";

import { Verdict } from "../components/badges.js";
import { Facts } from "../components/facts.js";
import { Empty } from "../components/load.js";
import { PlacePlot } from "../components/place_plot.js";
import { degrees, number } from "../format.js";
import { t, textOr } from "../texts/index.js";
import { levelOf, outcomeOf } from "./decode_list.js";

/** @param {{ readings: any[], image: HTMLImageElement | null }} props */
export function Readings({ readings, image }) {
  if (!readings.length) return html`<${Empty} title=${t("decode.no_plate")} />`;
  return readings.map((reading) => html`<${Reading} reading=${reading} image=${image} />`);
}

/** @param {{ reading: any, image: HTMLImageElement | null }} props */
function Reading({ reading, image }) {
  const { match, grade } = reading;
  const shown = outcomeOf(reading);
  return html`
    <article class="reading">
      <h3><${Verdict} level=${levelOf(shown)}>${textOr(`outcome.${shown}`, shown)}</${Verdict}> <span class="code">${reading.digits}</span></h3>
      <${Facts} of=${[
        [t("field.reason"), reading.reason],
        [t("decode.confidence"), `${number(100 * reading.confidence, 3, "%")}${reading.from_codebook ? `, ${t("decode.from_registered")}` : ""}`],
        [t("field.scheme"), reading.scheme],
        [t("decode.height_px"), number(reading.height_px, 0, "px")],
        [t("decode.print_grade"), grade && `${grade.letter} (${number(grade.overall, 1)})`],
        [t("decode.match"), match && (match.registered ? html`<a href=${`/markers/${match.marker_id}`}>${t("decode.match_marker", { distance: number(match.distance_m, 1, "m") })}</a>` : t("decode.not_registered"))],
        [t("field.note"), match?.note],
      ]} />
      <div class="reading-parts"><${Cells} reading=${reading} />${reading.corners_px && html`<${Crop} corners=${reading.corners_px} image=${image} />`}</div>
    </article>
  `;
}

/** The cells of the plate: digit and confidence. @param {{ reading: any }} props */
function Cells({ reading }) {
  const grid = useRef(/** @type {HTMLDivElement | null} */ (null));
  const digits = reading.digits ?? "";
  const across = Math.round(Math.sqrt(digits.length + 4));
  useEffect(() => {
    if (!grid.current) return;
    grid.current.style.gridTemplateColumns = `repeat(${across}, max-content)`;
    for (const cell of grid.current.querySelectorAll("[data-sure]")) {
      if (!(cell instanceof HTMLElement)) continue;
      cell.style.backgroundColor = `hsl(${Math.round(130 * Math.max(0, 2 * Number(cell.dataset.sure) - 1))} 55% 72%)`;
    }
  }, [digits]);
  if (!digits || across * across !== digits.length + 4) return null;
  let k = 0;
  const cells = Array.from({ length: across * across }, (_, place) => {
    const [row, column] = [Math.floor(place / across), place % across];
    const isCorner = (row === 0 || row === across - 1) && (column === 0 || column === across - 1);
    if (isCorner) return html`<span class=${place === 0 ? "triangle" : "square"}></span>`;
    const at = k;
    k += 1;
    const sure = reading.cell_confidence[at];
    return html`<span class=${reading.corrected_cells.includes(at) ? "corrected" : undefined} data-sure=${sure}><b>${digits[at]}</b>${sure === undefined ? "" : number(100 * sure, sure > 0.999 ? 0 : 1, "%")}</span>`;
  });
  return html`<div class="cells" ref=${grid} role="img" aria-label=${t("decode.cells", { digits })}>${cells}</div>`;
}

/** The part of the frame around a plate, enlarged. @param {{ corners: number[][], image: HTMLImageElement | null }} props */
function Crop({ corners, image }) {
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  useEffect(() => {
    if (!canvas.current || !image) return;
    const { width: wide, height: high } = canvas.current;
    const [xs, ys] = [corners.map(([x = 0]) => x), corners.map(([, y = 0]) => y)];
    const width = Math.max((Math.max(...xs) - Math.min(...xs)) * 1.3, ((Math.max(...ys) - Math.min(...ys)) * 1.3 * wide) / high);
    const height = (width * high) / wide;
    const [x, y] = [(Math.max(...xs) + Math.min(...xs)) / 2, (Math.max(...ys) + Math.min(...ys)) / 2];
    canvas.current.getContext("2d")?.drawImage(image, x - width / 2, y - height / 2, width, height, 0, 0, wide, high);
  }, [image]);
  return html`<canvas ref=${canvas} width="280" height="200" role="img" aria-label=${t("decode.crop")}></canvas>`;
}

/** @param {{ decode: any }} props */
export function FrameFix({ decode }) {
  const { fix, readings } = decode;
  if (!fix) return html`<${Empty} title=${t("decode.no_fix_plate")} />`;
  const places = readings.filter((/** @type {any} */ { match }) => match && match.lon_deg !== null).map((/** @type {any} */ { match, digits }) => ({ lon_deg: match.lon_deg, lat_deg: match.lat_deg, label: digits }));
  return html`
    <${Facts} of=${[
      [t("field.lon_deg"), degrees(fix.lon_deg, 8)],
      [t("field.lat_deg"), degrees(fix.lat_deg, 8)],
      [t("field.height_m"), fix.height_m === null ? null : number(fix.height_m, 3)],
      [t("field.heading_deg"), `${number(fix.heading_deg, 2)} ± ${number(fix.sigma.heading_deg, 2)}`],
      [t("decode.sigma_en"), `${number(100 * fix.sigma.east_m, 1, "cm")}, ${number(100 * fix.sigma.north_m, 1, "cm")}`],
      [t("field.grade"), textOr(`grade.${fix.localization_grade}`, fix.localization_grade)],
      [t("decode.notes"), fix.notes.join("; ")],
    ]} />
    <${PlacePlot} places=${places} vehicle=${fix} least_m=${4} label=${t("decode.fix_plot")} />
  `;
}
