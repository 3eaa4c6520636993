"""One road of OpenDRIVE as its file states it: reference line, profiles along it, lane sections."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from app.errors import UnreadableUpload
from app.formats.alignments.curves import GAP_WARNING_M, Curve, Piece, build_curve
from app.formats.alignments.geometry import BoundaryStyle, Floats
from app.formats.xml_tree import attribute

LANE_TYPES = frozenset({"driving", "entry", "exit", "onRamp", "offRamp", "connectingRamp"})
"""Lanes that vehicles drive on. Source: ASAM OpenDRIVE 1.7, e_laneType."""
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
    """A value along the road: cubics in the distance from the start of each, ``a b c d``; zero without any.

    Attributes
    ----------
    starts : ndarray, shape (n,)
    abcd : ndarray, shape (n, 4)
    """

    starts: Floats
    abcd: Floats

    def at(self, s: Floats, lookup: Floats) -> tuple[Floats, Floats, Floats]:
        """Value and first two derivatives at s, by the cubics that apply at `lookup`, the first one before it."""
        if not len(self.starts):
            return np.zeros_like(s), np.zeros_like(s), np.zeros_like(s)
        i = np.maximum(np.searchsorted(self.starts, lookup, side="right") - 1, 0)
        d = s - self.starts[i]
        a, b, c, e = self.abcd[i].T
        return a + d * (b + d * (c + d * e)), b + d * (2.0 * c + 3.0 * d * e), 2.0 * c + 6.0 * d * e


@dataclass(frozen=True, slots=True, eq=False)
class LaneRecord:
    """One lane of a section.

    Attributes
    ----------
    id : int
        Negative right of the reference line.
    drivable : bool
    width : Cubics
        In s of the road. [m]
    marks : list of (s, (inner, outer))
        Paint of the outer border from s on: style of the line nearer to the reference line, and of the other one.
    speeds : list of (s, speed)
        Limit from s on, NaN: none. [m/s]
    predecessor, successor : int or None
    """

    id: int
    drivable: bool
    width: Cubics
    marks: list[tuple[float, tuple[BoundaryStyle, BoundaryStyle]]]
    speeds: list[tuple[float, float]]
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
    """One road.

    Attributes
    ----------
    id, name, place : str
        `place` names it in errors.
    junction : str or None
        Junction that the road is part of.
    ends_at_junction, starts_at_junction : bool
    left_hand : bool
        Whether right lanes run against s.
    curve : Curve
    offset, elevation, superelevation : Cubics
        [m], [m], [rad]
    sections : tuple of Section
    speeds : list of (s, speed)
        [m/s]
    element : Element
    warnings : list of str
    """

    id: str
    name: str
    place: str
    junction: str | None
    starts_at_junction: bool
    ends_at_junction: bool
    left_hand: bool
    curve: Curve
    offset: Cubics
    elevation: Cubics
    superelevation: Cubics
    sections: tuple[Section, ...]
    speeds: list[tuple[float, float]]
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
    curve = build_curve(_pieces(element, place))
    warnings = list(curve.warnings)
    stated = attribute(element, "length", place, curve.end_s)
    if abs(stated - curve.end_s) > GAP_WARNING_M:
        warnings.append(f"{place}: the geometries end at s {curve.end_s:.3f} m, not at the length {stated:.3f} m.")
    if any(attribute(shape, key, place, 0.0) for shape in element.iterfind("lateralProfile/shape") for key in "abcd"):
        warnings.append(f"{place}: the shape of the lateral profile is left out; heights are those without it.")
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
        elevation=_cubics(element.findall("elevationProfile/elevation"), place),
        superelevation=_cubics(element.findall("lateralProfile/superelevation"), place),
        sections=_sections(element, place, curve.end_s),
        speeds=_speeds(element.findall("type"), place),
        element=element,
        warnings=warnings,
    )


def _pieces(road: ET.Element, place: str) -> list[Piece]:
    geometries = road.findall("planView/geometry")
    if not geometries:
        raise UnreadableUpload(
            f"{place}: the planView has no geometry", field="file", limit="one or more", cure="export the file again"
        )
    return [_piece(geometry, place) for geometry in geometries]


def _piece(geometry: ET.Element, place: str) -> Piece:
    place = f"{place}, geometry at s {geometry.get('s', '?')[:24]}"
    s, x, y, hdg, length = (attribute(geometry, name, place) for name in ("s", "x", "y", "hdg", "length"))
    base = Piece(place, s, length, x, y, math.remainder(hdg, math.tau))
    kinds = [child for child in geometry if child.tag != "userData"]
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
        cure="export the file as OpenDRIVE 1.4 to 1.7",
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


def _sections(road: ET.Element, place: str, end: float) -> tuple[Section, ...]:
    elements = road.findall("lanes/laneSection")
    starts = [attribute(element, "s", f"{place}, laneSection") for element in elements]
    if any(b <= a for a, b in pairwise(starts)):
        raise UnreadableUpload(
            f"{place}: the lane sections are not in the order of their s",
            field="file",
            limit="increasing s",
            cure="sort the lane sections, and remove those that stand twice",
        )
    found = []
    for element, start, stop in zip(elements, starts, [*starts, end][1:], strict=True):
        if stop - start > GAP_WARNING_M:
            lanes = [
                _lane(lane, place, start)
                for side in ("left", "right")
                for lane in element.iterfind(f"{side}/lane")
            ]  # fmt: skip
            centre = [_lane(lane, place, start) for lane in element.iterfind("center/lane")]
            found.append(Section(max(start, 0.0), stop, {lane.id: lane for lane in centre[:1] + lanes}))
    return tuple(found)


def _lane(lane: ET.Element, place: str, start: float) -> LaneRecord:
    number = lane.get("id", "")
    place = f"{place}, lane {number[:12]} at s {start:g}"
    lane_id = _integer(number)
    if lane_id is None:
        raise UnreadableUpload(
            f"{place}: the id is no number", field="file", limit="a whole number", cure="export the file again"
        )
    drivable = lane.get("type") in LANE_TYPES and lane_id != 0
    widths = lane.findall("width")
    if not widths and (drivable or lane.find("border") is not None):
        raise UnreadableUpload(
            f"{place}: the lane has no width",
            field="file",
            limit="elements width",
            cure="export lanes with widths; borders are not read",
        )
    links = {
        end: _integer(at.get("id", "")) for end in ("predecessor", "successor") for at in lane.iterfind(f"link/{end}")
    }
    return LaneRecord(
        id=lane_id,
        drivable=drivable,
        width=_cubics(widths, place, start),
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
        found.append((s, math.nan if speed is None else speed_mps(speed, place)))
    return sorted(found, key=lambda row: row[0])


def speed_mps(speed: ET.Element, place: str) -> float:
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
