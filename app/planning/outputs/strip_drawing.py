"""Drawing of one strip: lanes, stations, match lines, areas to avoid, and markers with their numbers."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain

import numpy as np
import numpy.typing as npt
import scipy
import shapely

from app.encoders.pdf import POINTS_PER_MM
from app.formats.alignments.geometry import BoundaryStyle, EventKind, StationEquation
from app.planning.alignment import Alignment, RoadEvent, format_station
from app.planning.outputs.drawing_sheet import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    LIGHT,
    ORANGE,
    PALE_ORANGE,
    RED,
    Sheet,
    draw_magnet,
    draw_north_arrow,
    draw_symbol,
)
from app.planning.outputs.strip_layout import ROW_MM, SCALES, LanePiece, Strip
from app.planning.plan import Plan, PlannedCerpm, PlannedLineMagnet, PlannedMarker, PlannedPlate, PlannedTag
from app.values import Floats

ROW_HEIGHT_MM = 78.0
"""Height of a row with its heading. [mm] Source: three rows above the title block of A3."""
_LEFT_MM, _WIDTH_MM = 20.0, 390.0
_MIDDLE_MM = _LEFT_MM + _WIDTH_MM / 2
_TOLERANCE_MM = 0.03  # of lines on paper; a third of the thinnest line
_CELL_MM = 0.4  # of the grid of taken places; a quarter of the smallest letters
_SHARED_M = 0.3  # between edges of two lanes that are one painted line; two widths of paint
_FROM_MATCH_MM = 7.0  # between numbered stations and match lines; half of a station's number
_SAME_STATION_M = 0.005  # stations are written in centimetres
_TICKS = 5  # from one numbered station to the next
_UNITS = {EventKind.SPEED_LIMIT: " km/h", EventKind.CURVE: " deg"}
_LIFTS_MM = (3.0, 5.5, 10.0, 13.0)  # of numbers outside the road; round the stations' numbers
_BELOW_MM = 12.0  # of a row, for stations and labels below the road
_HEADING_MM = 7.0  # of a row
_NEAR_MM = 3.0  # between a strip's road and areas that it shows
_BEYOND_MM = 9.0  # of match lines beyond the road


@dataclass(frozen=True, slots=True)
class StripPlace:
    """Where a strip is drawn, for match lines: number of its strip and of its sheet."""

    strip: int
    sheet: int


class Labels:
    """Places of a row that are taken, so that no label hides another one or a symbol."""

    def __init__(self, bottom_mm: float) -> None:
        self._bottom = bottom_mm
        shape = (int(ROW_HEIGHT_MM / _CELL_MM) + 1, int(_WIDTH_MM / _CELL_MM) + 1)
        self._taken = np.zeros(shape, dtype=bool)

    def take(self, left: float, bottom: float, right: float, top: float, *, force: bool = False) -> bool:
        """Take a rectangle; whether it was free and inside the row."""
        rows = self._span(bottom - self._bottom, top - self._bottom, self._taken.shape[0])
        columns = self._span(left - _LEFT_MM, right - _LEFT_MM, self._taken.shape[1])
        if not force and (rows is None or columns is None or self._taken[rows, columns].any()):
            return False
        if rows is not None and columns is not None:
            self._taken[rows, columns] = True
        return True

    @staticmethod
    def _span(low: float, high: float, cells: int) -> slice | None:
        first, last = int(low / _CELL_MM), int(high / _CELL_MM) + 1
        return slice(first, last) if low >= 0 and last <= cells else None


class StripDrawing:
    """Draws strips of one plan."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self._areas = _Areas(plan.alignment)

    def draw(
        self, sheet: Sheet, strip: Strip, bottom_mm: float, before: StripPlace | None, after: StripPlace | None
    ) -> None:
        """A strip in the row above `bottom_mm`, with the places of the strips that continue it."""
        row = _Row(sheet, strip, bottom_mm, self.plan)
        with sheet.canvas.clipped(_LEFT_MM, bottom_mm, _WIDTH_MM, ROW_HEIGHT_MM):
            self._areas.draw(row)
            row.draw_lanes()
            row.draw_match_line(strip.from_m, before, left=True)
            row.draw_match_line(strip.to_m, after, left=False)
            row.draw_heading()
            row.draw_stations()
            row.draw_events()
            row.draw_markers()


