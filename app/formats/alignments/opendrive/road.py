"""One road of OpenDRIVE as its file states it: reference line, profiles along it, lane sections."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from app.errors import UnreadableUpload
from app.formats.alignments.curves import (
    GAP_ERROR_M,
    GAP_WARNING_M,
    NO_LENGTH_M,
    Curve,
    Frame,
    Piece,
    build_curve,
    sample,
)
from app.formats.alignments.geometry import BoundaryStyle, LaneGeometry
from app.formats.xml_tree import attribute
from app.values import Floats, Ints

LANE_TYPES = frozenset({"driving", "entry", "exit", "onRamp", "offRamp", "connectingRamp", "slipLane"})
"""Lanes that vehicles drive on. Source: ASAM OpenDRIVE 1.8, e_laneType."""
_ADDITIONAL = frozenset({"userData", "include", "dataQuality"})
"""What every element may hold besides its own content. Source: ASAM OpenDRIVE 1.5 to 1.8, g_additionalData."""
_LANE_ID = re.compile(r"-?[0-9]{1,9}")
_SPEED_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704}
_STYLES = {
    "solid": BoundaryStyle.SOLID,
    "broken": BoundaryStyle.DASHED,
    "none": BoundaryStyle.NONE,
}
"""First words of e_roadMarkType; marks of two lines have two words. Source: ASAM OpenDRIVE 1.7."""


@dataclass(frozen=True, slots=True, eq=False)
class Cubics:
    """A value along the road: cubics in the distance from the start of each, ``a b c d``; zero before the first one."""

    starts: Floats  # shape (n,)
    abcd: Floats  # shape (n, 4)

    def at(self, s: Floats, lookup: Floats) -> tuple[Floats, Floats, Floats]:
        """Value and first two derivatives at s, by the cubics that apply at `lookup`."""
        if not len(self.starts):
            return np.zeros_like(s), np.zeros_like(s), np.zeros_like(s)
        i = np.searchsorted(self.starts, lookup, side="right") - 1
        d = s - self.starts[i]
        a, b, c, e = np.where(i >= 0, self.abcd[i].T, 0.0)
        return a + d * (b + d * (c + d * e)), b + d * (2.0 * c + 3.0 * d * e), 2.0 * c + 6.0 * d * e


@dataclass(frozen=True, slots=True, eq=False)
class LaneRecord:
    """One lane of a section."""

    id: int  # negative right of the reference line
    drivable: bool
    reversed: bool  # whether vehicles drive against the direction of its side of the road
    width: Cubics  # [m] in s of the road
    border: Cubics | None  # [m] left of the reference line, of the outer edge; instead of a width
    # whether it is not inclined with the road, and [m] how far its middle is raised above the road
    level: bool
    raised_m: float
    # paint of the outer border from s on: style of the line nearer to the reference line, and of the other one
    marks: list[tuple[float, tuple[BoundaryStyle, BoundaryStyle]]]
    speeds: list[tuple[float, float]]  # [m/s] limit from s on, NaN: none
    predecessor: int | None
    successor: int | None


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """Lanes between two distances along the road. [m]"""

    start: float
    end: float
    lanes: dict[int, LaneRecord]


@dataclass(frozen=True, slots=True, eq=False)
class Road:
    """One road."""

    # `id`, `name`, `place`: `place` names it in errors
    id: str
    name: str
    place: str
    junction: str | None  # junction that the road is part of
    starts_at_junction: bool
    ends_at_junction: bool
    left_hand: bool  # whether right lanes run against s
    curve: Curve
    # `offset` [m], `elevation` [m] and `superelevation` [rad] of s
    offset: Cubics
    elevation: Cubics
    superelevation: Cubics
    sections: tuple[Section, ...]
    speeds: list[tuple[float, float]]  # [m/s]
    element: ET.Element
    warnings: list[str]


def parse_road(element: ET.Element) -> Road:
    """The road of an element ``road``.

    Raises
    ------
    UnreadableUpload
        A number is missing or wrong, a geometry is unknown, or pieces do not meet.
    """
    road_id = element.get("id", "")[:40]
    place = f"road {road_id}"
    warnings: list[str] = []
    curve = build_curve(_pieces(element, place, warnings))
    warnings += curve.warnings
    start = float(curve.s[0])
    if abs(start) > GAP_WARNING_M:
        warnings.append(f"{place}: the planView begins at s {start:.3f} m; lanes begin at s {max(start, 0.0):.3f} m.")
    stated = attribute(element, "length", place, curve.end_s)
    if abs(stated - curve.end_s) > GAP_WARNING_M:
        warnings.append(f"{place}: the geometries end at s {curve.end_s:.3f} m, not at the length {stated:.3f} m.")
    if any(attribute(shape, key, place, 0.0) for shape in element.iterfind("lateralProfile/shape") for key in "abcd"):
        warnings.append(f"{place}: the shape of the lateral profile is left out; heights are those without it.")
    if element.find("lateralProfile/crossSectionSurface") is not None:
        warnings.append(f"{place}: the crossSectionSurface is left out; heights are those without it.")
    elevation = _cubics(element.findall("elevationProfile/elevation"), place)
    if len(elevation.starts) and elevation.starts[0] - max(start, 0.0) > GAP_WARNING_M:
        warnings.append(f"{place}: the file states no elevation before s {elevation.starts[0]:.3f} m; it is 0 there.")
    link = {end: element.find(f"link/{end}") for end in ("predecessor", "successor")}
    meets = {end: at is not None and at.get("elementType") == "junction" for end, at in link.items()}
    junction = element.get("junction", "-1")
    return Road(
        id=road_id,
        name=element.get("name", "").strip()[:80],
        place=place,
        junction=None if junction in ("-1", "") else junction[:40],
        starts_at_junction=meets["predecessor"],
        ends_at_junction=meets["successor"],
        left_hand=element.get("rule", "RHT").upper() == "LHT",
        curve=curve,
        offset=_cubics(element.findall("lanes/laneOffset"), place),
        elevation=elevation,
        superelevation=_cubics(element.findall("lateralProfile/superelevation"), place),
        sections=_sections(element, place, (max(start, 0.0), curve.end_s), warnings),
        speeds=_speeds(element.findall("type"), place),
        element=element,
        warnings=warnings,
    )


def _pieces(road: ET.Element, place: str, warnings: list[str]) -> list[Piece]:
    geometries = road.findall("planView/geometry")
    pieces = [piece for geometry in geometries if (piece := _piece(geometry, place)) is not None]
    if not pieces:
        state = "has geometries of zero length only" if geometries else "has no geometry"
        raise UnreadableUpload(
            f"{place}: the planView {state}", field="file", limit="one or more", cure="export the file again"
        )
    if len(pieces) < len(geometries):
        warnings.append(f"{place}: geometries of zero length, which are left out: {len(geometries) - len(pieces)}.")
    return pieces


def _piece(geometry: ET.Element, place: str) -> Piece | None:
    """The piece of a geometry; None if it has no length."""
    place = f"{place}, geometry at s {geometry.get('s', '?')[:24]}"
    s, x, y, hdg, length = (attribute(geometry, name, place) for name in ("s", "x", "y", "hdg", "length"))
    if 0.0 <= length < NO_LENGTH_M:
        return None
    base = Piece(place, s, length, x, y, math.remainder(hdg, math.tau))
    kinds = [child for child in geometry if child.tag not in _ADDITIONAL]
    kind = kinds[0].tag if len(kinds) == 1 else None
    shape = kinds[0] if kinds else geometry
    if kind == "line":
        return base
    if kind == "arc":
        k = attribute(shape, "curvature", place)
        return base._replace(k0=k, k1=k)
    if kind == "spiral":
        return base._replace(k0=attribute(shape, "curvStart", place), k1=attribute(shape, "curvEnd", place))
    if kind == "poly3":
        v = _four(shape, ("a", "b", "c", "d"), place)
        return base._replace(u=(0.0, length, 0.0, 0.0), v=v, by_length=True)
    if kind == "paramPoly3":
        # Without pRange: as pyxodr and esmini take it, though the schema of 1.7 asks for it.
        p = length if shape.get("pRange") == "arcLength" else 1.0
        u, v = (
            tuple(c * p**n for n, c in enumerate(_four(shape, tuple(f"{k}{axis}" for k in "abcd"), place)))
            for axis in "UV"
        )
        return base._replace(u=u, v=v)
    found = ", ".join(child.tag[:40] for child in kinds) or "nothing"
    raise UnreadableUpload(
        f"{place}: the geometry is {found}",
        field="file",
        limit="one of line, arc, spiral, poly3, paramPoly3",
        cure="export the file as OpenDRIVE 1.4 to 1.8",
    )


def _four(element: ET.Element, names: tuple[str, ...], place: str) -> tuple[float, ...]:
    return tuple(attribute(element, name, place) for name in names)


def _cubics(elements: list[ET.Element], place: str, start: float | None = None) -> Cubics:
    """Of elements with s, or with sOffset from the start of a section."""
    rows = []
    for element in elements:
        where = f"{place}, {element.tag}"
        s = attribute(element, "s", where) if start is None else start + attribute(element, "sOffset", where, 0.0)
        rows.append((s, *(attribute(element, key, where) for key in "abcd")))
    rows.sort(key=lambda row: row[0])
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    return Cubics(table[:, 0], table[:, 1:])


def _sections(road: ET.Element, place: str, span: tuple[float, float], warnings: list[str]) -> tuple[Section, ...]:
    """Lane sections between two distances along the road."""
    elements = road.findall("lanes/laneSection")
    starts = [attribute(element, "s", f"{place}, laneSection") for element in elements]
    if any(b <= a for a, b in pairwise(starts)):
        raise UnreadableUpload(
            f"{place}: the lane sections are not in the order of their s",
            field="file",
            limit="increasing s",
            cure="sort the lane sections, and remove those that stand twice",
        )
    found: list[Section] = []
    if starts and starts[0] - span[0] > GAP_WARNING_M:
        warnings.append(f"{place}: the first lane section begins at s {starts[0]:.3f} m; there are no lanes before it.")
    for element, start, stop in zip(elements, starts, [*starts, span[1]][1:], strict=True):
        if stop - max(start, span[0]) > GAP_WARNING_M:
            lanes = [
                _lane(lane, place, start, warnings)
                for side in ("left", "right")
                for lane in element.iterfind(f"{side}/lane")
            ]
            centre = [_lane(lane, place, start, warnings) for lane in element.iterfind("center/lane")]
            section = Section(max(start, span[0]), stop, {lane.id: lane for lane in centre[:1] + lanes})
            if found and element.get("singleSide", "false") in ("true", "1"):
                _continue_lanes(found[-1], section)
            found.append(section)
    return tuple(found)


def _continue_lanes(before: Section, section: Section) -> None:
    """Lanes of a side that a section with `singleSide` does not have go on as in the section before."""
    sides = {lane_id > 0 for lane_id in section.lanes if lane_id}
    for lane in [lane for lane in before.lanes.values() if lane.id and (lane.id > 0) not in sides]:
        before.lanes[lane.id] = replace(lane, successor=lane.id)
        section.lanes[lane.id] = replace(lane, predecessor=lane.id)


def _lane(lane: ET.Element, place: str, start: float, warnings: list[str]) -> LaneRecord:
    number = lane.get("id", "")
    place = f"{place}, lane {number[:12]} at s {start:g}"
    lane_id = _integer(number)
    if lane_id is None:
        raise UnreadableUpload(
            f"{place}: the id is no number", field="file", limit="a whole number", cure="export the file again"
        )
    drivable = lane.get("type") in LANE_TYPES and lane_id != 0
    widths = lane.findall("width")
    borders = lane.findall("border")
    if not widths and not borders and drivable:
        raise UnreadableUpload(
            f"{place}: the lane has no width",
            field="file",
            limit="elements width or border",
            cure="export lanes with widths",
        )
    raised_m = [
        (attribute(h, "inner", place, 0.0) + attribute(h, "outer", place, 0.0)) / 2.0 for h in lane.findall("height")
    ]
    if drivable and len(set(raised_m)) > 1:
        warnings.append(f"{place}: its height above the road changes; it is read with the first height.")
    direction = lane.get("direction", "standard")
    if drivable and direction not in ("standard", "reversed"):
        state = "vehicles drive on it both ways" if direction == "both" else "this direction is not known"
        warnings.append(
            f"{place}: its direction is {direction[:20]!r} ({state}); it is read in the direction of its side of the "
            "road."
        )
    if drivable and lane.get("dynamicLaneDirection", "false") in ("true", "1"):
        warnings.append(
            f"{place}: its direction of travel changes (dynamicLaneDirection); it is read in its usual direction only."
        )
    links = {
        end: _integer(at.get("id", "")) for end in ("predecessor", "successor") for at in lane.iterfind(f"link/{end}")
    }
    return LaneRecord(
        id=lane_id,
        drivable=drivable,
        reversed=direction == "reversed",
        width=_cubics(widths, place, start),
        border=None if widths or not borders else _cubics(borders, place, start),
        level=lane.get("level", "false") in ("true", "1"),
        raised_m=raised_m[0] if raised_m else 0.0,
        marks=sorted(
            (
                (start + attribute(mark, "sOffset", place, 0.0), _styles(mark.get("type", "")))
                for mark in lane.iterfind("roadMark")
            ),
            key=lambda mark: mark[0],
        ),
        speeds=_speeds(lane.findall("speed"), place, start),
        predecessor=links.get("predecessor"),
        successor=links.get("successor"),
    )


def _integer(text: str) -> int | None:
    return int(text) if _LANE_ID.fullmatch(text.strip()) else None


def _styles(mark: str) -> tuple[BoundaryStyle, BoundaryStyle]:
    """Styles of the lines nearer to and farther from the reference line; left and right of it for lane 0."""
    words = mark.replace("botts dots", "broken").split() or [""]
    return _STYLES.get(words[0], BoundaryStyle.UNKNOWN), _STYLES.get(words[-1], BoundaryStyle.UNKNOWN)


def _speeds(elements: list[ET.Element], place: str, start: float | None = None) -> list[tuple[float, float]]:
    """Limits of road types, or of lanes with sOffset. [m], [m/s]"""
    found = []
    for element in elements:
        speed = element if start is not None else element.find("speed")
        s = attribute(element, "s", place, 0.0) if start is None else start + attribute(element, "sOffset", place, 0.0)
        found.append((s, math.nan if speed is None else speed_m_s(speed, place)))
    return sorted(found, key=lambda row: row[0])


def speed_m_s(speed: ET.Element, place: str) -> float:
    if speed.get("max", "").strip() in ("", "no limit", "undefined"):
        return math.nan
    unit = speed.get("unit", "m/s").strip()
    if unit not in _SPEED_UNITS:
        raise UnreadableUpload(
            f"{place}: the unit of the speed is {unit[:20]!r}",
            field="file",
            limit=", ".join(_SPEED_UNITS),
            cure="correct the unit, or export the file again",
        )
    value = attribute(speed, "max", f"{place}, speed") * _SPEED_UNITS[unit]
    return value if value > 0.0 else math.nan


# === Lanes of an OpenDRIVE road in their direction of travel, their sections joined where the file links them.


MIN_WIDTH_M = 0.05
"""Stretches of lanes that are narrower are left out. [m] Tapers begin and end at zero width."""
_MIN_STRETCH = 0.02
"""Length of a lane per length of the reference line; with less it lies at the centre of a bend."""
_SAME = (1e-6, 1e-6, 1e-3, 1e-6)
"""Changes of curvature [1/m], superelevation [rad], width [m] and speed [m/s] that are none. Source: rounding."""
_X, _Y, _Z, _K, _ROLL, _WIDTH, _SPEED, _S, _OK = range(9)

Values = tuple[Floats, Floats, Floats]
"""A value along the road, and its first two derivatives."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One lane, with what places events on it."""

    geometry: LaneGeometry
    ids: list[tuple[float, float, int]]  # [m] its lane numbers between distances along the road
    forward: bool  # whether vehicles drive in the direction of s

    def point_at(self, s: float) -> tuple[float, float] | None:
        """Place on the centre line at a distance along the road; None beyond its ends. [m]"""
        assert self.geometry.centre is not None
        assert self.geometry.station_m is not None
        centre, station = self.geometry.centre, self.geometry.station_m
        if not self.forward:
            centre, station = centre[::-1], station[::-1]
        if not station[0] <= s <= station[-1]:
            return None
        return float(np.interp(s, station, centre[:, 0])), float(np.interp(s, station, centre[:, 1]))

    def lane_id_at(self, s: float) -> int | None:
        """Its lane number at a distance along the road; None beyond its ends."""
        return next((lane for start, end, lane in self.ids if start <= s <= end), None)


