"""Drawing to SVG in millimetres: width and height in mm, a viewBox in mm, a named group for each layer."""

from __future__ import annotations

from functools import lru_cache
from xml.sax.saxutils import escape

import numpy as np

from app.encoders.plate.colours import INKS
from app.encoders.plate.drawing import (
    FACE_LAYERS,
    SHEET_LAYERS,
    UNDER_LAYERS,
    Boxes,
    Drawing,
    Modules,
    Part,
    Shape,
    Stroke,
)
from app.encoders.plate.lettering import origin_mm, scale_mm, svg_run

_ORDER = (*UNDER_LAYERS, *FACE_LAYERS, *SHEET_LAYERS)


def write_svg(drawing: Drawing) -> bytes:
    """Write a drawing as SVG 1.1.

    Parameters
    ----------
    drawing : Drawing

    Returns
    -------
    bytes
        UTF-8. Each layer is a group (an Inkscape layer) whose id is the layer's name; all filled shapes of a layer are
        one path, lines and texts are paths of their own. Text is outlined. Heaters and light sources come first and
        lie under the opaque face. The same drawing always gives the same bytes.
    """
    width, height = f"{drawing.width_mm:.7g}", f"{drawing.height_mm:.7g}"
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape" '
        f'version="1.1" width="{width}mm" height="{height}mm" viewBox="0 0 {width} {height}">',
        f"<title>{escape(drawing.title)}</title>",
        f'<rect id="SHEET" width="{width}" height="{height}" fill="#ffffff"/>',
    ]
    by_layer = drawing.by_layer()
    for layer in _ORDER:
        parts = by_layer.get(layer)
        if not parts:
            continue
        areas = "".join(_area(p, drawing.height_mm) for p in parts if isinstance(p, (Boxes, Shape)))
        lines.append(
            f'<g id="{layer}" inkscape:groupmode="layer" inkscape:label="{layer}" fill="{INKS[layer].hex}" '
            f'stroke="none">'
        )
        if areas:
            lines.append(f'<path d="{areas}"/>')
        lines += [_line(p, drawing.height_mm) for p in parts if not isinstance(p, (Boxes, Shape))]
        lines.append("</g>")
    lines.append("</svg>\n")
    return "\n".join(lines).encode()


@lru_cache(maxsize=1024)
def _area(part: Boxes | Shape, sheet_height_mm: float) -> str:
    """Path data of filled shapes, y down."""
    if isinstance(part, Boxes):
        left, bottom, right, top = part.boxes_mm.T
        values = np.stack([left, sheet_height_mm - top, right, sheet_height_mm - bottom, left], axis=1)
        return "M%.7g %.7gH%.7gV%.7gH%.7gZ" * len(values) % tuple(values.ravel().tolist())
    return "M" + _points(part.points_mm, sheet_height_mm) + "Z"


@lru_cache(maxsize=1024)
def _line(part: Part, sheet_height_mm: float) -> str:
    """Element of a line or a text, y down."""
    if isinstance(part, Stroke):
        data = "M" + _points(part.points_mm, sheet_height_mm) + ("Z" if part.closed else "")
        return f'<path d="{data}" fill="none" stroke="{INKS[part.layer].hex}" stroke-width="{part.width_mm:.7g}"/>'
    if isinstance(part, Modules):
        place = (
            f"matrix({part.module_mm:.7g} 0 0 {part.module_mm:.7g} {part.x_mm:.7g} {sheet_height_mm - part.y_mm:.7g})"
        )
        return f'<path transform="{place}" d="{"".join([_run(*run) for run in part.runs])}"/>'
    if isinstance(part, (Boxes, Shape)):
        raise TypeError("areas are joined into one path")
    x, y = origin_mm(part)
    scale = f"{scale_mm(part):.6g}"
    place = f"matrix({scale} 0 0 -{scale} {x:.7g} {sheet_height_mm - y:.7g})"
    return f'<path transform="{place}" d="{svg_run(part.text)}"/>'


@lru_cache(maxsize=1 << 16)
def _run(row: int, start: int, count: int) -> str:
    return f"M{start} {row}h{count}v1h-{count}z"


def _points(points: np.ndarray[tuple[int, ...], np.dtype[np.float64]], sheet_height_mm: float) -> str:
    values = points * np.array([1.0, -1.0]) + np.array([0.0, sheet_height_mm])
    return "L".join(["%.7g %.7g"] * len(values)) % tuple(values.ravel().tolist())
