"""Sheets for the crew as files, of holes to drill or shells to glue onto the road: CSV, GeoJSON and PDF."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from itertools import pairwise

import orjson

from app.encoders.magnet.layout import CostRow, DrillingSheet, Hole, SheetFormat, UnpricedRow
from app.encoders.pdf import POINTS_PER_MM, Canvas, EmbeddedFont, PdfFile
from app.formats.text import TableWriter
from app.markers.magnet import InformationTag, Orientation, Polarity
from app.values import JsonObject

# === Sheet -> CSV: one row a magnet.


COLUMNS = (
    "layout", "code", "meaning", "hole", "chainage_m", "offset_m", "from_first_m", "from_previous_m", "lon_deg",
    "lat_deg", "east_m", "north_m", "polarity", "phi_deg", "north_pole", "north_pole_bearing_deg", "mounting",
    "depth_m", "height_mm",
)  # fmt: skip


def write_sheet_csv(sheet: DrillingSheet) -> bytes:
    """Write the magnets as rows in UTF-8, with a header.

    Positions are WGS 84 to 0.1 mm; east and north are from the line's first point; from_first_m is along the tag or
    the line, from_previous_m straight; depth_m is that of a magnet's centre below the road, negative above it; and
    height_mm that of a shell. Texts that a spreadsheet would take for a formula begin with an apostrophe.
    """
    layout = sheet.layout
    meaning = layout.meaning.text if layout.meaning else ""
    fixing = layout.installation
    stream = io.StringIO()
    writer = TableWriter(stream)
    writer.write_row(COLUMNS)
    for hole, gap_m in zip(layout.holes, [0.0, *layout.gaps_m], strict=True):
        bearing = hole.north_pole_bearing_deg
        writer.write_row(
            [
                *(layout.name, layout.tag.text, meaning),
                hole.number,
                *(fixed(v, 4) for v in (hole.chainage_m, hole.offset_m, hole.along_m, gap_m)),
                *(fixed(v, 9) for v in (hole.lon_deg, hole.lat_deg)),
                *(fixed(v, 4) for v in (hole.east_m, hole.north_m)),
                hole.polarity.value,
                hole.orientation.phi_deg,
                hole.north_pole,
                "" if bearing is None else fixed(bearing % 360.0, 3),
                fixing.mounting.value,
                fixed(fixing.depth_m, 4),
                f"{fixing.height_mm:g}",
            ]
        )
    return stream.getvalue().encode()


def fixed(value: float, decimals: int) -> str:
    """A number with so many decimals, without a negative zero."""
    text = f"{value:.{decimals}f}"
    return text[1:] if float(text) == 0 and text.startswith("-") else text


# === Sheet -> GeoJSON (RFC 7946).


_DECIMALS = 9


def write_sheet_geojson(sheet: DrillingSheet) -> bytes:
    """Write the magnets as points, with the layout, its checks and its bill as a foreign member.

    Positions are WGS 84, longitude first, to 0.1 mm.
    """
    return orjson.dumps(sheet_document(sheet), option=orjson.OPT_INDENT_2)


def sheet_document(sheet: DrillingSheet) -> JsonObject:
    """The same as plain values."""
    layout = sheet.layout
    features = [
        {
            "type": "Feature",
            "id": hole.number,
            "geometry": {
                "type": "Point",
                "coordinates": [round(hole.lon_deg, _DECIMALS), round(hole.lat_deg, _DECIMALS)],
            },
            "properties": {
                "layout": layout.name,
                "code": layout.tag.text,
                "hole": hole.number,
                "chainage_m": round(hole.chainage_m, 4),
                "offset_m": round(hole.offset_m, 4),
                "from_first_m": round(hole.along_m, 4),
                "east_m": round(hole.east_m, 4),
                "north_m": round(hole.north_m, 4),
                "polarity": hole.polarity.value,
                "phi_deg": hole.orientation.phi_deg,
                "north_pole": hole.north_pole,
                "north_pole_bearing_deg": _rounded(hole.north_pole_bearing_deg),
                "depth_m": round(layout.installation.depth_m, 4),
            },
        }
        for hole in layout.holes
    ]
    return {"type": "FeatureCollection", "features": features, "waymark": _summary(sheet)}


def _summary(sheet: DrillingSheet) -> dict[str, object]:
    layout, bill = sheet.layout, sheet.bill
    meaning = layout.meaning
    lon_deg, lat_deg, height_m = layout.lane.origin
    return {
        "layout": layout.name,
        "code": layout.tag.text,
        "kind": "information-tag" if isinstance(layout.tag, InformationTag) else "line",
        "meaning": None if meaning is None else {"kind": meaning.kind.value, "value": meaning.value},
        "bearing_deg": _rounded(layout.bearing_deg),
        "length_m": round(layout.length_m, 4),
        "installation": layout.installation,
        "height_mm": layout.installation.height_mm,
        "origin": {"lon_deg": lon_deg, "lat_deg": lat_deg, "height_m": height_m},
        "passed": sheet.passed,
        "checks": list(sheet.checks),
        "bill": {
            part: [
                {
                    "item": row.cost.item,
                    "quantity": row.quantity,
                    "unit": row.cost.unit,
                    "low_usd": row.low_usd,
                    "high_usd": row.high_usd,
                    "source": row.cost.source,
                }
                for row in rows
            ]
            for part, rows in (("materials", bill.materials), ("alternatives", bill.alternatives))
        }
        | {"without_price": [asdict(row) for row in bill.without_price]},
    }


def _rounded(degrees: float | None) -> float | None:
    """A bearing below 360 also after rounding. [deg]"""
    return None if degrees is None else math.fmod(round(degrees, 3), 360.0)


# === Sheets to PDF: the plan to scale with every pole drawn, the table of magnets, the checks and the bill.
#
# A4 on its side. Magnets are drawn larger than they are; the thin cross line through each is its place.


PAGE_MM = (297.0, 210.0)
PLAN_MM = 250.0
SCALES = (5, 10, 20, 25, 50, 100, 125)
LINE_SCALE = 200
HOLE_LINE_MM = 0.11
"""Width of the cross lines that mark places; nothing else on the sheet is so thin."""

_LEFT_MM, _RIGHT_MM, _BOTTOM_MM = 15.0, 282.0, 16.0
_PLAN_LEFT_MM = 23.5
_REGULAR, _BOLD = "Regular", "Bold"
_BLACK, _GREY, _RED, _BLUE, _PALE, _WHITE = "#111111", "#777777", "#c8102e", "#1f4e9e", "#f0f0f0", "#ffffff"
_THIN_MM = 0.2
_NOTES = (
    "Positions are WGS 84; distances are level, at the road's height. Bearings are clockwise from true north.",
    "Before gluing, hold a compass to each magnet: the pole marked N pushes the needle's north end away. "
    "Set each within 3 mm of its place.",
)
_SURFACE_NOTE = (
    "Nothing is drilled. Clean and dry the road, and press each shell with its magnet into a bed of epoxy. "
    "No traffic until it is hard: shells moved by up to 3 mm in the first 24 h, not after (METRO section 8.2)."
)

_HOLE_COLUMNS: tuple[tuple[str, float, Callable[[Hole, float], str]], ...] = (
    ("magnet", 26.0, lambda hole, gap: str(hole.number)),
    ("from first [m]", 50.0, lambda hole, gap: fixed(hole.along_m, 3)),
    ("from previous [m]", 78.0, lambda hole, gap: fixed(gap, 3) if hole.number > 1 else "-"),
    ("chainage [m]", 100.0, lambda hole, gap: fixed(hole.chainage_m, 3)),
    ("offset [m]", 118.0, lambda hole, gap: fixed(hole.offset_m, 3)),
    ("longitude [deg]", 148.0, lambda hole, gap: fixed(hole.lon_deg, 9)),
    ("latitude [deg]", 177.0, lambda hole, gap: fixed(hole.lat_deg, 9)),
    ("east [m]", 199.0, lambda hole, gap: fixed(hole.east_m, 3)),
    ("north [m]", 221.0, lambda hole, gap: fixed(hole.north_m, 3)),
    ("north pole", 246.0, lambda hole, gap: f"{hole.polarity}: {hole.north_pole}"),
    ("bearing [deg]", 272.0, lambda hole, gap: _bearing(hole.north_pole_bearing_deg)),
)
"""Title, right edge [mm] and cell of each column."""


def write_sheet_pdf(sheet: DrillingSheet) -> bytes:
    """Write a sheet: what to drill, or what to glue onto the road.

    Returns
    -------
    bytes
        PDF with embedded fonts. The same sheet always gives the same bytes.
    """
    paper = _Paper(sheet)
    _draw_plan(paper, sheet)
    _draw_holes(paper, sheet)
    _draw_checks(paper, sheet)
    _draw_bill(paper, sheet)
    return paper.to_bytes()


def plan_scale(sheet: DrillingSheet) -> int:
    """Denominator of the plan's scale: 1 to so many."""
    if not isinstance(sheet.layout.tag, InformationTag):
        return LINE_SCALE
    return next(scale for scale in SCALES if sheet.layout.length_m * 1000 / scale <= PLAN_MM)