class Grid:
    """Vertices of a road's lanes: distances along the road, and the smooth interval that each belongs to."""

    def __init__(self, road: Road) -> None:
        self.road = road
        self.breaks, self.section = _breaks(road)
        self.middle = (self.breaks[:-1] + self.breaks[1:]) / 2.0
        self.piece = road.curve.piece_at(self.middle)
        lines = max(len(section.lanes) for section in road.sections)
        self.s, self.interval = sample(self.breaks, self._bend, road.place, lines)
        self.lookup = self.middle[self.interval]
        self.frame = road.curve.evaluate(self.s, self.piece[self.interval])
        self.roll = road.superelevation.at(self.s, self.lookup)[0]
        self.height = road.elevation.at(self.s, self.lookup)[0]
        self.offset = road.offset.at(self.s, self.lookup)

    def rows(self, section: int, interval: Ints) -> slice:
        """Rows of a section among rows with these intervals."""
        of = self.section[interval]
        return slice(int(np.searchsorted(of, section)), int(np.searchsorted(of, section, side="right")))

    def _bend(self, s: Floats, interval: Ints) -> Floats:
        """Greatest second derivative of the drivable lanes, across them, by distance along the road."""
        road, lookup = self.road, self.middle[interval]
        frame = road.curve.evaluate(s, self.piece[interval])
        offset = road.offset.at(s, lookup)
        worst = np.abs(frame.k)
        for number, section in enumerate(road.sections):
            rows = self.rows(number, interval)
            part = Frame(*(values[rows] for values in frame))
            for lane, inner, outer in lane_edges(section, _cut(offset, rows), s[rows], lookup[rows]):
                if lane.drivable:
                    stretch, curvature = lane_curvature(part, _middle(inner, outer))
                    bend = np.where(_turned(part, _middle(inner, outer)), 0.0, np.abs(curvature) * stretch**2)
                    worst[rows] = np.maximum(worst[rows], bend)
        return np.asarray(np.hypot(worst, road.elevation.at(s, lookup)[2]))


