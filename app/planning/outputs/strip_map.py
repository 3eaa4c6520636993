"""Installation drawings of a plan as PDF: a title sheet with an index map, then strips of the road to scale."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely

from app.markers.cerpm import LaneSide
from app.markers.magnet import Polarity
from app.markers.reading import Verdict
from app.planning.alignment import format_station
from app.planning.outputs.bill import counts_sentence, finding_figures, verdict_counts
from app.planning.outputs.drawing_sheet import (
    BLACK,
    BLUE,
    DOCUMENT_TYPE,
    FRAME_MM,
    GREEN,
    GREY,
    LIGHT,
    ORANGE,
    PALE_ORANGE,
    RED,
    TITLE_MM,
    Sheet,
    SheetSet,
    TitleBlock,
    draw_cerpm,
    draw_magnet,
    draw_north_arrow,
    draw_plate,
    draw_scale_bar,
    draw_title_block,
)
from app.planning.outputs.strip_drawing import ROW_HEIGHT_MM, StripDrawing, StripPlace
from app.planning.outputs.strip_layout import Strip, cut_strips
from app.planning.plan import Plan
from app.values import Floats

MAX_SHEETS = 100
"""Sheets of one file; more become several files. What a viewer opens at once."""
NOT_SURVEYED = "PLANNED - positions not surveyed"
_ROWS = 3
_FIRST_ROW_MM = 287.0 - ROW_HEIGHT_MM
_MAP_MM = (28.0, 62.0, 270.0, 256.0)  # left, bottom, right, top of the index map
_LINES: tuple[tuple[str, float, str, tuple[int, ...]], ...] = (
    ("solid line", 0.35, BLACK, ()),
    ("dashed line", 0.35, BLACK, (8, 6)),
    ("lane centre, ticks at fifths of the numbered stations", 0.1, GREY, (8, 3, 1, 3)),
)
_KEY_MM = (24.0, 47.0)  # left and top of the key


class Drawings:
    """Installation drawings of a plan, in files of at most a hundred sheets.

    Parameters
    ----------
    plan : Plan
        With markers.
    block : TitleBlock, optional
        Owner, date and persons; title and number follow from the plan where they are empty.
    scale : int, optional
        Denominator, one of `app.planning.outputs.strip_layout.SCALES`; chosen by the number of sheets without.

    Raises
    ------
    InvalidParameter
        There is no such scale, or it takes more than a thousand sheets.
    """

    def __init__(self, plan: Plan, block: TitleBlock | None = None, scale: int | None = None) -> None:
        block = block or TitleBlock()
        number = block.number or f"WM-{zlib.crc32(repr((plan.name, plan.counts)).encode()):08X}"
        self._plan = plan
        self._block = replace(block, title=block.title or plan.name, number=number)
        self._strips = cut_strips(plan, scale)
        pages = [self._strips[k : k + _ROWS] for k in range(0, len(self._strips), _ROWS)]
        self._count = len(pages) + 1
        self._sheet_of = {strip.number: k + 2 for k, page in enumerate(pages) for strip in page}
        self._files = [pages[k : k + MAX_SHEETS] for k in range(0, len(pages), MAX_SHEETS)] or [[]]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the files: ``drawings.pdf``, or ``drawings-1.pdf`` and so on."""
        if len(self._files) == 1:
            return ("drawings.pdf",)
        return tuple(f"drawings-{k + 1}.pdf" for k in range(len(self._files)))

    def write(self, name: str) -> bytes:
        """One of the files as PDF; the same plan always gives the same bytes."""
        k = self.names.index(name)
        sheets = SheetSet(self._block)
        if k == 0:
            _draw_title_sheet(sheets.add(), self._plan, self._block, self._strips, self._count)
        drawing = StripDrawing(self._plan)
        for page in self._files[k]:
            _draw_strips(sheets.add(), drawing, page, self._block, self._sheet_of, self._count)
        return sheets.to_bytes()