class _Paper:
    """Pages in millimetres from the lower left corner, with a cursor `y_mm` that moves down."""

    def __init__(self, sheet: DrillingSheet) -> None:
        self._sheet = sheet
        self._fonts = {_REGULAR: EmbeddedFont(), _BOLD: EmbeddedFont(bold=True)}
        self._pages: list[Canvas] = []
        self._begin()

    @property
    def _title(self) -> str:
        return "Surface mounting sheet" if self._sheet.layout.installation.on_surface else "Drilling sheet"

    @property
    def canvas(self) -> Canvas:
        """The page that is drawn."""
        return self._pages[-1]

    def to_bytes(self) -> bytes:
        """The file; every page gets its number and the number of pages."""
        for number, page in enumerate(self._pages, start=1):
            footer = f"Waymark {self._title.lower()}, page {number} of {len(self._pages)}"
            page.text(_RIGHT_MM, 7, footer, font=_REGULAR, points=6.5, colour=_GREY, anchor="end")
        file = PdfFile(f"{self._title} {self._sheet.layout.name}")
        fonts = " ".join(f"/{name} {font.add_to(file)} 0 R" for name, font in self._fonts.items())
        resources = file.add(f"<< /Font << {fonts} >> >>".encode())
        for page in self._pages:
            file.add_page({"MediaBox": (0.0, 0.0, *PAGE_MM)}, resources, page.content())
        return file.to_bytes()

    def need(self, height_mm: float) -> bool:
        """Turn the page unless so much room is left; whether it was turned."""
        if self.y_mm - height_mm >= _BOTTOM_MM:
            return False
        self._begin()
        return True

    def text(
        self, x: float, y: float, text: str, points: float = 7.5, *, bold: bool = False, anchor: str = "start",
        colour: str = _BLACK, width: float | None = None,
    ) -> None:  # fmt: skip
        """A line of text, made smaller where it is wider than `width`."""
        font = _BOLD if bold else _REGULAR
        if width is not None:
            points = min(points, points * width / max(self._fonts[font].width_mm(text, points), 1e-9))
        self.canvas.text(x, y, text, font=font, points=points, colour=colour, anchor=anchor)

    def lines(
        self, points: Iterable[tuple[float, float]], width: float = _THIN_MM, colour: str = _BLACK,
        dash: Sequence[int] = (),
    ) -> None:  # fmt: skip
        """An open line through points."""
        self.canvas.lines(points, width_mm=width, colour=colour, dash=dash)

    def heading(self, title: str) -> None:
        self.text(_LEFT_MM, self.y_mm, title, 9, bold=True)
        self.y_mm -= 5.5

    def _begin(self) -> None:
        self._pages.append(Canvas(self._fonts))
        layout, passed = self._sheet.layout, self._sheet.passed
        self.text(_LEFT_MM, 196, layout.name, 14, bold=True, width=150)
        verdict = "all checks passed" if passed else "NOT all checks passed"
        self.text(_RIGHT_MM, 196, verdict, 10, bold=True, anchor="end", colour=_BLACK if passed else _RED)
        meaning = f": {layout.meaning.text}" if layout.meaning else ""
        kind = "information tag" if isinstance(layout.tag, InformationTag) else f"{layout.tag.style} line"
        fixing = f"; {layout.installation.text}" if layout.installation.text else ""
        code = f"{kind} {layout.tag.text}  {layout.tag.tuple_text}{meaning}{fixing}"
        self.text(_LEFT_MM, 190, code, 9, width=180)
        lon_deg, lat_deg, height_m = layout.lane.origin
        origin = f"east, north from {fixed(lon_deg, 9)}, {fixed(lat_deg, 9)}, height {height_m:g} m"
        self.text(_RIGHT_MM, 190, origin, 7.5, anchor="end", width=82)
        self.lines([(_LEFT_MM, 187.5), (_RIGHT_MM, 187.5)])
        notes = (_SURFACE_NOTE, *_NOTES) if layout.installation.on_surface else _NOTES
        for i, note in enumerate(reversed(notes)):
            self.text(_LEFT_MM, 6.0 + 3.5 * i, note, 6.5, colour=_GREY)
        self.y_mm = 181.0


