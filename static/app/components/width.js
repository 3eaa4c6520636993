// The width of an element, for drawings whose letters keep their size.

import { useEffect, useRef, useState } from "preact/hooks";

/**
 * @param {number} start Before it is measured. [px]
 * @returns {[import("preact").RefObject<HTMLDivElement | null>, number]} The reference of the element, and its width. [px]
 */
export function useWidth(start) {
  const box = useRef(/** @type {HTMLDivElement | null} */ (null));
  const [width, setWidth] = useState(start);
  useEffect(() => {
    if (!box.current) return undefined;
    const observer = new ResizeObserver(([entry]) => entry && entry.contentRect.width > 0 && setWidth(Math.round(entry.contentRect.width)));
    observer.observe(box.current);
    return () => observer.disconnect();
  }, []);
  return [box, width];
}
