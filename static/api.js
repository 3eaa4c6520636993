// Requests to the API. Every failure is a Problem with the fields of RFC 9457.

const KEY = "waymark-key";

export class Problem extends Error {
  constructor(document) {
    super(document.detail || document.title);
    this.document = document;
  }
}

export const key = {
  get: () => sessionStorage.getItem(KEY) || "",
  set: (value) => sessionStorage.setItem(KEY, value),
  forget: () => sessionStorage.removeItem(KEY),
};

async function request(path, options = {}) {
  const headers = { ...options.headers, Authorization: `Bearer ${key.get()}` };
  let answer;
  try {
    answer = await fetch(path, { ...options, headers, cache: "no-store" });
  } catch {
    throw new Problem({ title: "The server cannot be reached", detail: "The request was not answered.", cure: "check that the server is running, and try again" });
  }
  if (answer.ok) return answer;
  const document = await answer.json().catch(() => ({ title: `HTTP ${answer.status}`, detail: answer.statusText }));
  throw new Problem(document);
}

const json = (body) => ({ method: "POST", body: JSON.stringify(body), headers: { "Content-Type": "application/json" } });

const MAX_MARKERS = 5000;

export async function listMarkers() {
  const items = [];
  let path = "/v1/markers?limit=1000";
  while (path && items.length < MAX_MARKERS) {
    const answer = await request(path);
    items.push(...(await answer.json()).items);
    const next = /<([^>]+)>; rel="next"/.exec(answer.headers.get("Link") || "");
    path = next && new URL(next[1], location.href).pathname + new URL(next[1], location.href).search;
  }
  return { items, more: Boolean(path) };
}

export async function registerMarker(body) {
  return (await request("/v1/markers", json(body))).json();
}

export async function getMarker(id) {
  return (await request(`/v1/markers/${id}`)).json();
}

export async function fetchLayout(id, form) {
  return (await request(`/v1/markers/${id}/layout.${form}`)).blob();
}

export async function fetchPayload(id) {
  return (await request(`/v1/markers/${id}/payload.json`)).json();
}

export async function listCodebooks() {
  return (await (await request("/v1/codebooks")).json()).items;
}

export async function listEntries(id) {
  return (await (await request(`/v1/codebooks/${id}/entries`)).json()).items;
}

export async function fetchArtwork(id, form) {
  const answer = await request(`/v1/markers/${id}/artwork.${form}`);
  return { blob: await answer.blob(), proof: answer.headers.get("Waymark-Proof") || "" };
}

export async function fetchBundle(ids, formats) {
  const answer = await request("/v1/artwork", json({ marker_ids: ids, formats }));
  return { blob: await answer.blob(), proof: answer.headers.get("Waymark-Proof") || "" };
}

export async function decode(file, context) {
  const form = new FormData();
  form.append("file", file, file.name);
  form.append("context", JSON.stringify(context));
  return (await request("/v1/decodes", { method: "POST", body: form })).json();
}

export async function listVehicles() {
  return (await (await request("/v1/vehicles?limit=1000")).json()).items;
}

export async function addVehicle(body) {
  return (await request("/v1/vehicles", json(body))).json();
}

export async function calibrate(photos, declaration) {
  const form = new FormData();
  for (const photo of photos) form.append("photos", photo, photo.name);
  form.append("declaration", JSON.stringify(declaration));
  return (await request("/v1/calibrations", { method: "POST", body: form })).json();
}

export async function putCalibration(vehicle, id) {
  const headers = { "Content-Type": "application/json", "If-Match": `"${vehicle.version}"` };
  return (await request(`/v1/vehicles/${vehicle.id}/calibration`, { method: "PUT", headers, body: JSON.stringify({ calibration_id: id }) })).json();
}

export async function fetchBoard(board) {
  return (await request(`/v1/calibration-boards/board.pdf?${new URLSearchParams(board)}`)).blob();
}

export async function getDecode(id) {
  return (await request(`/v1/decodes/${id}`)).json();
}

export async function fetchPicture(path) {
  return (await request(path)).blob();
}

export function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}
