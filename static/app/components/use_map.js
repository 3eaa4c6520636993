// A map for as long as a component is shown.

import { useEffect, useRef, useState } from "preact/hooks";

import { createMap } from "../map/create.js";

/**
 * The map is made in the element of `box` when the component is shown, and removed with it.
 *
 * @param {() => import("../map/create.js").View | null | Promise<import("../map/create.js").View | null>} view Where to look first.
 * @param {(map: import("maplibre-gl").Map) => void} prepare Adds layers and listeners, once.
 * @param {string} [title] What people hear who do not see it.
 */
export function useMap(view, prepare, title) {
  const box = useRef(/** @type {HTMLDivElement | null} */ (null));
  const [ready, setReady] = useState(/** @type {Awaited<ReturnType<typeof createMap>> | null} */ (null));
  const [failed, setFailed] = useState("");
  useEffect(() => {
    let removed = false;
    /** @type {import("maplibre-gl").Map | null} */
    let made = null;
    const start = async () => {
      if (!box.current) return;
      const found = await createMap(box.current, await view(), title);
      made = found.map;
      if (removed) {
        made.remove();
        return;
      }
      prepare(made);
      setReady(found);
    };
    start().catch((error) => setFailed(String(error?.message ?? error)));
    return () => {
      removed = true;
      made?.remove();
    };
  }, []);
  return { box, ready, failed };
}