def lane_edges(
    section: Section, offset: Values, s: Floats, lookup: Floats
) -> Iterator[tuple[LaneRecord, Values, Values]]:
    """Every lane but lane 0, from the inside out, with its edges left of the reference line. [m]"""
    for sign in (1.0, -1.0):
        edge = offset
        for number in sorted((number for number in section.lanes if number * sign > 0), key=abs):
            lane = section.lanes[number]
            if lane.border is not None:
                outer = lane.border.at(s, lookup)
            else:
                width = lane.width.at(s, lookup)
                outer = (edge[0] + sign * width[0], edge[1] + sign * width[1], edge[2] + sign * width[2])
            yield lane, edge, outer
            edge = outer


def lane_curvature(frame: Frame, t: Values) -> tuple[Floats, Floats]:
    """Length per distance along the road, and curvature, of a line at t left of the reference line. [1], [1/m]

    With T, N along and across the reference line, the line's derivatives by s are (1 - k t) T + t' N and
    -(2 k t' + k' t) T + (k (1 - k t) + t'') N.
    """
    along = 1.0 - frame.k * t[0]
    stretch = np.hypot(along, t[1])
    across = along * (frame.k * along + t[2]) + t[1] * (frame.dk * t[0] + 2.0 * frame.k * t[1])
    with np.errstate(all="ignore"):
        return stretch, across / stretch**3


