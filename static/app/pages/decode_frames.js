// The frame at the timeline's time, with corners, grid, bits and confidence of what was read in it.

import { html } from "htm/preact";
import { useEffect, useRef, useState } from "preact/hooks";

import { Problem, request } from "../api/client.js";
import { Empty } from "../components/load.js";
import { ProblemBox } from "../components/problem.js";
import { number } from "../format.js";
import { t } from "../texts/index.js";
import { drawReading, viewOf } from "./decode_overlay.js";

const KEPT = 40; // pictures in memory
const LAYERS = /** @type {const} */ (["outlines", "grid", "bits", "labels"]);

/** @typedef {{ x: number, y: number, width: number, height: number }} View */

/**
 * @param {{ source: import("./decode_timeline.js").Source, timeline: import("./decode_timeline.js").Timeline, chosen: any, onChoose: (reading: any) => void, onImage: (image: HTMLImageElement) => void }} props
 */
export function Frames({ source, timeline, chosen, onChoose, onImage }) {
  const frame = frameAt(source, timeline.cursor.value);
  const pictures = usePictures();
  const [image, setImage] = useState(/** @type {HTMLImageElement | null} */ (null));
  const [error, setError] = useState(/** @type {unknown} */ (null));
  const [layers, setLayers] = useState(new Set(["outlines", "grid", "bits", "labels"]));
  const [view, setView] = useState(/** @type {View | null} */ (null));
  const number_ = frame?.frame;
  useEffect(() => {
    if (number_ === undefined) return undefined;
    let stopped = false;
    setError(null);
    pictures(`${source.decode.links.self}/annotated.jpg?frame=${number_}&outlines=false`).then((found) => {
      if (stopped) return;
      setImage(found);
      onImage(found);
    }, (problem) => stopped || setError(problem));
    return () => {
      stopped = true;
    };
  }, [number_, source.decode.id]);
  const readings = frame ? source.decode.readings.filter((/** @type {any} */ reading) => reading.frame === frame.frame) : [];
  useEffect(() => {
    setView(chosen && chosen.frame === number_ && image ? viewOf(chosen.corners_px, image) : null);
  }, [chosen, image, number_]);
  if (!frame) return html`<${Empty} title=${t(source.decode.kind === "video" ? "decode.no_frames_video" : "decode.no_frames")} />`;
  const caption = [
    frame.name ?? t("decode.frame_number", { number: number(frame.frame) }), frame.width_px && `${frame.width_px} × ${frame.height_px} px`,
    readings.length ? t("decode.count_readings", { count: readings.length }) : t("decode.no_plate"),
  ].filter(Boolean).join(" · ");
  const toggle = (/** @type {string} */ name) => setLayers((old) => new Set(old.has(name) ? [...old].filter((layer) => layer !== name) : [...old, name]));
  return html`
    <figure class="decode-picture">
      <div class="frame-tools">
        ${LAYERS.map((name) => html`<button type="button" class="quiet" aria-pressed=${layers.has(name)} onClick=${() => toggle(name)}>${t(`decode.layer_${name}`)}</button>`)}
        <span class="spacer"></span>
        <button type="button" class="quiet" disabled=${!view} onClick=${() => setView(null)}>${t("decode.whole_frame")}</button>
      </div>
      <${ProblemBox} error=${error} />
      <${FrameCanvas} image=${image} readings=${readings} layers=${layers} view=${view} chosen=${chosen} onChoose=${onChoose}
        label=${t("decode.frame_alt", { text: caption })} />
      <figcaption>${caption}</figcaption>
    </figure>
  `;
}

/** The frame at a time: the last one that was taken, among those that could be read. @param {import("./decode_timeline.js").Source} source @param {number} at */
export function frameAt({ frames, shift }, at) {
  let best = frames[0];
  for (const entry of frames) {
    if (!Number.isFinite(entry.at)) continue;
    if (Math.abs(entry.at + shift - at) < Math.abs((best?.at ?? Infinity) + shift - at) || !Number.isFinite(best?.at)) best = entry;
  }
  return best?.frame;
}

/** Pictures by their paths; the last ones are kept. @returns {(path: string) => Promise<HTMLImageElement>} */
function usePictures() {
  const kept = useRef(/** @type {Map<string, Promise<HTMLImageElement>>} */ (new Map()));
  useEffect(() => () => {
    for (const loading of kept.current.values()) loading.then((image) => URL.revokeObjectURL(image.src), () => {});
  }, []);
  return (path) => {
    const known = kept.current.get(path);
    if (known) return known;
    const loading = request(path).then(async (response) => {
      const image = new Image();
      image.src = URL.createObjectURL(await response.blob());
      await image.decode().catch(() => {
        throw new Problem({ title: t("decode.no_picture") });
      });
      return image;
    });
    loading.catch(() => kept.current.delete(path));
    kept.current.set(path, loading);
    if (kept.current.size > KEPT) {
      const [oldest] = kept.current.keys();
      kept.current.get(oldest ?? "")?.then((image) => URL.revokeObjectURL(image.src), () => {});
      kept.current.delete(oldest ?? "");
    }
    return loading;
  };
}

/**
 * @param {{ image: HTMLImageElement | null, readings: any[], layers: Set<string>, view: View | null, chosen: any, label: string, onChoose: (reading: any) => void }} props
 */
function FrameCanvas({ image, readings, layers, view, chosen, label, onChoose }) {
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  const whole = image ? { x: 0, y: 0, width: image.naturalWidth, height: image.naturalHeight } : null;
  const shown = view ?? whole;
  const scale = image && shown ? image.naturalWidth / shown.width : 1;
  useEffect(() => {
    const pen = canvas.current?.getContext("2d");
    if (!canvas.current || !pen || !image || !shown) return;
    canvas.current.width = image.naturalWidth;
    canvas.current.height = image.naturalHeight;
    pen.imageSmoothingEnabled = scale < 4;
    pen.drawImage(image, shown.x, shown.y, shown.width, shown.height, 0, 0, canvas.current.width, canvas.current.height);
    const place = (/** @type {number[]} */ [x = 0, y = 0]) => [(x + 0.5 - shown.x) * scale, (y + 0.5 - shown.y) * scale];
    for (const reading of readings) drawReading(pen, reading, place, layers, reading === chosen, image.naturalWidth / 1200);
    canvas.current.dataset.drawn = `${readings.length}`;
  }, [image, readings, layers, view, chosen]);
  const click = (/** @type {MouseEvent} */ event) => {
    if (!canvas.current || !shown) return;
    const box = canvas.current.getBoundingClientRect();
    const [x, y] = [shown.x + ((event.clientX - box.left) / box.width) * shown.width, shown.y + ((event.clientY - box.top) / box.height) * shown.height];
    const found = readings.find(({ corners_px }) => corners_px?.length && inside(corners_px, x, y));
    if (found) onChoose(found);
  };
  return html`<canvas class="frame-canvas" ref=${canvas} width="960" height="540" role="img" aria-label=${label} onClick=${click}></canvas>`;
}

/** @param {number[][]} corners @param {number} x @param {number} y */
function inside(corners, x, y) {
  const [xs, ys] = [corners.map(([u = 0]) => u), corners.map(([, v = 0]) => v)];
  return x >= Math.min(...xs) && x <= Math.max(...xs) && y >= Math.min(...ys) && y <= Math.max(...ys);
}
