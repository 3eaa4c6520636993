"""Alignments of LandXML 1.2: lines, curves and spirals, station equations, profiles."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from app.errors import ReferenceSystemError, UnreadableUpload
from app.formats.alignments.curves import GAP_WARNING_M as GAP_M
from app.formats.alignments.curves import (
    NO_LENGTH_M,
    Curve,
    Piece,
    Profile,
    VerticalPoint,
    build_curve,
    build_profile,
    clothoid,
    report_gap,
    sample,
)
from app.formats.alignments.geometry import (
    MAX_VERTICES,
    AlignmentDeclaration,
    AlignmentFile,
    LaneGeometry,
    StationEquation,
    Stationing,
    unit_length_m,
)
from app.formats.surveys.declaration import FEET, METRES
from app.formats.xml_tree import attribute, finite_number, parse_xml
from app.geodesy import reference_system
from app.values import Floats, Ints

UNITS = {
    "millimeter": ("m", 0.001), "centimeter": ("m", 0.01), "meter": ("m", 1.0), "kilometer": ("m", 1000.0),
    "inch": (FEET, 1 / 12), "foot": (FEET, 1.0), "ussurveyfoot": ("ft-us", 1.0), "mile": (FEET, 5280.0),
}  # fmt: skip
"""Unit of length of each linear unit, and how many of it that is. Source: LandXML 1.2, metLinear and impLinear."""
_HEIGHT_UNITS = {"meter": 1.0, "kilometer": 1000.0, "feet": METRES["ft-intl"], "foot": METRES["ft-intl"],
                 "miles": 5280.0 * METRES["ft-intl"]}  # fmt: skip
"""Source: LandXML 1.2, elevationType. [m]"""
_ANGLES = {"radians": 1.0, "grads": math.pi / 200.0, "decimal degrees": math.pi / 180.0}
"""Source: LandXML 1.2, angularType; radians without one. [rad]"""
_FEET = ("feet", "foot")  # which foot they are is that of the lengths
_MAX_MISFIT_RATIO = 0.25  # of two misfits the smaller one decides if it is below this share of the larger one
_MIN_MISFIT = 1e-3  # in rad, or as a share of the length; smaller ones are the rounding of coordinates
_MISSING_M = 1.0  # [m] of a line that its profile may leave out without a warning
_TANGENT_RAD = 0.01  # lines and curves that meet with a smaller angle are tangents
_WIDE = math.sin(math.pi / 4.0)  # chord of an arc of 90 or 270 degrees, as a share of the diameter
_CURE = "correct the element at this place, or export the alignment again"
Point = tuple[float, float]
"""Easting and northing from the origin of the file. [m]"""


@dataclass(frozen=True, slots=True)
class _Scale:
    """Coordinates of the file from metres about an origin near the road."""

    unit_m: float
    height_unit_m: float
    origin: tuple[float, float]  # northing and easting in the unit of the file
    angular: str  # unit of angles, by its name in the file
    named: dict[str, set[str]]  # texts of CgPoints by name; of a name that is used twice there may be several

    def length(self, element: ET.Element, name: str, place: str) -> float:
        return attribute(element, name, place) * self.unit_m

    def angle(self, element: ET.Element, name: str, place: str) -> float:
        """An angle of the file. [rad]"""
        value = attribute(element, name, place)
        if self.angular == "decimal dd.mm.ss":  # 45.3025 is 45 degrees, 30 minutes and 25 seconds
            minutes, seconds = divmod(round(abs(value) % 1.0 * 1e8) / 1e4, 100.0)
            return math.radians(abs(value) // 1.0 + minutes / 60.0 + seconds / 3600.0)
        return value * _ANGLES.get(self.angular, 1.0)

    def point(self, element: ET.Element, tag: str, place: str) -> Point | None:
        """A child with northing and easting, or with the name of a CgPoint; None without one."""
        child = element.find(tag)
        if child is None:
            return None
        text = child.text or ""
        if child.get("pntRef"):
            texts = self.named.get(child.get("pntRef", ""), set())
            if len(texts) > 1:
                raise _wrong(
                    f"{place}: {tag} refers to {child.get('pntRef', '')[:40]!r}, and points of this name are at "
                    f"{len(texts)} places",
                    "one place for each CgPoint that an alignment refers to",
                    "give the points different names, or export the alignment with coordinates",
                )
            text = next(iter(texts), "")
        parts = text.split()
        if len(parts) < 2:
            raise _wrong(f"{place}: {tag} is {text.strip()[:40]!r}", "northing and easting")
        return self.local(parts[0], parts[1], place)

    def local(self, northing: str, easting: str, place: str) -> Point:
        north = finite_number(northing, "the northing", place) - self.origin[0]
        return (finite_number(easting, "the easting", place) - self.origin[1]) * self.unit_m, north * self.unit_m


def read_landxml(data: bytes, declaration: AlignmentDeclaration | None = None) -> AlignmentFile:
    """One lane for each alignment, along its line, with heights from its first profile.

    Ends of elements are trusted, their directions (dir, dirStart) are not. Curves and spirals turn to the side that
    their length, PI and neighbours show, also against `rot`. Feet are those of the declaration or of the CRS. Geometry
    and profile are in true distance; station equations only change what is displayed.

    Returns
    -------
    AlignmentFile
        In the unit of the file, easting first.

    Raises
    ------
    UnreadableUpload
        It is no LandXML, is damaged, contradicts itself, or has unknown elements; the message names the place.
    """
    root = parse_xml(data, "LandXML")
    named: dict[str, set[str]] = {}
    for point in root.iter("CgPoint"):
        named.setdefault(point.get("name", ""), set()).add(" ".join((point.text or "").split()))
    crs, problem = _crs(root)
    unit_m, warnings = unit_length_m(_unit(root), declaration or AlignmentDeclaration(), crs)
    angular = next((child.get("angularUnit", "") for child in root.iterfind("Units/*")), "").lower()
    scale = _Scale(unit_m, _height_unit_m(root, unit_m), (0.0, 0.0), angular, named)
    lanes: list[LaneGeometry] = []
    stationing: dict[str, Stationing] = {}
    vertices = 0
    for number, element in enumerate(root.iterfind("Alignments/Alignment"), 1):
        name = _name(element, number, {lane.name for lane in lanes})
        place = f"alignment {name}"
        shape = element.find("CoordGeom")
        if shape is None or not len(shape):
            warnings.append(f"{place}: it has no CoordGeom; it is left out.")
            continue
        if not lanes:
            scale = replace(scale, origin=_first_point(shape, scale, place))
        start = attribute(element, "staStart", place, 0.0)
        curve = _curve(shape, scale, place, warnings)
        if curve is None:
            warnings.append(f"{place}: its elements have no length; it is left out.")
            continue
        equations = _equations(element, start, curve.end_s, scale, place, warnings)
        stationing[name] = Stationing(start * scale.unit_m, equations)
        lane = _lane(curve, _profile(element, start, curve.end_s, scale, place, warnings), scale, name)
        vertices += 0 if lane.station_m is None else len(lane.station_m)
        if vertices > MAX_VERTICES:
            raise _wrong("the alignments need too many vertices", f"{MAX_VERTICES} vertices", "cut the file into parts")
        lanes.append(lane)
    if not lanes:
        raise _wrong(
            "the file has no alignment with a CoordGeom that has a length",
            "one or more",
            "export the alignments as well",
        )
    return AlignmentFile(
        format="landxml",
        lanes=tuple(lanes),
        crs=crs,
        crs_problem=problem,
        unit_m=scale.unit_m,
        stationing=stationing,
        warnings=tuple(warnings),
    )


def _wrong(message: str, limit: str, cure: str = _CURE) -> UnreadableUpload:
    return UnreadableUpload(message, field="file", limit=limit, cure=cure)


def _unit(root: ET.Element) -> tuple[str, float]:
    units = next((child for child in root.iterfind("Units/*") if child.get("linearUnit")), None)
    name = "" if units is None else units.get("linearUnit", "")
    unit = UNITS.get(name.lower())
    if unit is None:
        state = f"the linear unit {name[:40]!r} is not known" if name else "the file states no linear unit"
        raise _wrong(state, ", ".join(UNITS), "export the file with Units in metres or feet")
    return unit


def _height_unit_m(root: ET.Element, unit_m: float) -> float:
    """Unit of the elevations, where the file states another one than that of lengths. [m]"""
    units = next((child for child in root.iterfind("Units/*") if child.get("elevationUnit")), None)
    name = "" if units is None else units.get("elevationUnit", "").lower()
    if not name:
        return unit_m
    if name not in _HEIGHT_UNITS:
        raise _wrong(f"the unit of elevations {name[:40]!r} is not known", ", ".join(_HEIGHT_UNITS))
    is_feet = abs(unit_m / METRES["ft-intl"] - 1.0) < 1e-5
    return unit_m if name in _FEET and is_feet else _HEIGHT_UNITS[name]


def _crs(root: ET.Element) -> tuple[str | None, str | None]:
    """The CRS of the file; None with a reason if it states one that cannot be used."""
    system = root.find("CoordinateSystem")
    code = "" if system is None else system.get("epsgCode", "").strip()
    if not code:
        return None, None
    crs = code if code.upper().startswith("EPSG:") else f"EPSG:{code}"
    try:
        reference_system(crs)
    except ReferenceSystemError as error:
        return None, f"The epsgCode {code[:20]!r} of the file cannot be used ({error.message}); declare the CRS."
    return crs.upper(), None


def _name(element: ET.Element, number: int, taken: set[str]) -> str:
    name = element.get("name", "").strip()[:80] or f"{number}"
    found, copy = name, 2
    while found in taken:
        found, copy = f"{name} ({copy})", copy + 1
    return found


def _first_point(shape: ET.Element, scale: _Scale, place: str) -> tuple[float, float]:
    point = next((found for child in shape if (found := scale.point(child, "Start", place)) is not None), (0.0, 0.0))
    return point[1] / scale.unit_m, point[0] / scale.unit_m


@dataclass(slots=True)
class _Shape:
    """An element of a CoordGeom."""

    place: str  # for errors and warnings
    # pieces with the stated ends; of a curve or spiral twice: turned as `rot` states, and to the other side
    sides: list[list[tuple[Piece, Point]]]
    side: int = 0  # which of them is used
    decided: bool = True  # whether the geometry shows the side, not only `rot`
    stated: bool = True  # whether there is a `rot`
    # the side for which a PI lies ahead of the start, of two arcs about a centre that have the same PI
    ahead: int | None = None

    def heading(self, side: int, at_end: bool) -> float:
        """Direction at its start or end. [rad]"""
        piece, _stop = self.sides[side][-1 if at_end else 0]
        return piece.hdg + at_end * piece.length * (piece.k0 + piece.k1) / 2.0


def _curve(shape: ET.Element, scale: _Scale, place: str, warnings: list[str]) -> Curve | None:
    """The line of a CoordGeom; None if none of its elements has a length."""
    shapes: list[_Shape] = []
    empty = 0
    s = 0.0
    for child in shape:
        where = f"{place}, {child.tag} at {s / scale.unit_m:.3f} from its start"
        if child.tag not in _READERS:
            if child.tag in ("Feature", "DocFileRef"):
                continue
            known = ", ".join(_READERS)
            raise _wrong(f"{where}: the element is not known", known, "export the alignment with these elements")
        start, end = scale.point(child, "Start", where), scale.point(child, "End", where)
        if start is None or end is None:
            raise _wrong(f"{where}: Start or End is missing", "Start and End")
        if math.dist(start, end) < NO_LENGTH_M and _has_no_length(child, scale, where):
            empty += 1
            continue
        shapes.append(_READERS[child.tag](child, start, end, scale, where, warnings))
        s += sum(piece.length for piece, _stop in shapes[-1].sides[0])
    if empty:
        warnings.append(f"{place}: elements of zero length that are left out: {empty}.")
    if not shapes:
        return None
    _choose_sides(shapes, place, warnings)
    pieces: list[Piece] = []
    ends: list[Point] = []
    s = 0.0
    for piece, stop in (one for found in shapes for one in found.sides[found.side]):
        pieces.append(piece._replace(s=s))
        ends.append(stop)
        s += piece.length
    curve = build_curve(pieces)
    frame = curve.evaluate(curve.s + curve.length, np.arange(len(pieces)))
    gaps = np.hypot(*(np.stack([frame.x, frame.y]) - np.array(ends).T))
    for i in np.flatnonzero(~(gaps <= GAP_M)).tolist():
        warnings.append(report_gap(pieces[i].place, float(gaps[i]), "the element misses its End by"))
    warnings += curve.warnings
    return curve


def _has_no_length(element: ET.Element, scale: _Scale, place: str) -> bool:
    """Whether an element that ends at its start has no length, and is not a full circle or a loop."""
    match element.tag:
        case "Line":
            return True
        case "IrregularLine":
            return not any((element.findtext(tag) or "").strip() for tag in ("PntList2D", "PntList3D"))
        case _:
            return element.get("length") is not None and 0.0 <= scale.length(element, "length", place) < NO_LENGTH_M


def _choose_sides(shapes: list[_Shape], place: str, warnings: list[str]) -> None:
    """Curves and spirals that length and PI do not decide are tangents of their neighbours, else turned as stated."""
    order = range(len(shapes))
    for i in (*order, *reversed(order)):
        if not shapes[i].decided and (side := _tangent_side(shapes, i)) is not None:
            shapes[i].side, shapes[i].decided = side, True
    for i, shape in enumerate(shapes):
        if not shape.decided and not shape.stated and shape.ahead is not None:
            shape.side, shape.decided = shape.ahead, True
        if not shape.decided and shape.ahead == 1:
            warnings.append(
                f"{shape.place}: its PI lies behind its start, and nothing but rot shows whether it is the long arc "
                "about its Center; it is read as such. Compare the line with a map."
            )
        if not shape.decided and not shape.stated:
            raise _wrong(f"{shape.place}: rot is missing, and nothing else shows the side of the turn", "cw or ccw")
        if shape.side and shape.stated and _tangent_side(shapes, i) == 0:
            raise _wrong(
                f"{shape.place}: rot and the elements beside it contradict its PI and its length",
                "a rot, a PI and a length of the same turn",
            )
    turned = [shape.place for shape in shapes if shape.side or not shape.stated]
    if turned:
        warnings.append(
            f"{place}: rot is missing or contradicts the length, the PI or the elements beside it. The number of such "
            f"curves and spirals is {len(turned)}, and the first is {turned[0].removeprefix(place + ', ')}. They turn "
            "to the side that these show; compare the line with a map."
        )


def _tangent_side(shapes: list[_Shape], i: int) -> int | None:
    """The side to which a curve or spiral turns as a tangent of its decided neighbours; None if they do not show it."""
    misfits = []
    for side in range(len(shapes[i].sides)):
        angles = [0.0]
        if i > 0 and shapes[i - 1].decided:
            angles.append(shapes[i - 1].heading(shapes[i - 1].side, True) - shapes[i].heading(side, False))
        if i + 1 < len(shapes) and shapes[i + 1].decided:
            angles.append(shapes[i + 1].heading(shapes[i + 1].side, False) - shapes[i].heading(side, True))
        misfits.append(sum(abs(math.remainder(angle, math.tau)) for angle in angles))
    return _smaller(misfits) if min(misfits) < _TANGENT_RAD else None


def _smaller(misfits: list[float]) -> int | None:
    """Which of two misfits is clearly the smaller one; None if neither is, or if there is only one."""
    low, high = min(misfits), max(misfits)
    return misfits.index(low) if high > _MIN_MISFIT and low < _MAX_MISFIT_RATIO * high else None


Read = Callable[[ET.Element, Point, Point, _Scale, str, list[str]], _Shape]


def _line(start: Point, end: Point, place: str) -> tuple[Piece, Point]:
    east, north = end[0] - start[0], end[1] - start[1]
    return Piece(place, 0.0, math.hypot(east, north), *start, math.atan2(north, east)), end


def _read_line(
    _element: ET.Element, start: Point, end: Point, _scale: _Scale, place: str, _warnings: list[str]
) -> _Shape:
    return _Shape(place, [[_line(start, end, place)]])


def _read_irregular(
    element: ET.Element, start: Point, end: Point, scale: _Scale, place: str, _warnings: list[str]
) -> _Shape:
    points = [start]
    for tag, size in (("PntList2D", 2), ("PntList3D", 3)):
        numbers = (element.findtext(tag) or "").split()
        if len(numbers) % size:
            raise _wrong(f"{place}: {tag} has {len(numbers)} numbers", f"a multiple of {size}")
        points += [scale.local(*pair, place) for pair in zip(numbers[::size], numbers[1::size], strict=True)]
    points.append(end)
    pairs = [pair for pair in pairwise(points) if math.dist(*pair) > GAP_M]
    return _Shape(place, [[_line(*pair, place) for pair in pairs] or [_line(start, end, place)]])


def _read_curve(
    element: ET.Element, start: Point, end: Point, scale: _Scale, place: str, warnings: list[str]
) -> _Shape:
    """An arc through both ends: its radius is their mean distance from the centre, or stated.

    Radius and chord of nearly a semicircle hardly show its turn: a last digit of 1 mm is 40 cm at its apex with a
    radius of 100 m. There, the angle about the centre counts, or the length or delta.
    """
    centre = scale.point(element, "Center", place)
    chord = math.dist(start, end)
    first = last = 0.0
    if centre is not None:
        radii = math.dist(start, centre), math.dist(end, centre)
        radius = sum(radii) / 2.0
        if abs(radii[0] - radii[1]) > GAP_M:
            off_m = abs(radii[0] - radii[1])
            warnings.append(report_gap(place, off_m, "the distances of Start and End from Center differ by"))
        first, last = (math.atan2(point[1] - centre[1], point[0] - centre[0]) for point in (start, end))
    else:
        radius = scale.length(element, "radius", place)
    if radius <= 0.0 or not 0.0 < chord <= 2.0 * radius + GAP_M:
        raise _wrong(
            f"{place}: no arc of radius {radius / scale.unit_m:g} joins Start and End",
            "a radius of half the distance of Start and End at least, which differ",
        )
    less = math.asin(min(chord / (2.0 * radius), 1.0))
    towards = math.atan2(end[1] - start[1], end[0] - start[0])
    stated = 0.0
    if element.get("length"):
        stated = scale.length(element, "length", place) / radius
    elif element.get("delta"):
        stated = scale.angle(element, "delta", place)

    def turned(sign: float) -> Piece:
        turn = sign * (last - first) % math.tau if centre is not None else stated
        half, own = math.pi - less if turn > math.pi else less, radius
        wide = math.sin(min(turn, math.tau) / 2.0)
        if wide > _WIDE and abs(2.0 * radius * wide - chord) <= GAP_M:
            half, own = turn / 2.0, chord / (2.0 * wide)
        k = sign / own
        return Piece(place, 0.0, 2.0 * half * own, *start, towards - sign * half, k, k)

    return _both_sides(element, turned, end, scale, place)


def _read_spiral(
    element: ET.Element, start: Point, end: Point, scale: _Scale, place: str, _warnings: list[str]
) -> _Shape:
    """A clothoid, turned so that its chord has the direction from Start to End."""
    kind = element.get("spiType", "clothoid")
    if kind != "clothoid":
        raise _wrong(f"{place}: the spiral is {kind[:40]!r}", "clothoid", "export the alignment with clothoids")
    length = scale.length(element, "length", place)
    stated = [_curvature(element, name, scale, place) for name in ("radiusStart", "radiusEnd")]
    towards = math.atan2(end[1] - start[1], end[0] - start[0])

    def turned(sign: float) -> Piece:
        k0, k1 = (sign * value for value in stated)
        hdg = towards
        if length > 0.0:
            local = clothoid(*(np.array([value]) for value in (length, k0, k1, length)))
            hdg -= math.atan2(local[1][0], local[0][0])
        return Piece(place, 0.0, length, *start, hdg, k0, k1)

    return _both_sides(element, turned, end, scale, place)


def _both_sides(element: ET.Element, turned: Callable[[float], Piece], end: Point, scale: _Scale, place: str) -> _Shape:
    """A curve or spiral turned to both sides, and the side that its length or PI show.

    With Start and End, the lines through the PI fix the turn. Two arcs about one centre have the same PI, which lies
    behind the start of the longer one; their length or delta shows which of them is meant.
    """
    rot = element.get("rot", "").strip().lower()
    signs = (-1.0, 1.0) if rot == "cw" else (1.0, -1.0)
    shape = _Shape(place, [[(turned(sign), end)] for sign in signs], stated=rot in ("cw", "ccw"))
    if element.get("rot") and not shape.stated:
        raise _wrong(f"{place}: rot is {element.get('rot', '')[:20]!r}", "cw or ccw")
    pi = scale.point(element, "PI", place)
    by_length, by_lines, by_pi = [], [], []
    for side, ((piece, _stop),) in enumerate(shape.sides):
        length = 0.0
        if element.get("length"):
            length = scale.length(element, "length", place)
        elif element.get("delta") and piece.k0:
            length = scale.angle(element, "delta", place) / abs(piece.k0)
        by_length.append(abs(piece.length / length - 1.0) if length > 0.0 else 0.0)
        to_pi = [] if pi is None else [((piece.x, piece.y), pi, False), (pi, end, True)]
        angles = [
            math.atan2(two[1] - one[1], two[0] - one[0]) - shape.heading(side, at_end)
            for one, two, at_end in to_pi
            if math.dist(one, two) > NO_LENGTH_M
        ]
        by_lines.append(sum(abs(math.remainder(angle, math.pi)) for angle in angles))
        by_pi.append(sum(abs(math.remainder(angle, math.tau)) for angle in angles))
    found = _smaller(by_length)
    if found is None and min(by_lines) < _TANGENT_RAD:
        found = _smaller(by_lines)
        shape.ahead = _smaller(by_pi) if min(by_pi) < _TANGENT_RAD else None
    shape.side, shape.decided = found or 0, found is not None
    return shape


def _curvature(element: ET.Element, name: str, scale: _Scale, place: str) -> float:
    if element.get(name, "").strip().upper() in ("INF", "INFINITY"):
        return 0.0
    radius = scale.length(element, name, place)
    if radius <= 0.0:
        raise _wrong(f"{place}: {name} is {radius / scale.unit_m:g}", "above 0, or INF")
    return 1.0 / radius


_READERS: dict[str, Read] = {
    "Line": _read_line,
    "Curve": _read_curve,
    "Spiral": _read_spiral,
    "IrregularLine": _read_irregular,
}


def _equations(
    alignment: ET.Element, start: float, length_m: float, scale: _Scale, place: str, warnings: list[str]
) -> tuple[StationEquation, ...]:
    """Station equations in the order of the line. Without staInternal, the distance follows from staBack."""
    found: list[StationEquation] = []
    distance, ahead, sign = 0.0, start, 1.0
    for element in alignment.iterfind("StaEquation"):
        where = f"{place}, StaEquation {element.get('staInternal') or element.get('staBack') or '?'}"
        new_ahead = attribute(element, "staAhead", where)
        if element.get("staInternal") is None:
            at = distance + sign * (attribute(element, "staBack", where) - ahead)
        else:
            at = attribute(element, "staInternal", where) - start
        back = attribute(element, "staBack", where, ahead + sign * (at - distance))
        if not (distance <= at and at * scale.unit_m <= length_m + GAP_M):
            warnings.append(f"{where}: it lies outside the line, or before the one before; it is left out.")
            continue
        distance, ahead, sign = at, new_ahead, -1.0 if element.get("staIncrement") == "decreasing" else 1.0
        found.append(StationEquation(at * scale.unit_m, back * scale.unit_m, new_ahead * scale.unit_m, sign))
    return tuple(found)


def _profile(
    alignment: ET.Element, start: float, length_m: float, scale: _Scale, place: str, warnings: list[str]
) -> Profile | None:
    """The first designed profile; surveyed ones (ProfSurf) are not used."""
    designs = alignment.findall("Profile/ProfAlign")
    if len(designs) > 1:
        warnings.append(f"{place}: it has {len(designs)} profiles; heights are those of the first.")
    points = []
    for element in designs[0] if designs else ():
        if element.tag not in ("PVI", "ParaCurve", "UnsymParaCurve", "CircCurve"):
            if element.tag in ("Feature", "DocFileRef"):
                continue
            limit = "PVI, ParaCurve, UnsymParaCurve, CircCurve"
            raise _wrong(f"{place}: the profile has an element {element.tag[:40]!r}", limit)
        parts = (element.text or "").split()
        where = f"{place}, {element.tag} at station {parts[0][:20] if parts else '?'}"
        if len(parts) < 2:
            raise _wrong(f"{where}: the text is {(element.text or '').strip()[:40]!r}", "station and elevation")
        station = (finite_number(parts[0], "the station", where) - start) * scale.unit_m
        lengths, radius = (0.0, 0.0), None
        if element.tag == "ParaCurve":
            lengths = (scale.length(element, "length", where) / 2.0,) * 2
        elif element.tag == "UnsymParaCurve":
            lengths = scale.length(element, "lengthIn", where), scale.length(element, "lengthOut", where)
        elif element.tag == "CircCurve":
            radius = abs(scale.length(element, "radius", where))
        height = finite_number(parts[1], "the elevation", where) * scale.height_unit_m
        points.append(VerticalPoint(where, station, height, *lengths, radius))
    if not points:
        return None
    missing_m = max(points[0].s, 0.0), max(length_m - points[-1].s, 0.0)
    if max(missing_m) > _MISSING_M:
        warnings.append(
            f"{place}: the profile begins {missing_m[0]:.1f} m after the line's start and ends {missing_m[1]:.1f} m "
            "before its end; the road has no heights of its own there."
        )
    return build_profile(points)


def _lane(curve: Curve, profile: Profile | None, scale: _Scale, name: str) -> LaneGeometry:
    inner = [] if profile is None else [s for s in profile.breaks.tolist() if 0.0 < s < curve.end_s]
    breaks = np.unique(np.concatenate([curve.s, [curve.end_s], inner]))
    breaks = breaks[np.diff(breaks, prepend=-np.inf) > 1e-6]
    breaks[-1] = curve.end_s
    middle = (breaks[:-1] + breaks[1:]) / 2.0
    piece = curve.piece_at(middle)

    def bend(s: Floats, interval: Ints) -> Floats:
        vertical = 0.0 if profile is None else profile.bend(middle[interval])
        return np.hypot(curve.evaluate(s, piece[interval]).k, vertical)

    s, interval = sample(breaks, bend, f"alignment {name}")
    frame = curve.evaluate(s, piece[interval])
    inside = (np.diff(s, prepend=-1.0) > 0.0) | (np.abs(np.diff(frame.k, prepend=math.inf)) > 1e-9)
    s, x, y, k = s[inside], frame.x[inside], frame.y[inside], frame.k[inside]
    twice = np.flatnonzero(np.diff(s) == 0.0)
    x[twice + 1], y[twice + 1] = x[twice], y[twice]
    height = np.full(len(s), np.nan) if profile is None else profile.height(s)
    centre = np.stack([x, y, height], axis=1) / scale.unit_m
    centre[:, :2] += scale.origin[::-1]
    return LaneGeometry(name, centre=centre, curvature_per_m=k, station_m=s, road=name)
