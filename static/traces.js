// Shows a decoded trace: tags with their meanings and positions, line crossings, and the samples left out.

import * as api from "./api.js";
import { drawMap } from "./map.js";
import { $, facts, make } from "./page.js";

const POLL_MS = 1000;

export function isTrace(file) {
  return /\.(csv|bin|dat|parquet)$/i.test(file.name) || (/\.zip$/i.test(file.name) && !/frames/i.test(file.name));
}

// Long recordings are jobs: request the state until the job has ended.
export async function waitFor(decoded) {
  let current = decoded;
  while (current.state === "queued" || current.state === "running") {
    await new Promise((resolve) => setTimeout(resolve, POLL_MS));
    current = await api.getDecode(current.id);
  }
  if (current.error) throw new api.Problem({ title: "The recording could not be decoded", ...current.error });
  return current;
}

export function drawTags(decoded) {
  const parts = decoded.tags.map(drawTag);
  if (!parts.length) parts.push(make("p", { class: "empty" }, "No information tag was found in this trace."));
  for (const crossing of decoded.crossings) {
    parts.push(make("p", { class: "reading" }, make("span", { class: "unsure" }, `${crossing.style} line crossed`), ` on the ${crossing.side} at ${crossing.odometer_m.toFixed(1)} m, ${crossing.t_s.toFixed(2)} s`));
  }
  const kinds = Object.entries(decoded.summary.noise).map(([kind, count]) => `${count} ${kind}`);
  parts.push(facts([
    ["Samples", `${decoded.report.samples} at ${decoded.report.rate_hz.toFixed(0)} Hz, ${decoded.report.gap_count} gaps`],
    ["Left out", [...decoded.report.left_out.map((entry) => `${entry.part}: ${entry.reason} (${entry.count})`), ...kinds].join("; ")],
    ["Warnings", decoded.report.warnings.join("; ")],
  ]));
  return parts;
}

function drawTag(tag) {
  const level = tag.direction === "wrong-way" ? "refused" : tag.tag ? "read" : "unsure";
  const { match } = tag;
  const meaning = match && match.meaning ? `${match.meaning.kind} ${match.meaning.value ?? ""}` : null;
  return make(
    "div",
    { class: "reading" },
    make("h3", {}, make("span", { class: level }, tag.direction), " ", make("span", { class: "digits" }, tag.tag || tag.polarities)),
    facts([
      ["Meaning", meaning],
      ["Ratio", tag.ratios.map((ratio, k) => `${ratio.toFixed(3)} ± ${tag.ratio_std[k].toFixed(3)}`).join(", ")],
      ["Position on the bar", `${tag.lateral_cm.toFixed(1)} cm`],
      ["Confidence", `${(100 * tag.confidence).toFixed(2)} %`],
      ["Match", match && (match.registered ? `marker ${match.marker_id}` : match.note)],
    ]),
  );
}

export function drawTagFix(decoded) {
  const { fix } = decoded;
  $("#fix-map").toggleAttribute("hidden", !fix);
  if (!fix) return make("p", { class: "empty" }, "No position: this needs a registered tag and an approximate position.");
  const places = decoded.tags.filter((tag) => tag.fix).map((tag) => ({ ...tag.fix, heading_deg: null, label: tag.tag }));
  drawMap($("#fix-map"), places, fix);
  return facts([
    ["Time", `${fix.t_s.toFixed(3)} s`],
    ["Longitude", `${fix.lon_deg.toFixed(8)}°`],
    ["Latitude", `${fix.lat_deg.toFixed(8)}°`],
    ["Heading", `${fix.heading_deg.toFixed(2)}° ± ${fix.sigma.heading_deg.toFixed(2)}°`],
    ["± along, across", `${(100 * fix.sigma.along_m).toFixed(1)} cm, ${(100 * fix.sigma.across_m).toFixed(1)} cm`],
    ["Distance from the tag's line", `${(100 * Math.abs(fix.across_m)).toFixed(1)} cm to the ${fix.across_m < 0 ? "right" : "left"}`],
    ["Grade", fix.localization_grade],
    ["Notes", fix.notes.join("; ")],
  ]);
}
