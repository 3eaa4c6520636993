// Plan a magnet tag from a meaning of a codebook; show a tag with its checks and download its drilling layout.

import * as api from "./api.js";
import { drawMap } from "./map.js";
import { $, attempt, facts, make, readForm, showStatus } from "./page.js";

const FORMATS = ["pdf", "csv", "geojson"];
let entries = [];

export function startMagnets() {
  const form = $("#magnets-form");
  form.elements["tag.codebook_id"].addEventListener("change", () => attempt(null, form, showMeanings));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    attempt(form.querySelector("button"), form, async () => {
      const marker = await api.registerMarker(bodyOf(form));
      showStatus(`Planned ${marker.code.text}${marker.warnings.length ? `, with warnings: ${marker.warnings.join(", ")}` : ""}.`);
      location.hash = `#markers/${marker.id}`;
    });
  });
}

export async function showMagnets() {
  const form = $("#magnets-form");
  await attempt(null, form, async () => {
    const select = form.elements["tag.codebook_id"];
    const chosen = select.value;
    const books = await api.listCodebooks();
    select.replaceChildren(...books.map((book) => make("option", { value: book.id, selected: book.id === chosen }, book.name)));
    $("#no-codebooks").hidden = books.length > 0;
    await showMeanings();
  });
}

async function showMeanings() {
  const form = $("#magnets-form");
  const book = form.elements["tag.codebook_id"].value;
  entries = book ? await api.listEntries(book) : [];
  form.elements["tag.meaning"].replaceChildren(
    ...entries.map((entry, k) => make("option", { value: k }, `${entry.meaning.text}: ${entry.code}`)),
  );
}

function bodyOf(form) {
  const body = { family: "magnet", lane: {}, tag: {}, ...readForm(form) };
  const entry = entries[Number(form.elements["tag.meaning"].value)];
  if (entry) body.tag.meaning = { kind: entry.meaning.kind, value: entry.meaning.value };
  if (body.lane.geometry) body.lane.geometry = readLine(body.lane.geometry);
  return body;
}

// Reads a GeoJSON geometry, feature or collection, or one longitude and latitude per line.
function readLine(text) {
  try {
    const document = JSON.parse(text);
    const feature = document.type === "FeatureCollection" ? document.features[0] : document;
    return feature.geometry || feature;
  } catch {
    const rows = text.split("\n").filter((row) => row.trim());
    return { type: "LineString", coordinates: rows.map((row) => row.trim().split(/[\s,;]+/).map((part) => (Number.isFinite(Number(part)) ? Number(part) : part))) };
  }
}

export function drawMagnets(box, marker) {
  const { code, position, layout } = marker;
  const plot = make("div");
  const buttons = FORMATS.map((form) => {
    const button = make("button", { type: "button", class: "quiet" }, form.toUpperCase());
    button.addEventListener("click", () => attempt(button, null, async () => {
      api.save(await api.fetchLayout(marker.id, form), `${marker.id}-r${marker.version}.${form}`);
    }));
    return button;
  });
  const place = layout.chainage_m === undefined
    ? `chainage ${layout.from_m} to ${layout.to_m === null ? "the end" : layout.to_m} m`
    : `chainage ${layout.chainage_m.toFixed(2)} m, offset ${layout.offset_m.toFixed(2)} m`;
  box.replaceChildren(
    make("h2", { class: "digits" }, code.text),
    plot,
    make("div", { class: "buttons", role: "group", "aria-label": "Download the layout" }, ...buttons),
    facts([
      ["Meaning", code.meaning ? code.meaning.text : null],
      ["Line", code.style],
      ["Magnets", `${marker.magnets.length} over ${marker.length_m} m`],
      ["Place in the lane", place],
      ["Status", `${marker.status}, version ${marker.version}`],
      ["First magnet", `${position.lon_deg.toFixed(8)}, ${position.lat_deg.toFixed(8)}`],
      ["Grade", position.localization_grade],
      ["Heading", `${marker.heading_deg.toFixed(2)}°`],
      ["Cost", `${marker.bill.total_usd.toFixed(2)} USD`],
      ["Road", marker.road],
      ["Id", marker.id],
    ]),
    make("h2", {}, "Checks"),
    make("ul", { class: "checks" }, ...marker.checks.map(drawCheck)),
  );
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("class", "map small");
  svg.setAttribute("role", "img");
  svg.setAttribute("aria-label", "The magnets; the layout lists them");
  plot.append(svg);
  drawMap(svg, marker.magnets.map((magnet) => ({
    lon_deg: magnet.lon_deg,
    lat_deg: magnet.lat_deg,
    heading_deg: magnet.north_pole_bearing_deg,
    label: `${magnet.number}: north pole ${magnet.north_pole}`,
    kind: magnet.polarity === "N" ? "chosen" : "",
  })), null, 4);
}

function drawCheck(check) {
  const figures = `${check.figure} ${check.relation} ${check.limit} ${check.unit}`;
  return make("li", { title: `${check.note} (${check.source})` }, make("span", { class: check.passed ? "read" : "unsure" }, check.passed ? "passed" : "warning"), ` ${check.name}: ${figures}`);
}
