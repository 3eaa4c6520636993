// Symbols of markers: the outline shows the family, what is inside shows the status. Lists draw them as SVG, the map as
// pictures that are made from the same paths.

export const FAMILIES = ["plate", "magnet", "cerpm", "fiducial"];
export const STATUSES = ["planned", "built", "surveyed", "active", "suspect", "retired"];

const OUTLINES = /** @type {Record<string, string>} */ ({
  plate: "M4 4h16v16h-16z",
  magnet: "M12 3a9 9 0 1 0 0 18a9 9 0 1 0 0-18z",
  cerpm: "M12 2.5L22 20.5h-20z",
  fiducial: "M12 1.5L22.5 12L12 22.5L1.5 12z",
});
const LOWER_HALVES = /** @type {Record<string, string>} */ ({
  plate: "M4 12h16v8h-16z",
  magnet: "M3 12a9 9 0 0 0 18 0z",
  cerpm: "M6.7 12h10.6L22 20.5h-20z",
  fiducial: "M1.5 12h21L12 22.5z",
});
const DOT = "M12 9.5a3.5 3.5 0 1 0 0 7a3.5 3.5 0 1 0 0-7z";
const EXCLAMATION = "M10.8 7h2.4l-.5 7h-1.4zM10.8 15.5h2.4v2.4h-2.4z";
const CROSS = "M8 9.4l1.4-1.4l2.6 2.6l2.6-2.6l1.4 1.4l-2.6 2.6l2.6 2.6l-1.4 1.4l-2.6-2.6l-2.6 2.6l-1.4-1.4l2.6-2.6z";

/**
 * The parts of a symbol, from the lowest up, in a square of 24.
 *
 * @param {string} family
 * @param {string} status
 * @returns {{ kind: "ground" | "fill" | "mark" | "line", d: string }[]}
 */
export function symbolPaths(family, status) {
  const outline = OUTLINES[family] ?? "M12 3a9 9 0 1 0 0 18a9 9 0 1 0 0-18z";
  /** @type {{ kind: "ground" | "fill" | "mark" | "line", d: string }[]} */
  const parts = [{ kind: "ground", d: outline }];
  if (status === "built") parts.push({ kind: "fill", d: LOWER_HALVES[family] ?? outline });
  if (status === "surveyed") parts.push({ kind: "fill", d: DOT });
  if (status === "active") parts.push({ kind: "fill", d: outline });
  if (status === "suspect") parts.push({ kind: "fill", d: outline }, { kind: "mark", d: EXCLAMATION });
  if (status === "retired") parts.push({ kind: "fill", d: CROSS });
  parts.push({ kind: "line", d: outline });
  return parts;
}

/**
 * The colours of the page's style that the map needs.
 *
 * @returns {Record<"ground" | "card" | "text" | "soft" | "line" | "accent" | "warn" | "retired" | "road" | "chosen", string>}
 */
export function pageColours() {
  const style = getComputedStyle(document.documentElement);
  /** @param {string} name */
  const value = (name) => style.getPropertyValue(`--${name}`).trim();
  return {
    ground: value("map-ground"), card: value("card"), text: value("text"), soft: value("soft"), line: value("line"),
    accent: value("accent"), warn: value("warn"), retired: value("retired"), road: value("map-road"), chosen: value("chosen"),
  };
}

/**
 * A symbol as a picture for the map.
 *
 * @param {string} family
 * @param {string} status
 * @param {ReturnType<typeof pageColours>} colours
 */
export function symbolPicture(family, status, colours) {
  const scale = 2;
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 24 * scale;
  const pen = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  pen.scale(scale, scale);
  const colour = status === "suspect" ? colours.warn : status === "retired" ? colours.retired : colours.accent;
  for (const { kind, d } of symbolPaths(family, status)) {
    const path = new Path2D(d);
    if (kind === "line") {
      pen.lineWidth = 2;
      pen.lineJoin = "round";
      pen.strokeStyle = colour;
      pen.stroke(path);
    } else {
      pen.fillStyle = kind === "fill" ? colour : colours.card;
      pen.fill(path);
    }
  }
  return pen.getImageData(0, 0, canvas.width, canvas.height);
}