class _Areas:
    """Areas to avoid, with the circles that contain them."""

    def __init__(self, road: Alignment) -> None:
        self._areas = road.areas
        boxes = [(*area.ring_deg.min(axis=0), *area.ring_deg.max(axis=0)) for area in road.areas]
        self._boxes = np.array(boxes, dtype=np.float64).reshape(-1, 4)

    def draw(self, row: _Row) -> None:
        """Those that reach into a row."""
        if not len(self._boxes):
            return
        corners = [row.paper(self._boxes[:, a], self._boxes[:, b]) for a, b in ((0, 1), (2, 1), (2, 3), (0, 3))]
        low, high = np.min(corners, axis=0), np.max(corners, axis=0)
        inside = (low[:, 0] < _LEFT_MM + _WIDTH_MM) & (high[:, 0] > _LEFT_MM)
        inside &= (low[:, 1] < row.bottom + ROW_HEIGHT_MM) & (high[:, 1] > row.bottom)
        for k in np.flatnonzero(inside):
            area = self._areas[k]
            ring = row.paper(area.ring_deg[:, 0], area.ring_deg[:, 1])
            if not row.is_beside(ring):
                continue
            row.sheet.canvas.polygon(ring.tolist(), fill=PALE_ORANGE, outline=ORANGE, width_mm=0.25)
            for line in _hatches(ring):
                row.sheet.lines(line, 0.1, ORANGE)
            middle, top = float(ring[:, 0].mean()), float(ring[:, 1].max())
            row.label(middle, top + 1.0, area.kind.removesuffix("s"), 5.5, ORANGE, force=True)


def _hatches(ring: Floats, spacing: float = 2.0) -> list[list[tuple[float, float]]]:
    """Lines at 45 degrees through an area. [mm]"""
    area = shapely.make_valid(shapely.Polygon(ring))
    left, bottom, right, top = area.bounds
    height = top - bottom
    if height > 4 * ROW_HEIGHT_MM or right - left > 2 * _WIDTH_MM:
        return []
    starts = np.arange(left - height, right, spacing)
    lines = shapely.linestrings([[(x, bottom), (x + height, top)] for x in starts.tolist()]) if len(starts) else []
    parts = shapely.get_parts(shapely.intersection(lines, area))
    return [
        shapely.get_coordinates(part).tolist() for part in parts if part.geom_type == "LineString" and part.length > 0.2
    ]