def build_tracks(road: Road, grid: Grid, names: set[str], road_name: str) -> list[Track]:
    """Lanes of a road in their direction of travel; what is left out or mended goes to the road's warnings.

    Parameters
    ----------
    names : set of str
        Names that are taken; those of the lanes are added.
    """
    parts = _lane_parts(road, grid)
    prefix = f"junction {road.junction} {road.place}" if road.junction is not None else road.place
    tracks = []
    for chain in _chains(road.sections):
        first = chain[0]
        against = road.sections[first[0]].lanes[first[1]].reversed
        forward = ((first[1] < 0) != road.left_hand) != against
        table = np.concatenate([parts[key] for key in chain])
        styles = _lane_styles(road, chain)
        ids = [(road.sections[i].start, road.sections[i].end, lane) for i, lane in chain]
        name = f"{prefix} lane {first[1] if forward else chain[-1][1]}"
        runs = _runs(table, f"{prefix} lane {first[1]}", road.warnings)
        if not forward:
            signs = np.where(np.isin(np.arange(table.shape[1]), (_K, _ROLL)), -1.0, 1.0)
            table, runs = table[::-1], [run[::-1] * signs for run in reversed(runs)]
        for number, run in enumerate(runs):
            start = (run if number else table)[0, _S]
            tracks.append(Track(_geometry(run, _free(name, start, names), styles, road_name), ids, forward))
    return tracks


