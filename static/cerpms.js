// Register a CERPM, show its message byte by byte, and show the lane of a decoded packet log.

import * as api from "./api.js";
import { drawMap } from "./map.js";
import { $, attempt, facts, make, readForm, showStatus } from "./page.js";

const VERDICTS = { authentic: "read", duplicate: "read" };
const MAP_STEP = 10; // stations between two ticks of the map

export function isPacketLog(file) {
  return /\.(jsonl|ndjson|json)$/i.test(file.name) || (/\.(csv|zip|bin|txt)$/i.test(file.name) && /packet|uplink|cerpm|lora/i.test(file.name));
}

export function startCerpms() {
  const form = $("#cerpms-form");
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    attempt(form.querySelector("button"), form, async () => {
      const body = { family: "cerpm", position: {}, ...readForm(form) };
      const { value } = body.speed_limit || {};
      if (value === undefined) delete body.speed_limit;
      const marker = await api.registerMarker(body);
      showStatus(`Registered CERPM ${marker.code.number}.`);
      location.hash = `#markers/${marker.id}`;
    });
  });
}

export async function drawCerpm(box, marker) {
  const { position, code, radio, speed_limit: limit } = marker;
  const message = make("div");
  box.replaceChildren(
    make("h2", { class: "digits" }, `CERPM ${code.number}`),
    facts([
      ["Side", marker.side],
      ["Speed limit", limit && `${limit.value} ${limit.unit}`],
      ["Status", `${marker.status}, version ${marker.version}`],
      ["Position", `${position.lon_deg.toFixed(8)}, ${position.lat_deg.toFixed(8)}`],
      ["Height", position.height_m === null ? null : `${position.height_m.toFixed(3)} m`],
      ["Accuracy", position.horizontal_rmse_m === null ? "not stated" : `${position.horizontal_rmse_m} m horizontal`],
      ["Grade", position.localization_grade],
      ["Transmission", `every ${radio.interval_s} s, SF${radio.spreading_factor}, ${radio.bandwidth_hz / 1000} kHz at ${radio.frequency_hz / 1e6} MHz`],
      ["DevEUI", marker.dev_eui],
      ["Road", marker.road],
      ["Id", marker.id],
    ]),
    message,
  );
  const payload = await api.fetchPayload(marker.id);
  const buttons = ["bin", "hex", "json"].map((form) => {
    const button = make("button", { type: "button", class: "quiet" }, form.toUpperCase());
    button.addEventListener("click", () => attempt(button, null, async () => {
      api.save(await api.fetchPicture(`/v1/markers/${marker.id}/payload.${form}`), `cerpm-${code.number}.${form}`);
    }));
    return button;
  });
  message.append(
    make("h2", {}, "Message"),
    make("div", { class: "buttons", role: "group", "aria-label": "Download the message" }, ...buttons),
    make("p", { class: "digits" }, payload.hex),
    make("div", { class: "scroll" }, make(
      "table",
      {},
      make("thead", {}, make("tr", {}, ...["Bytes", "Hex", "Field", "Value"].map((name) => make("th", { scope: "col" }, name)))),
      make("tbody", {}, ...payload.bytes.map((part) => make(
        "tr",
        {},
        make("td", {}, part.length === 1 ? `${part.offset}` : `${part.offset}-${part.offset + part.length - 1}`),
        make("td", { class: "digits" }, part.hex),
        make("td", {}, part.field),
        make("td", {}, part.value),
      ))),
    )),
    payload.note ? make("p", { class: "hint" }, payload.note) : "", // append() would write null as a word
  );
}

export function drawPackets(decoded) {
  const { report, markers, lane, steering } = decoded;
  const counts = Object.entries(report.verdicts).filter(([, count]) => count).map(([verdict, count]) => `${count} ${verdict}`);
  const parts = [facts([
    ["Packets", `${report.packets}: ${counts.join(", ")}`],
    ["Left out", report.left_out.map((entry) => `${entry.what}: ${entry.reason}`).join("; ")],
    ["Path", lane && !lane.refusal ? `${lane.length_m.toFixed(0)} m, ± ${(100 * lane.sigma_median_m).toFixed(1)} cm` : lane && lane.refusal],
    ["Warnings", [...report.warnings, ...(lane ? lane.localization_warnings : [])].join("; ")],
    ["Steering check", steering && !steering.refusal ? `${steering.controller}: RMS ${(100 * steering.rms_m).toFixed(1)} cm, maximum ${(100 * steering.max_m).toFixed(1)} cm` : steering && steering.refusal],
  ])];
  const noted = markers.filter((marker) => marker.left_out || marker.notes.length);
  for (const marker of noted) {
    parts.push(make(
      "div",
      { class: "reading" },
      make("h3", {}, make("span", { class: marker.left_out ? "refused" : "unsure" }, marker.left_out ? "left out" : "warning"), " ", make("span", { class: "digits" }, `CERPM ${marker.number}`)),
      facts([["Reason", [marker.left_out, ...marker.notes].filter(Boolean).join("; ")], ["Packets", marker.packets], ["Health", marker.health && marker.health.verdict]]),
    ));
  }
  if (!noted.length) parts.push(make("p", { class: "reading" }, make("span", { class: VERDICTS.authentic }, "all markers agree"), ` ${markers.length} CERPMs received`));
  return parts;
}

export function drawLane(decoded) {
  const { lane } = decoded;
  const shown = Boolean(lane && !lane.refusal);
  $("#fix-map").toggleAttribute("hidden", !shown);
  if (!shown) return make("p", { class: "empty" }, lane && lane.refusal ? lane.refusal : "No path was estimated.");
  const places = lane.stations.lon_deg.flatMap((lon_deg, k) => (k % MAP_STEP ? [] : [{
    lon_deg, lat_deg: lane.stations.lat_deg[k], heading_deg: lane.stations.heading_deg[k], label: `${lane.stations.station_m[k].toFixed(0)} m`,
  }]));
  drawMap($("#fix-map"), places, null);
  const save = make("button", { type: "button", class: "quiet" }, "Download path (GeoJSON)");
  save.addEventListener("click", () => attempt(save, null, async () => api.save(await api.fetchPicture(decoded.links.lane), `lane-${decoded.id}.geojson`)));
  return make("div", {}, save, facts([
    ["Length", `${lane.length_m.toFixed(1)} m`],
    ["Accuracy", `median ± ${(100 * lane.sigma_median_m).toFixed(1)} cm, maximum ± ${(100 * lane.sigma_max_m).toFixed(1)} cm`],
    ["Speed limit", lane.speed_limits_km_h.length ? `${lane.speed_limits_km_h.map((limit) => limit.toFixed(0)).join(", ")} km/h` : null],
    ["Sharpest bend", lane.min_radius_m === null ? null : `radius ${lane.min_radius_m.toFixed(0)} m`],
    ["Grade", lane.localization_grade],
  ]));
}
