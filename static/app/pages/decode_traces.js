// Tags that were read in a magnetometer trace, lines that were crossed, and the position that follows.

import { html } from "htm/preact";

import { Verdict } from "../components/badges.js";
import { Facts } from "../components/facts.js";
import { Empty } from "../components/load.js";
import { PlacePlot } from "../components/place_plot.js";
import { degrees, number } from "../format.js";
import { t, textOr } from "../texts/index.js";

/** @param {{ decode: any }} props */
export function Tags({ decode }) {
  const { tags, crossings, report, summary } = decode;
  const noise = Object.entries(summary.noise).map(([kind, count]) => `${count} ${textOr(`noise.${kind}`, kind)}`);
  return html`
    ${tags.length ? tags.map((/** @type {any} */ tag) => html`<${Tag} tag=${tag} />`) : html`<${Empty} title=${t("decode.no_tag")} />`}
    ${crossings.map((/** @type {any} */ crossing) => html`
      <p class="reading"><${Verdict} level="warn">${t(crossing.style === "solid" ? "decode.crossed_solid" : "decode.crossed_dashed")}</${Verdict}>
        ${" "}${t("decode.crossed_at", { side: textOr(`option.${crossing.side}`, crossing.side), m: number(crossing.odometer_m, 1), s: number(crossing.t_s, 2) })}</p>
    `)}
    <${Facts} of=${[
      [t("decode.samples"), t("decode.samples_text", { count: number(report.samples), rate: number(report.rate_hz), gaps: report.gap_count })],
      [t("decode.left_out"), [...report.left_out.map((/** @type {any} */ entry) => `${entry.part}: ${entry.reason} (${entry.count})`), ...noise].join("; ")],
    ]} />
  `;
}

/** @param {{ tag: any }} props */
function Tag({ tag }) {
  const { match } = tag;
  return html`
    <article class="reading">
      <h3><${Verdict} level=${tag.direction === "wrong-way" ? "bad" : tag.tag ? "good" : "warn"}>${textOr(`observation.${tag.direction}`, tag.direction)}</${Verdict}> <span class="code">${tag.tag || tag.polarities}</span></h3>
      <${Facts} of=${[
        [t("marker.meaning"), match?.meaning && `${match.meaning.kind} ${match.meaning.value ?? ""}`],
        [t("decode.ratio"), tag.ratios.map((/** @type {number} */ ratio, /** @type {number} */ k) => `${number(ratio, 3)} ± ${number(tag.ratio_std[k], 3)}`).join("; ")],
        [t("decode.lateral"), number(tag.lateral_cm, 1, "cm")],
        [t("decode.confidence"), number(100 * tag.confidence, 2, "%")],
        [t("decode.match"), match && (match.registered ? html`<a href=${`/markers/${match.marker_id}`}>${t("list.marker")}</a>` : match.note)],
      ]} />
    </article>
  `;
}

/** @param {{ decode: any }} props */
export function TagFix({ decode }) {
  const { fix, tags } = decode;
  if (!fix) return html`<${Empty} title=${t("decode.no_fix_tag")} />`;
  const places = tags.filter((/** @type {any} */ tag) => tag.fix).map((/** @type {any} */ tag) => ({ ...tag.fix, heading_deg: null, label: tag.tag }));
  return html`
    <${Facts} of=${[
      [t("decode.time"), number(fix.t_s, 3, "s")],
      [t("field.lon_deg"), degrees(fix.lon_deg, 8)],
      [t("field.lat_deg"), degrees(fix.lat_deg, 8)],
      [t("field.heading_deg"), `${number(fix.heading_deg, 2)} ± ${number(fix.sigma.heading_deg, 2)}`],
      [t("decode.sigma_aa"), `${number(100 * fix.sigma.along_m, 1, "cm")}, ${number(100 * fix.sigma.across_m, 1, "cm")}`],
      [t("decode.across"), `${number(100 * Math.abs(fix.across_m), 1, "cm")}, ${textOr(`option.${fix.across_m < 0 ? "right" : "left"}`, "")}`],
      [t("field.grade"), textOr(`grade.${fix.localization_grade}`, fix.localization_grade)],
      [t("decode.notes"), fix.notes.join("; ")],
    ]} />
    <${PlacePlot} places=${places} vehicle=${fix} least_m=${4} label=${t("decode.fix_plot")} />
  `;
}
