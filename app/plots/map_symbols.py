"""Symbols of markers on maps, as the sprite of a MapLibre style: the shape shows the family, the fill the status.

Statuses differ by marks as well as by colours, so that they can be distinguished without colour. The files in
`static/sprites` are made by ``python -m app.plots.map_symbols static/sprites``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import orjson

Image = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]
SIZE_PX = 22
"""Side of a symbol at a pixel ratio of 1. [px]"""
_FINER = 8  # drawn so many times larger, then averaged
_RADIUS = 7.5
_HALO: Colour = (255, 255, 255)
_DARK: Colour = (38, 50, 56)
_WHITE: Colour = (255, 255, 255)


class Look(NamedTuple):
    """Fill and outline, in RGB, and the mark on the fill."""

    fill: Colour
    outline: Colour
    mark: str = ""


LOOKS = {
    "planned": Look(_WHITE, _DARK),
    "built": Look((127, 200, 248), _DARK, "half"),
    "surveyed": Look((31, 120, 180), _DARK, "dot"),
    "active": Look((27, 158, 87), _DARK),
    "suspect": Look((240, 162, 2), _DARK, "warning"),
    "retired": Look((200, 204, 208), (110, 118, 125), "cross"),
    "draft": Look(_WHITE, (140, 148, 155)),
    "checked": Look(_WHITE, (31, 120, 180), "dot"),
    "approved": Look((166, 219, 160), (20, 90, 50), "half"),
    "rejected": Look(_WHITE, (140, 148, 155), "cross"),
}
"""By name. The colours are Okabe and Ito's or darker than these, for readers who see red and green alike."""
SHAPES = {
    "plate": [(-1, -1), (1, -1), (1, 1), (-1, 1)],
    "magnet": [(1.12 * np.cos(a), 1.12 * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 64, endpoint=False)],
    "cerpm": [(0, -1.25), (1.25, 0.95), (-1.25, 0.95)],
    "fiducial": [(0, -1.4), (1.4, 0), (0, 1.4), (-1.4, 0)],
    "other": [
        (0.45, -1.2),
        (1.2, -0.45),
        (1.2, 0.45),
        (0.45, 1.2),
        (-0.45, 1.2),
        (-1.2, 0.45),
        (-1.2, -0.45),
        (-0.45, -1.2),
    ],
}
"""Outlines by the name of the family, in radii, x to the right and y down; `other` is for features of no family."""


def symbol_name(family: str, look: str) -> str:
    """Name of a symbol in the sprite; that of `other` for families without a shape."""
    return f"{family if family in SHAPES else 'other'}-{look}"


def sprite(pixel_ratio: int) -> tuple[Image, dict[str, dict[str, int]]]:
    """All symbols on one picture, RGBA, and where each one is.

    Parameters
    ----------
    pixel_ratio : int
        Pixels of the picture for a pixel of the map.
    """
    side = SIZE_PX * pixel_ratio
    picture = np.zeros((side * len(SHAPES), side * len(LOOKS), 4), dtype=np.uint8)
    places = {}
    for row, family in enumerate(SHAPES):
        for column, look in enumerate(LOOKS):
            y, x = row * side, column * side
            picture[y : y + side, x : x + side] = _symbol(family, LOOKS[look], pixel_ratio)
            name = symbol_name(family, look)
            places[name] = {"x": x, "y": y, "width": side, "height": side, "pixelRatio": pixel_ratio}
    return picture, places


def _symbol(family: str, look: Look, pixel_ratio: int) -> Image:
    """One symbol: a white halo, the outline, the fill, the mark."""
    scale = _FINER * pixel_ratio
    side = SIZE_PX * scale
    outline = np.array(SHAPES[family]) * _RADIUS * scale * 0.9 + side / 2
    colours = np.zeros((side, side, 3), dtype=np.uint8)
    opaque = np.zeros((side, side), dtype=np.uint8)
    points = [np.rint(outline).astype(np.int32)]
    cv2.polylines(opaque, points, True, 255, round(4.4 * scale), cv2.LINE_8)
    cv2.fillPoly(opaque, points, 255)
    colours[:] = _HALO
    cv2.polylines(colours, points, True, look.outline, round(2.4 * scale), cv2.LINE_8)
    cv2.fillPoly(colours, points, look.fill)
    _mark(colours, look, scale)
    cv2.polylines(colours, points, True, look.outline, round(1.6 * scale), cv2.LINE_8)
    weights = opaque.astype(np.float32) / 255
    shape = (SIZE_PX * pixel_ratio,) * 2
    alpha = cv2.resize(weights, shape, interpolation=cv2.INTER_AREA)
    premultiplied = cv2.resize(colours * weights[..., None], shape, interpolation=cv2.INTER_AREA)
    plain = premultiplied / np.maximum(alpha, 1e-6)[..., None]
    return np.rint(np.dstack([plain, alpha * 255])).clip(0, 255).astype(np.uint8)


def _mark(colours: Image, look: Look, scale: int) -> None:
    middle = SIZE_PX * scale / 2

    def at(x: float, y: float) -> tuple[int, int]:
        return round(middle + x * scale), round(middle + y * scale)

    match look.mark:
        case "half":
            colours[: round(middle)][(colours[: round(middle)] == look.fill).all(axis=2)] = _WHITE
        case "dot":
            cv2.circle(colours, at(0, 0), round(2.4 * scale), _WHITE if look.fill != _WHITE else look.outline, -1)
        case "cross":
            for sign in (1, -1):
                cv2.line(colours, at(-3, -3 * sign), at(3, 3 * sign), look.outline, round(1.8 * scale))
        case "warning":
            cv2.line(colours, at(0, -4), at(0, 0.8), _DARK, round(2 * scale))
            cv2.circle(colours, at(0, 4), round(1.2 * scale), _DARK, -1)


def write_sprites(folder: Path) -> None:
    """Write the sprite at both pixel ratios that browsers ask for."""
    for pixel_ratio, suffix in ((1, ""), (2, "@2x")):
        picture, places = sprite(pixel_ratio)
        encoded = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA), [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]
        (folder / f"markers{suffix}.png").write_bytes(encoded.tobytes())
        (folder / f"markers{suffix}.json").write_bytes(orjson.dumps(places, option=orjson.OPT_INDENT_2) + b"\n")


if __name__ == "__main__":
    write_sprites(Path(sys.argv[1]))
