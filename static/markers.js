// The list of markers and their plot; the artwork or layout of one marker; the artwork of several as a ZIP.

import * as api from "./api.js";
import { drawCerpm } from "./cerpms.js";
import { drawMagnets } from "./magnets.js";
import { drawMap } from "./map.js";
import { $, attempt, facts, make, showStatus } from "./page.js";

const FORMATS = ["svg", "pdf", "dxf", "png"];
const state = { markers: [], selected: new Set(), chosen: null };
let previewUrl = null;

export function startMarkers() {
  $("#select-all").addEventListener("change", (event) => {
    state.selected = new Set(event.target.checked ? plates().map((marker) => marker.id) : []);
    drawRows();
  });
  $("#bundle-form").addEventListener("submit", (event) => {
    event.preventDefault();
    saveBundle(event.currentTarget);
  });
  window.addEventListener("resize", () => drawPlaces());
}

const plates = () => state.markers.filter((marker) => marker.family === "plate");
const codeOf = (marker) => marker.code.digits || marker.code.text;

export async function showMarkers(chosenId = null) {
  await attempt(null, null, async () => {
    const { items, more } = await api.listMarkers();
    state.markers = items;
    state.selected = new Set([...state.selected].filter((id) => items.some((marker) => marker.id === id)));
    $("#no-markers").hidden = items.length > 0;
    $("#map-caption").textContent = items.length
      ? `${items.length}${more ? " and more" : ""} markers. Ticks point in the direction of travel. Amber markers have a position that is not for localization.`
      : "";
    const chosen = items.find((marker) => marker.id === (chosenId || state.chosen)) || null;
    state.chosen = chosen && chosen.id;
    drawRows();
    drawPlaces();
    if (chosen) await showDetail(chosen);
  });
}

function drawRows() {
  const rows = state.markers.map((marker) => {
    let box = null; // magnets and CERPMs have no artwork to select
    if (marker.family === "plate") {
      box = make("input", { type: "checkbox", "aria-label": `Select ${codeOf(marker)}`, onchange: (event) => select(marker.id, event.target.checked) });
      box.checked = state.selected.has(marker.id);
    }
    const open = make("button", { type: "button", class: "link", onclick: () => choose(marker) }, codeOf(marker));
    const { lon_deg, lat_deg } = marker.position;
    return make(
      "tr",
      { class: marker.id === state.chosen ? "chosen" : null },
      make("td", {}, box),
      make("td", { class: "digits" }, open),
      make("td", {}, marker.code.scheme),
      make("td", {}, marker.status),
      make("td", { class: "number" }, lon_deg.toFixed(6)),
      make("td", { class: "number" }, lat_deg.toFixed(6)),
    );
  });
  $("#marker-rows").replaceChildren(...rows);
  showCount();
}

function showCount() {
  const count = state.selected.size;
  $("#selected-count").textContent = `${count} selected`;
  $("#bundle-form button").disabled = count === 0;
  $("#select-all").checked = count > 0 && count === plates().length;
}

function select(id, on) {
  if (on) state.selected.add(id);
  else state.selected.delete(id);
  showCount();
}

function drawPlaces() {
  if ($("#view-markers").hidden) return;
  drawMap($("#map"), state.markers.map((marker) => ({
    lon_deg: marker.position.lon_deg,
    lat_deg: marker.position.lat_deg,
    heading_deg: marker.heading_deg,
    label: `${codeOf(marker)}, ${marker.status}`,
    kind: kindOf(marker),
    choose: () => choose(marker),
  })));
}

function kindOf(marker) {
  if (marker.id === state.chosen) return "chosen";
  if (marker.status === "retired") return "retired";
  return marker.position.localization_grade === "unfit" ? "unfit" : "";
}

function choose(marker) {
  state.chosen = marker.id;
  drawRows();
  drawPlaces();
  attempt(null, null, () => showDetail(marker));
}

async function showDetail(marker) {
  if (marker.family === "cerpm") return drawCerpm($("#detail"), marker);
  if (marker.family !== "magnet") return showArtwork(marker);
  const whole = await api.getMarker(marker.id);
  if (state.chosen === marker.id) drawMagnets($("#detail"), whole);
  return undefined;
}

// Plates, and every family whose view is its artwork.
async function showArtwork(marker) {
  const { position, geometry, code } = marker;
  const title = codeOf(marker);
  const units = geometry.n ? `${geometry.n} × ${geometry.n} units, ` : "";
  const picture = make("img", { class: "preview", alt: `Artwork of the ${marker.family} ${title}` });
  const proof = make("p", { class: "hint" });
  const buttons = FORMATS.map((form) => {
    const button = make("button", { type: "button", class: "quiet" }, form.toUpperCase());
    button.addEventListener("click", () => attempt(button, null, async () => {
      const artwork = await api.fetchArtwork(marker.id, form);
      api.save(artwork.blob, `${title}.${form}`);
    }));
    return button;
  });
  $("#detail").replaceChildren(
    make("h2", { class: "digits" }, title),
    picture,
    proof,
    make("div", { class: "buttons", role: "group", "aria-label": "Download the artwork" }, ...buttons),
    facts([
      ["Scheme", code.scheme + (code.registry_number == null ? "" : `, number ${code.registry_number}`)],
      ["Status", `${marker.status}, version ${marker.version}`],
      ["Position", `${position.lon_deg.toFixed(8)}, ${position.lat_deg.toFixed(8)}`],
      ["Height", position.height_m === null ? null : `${position.height_m.toFixed(3)} m`],
      ["Accuracy", position.horizontal_rmse_m === null ? "not stated" : `${position.horizontal_rmse_m} m horizontal`],
      ["Grade", position.localization_grade],
      ["Heading", marker.heading_deg === null ? null : `${marker.heading_deg.toFixed(2)}°`],
      ["Size", `${units}${geometry.side_mm} mm square`],
      ["Road", marker.road],
      ["Id", marker.id],
    ]),
  );
  const artwork = await api.fetchArtwork(marker.id, "svg");
  if (previewUrl) URL.revokeObjectURL(previewUrl);
  previewUrl = URL.createObjectURL(artwork.blob);
  picture.src = previewUrl;
  proof.textContent = `Read back by the decoder before delivery: ${artwork.proof}`;
}

function saveBundle(form) {
  const formats = [...form.querySelectorAll("[name=formats]:checked")].map((box) => box.value);
  attempt(form.querySelector("button"), form, async () => {
    showStatus("Creating the artwork …");
    const bundle = await api.fetchBundle([...state.selected], formats);
    api.save(bundle.blob, "waymark-artwork.zip");
    showStatus(`The artwork is ready: ${bundle.proof}`);
  }).then(showCount);
}
