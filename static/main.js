// Chooses the view from the address, and stores the API key that every request needs.

import { key } from "./api.js";
import { startCerpms } from "./cerpms.js";
import { startDecode } from "./decode.js";
import { showFleet, startFleet } from "./fleet.js";
import { showMagnets, startMagnets } from "./magnets.js";
import { showMarkers, startMarkers } from "./markers.js";
import { $, clearProblem, showStatus } from "./page.js";
import { startRegister } from "./register.js";

const VIEWS = ["markers", "register", "magnets", "cerpms", "decode", "fleet"];

function showView() {
  const [requested, id] = location.hash.slice(1).split("/");
  const name = VIEWS.includes(requested) ? requested : "markers";
  for (const view of VIEWS) $(`#view-${view}`).hidden = view !== name;
  for (const link of document.querySelectorAll(".bar nav a")) {
    if (link.getAttribute("href") === `#${name}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  clearProblem();
  if (!key.get()) {
    showStatus("Enter an API key. The server printed an admin key at its first start; the command waymark key creates more.");
    $("#key").focus();
  } else if (name === "markers") {
    showMarkers(id);
  } else if (name === "magnets") {
    showMagnets();
  } else if (name === "fleet") {
    showFleet(id);
  }
}

function showKey() {
  $("#forget").hidden = !key.get();
  $("#key").value = key.get();
}

$("#key-form").addEventListener("submit", (event) => {
  event.preventDefault();
  key.set($("#key").value.trim());
  showStatus("");
  showKey();
  showView();
});
$("#forget").addEventListener("click", () => {
  key.forget();
  location.reload();
});
window.addEventListener("hashchange", () => {
  if (key.get()) showStatus("");
  showView();
});

startMarkers();
startRegister();
startMagnets();
startCerpms();
startDecode();
startFleet();
showKey();
showView();
