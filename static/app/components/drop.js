// A place to drop files on, with a field to choose them in.

import { html } from "htm/preact";
import { useState } from "preact/hooks";

/** @param {{ onFiles: (files: File[]) => void, children?: any }} props `children`: the field and its label. */
export function DropArea({ onFiles, children }) {
  const [over, setOver] = useState(false);
  const drag = (/** @type {boolean} */ on) => (/** @type {DragEvent} */ event) => {
    event.preventDefault();
    setOver(on);
  };
  return html`
    <div class=${over ? "drop over" : "drop"} onDragEnter=${drag(true)} onDragOver=${drag(true)} onDragLeave=${drag(false)}
      onDrop=${(/** @type {DragEvent} */ event) => {
        drag(false)(event);
        onFiles([...(event.dataTransfer?.files ?? [])]);
      }}>${children}</div>
  `;
}
