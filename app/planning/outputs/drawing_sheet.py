"""Sheets of drawings: A3 with the frame of ISO 5457 and the title block of ISO 7200."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field, with_config

from app.encoders.pdf import POINTS_PER_MM, Canvas, EmbeddedFont, PdfFile
from app.inputs import INPUT, Text
from app.markers.cerpm import LaneSide
from app.markers.magnet import Polarity
from app.planning.plan import PlannedCerpm, PlannedLineMagnet, PlannedMarker, PlannedPlate, PlannedTag

PAGE_MM = (420.0, 297.0)
"""A3 on its side, trimmed. [mm] Source: ISO 216."""
FRAME_MM = (20.0, 10.0, 410.0, 287.0)
"""Left, bottom, right, top: margins of 20 mm on the left, 10 mm elsewhere. [mm] Source: ISO 5457."""
TITLE_MM = (230.0, 10.0, 410.0, 50.0)
"""The title block in the lower right corner, 180 mm wide. [mm] Source: ISO 7200."""
BLACK, GREY, LIGHT, WHITE = "#111111", "#6b6b6b", "#bdbdbd", "#ffffff"
RED, BLUE, GREEN, ORANGE, PALE_ORANGE = "#c8102e", "#1f4e9e", "#1b7f3b", "#d9730d", "#fbe3cf"
_REGULAR, _BOLD = "Regular", "Bold"
_FIELD_MM = 50.0  # of the grid reference, counted from the middle; source: ISO 5457
_BORDER_MM = 5.0  # of the grid reference; source: ISO 5457
_LABELS_PT, _VALUES_PT = 5.0, 8.0


DOCUMENT_TYPE = "Installation drawing"


@with_config(INPUT)
@dataclass(frozen=True, slots=True)
class TitleBlock:
    """What the title block of a set of drawings states; empty fields are left to be filled in by hand."""

    owner: Annotated[Text, Field(max_length=80, description="Legal owner, as the agency's name.")] = ""
    number: Annotated[Text, Field(max_length=80, description="Identification number of the set, 16 characters.")] = ""
    date: Annotated[Text, Field(max_length=80, description="Date of issue.")] = ""
    creator: Annotated[Text, Field(max_length=80)] = ""
    approver: Annotated[Text, Field(max_length=80)] = ""
    title: Annotated[Text, Field(max_length=80, description="Without, the name of the plan.")] = ""


class SheetSet:
    """Sheets of one file, with common fonts; every sheet has its frame from the start."""

    def __init__(self, block: TitleBlock) -> None:
        self.block = block
        self.fonts = {_REGULAR: EmbeddedFont(), _BOLD: EmbeddedFont(bold=True)}
        self._sheets: list[Sheet] = []

    def add(self) -> Sheet:
        """A new sheet with its frame."""
        sheet = Sheet(self.fonts)
        _draw_frame(sheet)
        self._sheets.append(sheet)
        return sheet

    def to_bytes(self) -> bytes:
        """The file; the same calls always give the same bytes."""
        file = PdfFile(f"{DOCUMENT_TYPE} {self.block.title}")
        fonts = " ".join(f"/{name} {font.add_to(file)} 0 R" for name, font in self.fonts.items())
        resources = file.add(f"<< /Font << {fonts} >> >>".encode())
        for sheet in self._sheets:
            file.add_page({"MediaBox": (0.0, 0.0, *PAGE_MM)}, resources, sheet.canvas.content())
        return file.to_bytes()


class Sheet:
    """One page, in millimetres from its lower left corner."""

    def __init__(self, fonts: dict[str, EmbeddedFont]) -> None:
        self._fonts = fonts
        self.canvas = Canvas(fonts)

    def text(
        self, x: float, y: float, text: str, points: float = 7.0, *, bold: bool = False, anchor: str = "start",
        colour: str = BLACK, width: float | None = None, angle_deg: float = 0.0,
    ) -> None:  # fmt: skip
        """A line of text, made smaller where it is wider than `width`."""
        font = _BOLD if bold else _REGULAR
        if width is not None:
            points = min(points, points * width / max(self._fonts[font].width_mm(text, points), 1e-9))
        self.canvas.text(x, y, text, font=font, points=points, colour=colour, anchor=anchor, angle_deg=angle_deg)

    def width_mm(self, text: str, points: float, *, bold: bool = False) -> float:
        """Width of a text. [mm]"""
        return self._fonts[_BOLD if bold else _REGULAR].width_mm(text, points)

    def lines(
        self, points: Iterable[tuple[float, float]], width: float = 0.2, colour: str = BLACK, dash: Sequence[int] = ()
    ) -> None:
        """An open line through points; the dash pattern is in points of 1/72 inch."""
        self.canvas.lines(points, width_mm=width, colour=colour, dash=dash)

    def rectangle(self, left: float, bottom: float, right: float, top: float, width: float = 0.35) -> None:
        """An outline."""
        corners = [(left, bottom), (right, bottom), (right, top), (left, top)]
        self.canvas.polygon(corners, fill=None, outline=BLACK, width_mm=width)


def _draw_frame(sheet: Sheet) -> None:
    """Frame, grid reference and centring marks (ISO 5457)."""
    left, bottom, right, top = FRAME_MM
    sheet.rectangle(left, bottom, right, top, 0.7)
    sheet.rectangle(left - _BORDER_MM, bottom - _BORDER_MM, right + _BORDER_MM, top + _BORDER_MM, 0.18)
    middle_x, middle_y = PAGE_MM[0] / 2, PAGE_MM[1] / 2
    for x, y, out_x, out_y in (
        (left, middle_y, -1, 0),
        (right, middle_y, 1, 0),
        (middle_x, bottom, 0, -1),
        (middle_x, top, 0, 1),
    ):
        ends = [(x + k * out_x * _BORDER_MM, y + k * out_y * _BORDER_MM) for k in (-1, 1)]
        sheet.lines(ends, 0.7)
    columns, rows = int(PAGE_MM[0] // _FIELD_MM), int(PAGE_MM[1] // _FIELD_MM)
    for k in range(columns):
        x = middle_x + (k - columns / 2) * _FIELD_MM
        middle = (max(x, left) + min(x + _FIELD_MM, right)) / 2
        for y in (bottom - _BORDER_MM, top):
            if k:
                sheet.lines([(x, y), (x, y + _BORDER_MM)], 0.18)
            sheet.text(middle, y + 1.4, str(k + 1), 7, anchor="middle")
    for k in range(rows + 1):
        y = middle_y + ((rows + 1) / 2 - k) * _FIELD_MM
        low, high = max(y - _FIELD_MM, bottom), min(y, top)
        if high - low < _BORDER_MM:
            continue
        for x in (left - _BORDER_MM, right):
            if k and y < top:
                sheet.lines([(x, y), (x + _BORDER_MM, y)], 0.18)
            sheet.text(x + _BORDER_MM / 2, (low + high) / 2 - 1.2, chr(ord("A") + k), 7, anchor="middle")


def draw_title_block(sheet: Sheet, block: TitleBlock, *, subtitle: str, scale: str, number: int, count: int) -> None:
    """The title block with all mandatory fields of ISO 7200."""
    left, bottom, right, top = TITLE_MM
    sheet.canvas.box(left, bottom, right - left, top - bottom, fill=WHITE)
    sheet.rectangle(left, bottom, right, top, 0.7)
    low, high = bottom + 11.0, bottom + 22.0
    for y in (low, high):
        sheet.lines([(left, y), (right, y)], 0.35)
    _field(sheet, left, high, 60.0, "Legal owner", block.owner)
    sheet.lines([(left + 60, high), (left + 60, top)], 0.35)
    sheet.text(left + 61.5, top - 3.0, "Title", _LABELS_PT, colour=GREY)
    sheet.text(left + 61.5, top - 8.5, block.title, 11, bold=True, width=117)
    sheet.text(left + 61.5, top - 14.5, subtitle, 8, width=117)
    for x, width, label, value in (
        (0.0, 60.0, "Document type", DOCUMENT_TYPE),
        (60.0, 40.0, "Creator", block.creator),
        (100.0, 40.0, "Approval person", block.approver),
        (140.0, 40.0, "Date of issue", block.date),
    ):
        _field(sheet, left + x, low, width, label, value)
        sheet.lines([(left + x, low), (left + x, high)], 0.35)
    for x, width, label, value in (
        (0.0, 60.0, "Identification number", block.number),
        (60.0, 80.0, "Scale", scale),
        (140.0, 40.0, "Sheet", f"{number} / {count}"),
    ):
        _field(sheet, left + x, bottom, width, label, value)
        sheet.lines([(left + x, bottom), (left + x, low)], 0.35)


def _field(sheet: Sheet, left: float, bottom: float, width: float, label: str, value: str) -> None:
    top = bottom + (18.0 if label == "Legal owner" else 11.0)
    sheet.text(left + 1.5, top - 3.0, label, _LABELS_PT, colour=GREY)
    sheet.text(left + 1.5, bottom + 2.6, value, _VALUES_PT, bold=label == "Sheet", width=width - 3.0)


def draw_scale_bar(sheet: Sheet, x: float, y: float, scale: int) -> None:
    """A bar of 100 mm in fields of 20 mm, with its lengths on the road; right at any size of print."""
    field_mm = 20.0
    for k in range(5):
        left = x + k * field_mm
        if k % 2 == 0:
            sheet.canvas.box(left, y, field_mm, 1.6, fill=BLACK)
    sheet.rectangle(x, y, x + 5 * field_mm, y + 1.6, 0.18)
    for k in range(6):
        metres = k * field_mm * scale / 1000
        unit = " m" if k == 5 else ""
        sheet.text(x + k * field_mm, y + 2.6, f"{metres:g}{unit}", 6, anchor="middle" if k < 5 else "start")
    sheet.text(x, y - 3.2, f"1 : {scale} on A3; the bar is 100 mm long", 6, colour=GREY)


def draw_north_arrow(sheet: Sheet, x: float, y: float, bearing_deg: float, size: float = 6.0) -> None:
    """An arrow to true north on a drawing whose x axis has a bearing."""
    turn = math.radians(bearing_deg)  # on paper, north lies counter-clockwise of the x axis by the axis's bearing
    cos, sin = math.cos(turn), math.sin(turn)

    def at(along: float, left: float) -> tuple[float, float]:
        return x + along * cos - left * sin, y + along * sin + left * cos

    sheet.canvas.polygon([at(size, 0), at(-size * 0.6, size * 0.35), at(-size * 0.3, 0)], fill=BLACK, outline=BLACK)
    sheet.canvas.polygon([at(size, 0), at(-size * 0.6, -size * 0.35), at(-size * 0.3, 0)], fill=WHITE, outline=BLACK)
    tip = at(size + 2.2, 0)
    sheet.text(tip[0], tip[1] - 7 * 0.36 / POINTS_PER_MM, "N", 7, bold=True, anchor="middle")


# === Symbols of markers on drawings; they differ in shape, so that black and white prints can be read.


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