class _Row:
    """One strip in its row on a sheet."""

    def __init__(self, sheet: Sheet, strip: Strip, bottom_mm: float, plan: Plan) -> None:
        self.sheet = sheet
        self.strip = strip
        self.bottom = bottom_mm
        self.plan = plan
        self._middle = np.array([_MIDDLE_MM, bottom_mm + _BELOW_MM + ROW_MM / 2])
        self._labels = Labels(bottom_mm)
        self._pieces: list[LanePiece] = [
            LanePiece(p.lane, p.centre_mm + self._middle, p.left_mm + self._middle, p.right_mm + self._middle)
            for p in strip.pieces()
        ]
        edges = [edge for p in self._pieces for edge in (p.left_mm, p.right_mm)]
        self._edges = np.concatenate(edges) if edges else np.zeros((1, 2)) + self._middle

    def paper(self, lon_deg: Floats, lat_deg: Floats) -> Floats:
        """Places on the sheet, shape (N, 2). [mm]"""
        return np.asarray(self.strip.to_paper(lon_deg, lat_deg) + self._middle)

    def is_beside(self, ring_mm: Floats) -> bool:
        """Whether an area touches the road of this strip, or nearly."""
        return bool(shapely.Polygon(ring_mm).distance(shapely.MultiPoint(self._edges)) <= _NEAR_MM)

    def label(
        self, x: float, y: float, text: str, points: float, colour: str, *, bold: bool = False, anchor: str = "middle",
        force: bool = False,
    ) -> bool:  # fmt: skip
        """A text where nothing else is; whether it was drawn."""
        width = self.sheet.width_mm(text, points, bold=bold)
        left = x - {"start": 0.0, "middle": 0.5, "end": 1.0}[anchor] * width
        height = points * 0.73 / POINTS_PER_MM
        if not self._labels.take(left - 0.2, y - 0.2, left + width + 0.2, y + height + 0.2, force=force):
            return False
        self.sheet.text(x, y, text, points, bold=bold, colour=colour, anchor=anchor)
        return True

    # --- road ---

    def draw_lanes(self) -> None:
        """Edges by their paint, centre lines, and arrows of travel with the lanes' names."""
        drawn: list[Floats] = []
        for piece in self._pieces:
            self.sheet.lines(_simple(piece.centre_mm), 0.1, LIGHT, (8, 3, 1, 3))
            for edge, style in ((piece.left_mm, piece.lane.left_style), (piece.right_mm, piece.lane.right_style)):
                self._draw_edge(edge, style, drawn)
        for piece in self._pieces:
            self._draw_travel(piece)

    def _draw_edge(self, edge: Floats, style: BoundaryStyle, drawn: list[Floats]) -> None:
        width, colour, dash = {
            BoundaryStyle.SOLID: (0.35, BLACK, ()),
            BoundaryStyle.DASHED: (0.35, BLACK, (8, 6)),
            BoundaryStyle.NONE: (0.13, LIGHT, ()),
            BoundaryStyle.UNKNOWN: (0.18, GREY, ()),
        }[style]
        new: npt.NDArray[np.bool_] = np.ones(len(edge), dtype=np.bool_)
        if drawn:
            near = _SHARED_M * 1000 / self.strip.scale
            new = (
                np.asarray(scipy.spatial.cKDTree(np.concatenate(drawn)).query(edge, distance_upper_bound=near)[0])
                > near
            )
        drawn.append(edge)
        runs = np.flatnonzero(new)
        for run in np.split(runs, np.flatnonzero(np.diff(runs) > 1) + 1):
            if len(run) >= 2:
                self.sheet.lines(_simple(edge[run]), width, colour, dash)

    def _draw_travel(self, piece: LanePiece) -> None:
        line = piece.centre_mm
        steps = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
        if steps[-1] < 12.0:
            return
        at = min(8.0, 0.1 * steps[-1]) if line[-1, 0] >= line[0, 0] else steps[-1] - min(8.0, 0.1 * steps[-1])
        k = int(np.clip(np.searchsorted(steps, at), 1, len(line) - 1))
        way = (line[k] - line[k - 1]) / max(float(np.hypot(*(line[k] - line[k - 1]))), 1e-9)
        tip, side = line[k] + 2.2 * way, np.array([-way[1], way[0]])
        shaft = [line[k] - 2.2 * way, tip]
        self.sheet.lines([tuple(point) for point in shaft], 0.25, GREY)
        self.sheet.lines(
            [tuple(tip - 1.4 * way + 0.7 * side), tuple(tip), tuple(tip - 1.4 * way - 0.7 * side)], 0.25, GREY
        )
        for point in shaft:
            self._labels.take(point[0] - 1.5, point[1] - 0.8, point[0] + 1.5, point[1] + 0.8, force=True)
        x, y = line[k]
        self.label(x + 4.5, y - 0.7, f"lane {piece.lane.name}"[:24], 5.5, GREY, anchor="start", force=True)

    def _below(self, x: float) -> float:
        near = np.abs(self._edges[:, 0] - x) < 6.0
        return float(self._edges[near, 1].min()) if near.any() else float(self._middle[1])

    def _above(self, x: float) -> float:
        near = np.abs(self._edges[:, 0] - x) < 6.0
        return float(self._edges[near, 1].max()) if near.any() else float(self._middle[1])

    def _at(self, along_m: float) -> tuple[Floats, Floats]:
        """Place on the reference lane and direction of growing stations, on paper."""
        reference = self.strip.reference
        ends = np.clip([along_m, along_m - 0.5, along_m + 0.5], reference.along_m[0], reference.along_m[-1])
        lon = np.interp(ends, reference.along_m, reference.lon_deg)
        lat = np.interp(ends, reference.along_m, reference.lat_deg)
        place, back, ahead = self.paper(lon, lat)
        return place, (ahead - back) / max(float(np.hypot(*(ahead - back))), 1e-9)

    def draw_match_line(self, along_m: float, other: StripPlace | None, *, left: bool) -> None:
        """The end of the strip, with where the road goes on."""
        place, way = self._at(along_m)
        across = np.array([-way[1], way[0]])
        near = self._edges[np.hypot(*(self._edges - place).T) < 40.0]
        offsets = (near - place) @ across if len(near) else np.zeros(1)
        foot, head = place + (offsets.min() - _BEYOND_MM) * across, place + (offsets.max() + _BEYOND_MM) * across
        self.sheet.lines([tuple(foot), tuple(head)], 0.5, BLACK, (12, 3, 2, 3))
        low, high = self.strip.stations_m
        station = format_station(low if left else high)
        text = f"{'START' if left else 'END'} {station}"
        if other is not None:
            text = f"MATCH LINE {station} - strip {other.strip}, sheet {other.sheet}"
        angle = float(np.degrees(np.arctan2(across[1], across[0])))
        beside = place + (-5.5 if left else 7.2) * way
        length = self.sheet.width_mm(text, 5.5, bold=True)
        start = beside - 0.5 * length * across
        rise = float(across[1])
        if rise > 0.2:  # slide along the line into the row
            low_mm, high_mm = self.bottom + 2.0, self.bottom + ROW_HEIGHT_MM - _HEADING_MM
            start = start + (np.clip(start[1], low_mm, max(high_mm - length * rise, low_mm)) - start[1]) / rise * across
        self.sheet.text(start[0], start[1], text, 5.5, bold=True, angle_deg=angle)
        for ends in ((foot, head), (start, start + length * across)):
            for k in np.linspace(0, 1, 32):
                x, y = ends[0] + k * (ends[1] - ends[0])
                self._labels.take(x - 1.2, y - 1.2, x + 1.2, y + 1.2, force=True)

    def draw_heading(self) -> None:
        """Number, road and stations of the strip, and its north arrow."""
        low, high = (format_station(station) for station in self.strip.stations_m)
        lane = self.strip.reference.lane
        top = self.bottom + ROW_HEIGHT_MM - 5.0
        self.label(_LEFT_MM + 4.0, top, f"Strip {self.strip.number}", 9, BLACK, bold=True, anchor="start", force=True)
        text = f"road {lane.road}, along lane {lane.name}: {low} to {high}"
        self.label(_LEFT_MM + 24.0, top, text, 7, BLACK, anchor="start", force=True)
        x, y = _LEFT_MM + _WIDTH_MM - 11.0, self.bottom + ROW_HEIGHT_MM - 11.0
        draw_north_arrow(self.sheet, x, y, self.strip.bearing_deg)
        self._labels.take(x - 9, y - 9, x + 9, y + 9, force=True)

    def draw_stations(self) -> None:
        """Numbered stations below the road, and ticks between them."""
        reference, minor = self.strip.reference, SCALES[self.strip.scale] / _TICKS
        ends = np.array([self._at(end)[0] for end in (self.strip.from_m, self.strip.to_m)])
        for equation in reference.stationing.equations:
            at = float(np.interp(equation.distance_m, reference.distance_m, reference.along_m, -1.0, -1.0))
            is_jump = abs(equation.ahead_m - equation.back_m) > _SAME_STATION_M
            if is_jump and at >= 0 and self.strip.from_m <= at <= self.strip.to_m:
                self._draw_equation(at, equation)
        places, stations = reference.round_stations(minor)
        for k in np.flatnonzero((places >= self.strip.from_m - 1e-6) & (places <= self.strip.to_m + 1e-6)):
            is_numbered = round(stations[k] / minor) % _TICKS == 0
            self._draw_tick(float(places[k]), float(stations[k]) if is_numbered else None, ends)

    def _draw_tick(self, along_m: float, station_m: float | None, ends: Floats) -> None:
        place, way = self._at(along_m)
        across = np.array([-way[1], way[0]])
        size = 0.6 if station_m is None else 1.2
        self.sheet.lines([tuple(place - size * across), tuple(place + size * across)], 0.13, GREY)
        if station_m is None:
            return
        if float(np.hypot(*(ends - place).T).min()) < _FROM_MATCH_MM:
            return  # the match line states it
        foot = self._below(float(place[0])) - 7.0
        self.sheet.lines([tuple(place), (place[0], foot + 2.4)], 0.08, LIGHT)
        self.label(float(place[0]), foot, format_station(station_m)[:-3], 6.5, BLACK, force=True)

    def _draw_equation(self, along_m: float, equation: StationEquation) -> None:
        place, _ = self._at(along_m)
        top = self._above(float(place[0])) + 6.0
        self.sheet.lines([tuple(place), (place[0], top - 1.0)], 0.25, BLACK)
        text = f"station equation: {format_station(equation.back_m)} back = {format_station(equation.ahead_m)} ahead"
        anchor = "end" if place[0] > _MIDDLE_MM else "start"
        self.label(float(place[0]), top, text, 6, BLACK, bold=True, anchor=anchor, force=True)

    def draw_events(self) -> None:
        """Stop lines across their lane, and a note for each event."""
        beside = {one.lane.name: one for one in self.strip.reference.lanes}
        for event in self.plan.alignment.events:
            found = beside.get(event.lane)
            if found is None:
                continue
            along = float(np.interp(event.chainage_m, found.lane.chainage_m, found.along_m))
            if not self.strip.from_m <= along <= self.strip.to_m:
                continue
            half = float(found.lane.value_at(found.lane.width_m, event.chainage_m)) / 2
            lon, lat = found.lane.position_at([event.chainage_m] * 2, [half, -half])
            left, right = self.paper(lon, lat)
            width = 0.9 if event.kind is EventKind.STOP_LINE else 0.2
            self.sheet.lines([tuple(left), tuple(right)], width, GREY)
            value = (
                ""
                if event.value is None
                else f" {event.value:.0f}"
                if isinstance(event.value, float)
                else f" {event.value}"
            )
            unit = {EventKind.SPEED_LIMIT: " km/h", EventKind.CURVE: " deg"}.get(event.kind, "") if value else ""
            end = max(left, right, key=lambda point: float(point[1]))
            top = self._above(float(end[0])) + 4.0
            for lift in (0.0, 3.0, 6.0, 9.0):
                if self.label(
                    float(end[0]), top + lift, f"{event.kind.value.replace('_', ' ')}{value}{unit}", 5.5, GREY
                ):
                    self.sheet.lines([tuple(end), (end[0], top + lift - 0.6)], 0.1, GREY)
                    break

    # --- markers ---

    def draw_markers(self) -> None:
        """Symbols of all markers, then their numbers: plates and tags first."""
        markers = [self.plan.markers[k] for k in self.strip.markers]
        if not markers:
            return
        places = self.paper(np.array([m.lon_deg for m in markers]), np.array([m.lat_deg for m in markers]))
        order = sorted(range(len(markers)), key=lambda k: _PRIORITY[type(markers[k].detail)])
        for k in order:
            self._draw_symbol(markers[k], places[k])
        for k in order:
            self._draw_number(markers[k], places[k])

    def _draw_symbol(self, marker: PlannedMarker, place: Floats) -> None:
        x, y = float(place[0]), float(place[1])
        detail = marker.detail
        if isinstance(detail, PlannedTag):
            dots = self.paper(np.array([m[1] for m in detail.magnets]), np.array([m[2] for m in detail.magnets]))
            self.sheet.lines([tuple(dots[0]), tuple(dots[-1])], 0.9, RED)
            for dot, polarity in zip(dots, detail.tag.polarities, strict=True):
                draw_magnet(self.sheet, float(dot[0]), float(dot[1]), polarity, RED)
            low, high = dots.min(axis=0) - 0.7, dots.max(axis=0) + 0.7
            self._labels.take(low[0], low[1], high[0], high[1], force=True)
            return
        draw_symbol(self.sheet, x, y, marker, marker.heading_deg - self.strip.bearing_deg)
        reach = 1.3 if isinstance(detail, PlannedPlate) else 0.8
        self._labels.take(x - reach, y - reach, x + reach, y + reach, force=True)

    def _draw_number(self, marker: PlannedMarker, place: Floats) -> None:
        x, y = float(place[0]), float(place[1])
        detail = marker.detail
        text, points, colour, bold = str(marker.number), 4.6, BLACK, False
        if isinstance(detail, PlannedPlate):
            points, colour, bold = 6.5, BLUE, True
        elif isinstance(detail, PlannedTag):
            text, points, colour, bold = f"{marker.number} {detail.meaning.text}", 5.5, RED, True
        elif isinstance(detail, PlannedCerpm):
            points, colour = 5.0, GREEN
        height = points * 0.73 / POINTS_PER_MM
        above, below = self._above(x), self._below(x)
        upper = y >= (above + below) / 2
        near = [y + 1.3, y - 1.3 - height]
        for level in near if upper else near[::-1]:
            for shift, anchor in ((0.0, "middle"), (1.0, "start"), (-1.0, "end")):
                if self.label(x + shift, level, text, points, colour, bold=bold, anchor=anchor):
                    return
        if not bold:
            return
        # plates and tags always have their number, beside the road if need be
        outside = [[(above + lift, above + lift - 0.6) for lift in _LIFTS_MM]]
        outside.append([(below - lift - height, below - lift + 0.6) for lift in _LIFTS_MM])
        for level, end in chain.from_iterable(outside if upper else outside[::-1]):
            if self.label(x, level, text, points, colour, bold=bold):
                self.sheet.lines([(x, y), (x, end)], 0.1, colour)
                return


def _event_text(event: RoadEvent) -> str:
    kind = event.kind.value.replace("_", " ")
    if event.value is None:
        return kind
    value = f"{event.value:.0f}" if isinstance(event.value, float) else event.value
    return f"{kind} {value}{_UNITS.get(event.kind, '')}"


_PRIORITY = {PlannedPlate: 0, PlannedTag: 1, PlannedCerpm: 2, PlannedLineMagnet: 3}


def _simple(line_mm: Floats) -> list[tuple[float, float]]:
    """A line with the points that it needs on paper."""
    if len(line_mm) < 3:
        return [(float(x), float(y)) for x, y in line_mm]
    points = shapely.get_coordinates(shapely.simplify(shapely.LineString(line_mm), _TOLERANCE_MM))
    return [(float(x), float(y)) for x, y in points]
