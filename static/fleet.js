// The fleet: vehicles with their sensor profiles, uploads and distances, and the calibration of their cameras.

import * as api from "./api.js";
import { $, attempt, facts, make, readForm, showStatus } from "./page.js";

const state = { vehicles: [], chosen: null };
const SECTIONS = ["camera", "thermal", "thermal_range", "trace", "packets"];

export function startFleet() {
  const form = $("#vehicle-form");
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    attempt(form.querySelector("button"), form, async () => {
      const body = readForm(form);
      if (body.profile) body.profile = readProfile(body.profile);
      const vehicle = await api.addVehicle(body);
      showStatus(`Added ${vehicle.name}.`);
      form.reset();
      location.hash = `#fleet/${vehicle.id}`;
    });
  });
}

export async function showFleet(chosenId = null) {
  await attempt(null, null, async () => {
    state.vehicles = await api.listVehicles();
    state.chosen = chosenId || state.chosen;
    $("#no-vehicles").hidden = state.vehicles.length > 0;
    drawRows();
    const chosen = state.vehicles.find((vehicle) => vehicle.id === state.chosen);
    if (chosen) drawVehicle(chosen);
  });
}

function readProfile(text) {
  try {
    return JSON.parse(text);
  } catch (error) {
    throw new api.Problem({ title: "The profile cannot be read", detail: String(error.message), field: "profile", limit: "JSON", cure: "correct the JSON, or empty the field" });
  }
}

function drawRows() {
  $("#vehicle-rows").replaceChildren(...state.vehicles.map((vehicle) => make(
    "tr",
    { class: vehicle.id === state.chosen ? "chosen" : null },
    make("td", {}, make("button", { type: "button", class: "link", onclick: () => choose(vehicle) }, vehicle.name)),
    make("td", {}, vehicle.status),
    make("td", {}, vehicle.last_seen_at ? time(vehicle.last_seen_at) : "never"),
    make("td", { class: "number" }, `${vehicle.uploads}`),
    make("td", { class: "number" }, vehicle.driven_km.toFixed(1)),
  )));
}

const time = (text) => text.slice(0, 16).replace("T", " ");

function choose(vehicle) {
  state.chosen = vehicle.id;
  drawRows();
  drawVehicle(vehicle);
}

function drawVehicle(vehicle) {
  const { profile } = vehicle;
  const camera = profile.camera || {};
  const known = SECTIONS.filter((section) => section in profile);
  $("#vehicle").replaceChildren(
    make("h2", {}, vehicle.name),
    facts([
      ["Status", `${vehicle.status}, version ${vehicle.version}`],
      ["Note", vehicle.note],
      ["Last seen", vehicle.last_seen_at ? `${time(vehicle.last_seen_at)} UTC` : "never"],
      ["Uploads", vehicle.uploads],
      ["Distance", `${vehicle.driven_km.toFixed(3)} km driven`],
      ["Keys", vehicle.keys.map((key) => `${key.label} (${key.prefix}…)`).join(", ") || "none; uploads must name the vehicle"],
      ["Camera", cameraText(camera)],
      ["Calibration", camera.calibration_id],
      ["Id", vehicle.id],
    ]),
    make("h2", { class: "part" }, "Sensor profile"),
    ...(known.length ? known.map((section) => make("details", {}, make("summary", {}, section), make("pre", {}, JSON.stringify(profile[section], null, 1)))) : [make("p", { class: "empty" }, "The profile is empty. Uploads of this vehicle must state their whole context.")]),
    make("h2", { class: "part" }, "Camera calibration"),
    calibrationForm(vehicle),
    make("div", { id: "calibration", "aria-live": "polite" }),
  );
}

function cameraText(camera) {
  const size = camera.width_px ? `${camera.width_px} × ${camera.height_px} px` : null;
  const lens = camera.fx_px ? `fx ${camera.fx_px.toFixed(1)} px` : camera.horizontal_fov_deg ? `${camera.horizontal_fov_deg}° field of view` : "no intrinsics";
  const mount = camera.height_m ? `${camera.height_m} m above the road, ${camera.depression_deg ?? 23}° below the horizon` : null;
  return Object.keys(camera).length ? [size, lens, mount].filter(Boolean).join(", ") : null;
}