def _breaks(road: Road) -> tuple[Floats, Ints]:
    """Where a cubic, geometry, limit or section begins or ends, and the section of every interval between."""
    cubics = [road.offset, road.elevation, road.superelevation]
    cubics += [lane.border or lane.width for section in road.sections for lane in section.lanes.values()]
    speeds = [s for section in road.sections for lane in section.lanes.values() for s, _ in lane.speeds]
    starts = np.concatenate([c.starts for c in cubics] + [road.curve.s, speeds, [s for s, _ in road.speeds]])
    ends = np.array([section.start for section in road.sections] + [road.sections[-1].end])
    inner = np.unique(starts[(starts > ends[0]) & (starts < ends[-1])])
    near = ends[np.minimum(np.searchsorted(ends, inner - 1e-6), len(ends) - 1)]
    inner = inner[np.abs(near - inner) > 1e-6]
    inner = inner[np.diff(inner, prepend=-np.inf) > 1e-6]
    breaks = np.union1d(inner, ends)
    return breaks, np.searchsorted(ends, breaks[:-1], side="right") - 1


def _cut(values: Values, rows: slice) -> Values:
    return values[0][rows], values[1][rows], values[2][rows]


def _middle(inner: Values, outer: Values) -> Values:
    return (inner[0] + outer[0]) / 2.0, (inner[1] + outer[1]) / 2.0, (inner[2] + outer[2]) / 2.0


