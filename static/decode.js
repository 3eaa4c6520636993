// Decode an upload, and show its picture, its readings and the vehicle's position.

import * as api from "./api.js";
import { drawLane, drawPackets, isPacketLog } from "./cerpms.js";
import { drawMap } from "./map.js";
import { $, attempt, facts, fillForm, make, readForm, showStatus } from "./page.js";
import { drawTagFix, drawTags, isTrace, waitFor } from "./traces.js";

let pictureUrl = null;
let frame = null;

export function startDecode() {
  const form = $("#decode-form");
  const drop = $("#drop");
  $("#file").addEventListener("change", (event) => take(event.target.files[0]));
  for (const name of ["dragenter", "dragover"]) {
    drop.addEventListener(name, (event) => {
      event.preventDefault();
      drop.classList.add("over");
    });
  }
  drop.addEventListener("dragleave", () => drop.classList.remove("over"));
  drop.addEventListener("drop", (event) => {
    event.preventDefault();
    drop.classList.remove("over");
    take(event.dataTransfer.files[0]);
  });
  $("#context").addEventListener("input", (event) => {
    try {
      fillForm(form, JSON.parse(event.target.value));
      event.target.removeAttribute("aria-invalid");
    } catch {
      event.target.setAttribute("aria-invalid", "true");
    }
  });
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    attempt(form.querySelector("button"), form, () => upload(form));
  });
}

function take(file) {
  frame = file || null;
  $("#file-name").textContent = file ? `${file.name}, ${Math.ceil(file.size / 1024)} kB` : "";
  if (file) $("#kind").value = kindOf(file);
}

function kindOf(file) {
  if (isPacketLog(file)) return "packets";
  return isTrace(file) ? "trace" : "frame";
}

async function upload(form) {
  if (!frame) throw new api.Problem({ title: "No file is selected", detail: "Choose a picture, a recording or a packet log first.", field: "file", limit: "JPEG, PNG, recording or packet log", cure: "drop a file on the dashed area, or choose one" });
  showStatus("Decoding …");
  const context = contextOf(form);
  const kind = $("#kind").value;
  if (kind !== "frame" && !context.trace && !context.packets) context[kind] = {};
  const decoded = await waitFor(await api.decode(frame, context));
  await SHOWN[decoded.kind](decoded);
  showStatus(decoded.summary.text);
  $("#decoded").scrollIntoView({ block: "start" });
}

// The context from the JSON text (which alone can hold intrinsics and times), overridden by the form fields.
function contextOf(form) {
  let context = {};
  try {
    context = JSON.parse($("#context").value || "{}");
  } catch {
    throw new api.Problem({ title: "The context cannot be read", detail: "The text is not valid JSON.", field: "context", cure: "correct the JSON, or empty the field" });
  }
  const fields = readForm(form);
  for (const part of ["coarse_position", "camera"]) {
    if (context[part] || fields[part]) context[part] = { ...context[part], ...fields[part] };
  }
  if (fields.heading_deg !== undefined) context.heading_deg = fields.heading_deg;
  if (fields.thermal) context.thermal = true;
  if (fields.vehicle) context.vehicle = fields.vehicle;
  return context;
}

async function show(decoded) {
  $("#decoded").hidden = false;
  $("#summary").textContent = `${decoded.summary.text}. ${decoded.decoder}, ${decoded.frames[0].decode_ms.toFixed(1)} ms, registered plates near the approximate position: ${decoded.codebook_plates}.`;
  $("#readings").replaceChildren(...(decoded.readings.length ? decoded.readings.map(drawReading) : [make("p", { class: "empty" }, "No plate was found in this frame.")]));
  drawFix(decoded);
  const text = `The frame with the plates that were found: ${decoded.summary.text}`;
  drawCrops(decoded.readings, await showPicture(decoded.links.annotated, text));
}

async function showTrace(decoded) {
  $("#decoded").hidden = false;
  $("#summary").textContent = `${decoded.summary.text}. ${decoded.decoder}, ${decoded.report.decode_ms.toFixed(0)} ms, registered tags near the approximate position: ${decoded.codebook_tags}.`;
  $("#readings").replaceChildren(...drawTags(decoded));
  $("#fix").replaceChildren(drawTagFix(decoded));
  await showPicture(decoded.links.plot, `The trace with the magnets and tags that were found: ${decoded.summary.text}`);
}

async function showPackets(decoded) {
  $("#decoded").hidden = false;
  $("#summary").textContent = `${decoded.summary.text}. ${decoded.decoder}, ${decoded.report.decode_ms.toFixed(0)} ms.`;
  $("#readings").replaceChildren(...drawPackets(decoded));
  $("#fix").replaceChildren(drawLane(decoded));
  await showPicture(decoded.links.plot, `The lane estimated from the markers: ${decoded.summary.text}`);
}

async function showVideo(decoded) {
  $("#decoded").hidden = false;
  $("#summary").textContent = `${decoded.summary.text}. ${decoded.decoder}, registered plates along the drive: ${decoded.codebook_plates}.`;
  const plates = decoded.plates.map((plate) => make("p", {}, `${plate.digits || plate.outcome}, in ${plate.frames.length} frames from frame ${plate.frames[0]} on`));
  $("#readings").replaceChildren(...(plates.length ? plates : [make("p", { class: "empty" }, "No plate was found in this video.")]));
  $("#fix").replaceChildren();
  $("#annotated").removeAttribute("src");
}

