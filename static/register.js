// Register a plate.

import * as api from "./api.js";
import { $, attempt, readForm, showStatus } from "./page.js";

export function startRegister() {
  const form = $("#register-form");
  form.addEventListener("input", () => showSide(form));
  form.elements["code.scheme"].addEventListener("change", () => suggestSize(form));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    attempt(form.querySelector("button"), form, async () => {
      const body = readForm(form);
      body.position ??= {};
      const marker = await api.registerMarker(body);
      showStatus(`Registered ${marker.code.digits}.`);
      location.hash = `#markers/${marker.id}`;
    });
  });
  showSide(form);
}

// Plates of 325 mm in every scheme, see docs/decisions/0031-codes-that-survive-dirt.md.
const SIZES = { "position-robust": [10, 27] };
const HINTS = {
  id: "The plate carries a registry number. Vehicles look its position up in the registry or in a snapshot.",
  "position-robust": "The plate carries its position to 0.1 m. It has 10 x 10 or 12 x 12 units.",
  "position-check": "A wrong digit is noticed in most cases, and never corrected.",
  position: "The paper's plate: any twelve digits are a position, so that one wrong cell is another place.",
};

function suggestSize(form) {
  const scheme = form.elements["code.scheme"].value;
  const [n, unit] = SIZES[scheme] || [8, 35];
  form.elements["geometry.n"].value = n;
  form.elements["geometry.unit_mm"].value = unit;
  form.elements["geometry.gap_mm"].value = 5;
  showSide(form);
}

function showSide(form) {
  $("#scheme-hint").textContent = HINTS[form.elements["code.scheme"].value];
  const { n, unit_mm: unit, gap_mm: gap } = readForm(form).geometry || {};
  const side = n * unit + (n + 1) * gap;
  $("#side").textContent = Number.isFinite(side) ? `${Math.round(side * 10) / 10} mm` : "?";
}