def _draw_strips(
    sheet: Sheet, drawing: StripDrawing, page: Sequence[Strip], block: TitleBlock, sheet_of: dict[int, int], count: int
) -> None:
    for k, strip in enumerate(page):
        bottom = _FIRST_ROW_MM - k * ROW_HEIGHT_MM
        before = StripPlace(strip.number - 1, sheet_of[strip.number - 1]) if strip.continued_left else None
        after = StripPlace(strip.number + 1, sheet_of[strip.number + 1]) if strip.continued_right else None
        drawing.draw(sheet, strip, bottom, before, after)
        if k:
            sheet.lines([(FRAME_MM[0], bottom + ROW_HEIGHT_MM), (FRAME_MM[2], bottom + ROW_HEIGHT_MM)], 0.18)
    low, high = format_station(page[0].stations_m[0]), format_station(page[-1].stations_m[1])
    scale = page[0].scale
    _draw_foot(sheet, drawing.plan, scale)
    number = sheet_of[page[0].number]
    draw_title_block(
        sheet, block, subtitle=f"Strips {page[0].number} to {page[-1].number}, station {low} to {high}",
        scale=f"1 : {scale} (A3)", number=number, count=count,
    )  # fmt: skip


def _draw_foot(sheet: Sheet, plan: Plan, scale: int | None) -> None:
    """Key, scale bar and notes, left of the title block."""
    left, top = _KEY_MM
    sheet.lines([(FRAME_MM[0], TITLE_MM[3]), (TITLE_MM[0], TITLE_MM[3])], 0.35)
    draw_plate(sheet, left + 2, top - 3.2, 0.0)
    sheet.text(left + 7, top - 4.0, "coded plate, pointer in the direction of travel", 6)
    sheet.lines([(left - 0.5, top - 8.2), (left + 4.5, top - 8.2)], 0.9, RED)
    draw_magnet(sheet, left, top - 8.2, Polarity.N, RED)
    draw_magnet(sheet, left + 4, top - 8.2, Polarity.S, RED)
    sheet.text(left + 7, top - 9.0, "information tag: lying magnets, full = north pole forward", 6)
    draw_magnet(sheet, left, top - 13.2, Polarity.N, BLACK)
    draw_magnet(sheet, left + 4, top - 13.2, Polarity.S, BLACK)
    sheet.text(left + 7, top - 14.0, "line magnet: full = north pole up, open = north pole down", 6)
    draw_cerpm(sheet, left, top - 18.2, LaneSide.LEFT)
    draw_cerpm(sheet, left + 4, top - 18.2, LaneSide.UNKNOWN)
    sheet.text(left + 7, top - 19.0, "CERPM; open = on a line that both directions share", 6)
    sheet.canvas.box(left - 1, top - 24.6, 6.0, 2.6, fill=PALE_ORANGE)
    sheet.text(left + 7, top - 24.0, "area to avoid: nothing is installed here", 6)
    for k, (dash, name) in enumerate((((), "solid line"), ((8, 6), "dashed line"), ((8, 3, 1, 3), "lane centre"))):
        x = left + 85
        centre = k == 2
        sheet.lines(
            [(x, top - 3.2 - 5 * k), (x + 9, top - 3.2 - 5 * k)],
            0.1 if centre else 0.35,
            GREY if centre else BLACK,
            dash,
        )
        sheet.text(x + 12, top - 4.0 - 5 * k, name, 6)
    x = left + 85
    sheet.text(x, top - 19.0, "Numbers are those of the stakeout and the marker sheets;", 6, colour=GREY)
    sheet.text(x, top - 22.0, "numbers without room are left out here.", 6, colour=GREY)
    if scale is not None:
        draw_scale_bar(sheet, x, top - 32.5, scale)
    if not plan.alignment.surveyed:
        sheet.text(left - 1, top - 33.0, NOT_SURVEYED, 9, bold=True, colour=RED)


# --- title sheet ----------------------------------------------------------------------------------------------------


def _draw_title_sheet(sheet: Sheet, plan: Plan, block: TitleBlock, strips: Sequence[Strip], count: int) -> None:
    sheet.text(_MAP_MM[0], 272, plan.name, 22, bold=True, width=240)
    sheet.text(_MAP_MM[0], 265.5, f"{DOCUMENT_TYPE}s: {counts_sentence(plan)}", 9, width=240)
    _draw_index_map(sheet, plan, strips)
    _draw_facts(sheet, plan, strips)
    _draw_foot(sheet, plan, None)
    scale = f"strips 1 : {strips[0].scale}" if strips else "-"
    draw_title_block(sheet, block, subtitle="Index map, counts and key", scale=scale, number=1, count=count)