const SHOWN = { frame: show, archive: show, video: showVideo, trace: showTrace, packets: showPackets };

async function showPicture(path, text) {
  const picture = await api.fetchPicture(path);
  if (pictureUrl) URL.revokeObjectURL(pictureUrl);
  pictureUrl = URL.createObjectURL(picture);
  const image = $("#annotated");
  image.src = pictureUrl;
  image.alt = text;
  await image.decode();
  return image;
}

function drawReading(reading) {
  const level = reading.outcome === "read" ? "read" : reading.outcome === "unsure" ? "unsure" : "refused";
  const { match, grade } = reading;
  return make(
    "div",
    { class: "reading" },
    make("h3", {}, make("span", { class: level }, reading.outcome), " ", make("span", { class: "digits" }, reading.digits || "")),
    facts([
      ["Reason", reading.reason],
      ["Confidence", `${(100 * reading.confidence).toFixed(3)} %${reading.from_codebook ? ", chosen among the registered plates near by" : ""}`],
      ["Scheme", reading.scheme],
      ["Height in the frame", `${reading.height_px} px`],
      ["Grade", grade && `${grade.letter} (${grade.overall.toFixed(1)})`],
      ["Match", match && (match.registered ? `marker ${match.marker_id}, ${match.distance_m} m away` : "not registered here")],
      ["Note", match && match.note],
    ]),
    make("div", { class: "parts" }, drawCells(reading), reading.corners_px && make("canvas", { width: 280, height: 200, role: "img", "aria-label": "The plate in the frame" })),
  );
}

// The part of the frame around each plate, enlarged.
function drawCrops(readings, image) {
  const canvases = document.querySelectorAll("#readings canvas");
  readings.filter((reading) => reading.corners_px).forEach((reading, k) => {
    const [xs, ys] = [0, 1].map((axis) => reading.corners_px.map((corner) => corner[axis]));
    const canvas = canvases[k];
    const width = Math.max((Math.max(...xs) - Math.min(...xs)) * 1.3, ((Math.max(...ys) - Math.min(...ys)) * 1.3 * canvas.width) / canvas.height);
    const height = (width * canvas.height) / canvas.width;
    const [x, y] = [xs, ys].map((values) => (Math.max(...values) + Math.min(...values)) / 2);
    canvas.getContext("2d").drawImage(image, x - width / 2, y - height / 2, width, height, 0, 0, canvas.width, canvas.height);
  });
}

function drawCells(reading) {
  if (!reading.digits || !reading.geometry) return null;
  const across = reading.geometry.n / 2;
  const grid = make("div", { class: "cells", role: "img", "aria-label": `Confidence per cell: ${reading.cell_confidence.map((c) => Math.round(100 * c)).join(", ")} percent` });
  grid.style.gridTemplateColumns = `repeat(${across}, max-content)`;
  let k = 0;
  for (let row = 0; row < across; row += 1) {
    for (let column = 0; column < across; column += 1) {
      const isBoundaryMarker = (row === 0 || row === across - 1) && (column === 0 || column === across - 1);
      if (isBoundaryMarker) {
        grid.append(make("span", { class: row === 0 && column === 0 ? "triangle" : "square" }));
        continue;
      }
      const confidence = reading.cell_confidence[k];
      const cell = make("span", { class: reading.corrected_cells.includes(k) ? "corrected" : null }, make("b", {}, reading.digits[k]));
      if (confidence !== undefined) {
        cell.append(`${(100 * confidence).toFixed(confidence > 0.999 ? 0 : 1)} %`);
        cell.style.backgroundColor = `hsl(${Math.round(130 * Math.max(0, 2 * confidence - 1))} 55% 72%)`;
      }
      grid.append(cell);
      k += 1;
    }
  }
  return grid;
}

function drawFix(decoded) {
  const { fix } = decoded;
  $("#fix-map").toggleAttribute("hidden", !fix);
  if (!fix) {
    $("#fix").replaceChildren(make("p", { class: "empty" }, "No position: this needs a plate that matches a registered one, the camera and an approximate position."));
    return;
  }
  const { sigma } = fix;
  $("#fix").replaceChildren(facts([
    ["Longitude", `${fix.lon_deg.toFixed(8)}°`],
    ["Latitude", `${fix.lat_deg.toFixed(8)}°`],
    ["Height", fix.height_m === null ? null : `${fix.height_m.toFixed(3)} m`],
    ["Heading", `${fix.heading_deg.toFixed(2)}° ± ${sigma.heading_deg.toFixed(2)}°`],
    ["± east, north", `${(100 * sigma.east_m).toFixed(1)} cm, ${(100 * sigma.north_m).toFixed(1)} cm`],
    ["Grade", fix.localization_grade],
    ["Notes", fix.notes.join("; ")],
  ]));
  const places = decoded.readings.filter((reading) => reading.match && reading.match.lon_deg !== null).map((reading) => ({
    lon_deg: reading.match.lon_deg,
    lat_deg: reading.match.lat_deg,
    heading_deg: null,
    label: reading.digits,
  }));
  drawMap($("#fix-map"), places, fix);
}