def _turned(frame: Frame, t: Values) -> npt.NDArray[np.bool_]:
    """Where a line lies at the centre of a bend of the reference line, or beyond it."""
    return np.asarray(1.0 - frame.k * t[0] < _MIN_STRETCH)


def _lane_parts(road: Road, grid: Grid) -> dict[tuple[int, int], Floats]:
    """Vertices of drivable lanes by section and lane number, shape (N, 9), in the direction of s."""
    parts = {}
    for number, section in enumerate(road.sections):
        rows = grid.rows(number, grid.interval)
        s, lookup, roll = grid.s[rows], grid.lookup[rows], grid.roll[rows]
        frame = Frame(*(values[rows] for values in grid.frame))
        cos = np.cos(roll)
        limit = _steps(road.speeds, lookup, np.full(len(s), np.nan))
        hinges: dict[bool, Values] = {}  # by side: edge of the inclined road, beyond which lanes are level
        for lane, inner, outer in lane_edges(section, _cut(grid.offset, rows), s, lookup):
            if lane.level:
                hinges.setdefault(lane.id > 0, inner)
            if not lane.drivable:
                continue
            middle = _middle(inner, outer)
            inclined = hinges.get(lane.id > 0, middle)
            # widths are measured on the inclined road
            t = (
                middle[0] - inclined[0] * (1.0 - cos),
                middle[1] - inclined[1] * (1.0 - cos),
                middle[2] - inclined[2] * (1.0 - cos),
            )
            width = np.abs(outer[0] - inner[0]) * np.sign((outer[0] - inner[0]) * lane.id)
            parts[number, lane.id] = np.stack(
                [
                    frame.x - np.sin(frame.hdg) * t[0],
                    frame.y + np.cos(frame.hdg) * t[0],
                    grid.height[rows] + inclined[0] * np.sin(roll) + lane.raised_m,
                    lane_curvature(frame, t)[1],
                    np.zeros(len(s)) if (lane.id > 0) in hinges else roll,
                    width,
                    _steps(lane.speeds, lookup, limit),
                    s,
                    (width >= MIN_WIDTH_M) & ~_turned(frame, t),
                ],
                axis=1,
            )
    return parts


