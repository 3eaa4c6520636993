// Draws positions on a plain plot without map tiles, in metres east and north of the centre.

const SVG = "http://www.w3.org/2000/svg";
const M_PER_DEG = 111_320;
const WIDTH = 800;
const MARGIN = 40;

function draw(parent, tag, attributes, text) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  if (text) element.textContent = text;
  parent.append(element);
  return element;
}

const turn = (degrees) => ((degrees + 540) % 360) - 180;

/**
 * places: [{lon_deg, lat_deg, heading_deg, label, kind, choose}], kind is a class of the style sheet.
 * vehicle: {lon_deg, lat_deg, heading_deg, covariance} or null. least: metres that the plot shows at least.
 */
export function drawMap(svg, places, vehicle = null, least = vehicle ? 4 : 20) {
  svg.replaceChildren();
  const height = Math.max(120, Math.round((WIDTH * svg.clientHeight) / Math.max(svg.clientWidth, 1)) || 400);
  svg.setAttribute("viewBox", `0 0 ${WIDTH} ${height}`);
  const all = vehicle ? [...places, vehicle] : places;
  if (!all.length) return;
  const first = all[0];
  const flat = (place) => [
    turn(place.lon_deg - first.lon_deg) * M_PER_DEG * Math.cos((first.lat_deg * Math.PI) / 180),
    (place.lat_deg - first.lat_deg) * M_PER_DEG,
  ];
  const points = all.map(flat);
  const [low, high] = [Math.min, Math.max].map((pick) => [0, 1].map((k) => points.reduce((best, point) => pick(best, point[k]), points[0][k])));
  const span = [0, 1].map((k) => Math.max(high[k] - low[k], least));
  const scale = Math.min((WIDTH - 2 * MARGIN) / span[0], (height - 2 * MARGIN) / span[1]);
  const middle = [0, 1].map((k) => (low[k] + high[k]) / 2);
  const at = ([east, north]) => [WIDTH / 2 + (east - middle[0]) * scale, height / 2 - (north - middle[1]) * scale];

  drawScale(svg, scale, height);
  places.forEach((place, k) => drawPlace(svg, place, at(points[k])));
  if (vehicle) drawVehicle(svg, vehicle, at(points[points.length - 1]), scale);
}

function drawScale(svg, scale, height) {
  const wanted = 140 / scale;
  const power = 10 ** Math.floor(Math.log10(wanted));
  const metres = [5, 2, 1].map((step) => step * power).find((step) => step <= wanted) || power;
  const [x, y, length] = [16, height - 16, metres * scale];
  draw(svg, "path", { class: "scale", d: `M${x} ${y - 5}v5h${length}v-5`, fill: "none" });
  draw(svg, "text", { x: x + length + 8, y }, metres >= 1000 ? `${metres / 1000} km` : `${metres} m`);
  draw(svg, "path", { class: "scale", d: `M${WIDTH - 24} 34v-18m-5 6l5 -7l5 7`, fill: "none" });
  draw(svg, "text", { x: WIDTH - 28, y: 48 }, "N");
}

function drawPlace(svg, place, [x, y]) {
  if (place.heading_deg !== null && place.heading_deg !== undefined) {
    const angle = (place.heading_deg * Math.PI) / 180;
    draw(svg, "line", { class: "tick", x1: x, y1: y, x2: x + 16 * Math.sin(angle), y2: y - 16 * Math.cos(angle) });
  }
  const dot = draw(svg, "circle", { class: `marker ${place.kind || ""}`, cx: x, cy: y, r: 6 });
  draw(dot, "title", {}, place.label);
  if (place.choose) dot.addEventListener("click", place.choose);
}

function drawVehicle(svg, vehicle, [x, y], scale) {
  const [[a, b], [, d]] = vehicle.covariance.slice(0, 2).map((row) => row.slice(0, 2));
  const mean = (a + d) / 2;
  const apart = Math.hypot((a - d) / 2, b);
  const radii = [mean + apart, Math.max(mean - apart, 0)].map((variance) => 2 * Math.sqrt(variance) * scale);
  const angle = (-Math.atan2(2 * b, a - d) * 90) / Math.PI;
  draw(svg, "ellipse", { class: "ellipse", cx: x, cy: y, rx: Math.max(radii[0], 1), ry: Math.max(radii[1], 1), transform: `rotate(${angle} ${x} ${y})` });
  const arrow = draw(svg, "path", { class: "vehicle", d: "M0 -12l8 20l-8 -5l-8 5z", transform: `translate(${x} ${y}) rotate(${vehicle.heading_deg})` });
  draw(arrow, "title", {}, "Vehicle; the ellipse is two standard deviations");
}