def _draw_index_map(sheet: Sheet, plan: Plan, strips: Sequence[Strip]) -> None:
    """All lanes with north up, the strips by their first ends, and the numbers of the sheets."""
    left, bottom, right, top = _MAP_MM
    lanes = plan.alignment.lanes
    lon = np.concatenate([np.unwrap(lane.lon_deg, period=360.0) for lane in lanes])
    lat = np.concatenate([lane.lat_deg for lane in lanes])
    middle = float(lon.min() + lon.max()) / 2, float(lat.min() + lat.max()) / 2
    shrink = float(np.cos(np.radians(middle[1])))
    spread = max(float(np.ptp(lon)) * shrink / (right - left - 16), float(np.ptp(lat)) / (top - bottom - 16), 1e-9)

    def at(lon_deg: Floats, lat_deg: Floats) -> Floats:
        x = (left + right) / 2 + (np.asarray(lon_deg) - middle[0]) * shrink / spread
        return np.stack([x, (bottom + top) / 2 + (np.asarray(lat_deg) - middle[1]) / spread], axis=-1)

    sheet.rectangle(left, bottom, right, top, 0.18)
    for lane in lanes:
        line = shapely.simplify(shapely.LineString(at(np.unwrap(lane.lon_deg, period=360.0), lane.lat_deg)), 0.1)
        sheet.lines(shapely.get_coordinates(line).tolist(), 0.35, GREY)
    labels = _MapLabels()
    for strip in strips:
        reference = strip.reference
        ends = [strip.from_m, (strip.from_m + strip.to_m) / 2]
        start, half = at(
            np.interp(ends, reference.along_m, reference.lon_deg),
            np.interp(ends, reference.along_m, reference.lat_deg),
        )
        sheet.canvas.circle(float(start[0]), float(start[1]), 0.5, fill=BLUE, outline=BLUE, width_mm=0.1)
        text = f"{strip.number}"
        way = (half - start) / max(float(np.hypot(*(half - start))), 1e-9)
        x, y = half + 3.2 * np.array([way[1], -way[0]]) - (0.0, 0.8)
        if labels.free(float(x), float(y), sheet.width_mm(text, 6.5)):
            sheet.text(float(x), float(y), text, 6.5, bold=True, colour=BLUE, anchor="middle")
    draw_north_arrow(sheet, right - 10, top - 12, 90.0, 7.0)
    metres = spread * 111_195.0  # on the road for 1 mm on the map
    round_m = _round_length(metres * 40.0)
    end = left + round_m / metres
    sheet.lines([(left, bottom - 4.0), (end, bottom - 4.0)], 0.7)
    sheet.text(end + 2, bottom - 4.8, f"{round_m / 1000:g} km" if round_m >= 1000 else f"{round_m:g} m", 6.5)
    sheet.text(left, top + 1.6, "Index map: numbers of the strips, dots where they begin", 6.5, colour=GREY)


class _MapLabels:
    """Places of labels on the index map."""

    def __init__(self) -> None:
        self._boxes: list[tuple[float, float, float]] = []

    def free(self, x: float, y: float, width: float) -> bool:
        """Whether a label fits; it is then taken."""
        if any(
            abs(x - other) < (width + wide) / 2 + 1.0 and abs(y - level) < 3.0 for other, level, wide in self._boxes
        ):
            return False
        self._boxes.append((x, y, width))
        return True