def _steps(records: list[tuple[float, float]], lookup: Floats, before: Floats) -> Floats:
    """Values of the records that apply, each from its start on."""
    if not records:
        return before
    i = np.searchsorted([s for s, _ in records], lookup, side="right") - 1
    return np.where(i >= 0, np.array([value for _, value in records])[np.maximum(i, 0)], before)


def _chains(sections: tuple[Section, ...]) -> list[list[tuple[int, int]]]:
    """Drivable lanes that follow each other from section to section, as pairs of section and lane number."""
    following: dict[tuple[int, int], tuple[int, int]] = {}
    for i, (section, after) in enumerate(pairwise(sections)):
        for lane in section.lanes.values():
            backwards = (other.id for other in after.lanes.values() if other.predecessor == lane.id)
            next_id = lane.successor if lane.successor is not None else next(backwards, None)
            found = after.lanes.get(next_id) if next_id is not None else None
            if found is None or (i + 1, found.id) in following.values():
                continue
            if lane.drivable and found.drivable and found.id * lane.id > 0 and found.reversed == lane.reversed:
                following[i, lane.id] = (i + 1, found.id)
    taken = set(following.values())
    chains = []
    for i, section in enumerate(sections):
        for lane in sorted(section.lanes.values(), key=lambda lane: (abs(lane.id), lane.id)):
            if lane.drivable and (i, lane.id) not in taken:
                chain = [(i, lane.id)]
                while chain[-1] in following:
                    chain.append(following[chain[-1]])
                chains.append(chain)
    return chains