# --- plan -----------------------------------------------------------------------------------------------------------


def _draw_plan(paper: _Paper, sheet: DrillingSheet) -> None:
    layout, scale = sheet.layout, plan_scale(sheet)
    straight = isinstance(layout.tag, InformationTag)
    bearing = f"{_bearing(layout.bearing_deg)} deg"
    what = f"from above, bearing {bearing}; dashed: the line it was placed by"
    if not straight:
        what = f"straightened; bearing {bearing} at the first magnet"
    paper.heading(f"Plan 1 : {scale}, {what}")
    span_m = PLAN_MM / 1000 * scale
    strips = 1 if straight else int((layout.length_m - 1e-6) // span_m) + 1
    for strip in range(strips):
        above = 23.0 if straight else (18.0 if strip == 0 else 11.0)
        paper.need(above + (24.0 if straight else 15.0))
        start_m, axis_mm = strip * span_m, paper.y_mm - above
        if strip == 0:
            _draw_travel(paper, paper.y_mm - 4.0)
            _draw_scale_bar(paper, paper.y_mm - 4.0, scale)
        _draw_strip(paper, sheet, start_m, min(start_m + span_m, layout.length_m), scale, axis_mm)
        paper.y_mm = axis_mm - (27.0 if straight else 17.0)


def _draw_strip(paper: _Paper, sheet: DrillingSheet, start_m: float, end_m: float, scale: int, axis_mm: float) -> None:
    """A piece of the plan from `start_m` to `end_m` along the tag, its axis at the height `axis_mm`."""
    layout = sheet.layout
    per_m = 1000.0 / scale
    holes = [h for h in layout.holes if start_m - 1e-6 <= h.along_m <= end_m + 1e-6]
    below_mm = axis_mm - max(9.5, _draw_lane(paper, sheet, start_m, per_m, axis_mm) + 4.0)
    x_of = {hole.number: _PLAN_LEFT_MM + (hole.along_m - start_m) * per_m for hole in holes}
    nearest = min((b - a for a, b in pairwise(x_of.values())), default=10.0)
    for hole in holes:
        _draw_magnet(paper, hole, x_of[hole.number], axis_mm, size=min(9.0, 0.8 * nearest))
    for before, hole in pairwise(holes):
        middle = (x_of[before.number] + x_of[hole.number]) / 2
        gap = f"{(hole.along_m - before.along_m) * 1000:.0f}"
        paper.text(middle, below_mm, gap, 6.5, anchor="middle", width=0.95 * (x_of[hole.number] - x_of[before.number]))
    for hole in holes:
        paper.text(
            x_of[hole.number], below_mm - 3.5, fixed(hole.along_m, 3), 6, anchor="middle", colour=_GREY, width=nearest
        )
    paper.text(_PLAN_LEFT_MM - 4, below_mm, "mm", 6, anchor="end")
    paper.text(_PLAN_LEFT_MM - 4, below_mm - 3.5, "m", 6, anchor="end", colour=_GREY)


def _draw_lane(paper: _Paper, sheet: DrillingSheet, start_m: float, per_m: float, axis_mm: float) -> float:
    """The axis and, on the plan of a tag, the lane's line; returns how far below the axis it reaches. [mm]"""
    layout = sheet.layout
    end = _PLAN_LEFT_MM + min(PLAN_MM, (layout.length_m - start_m) * per_m)
    paper.lines([(_PLAN_LEFT_MM - 3, axis_mm), (end + 3, axis_mm)], 0.15, _GREY)
    if not isinstance(layout.tag, InformationTag):
        return 0.0
    first, last = layout.holes[0], layout.holes[-1]
    along = (last.point_enu_m - first.point_enu_m) / layout.length_m
    inside = [c for c in layout.lane.chainages_m if first.chainage_m < c < last.chainage_m]
    points = []
    for chainage_m in [first.chainage_m, *inside, last.chainage_m]:
        away = layout.lane.at(float(chainage_m)) - first.point_enu_m
        left_m = along[0] * away[1] - along[1] * away[0]
        if abs(left_m) * per_m > 14.0:  # it would cross what else is drawn
            return 0.0
        points.append((_PLAN_LEFT_MM + float(away @ along) * per_m, axis_mm + left_m * per_m))
    paper.lines(points, 0.3, _GREY, dash=(4, 3))
    return float(axis_mm - min(y for _, y in points))


def _draw_magnet(paper: _Paper, hole: Hole, x: float, y: float, size: float) -> None:
    """A magnet with its poles: red and N where the north pole is."""
    if hole.orientation is Orientation.UP:
        up = hole.polarity
        fill = _RED if up is Polarity.N else _BLUE
        paper.canvas.circle(x, y, size / 2 * 0.7, fill=fill, outline=_BLACK, width_mm=_THIN_MM)
        _pole_letter(paper, up, x, y, size)
    else:
        forward = hole.polarity
        for pole, left in ((forward.flipped, x - size / 2), (forward, x)):
            fill = _RED if pole is Polarity.N else _BLUE
            paper.canvas.box(left, y - size / 4, size / 2, size / 2, fill=fill)
            _pole_letter(paper, pole, left + size / 4, y, size * 0.75)
    for end in (7.0, -7.0):
        paper.lines([(x, y + end), (x, y + end * 0.035 * size)], HOLE_LINE_MM)
    paper.text(x, y + 7.6, str(hole.number), 7, bold=True, anchor="middle", width=max(size, 1.5))


def _pole_letter(paper: _Paper, pole: Polarity, x: float, y: float, size: float) -> None:
    points = size * 0.35 * POINTS_PER_MM
    middle = y - 0.37 * points / POINTS_PER_MM
    paper.text(x, middle, pole.value, points, bold=True, anchor="middle", colour=_WHITE)


def _draw_travel(paper: _Paper, y: float) -> None:
    paper.lines([(_PLAN_LEFT_MM, y), (_PLAN_LEFT_MM + 22, y)], 0.4)
    paper.lines([(_PLAN_LEFT_MM + 19, y + 1.5), (_PLAN_LEFT_MM + 22, y), (_PLAN_LEFT_MM + 19, y - 1.5)], 0.4)
    paper.text(_PLAN_LEFT_MM + 25, y - 1, "direction of travel", 7)


def _draw_scale_bar(paper: _Paper, y: float, scale: int) -> None:
    """100 mm on paper, to see whether the sheet was printed at its size."""
    left = _RIGHT_MM - 110
    paper.lines([(left, y), (left + 100, y)], 0.4)
    for x in (left, left + 50, left + 100):
        paper.lines([(x, y - 1.2), (x, y + 1.2)], 0.4)
    paper.text(left + 50, y + 1.8, f"100 mm on paper = {100 * scale / 1000:g} m on the road", 6.5, anchor="middle")


# --- tables ---------------------------------------------------------------------------------------------------------


def _draw_holes(paper: _Paper, sheet: DrillingSheet) -> None:
    layout = sheet.layout
    paper.need(24.0)
    _hole_titles(paper)
    for hole, gap_m in zip(layout.holes, [0.0, *layout.gaps_m], strict=True):
        if paper.need(5.0):
            _hole_titles(paper)
        if hole.number % 2:
            paper.canvas.box(_LEFT_MM, paper.y_mm - 1.3, _RIGHT_MM - _LEFT_MM, 4.6, fill=_PALE)
        for _, right, cell in _HOLE_COLUMNS:
            paper.text(right, paper.y_mm, cell(hole, float(gap_m)), 7.5, anchor="end")
        paper.y_mm -= 4.6
    paper.y_mm -= 4.0


def _hole_titles(paper: _Paper) -> None:
    paper.heading("Magnets")
    for title, right, _ in _HOLE_COLUMNS:
        paper.text(right, paper.y_mm, title, 6.5, bold=True, anchor="end")
    paper.y_mm -= 5.0


def _draw_checks(paper: _Paper, sheet: DrillingSheet) -> None:
    paper.need(14.0 + 4.6 * min(len(sheet.checks), 8))
    paper.heading("Checks")
    for check in sheet.checks:
        paper.need(5.0)
        verdict, colour = ("passed", _BLACK) if check.passed else ("FAILED", _RED)
        paper.text(_LEFT_MM, paper.y_mm, verdict, 7.5, bold=True, colour=colour)
        paper.text(32, paper.y_mm, check.name, 7.5, width=38)
        figures = f"{fixed(check.figure, 3)} {check.unit} {check.relation} {fixed(check.limit, 3)} {check.unit}"
        paper.text(72, paper.y_mm, figures, 7.5, width=42)
        paper.text(116, paper.y_mm, check.note, 7, width=88)
        paper.text(206, paper.y_mm, check.source, 7, colour=_GREY, width=_RIGHT_MM - 206)
        paper.y_mm -= 4.6
    paper.y_mm -= 4.0


def _draw_bill(paper: _Paper, sheet: DrillingSheet) -> None:
    bill = sheet.bill
    rows: list[tuple[str, CostRow | UnpricedRow]] = [
        *(("", row) for row in bill.materials),
        *(("", unpriced) for unpriced in bill.without_price),
        *(("instead: ", row) for row in bill.alternatives),
    ]
    paper.need(8.0 + 4.6 * len(rows))
    paper.heading("Materials, without labour")
    for prefix, row in rows:
        if isinstance(row, CostRow):
            item, unit, source = row.cost.item, row.cost.unit, row.cost.source
            usd = f"{row.low_usd:.2f}" if row.low_usd == row.high_usd else f"{row.low_usd:.2f} - {row.high_usd:.2f}"
            price = f"{usd} USD"
        else:
            item, unit, source, price = row.item, row.unit, "", "no published price"
        paper.text(_LEFT_MM, paper.y_mm, f"{prefix}{item}", 7.5)
        paper.text(100, paper.y_mm, f"{row.quantity:g} {unit}", 7.5, anchor="end")
        paper.text(150, paper.y_mm, price, 7.5, anchor="end")
        paper.text(156, paper.y_mm, source, 7, colour=_GREY)
        paper.y_mm -= 4.6


def _bearing(degrees: float | None) -> str:
    return "-" if degrees is None else fixed(round(degrees, 2) % 360.0, 2)


# === The file formats of sheets, each with its writer.


def write_sheet(sheet: DrillingSheet, form: SheetFormat) -> bytes:
    """Write a sheet in one format."""
    match form:
        case SheetFormat.PDF:
            return write_sheet_pdf(sheet)
        case SheetFormat.CSV:
            return write_sheet_csv(sheet)
        case SheetFormat.GEOJSON:
            return write_sheet_geojson(sheet)