def _round_length(metres: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not longer."""
    power = 10.0 ** np.floor(np.log10(max(metres, 1e-3)))
    return float(next(step * power for step in (5, 2, 1) if step * power <= metres * 1.0001))


def _draw_facts(sheet: Sheet, plan: Plan, strips: Sequence[Strip]) -> None:
    """Counts, reference system and checks in the right column."""
    x, y, right = 278.0, 272.0, 404.0
    road = plan.alignment
    if not road.surveyed:
        sheet.text(x, y, NOT_SURVEYED, 13, bold=True, colour=RED, width=right - x)
        y -= 9.0
    found = verdict_counts(plan)
    checks = ", ".join(f"{n} {verdict.value}" for verdict, n in found.items() if n) or "not checked"
    datum = road.vertical_datum or "no heights"
    epoch = "" if road.epoch is None else f", epoch {road.epoch:g}"
    rows = [
        ("Road", road.name),
        ("Lanes", f"{len(road.lanes)}, {road.lane_length_m / 1000:.3f} km together"),
        ("Rules", plan.rules.name),
        ("Reference system", f"{road.crs}; {road.realization or 'no realization stated'}{epoch}"),
        ("Positions", str(road.grade)),
        ("Heights", datum),
        ("Checks", checks),
        (
            "Left out, moved",
            f"{sum(m.moved_m is None for m in plan.left_out)}, {sum(m.moved_m is not None for m in plan.left_out)}",
        ),
        ("Strips", f"{len(strips)} at 1 : {strips[0].scale}" if strips else "0"),
    ]
    if plan.rules.installation.text and "magnet" in plan.counts:
        rows.append(("Magnets", plan.rules.installation.text))
    for label, value in rows:
        sheet.text(x, y, label, 7, colour=GREY)
        sheet.text(x + 34, y, value, 7.5, width=right - x - 34)
        y -= 5.5
    y -= 4.0
    sheet.text(x, y, "Markers by lane", 9, bold=True)
    y -= 6.0
    columns = (("lane", 0.0, "start"), ("plates", 52.0, "end"), ("magnets", 74.0, "end"), ("CERPMs", 96.0, "end"),
               ("all", 118.0, "end"))  # fmt: skip
    for title, place, anchor in columns:
        sheet.text(x + place, y, title, 6.5, bold=True, anchor=anchor)
    y -= 1.6
    sheet.lines([(x, y), (x + 118, y)], 0.25, LIGHT)
    for name, numbers in _lane_counts(plan):
        y -= 5.0
        if y < 62.0:
            sheet.text(x, y, "more lanes: see the schedule", 6.5, colour=GREY)
            break
        sheet.text(x, y, name, 7, width=36, bold=name == "all")
        for (_, place, anchor), number in zip(columns[1:], numbers, strict=True):
            sheet.text(x + place, y, str(number), 7, anchor=anchor, bold=name == "all")
    _draw_findings(sheet, plan, x, y - 9.0, right)


def _draw_findings(sheet: Sheet, plan: Plan, x: float, y: float, right: float) -> None:
    """Checks with their verdicts, those that are not met first, as many as there is room for."""
    if not plan.findings or y < 75.0:
        return
    sheet.text(x, y, "Checks", 9, bold=True)
    order = [Verdict.FAIL, Verdict.WARN, Verdict.OK]
    colours = {Verdict.FAIL: RED, Verdict.WARN: ORANGE, Verdict.OK: GREEN}
    for finding in sorted(plan.findings, key=lambda finding: order.index(finding.verdict)):
        y -= 4.8
        if y < 62.0:
            sheet.text(x, y, "more checks: see the report", 6.5, colour=GREY)
            break
        figure, limit = finding_figures(finding)
        sheet.text(x, y, finding.verdict.value, 6.5, bold=True, colour=colours[finding.verdict])
        sheet.text(x + 11, y, finding.name, 6.5, width=44)
        sheet.text(x + 58, y, f"{figure}, {limit}", 6.5, width=right - x - 58)


def _lane_counts(plan: Plan) -> list[tuple[str, tuple[int, ...]]]:
    """Markers of each lane by family, then of all lanes."""
    lanes: dict[str, list[int]] = {}
    families = ("plate", "magnet", "cerpm")
    for marker in plan.markers:
        lanes.setdefault(marker.lane, [0, 0, 0, 0])[families.index(marker.family)] += 1
        lanes[marker.lane][3] += 1
    total = tuple(np.sum(list(lanes.values()), axis=0).tolist()) if lanes else (0, 0, 0, 0)
    return [("all", total), *((name, tuple(counts)) for name, counts in lanes.items())]
