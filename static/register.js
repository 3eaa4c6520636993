// Register a plate.

import * as api from "./api.js";
import { $, attempt, readForm, showStatus } from "./page.js";

export function startRegister() {
  const form = $("#register-form");
  form.addEventListener("input", () => showSide(form));
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

function showSide(form) {
  const { n, unit_mm: unit, gap_mm: gap } = readForm(form).geometry || {};
  const side = n * unit + (n + 1) * gap;
  $("#side").textContent = Number.isFinite(side) ? `${Math.round(side * 10) / 10} mm` : "?";
}