def _runs(table: Floats, place: str, warnings: list[str]) -> list[Floats]:
    """Stretches without a jump sideways and wide enough; a vertex stands twice only where its values jump."""
    same = np.diff(table[:, _S]) == 0.0
    step = np.diff(table[:, : _Z + 1], axis=0)
    gap = np.where(same, np.sqrt(np.nansum(step * step, axis=1)), 0.0)
    usable = (table[:-1, _OK] > 0.0) & (table[1:, _OK] > 0.0)
    for i in np.flatnonzero(usable & (gap > GAP_WARNING_M)):
        state = "it is divided there" if gap[i] > GAP_ERROR_M else "the jump is closed"
        warnings.append(f"{place}: it jumps by {gap[i]:.3f} m at s {table[i, _S]:.3f} m; {state}.")
    closed = np.flatnonzero(same & (gap <= GAP_ERROR_M))
    table[closed + 1, : _Z + 1] = table[closed, : _Z + 1]
    change = np.abs(np.diff(table[:, _K : _SPEED + 1], axis=0))
    change[np.isnan(table[1:, _K : _SPEED + 1]) & np.isnan(table[:-1, _K : _SPEED + 1])] = 0.0
    twice = np.zeros(len(table), dtype=np.bool_)
    twice[1:] = same & (gap <= GAP_ERROR_M) & (change <= _SAME).all(axis=1)
    divided = np.concatenate([[False], gap > GAP_ERROR_M])[~twice]
    table = table[~twice]
    turns = np.flatnonzero(divided | (np.diff(table[:, _OK], prepend=table[0, _OK]) != 0.0))
    found = []
    for run in np.split(table, turns):
        length = run[-1, _S] - run[0, _S]
        if run[0, _OK] and length > GAP_WARNING_M:
            found.append(run)
        elif not run[0, _OK]:
            warnings.append(
                f"{place}: it is narrower than {MIN_WIDTH_M * 1000:g} mm, or at the centre of a bend, from s "
                f"{run[0, _S]:.3f} to {run[-1, _S]:.3f} m; this stretch is left out."
            )
    return found


def _free(name: str, s: float, names: set[str]) -> str:
    """The name, or one with the distance along the road, or with a number as well."""
    place = f"{name} from s {s:.0f}"
    found = name if name not in names else place
    number = 2
    while found in names:
        found, number = f"{place} ({number})", number + 1
    names.add(found)
    return found


def _lane_styles(road: Road, chain: list[tuple[int, int]]) -> tuple[BoundaryStyle, BoundaryStyle]:
    """Paint left and right in the direction of travel: the styles along the greater part of the lane."""
    lengths: tuple[dict[BoundaryStyle, float], ...] = (defaultdict(float), defaultdict(float))
    for i, number in chain:
        section = road.sections[i]
        inside = section.lanes.get(_inside(section, number))
        # Of a double line on the neighbour's border the far one is nearer to this lane; lane 0 has left, right.
        near = 0 if inside is not None and inside.id == 0 and number > 0 else 1
        for side, lane, line in ((0, inside, near), (1, section.lanes[number], 0)):
            marks = lane.marks if lane is not None else []
            ends = [*[mark[0] for mark in marks], section.end][1:]
            covered = 0.0
            for mark, end in zip(marks, ends, strict=True):
                part = max(min(end, section.end) - max(mark[0], section.start), 0.0)
                lengths[side][mark[1][line]] += part
                covered += part
            lengths[side][BoundaryStyle.UNKNOWN] += section.end - section.start - covered
    inner, outer = (max(part, key=lambda style: part[style]) for part in lengths)
    against = road.sections[chain[0][0]].lanes[chain[0][1]].reversed
    return (outer, inner) if road.left_hand != against else (inner, outer)


def _inside(section: Section, number: int) -> int:
    """The neighbour nearer to the reference line."""
    sign = 1 if number > 0 else -1
    return max((n for n in section.lanes if 0 < n * sign < number * sign), key=abs, default=0)


def _geometry(run: Floats, name: str, styles: tuple[BoundaryStyle, BoundaryStyle], road: str) -> LaneGeometry:
    speed = run[:, _SPEED]
    return LaneGeometry(
        name=name,
        centre=np.ascontiguousarray(run[:, : _Z + 1]),
        curvature_per_m=run[:, _K],
        superelevation_rad=run[:, _ROLL],
        width_m=run[:, _WIDTH],
        speed_limit_m_s=None if np.isnan(speed).all() else speed,
        station_m=run[:, _S],
        left_style=styles[0],
        right_style=styles[1],
        road=road,
    )
