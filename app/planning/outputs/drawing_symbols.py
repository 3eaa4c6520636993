"""Symbols of markers on drawings; they differ in shape, so that black and white prints can be read."""

from __future__ import annotations

import numpy as np

from app.markers.cerpm import LaneSide
from app.markers.magnet import Polarity
from app.planning.outputs.drawing_sheet import BLACK, BLUE, GREEN, RED, WHITE, Sheet
from app.planning.plan import PlannedCerpm, PlannedLineMagnet, PlannedMarker, PlannedPlate, PlannedTag


def draw_symbol(sheet: Sheet, x: float, y: float, marker: PlannedMarker, turned_deg: float) -> None:
    """Symbol of a plate, a line magnet or a CERPM; a plate is turned clockwise from the x axis."""
    match marker.detail:
        case PlannedPlate():
            draw_plate(sheet, x, y, turned_deg)
        case PlannedLineMagnet():
            draw_magnet(sheet, x, y, marker.detail.tag.polarity, BLACK)
        case PlannedCerpm():
            draw_cerpm(sheet, x, y, marker.detail.side)
        case PlannedTag():
            sheet.lines([(x - 2.5, y), (x + 2.5, y)], 0.9, RED)


def draw_plate(sheet: Sheet, x: float, y: float, turned_deg: float, size: float = 1.2) -> None:
    """A square with a pointer in the direction of travel."""
    angle = np.radians(-turned_deg)
    cos, sin = float(np.cos(angle)), float(np.sin(angle))

    def at(along: float, left: float) -> tuple[float, float]:
        return x + along * cos - left * sin, y + along * sin + left * cos

    corners = [at(size, size), at(size, -size), at(-size, -size), at(-size, size)]
    sheet.canvas.polygon(corners, fill=BLUE, outline=BLUE, width_mm=0.1)
    pointer = [at(size * 0.7, 0), at(-size * 0.5, size * 0.55), at(-size * 0.5, -size * 0.55)]
    sheet.canvas.polygon(pointer, fill=WHITE, outline=None)


def draw_magnet(sheet: Sheet, x: float, y: float, polarity: Polarity, colour: str) -> None:
    """A disc: full for N, open for S."""
    fill = colour if polarity is Polarity.N else WHITE
    sheet.canvas.circle(x, y, 0.55, fill=fill, outline=colour, width_mm=0.2)


def draw_cerpm(sheet: Sheet, x: float, y: float, side: LaneSide, size: float = 1.0) -> None:
    """A diamond; open where the boundary belongs to lanes of both directions."""
    corners = [(x + size, y), (x, y + size), (x - size, y), (x, y - size)]
    fill = WHITE if side is LaneSide.UNKNOWN else GREEN
    sheet.canvas.polygon(corners, fill=fill, outline=GREEN, width_mm=0.25)
