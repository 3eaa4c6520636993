// The fleet: vehicles with their profiles, what they did, and the calibration of their cameras.

import * as api from "./api.js";
import { $, attempt, facts, make, readForm, say } from "./page.js";

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
      say(`Added ${vehicle.name}.`);
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
    throw new api.Problem({ title: "The profile cannot be read", detail: String(error.message), field: "profile", limit: "JSON", cure: "correct it or empty the field" });
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
      ["Uploads", `${vehicle.uploads}, ${vehicle.driven_km.toFixed(3)} km driven`],
      ["Keys", vehicle.keys.map((key) => `${key.label} (${key.prefix}…)`).join(", ") || "none: uploads name the vehicle"],
      ["Camera", cameraText(camera)],
      ["Calibration", camera.calibration_id],
      ["Id", vehicle.id],
    ]),
    make("h2", { class: "part" }, "Profile"),
    ...(known.length ? known.map((section) => make("details", {}, make("summary", {}, section), make("pre", {}, JSON.stringify(profile[section], null, 1)))) : [make("p", { class: "empty" }, "Empty: uploads of this vehicle must state everything.")]),
    make("h2", { class: "part" }, "Calibrate its camera"),
    calibrationForm(vehicle),
    make("div", { id: "calibration", "aria-live": "polite" }),
  );
}

function cameraText(camera) {
  const size = camera.width_px ? `${camera.width_px} × ${camera.height_px} px` : null;
  const lens = camera.fx_px ? `fx ${camera.fx_px.toFixed(1)} px` : camera.horizontal_fov_deg ? `${camera.horizontal_fov_deg}° wide` : "no intrinsics";
  const mount = camera.height_m ? `${camera.height_m} m up, ${camera.depression_deg ?? 23}° down` : null;
  return Object.keys(camera).length ? [size, lens, mount].filter(Boolean).join(", ") : null;
}

function calibrationForm(vehicle) {
  const field = (label, name, value) => make("label", {}, label, make("input", { name, value, inputmode: "decimal", "data-kind": "number" }));
  const photos = make("input", { type: "file", name: "photos", multiple: true, accept: "image/jpeg,image/png,.zip" });
  const print = make("button", { type: "button", class: "quiet" }, "Board as PDF");
  const form = make(
    "form",
    { class: "form", novalidate: true },
    make("label", {}, "12 to 20 photos of the board, or a ZIP of them", photos),
    make("fieldset", { class: "pairs" }, field("Squares across", "board.columns", 7), field("Squares down", "board.rows", 10), field("Square [mm]", "board.square_mm", 25), field("Marker [mm]", "board.marker_mm", 18)),
    make("p", { class: "actions buttons" }, make("button", { type: "submit" }, "Calibrate"), print),
  );
  print.addEventListener("click", () => attempt(print, form, async () => {
    api.save(await api.fetchBoard(readForm(form).board), "waymark-board.pdf");
  }));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    attempt(form.querySelector("button"), form, async () => {
      if (!photos.files.length) throw new api.Problem({ title: "There are no photos", detail: "Choose photos of the board first.", field: "photos", limit: "6 at least, 60 at most", cure: "print the board, and photograph it from all sides" });
      $("#calibration").replaceChildren();
      say("Looking for the board in each photo …");
      const found = await api.calibrate(photos.files, { board: readForm(form).board });
      say(found.summary);
      drawCalibration(vehicle, found);
    });
  });
  return form;
}

function drawCalibration(vehicle, found) {
  const { camera, sigma } = found;
  const sure = (name) => `${camera[name].toFixed(2)} ± ${sigma[name].toFixed(2)} px`;
  const use = make("button", { type: "button" }, `Use for ${vehicle.name}`);
  use.addEventListener("click", () => attempt(use, null, async () => {
    const changed = await api.putCalibration(vehicle, found.id);
    say(`${changed.name} has the calibrated camera, version ${changed.version}.`);
    await showFleet(changed.id);
  }));
  $("#calibration").replaceChildren(
    make("p", {}, make("span", { class: found.rms_px < 0.5 ? "read" : "unsure" }, `Reprojection error ${found.rms_px.toFixed(3)} px`), ` over ${found.views.filter((view) => view.used).length} of ${found.views.length} photos`),
    facts([
      ["fx", sure("fx_px")], ["fy", sure("fy_px")], ["cx", sure("cx_px")], ["cy", sure("cy_px")],
      ["Distortion", camera.distortion.map((value) => value.toFixed(4)).join(", ")],
      ["Tilt", `${found.tilt_spread_deg.toFixed(0)}° between the views furthest apart`],
      ["Covered", `${(100 * found.coverage.share).toFixed(0)} % of the image`],
    ]),
    make("div", { class: "coverage", role: "img", "aria-label": "Cells of the image that a corner of the board lay in" }, ...found.coverage.cells.flat().map((on) => make("span", { class: on ? "on" : null }))),
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