function calibrationForm(vehicle) {
  const field = (label, name, value) => make("label", {}, label, make("input", { name, value, inputmode: "decimal", "data-kind": "number" }));
  const photos = make("input", { type: "file", name: "photos", multiple: true, accept: "image/jpeg,image/png,.zip" });
  const print = make("button", { type: "button", class: "quiet" }, "Download board (PDF)");
  const form = make(
    "form",
    { class: "form", novalidate: true },
    make("label", {}, "12 to 20 photos of the board, or a ZIP of them", photos),
    make("fieldset", { class: "pairs" }, field("Columns of squares", "board.columns", 7), field("Rows of squares", "board.rows", 10), field("Side of a square [mm]", "board.square_mm", 25), field("Side of a marker [mm]", "board.marker_mm", 18)),
    make("p", { class: "actions buttons" }, make("button", { type: "submit" }, "Calibrate"), print),
  );
  print.addEventListener("click", () => attempt(print, form, async () => {
    api.save(await api.fetchBoard(readForm(form).board), "waymark-board.pdf");
  }));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    attempt(form.querySelector("button"), form, async () => {
      if (!photos.files.length) throw new api.Problem({ title: "No photos are selected", detail: "Choose photos of the board first.", field: "photos", limit: "6 to 60 photos", cure: "print the board, and photograph it from several directions" });
      $("#calibration").replaceChildren();
      showStatus("Detecting the board in each photo …");
      const found = await api.calibrate(photos.files, { board: readForm(form).board });
      showStatus(found.summary);
      drawCalibration(vehicle, found);
    });
  });
  return form;
}

function drawCalibration(vehicle, found) {
  const { camera, sigma } = found;
  const withSigma = (name) => `${camera[name].toFixed(2)} ± ${sigma[name].toFixed(2)} px`;
  const use = make("button", { type: "button" }, `Use for ${vehicle.name}`);
  use.addEventListener("click", () => attempt(use, null, async () => {
    const changed = await api.putCalibration(vehicle, found.id);
    showStatus(`The calibration is stored in the profile of ${changed.name}, version ${changed.version}.`);
    await showFleet(changed.id);
  }));
  $("#calibration").replaceChildren(
    make("p", {}, make("span", { class: found.rms_px < 0.5 ? "read" : "unsure" }, `Reprojection error ${found.rms_px.toFixed(3)} px`), ` over ${found.views.filter((view) => view.used).length} of ${found.views.length} photos`),
    facts([
      ["fx", withSigma("fx_px")], ["fy", withSigma("fy_px")], ["cx", withSigma("cx_px")], ["cy", withSigma("cy_px")],
      ["Distortion", camera.distortion.map((value) => value.toFixed(4)).join(", ")],
      ["Tilt", `up to ${found.tilt_spread_deg.toFixed(0)}° between two views`],
      ["Covered", `${(100 * found.coverage.share).toFixed(0)} % of the image`],
    ]),
    make("div", { class: "coverage", role: "img", "aria-label": "Cells of the image that contain a corner of the board" }, ...found.coverage.cells.flat().map((on) => make("span", { class: on ? "on" : null }))),
    make("p", { class: "actions" }, use),
    make("div", { class: "scroll" }, make(
      "table",
      {},
      make("thead", {}, make("tr", {}, make("th", { scope: "col" }, "Photo"), make("th", { scope: "col" }, "Used"), make("th", { scope: "col", class: "number" }, "Error [px]"), make("th", { scope: "col", class: "number" }, "Tilt [°]"))),
      make("tbody", {}, ...found.views.map((view) => make(
        "tr",
        { title: view.detail },
        make("td", {}, view.name),
        make("td", { class: view.used ? "read" : "refused" }, view.used ? "yes" : view.reason),
        make("td", { class: "number" }, view.rms_px === null ? "" : view.rms_px.toFixed(3)),
        make("td", { class: "number" }, view.tilt_deg === null ? "" : view.tilt_deg.toFixed(0)),
      ))),
    )),
  );
}
