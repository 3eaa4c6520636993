"""Valid LandXML with known alignments, for `benchmarks.fuzz.grammar`."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import cast

import numpy as np

from app.formats.alignments.geometry import AlignmentDeclaration, AlignmentFile, LaneGeometry, StationEquation
from app.formats.alignments.read import read_alignment
from app.formats.surveys.declaration import Unit
from app.values import Floats
from benchmarks.fuzz.courses import Course, Stretch, compare_plan, compare_warnings, integrate
from benchmarks.fuzz.grammar import Check, Rng

_FOOT_M, _US_FOOT_M = 0.3048, 1200.0 / 3937.0
_UNITS = {
    "meter": 1.0, "millimeter": 0.001, "centimeter": 0.01, "kilometer": 1000.0,
    "USSurveyFoot": _US_FOOT_M, "foot": _FOOT_M, "inch": _FOOT_M / 12, "mile": 5280 * _FOOT_M,
}  # fmt: skip
_ELEVATIONS = {"meter": 1.0, "kilometer": 1000.0, "feet": _FOOT_M, "miles": 5280 * _FOOT_M}
_ENCODINGS = ("", "UTF-8", "utf-16", "ISO-8859-1", "windows-1252")
_ANGULAR = ("", "radians", "grads", "decimal degrees", "decimal dd.mm.ss")
_NAMES = ("Straße A", "CL", "", "Ramp 7 & 8", "CL")
_FOOT_NOTE = "in feet without stating which"
_ROT_NOTE = "rot is missing or contradicts"
_LONG_ARC_NOTE = "its PI lies behind its start"
_PRINTED = 12.0
"""Greatest error of a place as a multiple of the last digit: Start, End and Center are each rounded, the direction of a
chord is that of two rounded ends, and the length of an arc of 2.3 rad that its radius alone shows is 6 times that."""


@dataclass(slots=True)
class _Writer:
    """How numbers and points are written."""

    rng: Rng
    unit_m: float
    decimals: int
    base: tuple[float, float]  # easting and northing of the first point [unit]
    angular: str  # unit of angles
    points: list[str] = field(default_factory=list)  # elements CgPoint

    @property
    def digit_m(self) -> float:
        """The last digit. [m]"""
        return 10.0**-self.decimals * self.unit_m

    def length(self, metres: float) -> str:
        return f"{metres / self.unit_m:.{self.decimals}f}"

    def pair(self, x: float, y: float, height: bool = False) -> str:
        """Northing and easting."""
        values = [self.base[1] + y / self.unit_m, self.base[0] + x / self.unit_m, *([123.4] * height)]
        return " ".join(f"{value:.{self.decimals}f}" for value in values)

    def point(self, tag: str, x: float, y: float) -> str:
        """A point as coordinates in two or three dimensions, or by the name of a CgPoint."""
        text = self.pair(x, y, bool(self.rng.random() < 0.2))
        if self.rng.random() > 0.15:
            return f"<{tag}> {text}\n</{tag}>" if self.rng.random() < 0.1 else f"<{tag}>{text}</{tag}>"
        self.points.append(f'<CgPoint name="P{len(self.points)}">{text}</CgPoint>')
        return f'<{tag} pntRef="P{len(self.points) - 1}"/>'


@dataclass(slots=True)
class _Alignment:
    """What an alignment is, and how it is written."""

    name: str
    text: str
    course: Course
    heights: tuple[_Vertical, ...]
    start: float  # [unit]
    equations: tuple[StationEquation, ...]
    warnings: list[str]


@dataclass(frozen=True, slots=True)
class _Vertical:
    """A point of a profile as it is printed, with the lengths or the radius of its rounding. [m]"""

    s: float
    z: float
    before: float = 0.0
    after: float = 0.0
    radius: float = 0.0


def write_landxml(rng: Rng) -> tuple[bytes, Check]:
    """Alignments of tangents, arcs, clothoids and polylines, whose line is the integral of its curvature."""
    unit = str(rng.choice(list(_UNITS), p=[0.4, 0.05, 0.05, 0.05, 0.15, 0.2, 0.05, 0.05]))
    epsg, foot, declared = "", "", None
    if unit in ("foot", "inch", "mile"):  # which foot it is, the CRS or the declaration says
        foot = str(rng.choice(["", "crs", "declared ft-us", "declared ft-intl"]))
        epsg = "2264" if foot == "crs" else ""
        declared = foot.split()[1] if foot.startswith("declared") else None
    elif unit == "meter" and rng.random() < 0.4:
        epsg = str(rng.choice(["25832", "EPSG:25832"]))
    unit_m = _UNITS[unit] * (_US_FOOT_M / _FOOT_M if foot in ("crs", "declared ft-us") else 1.0)
    digits = math.ceil(math.log10(unit_m)) + int(rng.integers(3, 9))
    base = (500_000.0 / unit_m + float(rng.uniform(0, 1000)), 5_400_000.0 / unit_m + float(rng.uniform(0, 1000)))
    if rng.random() < 0.2:
        base = (0.0, 0.0)
    writer = _Writer(rng, unit_m, max(digits, 0), base, str(rng.choice(_ANGULAR)))
    height = str(rng.choice(["", *_ELEVATIONS])) if unit in ("meter", "foot", "USSurveyFoot") else "meter"
    is_foot = abs(unit_m / _FOOT_M - 1) < 1e-5
    height_m = unit_m if not height or (height == "feet" and is_foot) else _ELEVATIONS[height]
    found: list[_Alignment] = []
    for _ in range(int(rng.integers(1, 4))):
        found.append(_alignment(writer, height_m, {one.name for one in found}, len(found) + 1))
    warnings = [warning for one in found for warning in one.warnings] + ([_FOOT_NOTE] if foot in ("", "crs") and (
        unit in ("foot", "inch", "mile")) else [])  # fmt: skip
    text = _document(rng, unit, height, epsg, writer, found)

    def check() -> str:
        file = read_alignment(text, declaration=AlignmentDeclaration(unit=cast("Unit | None", declared)))
        return _compare(file, found, writer, warnings)

    return text, check


def _document(rng: Rng, unit: str, height: str, epsg: str, writer: _Writer, found: Sequence[_Alignment]) -> bytes:
    system = "Metric" if "meter" in unit else "Imperial"
    elevation = f' elevationUnit="{height}"' if height else ""
    groups = "".join(one.text for one in found)
    points = f"<CgPoints>{''.join(writer.points)}</CgPoints>" if writer.points else ""
    crs = f'<CoordinateSystem epsgCode="{epsg}"/>' if epsg else ""
    body = f"{crs}{points}<Alignments>{groups}</Alignments>" if rng.random() < 0.5 else (
        f"<Alignments>{groups}</Alignments>{crs}{points}")  # fmt: skip
    angular = f' angularUnit="{writer.angular}"' if writer.angular else ""
    space = 'xmlns{}="http://www.landxml.org/schema/LandXML-1.2"'
    text = (
        f'<LandXML {space} version="1.2" date="2026-01-01" time="08:00:00"><Units><{system} linearUnit="{unit}"'
        f' areaUnit="squareMeter"{angular}{elevation}/></Units>{body}</LandXML>'
    )
    prefix = str(rng.choice(["", "", "lx"]))
    if prefix:
        text = re.sub(r"<(/?)([A-Z])", rf"<\1{prefix}:\2", text)
    text = text.replace("xmlns{}", f"xmlns:{prefix}" if prefix else "xmlns")
    encoding = str(rng.choice(_ENCODINGS))
    stated = f' encoding="{encoding}"' if encoding else ""
    return f'<?xml version="1.0"{stated}?>{text}'.encode(encoding or "utf-8")


# === The line.


def _alignment(writer: _Writer, height_m: float, taken: set[str], number: int) -> _Alignment:
    rng = writer.rng
    name = str(rng.choice(_NAMES))
    read_as = name.strip() or str(number)
    unique, copy = read_as, 2
    while unique in taken:
        unique, copy = f"{read_as} ({copy})", copy + 1
    elements, parts, notes = _elements(writer)
    course = Course(parts)
    start = float(rng.choice([0.0, 0.0, 1000.0, -250.0, 12345.678]))
    equations, equation_text = _equations(writer, start, course.end_s)
    heights, profile, warnings = _profile(writer, start, course.end_s, height_m)
    stated = f' staStart="{start!r}"' if start or rng.random() < 0.5 else ""
    comment = "<!-- made -->" if rng.random() < 0.2 else ""
    text = (
        f'<Alignment name="{name.replace("&", "&amp;")}" length="{writer.length(course.end_s)}"'
        f"{stated}>{comment}<CoordGeom>{''.join(elements)}</CoordGeom>{equation_text}{profile}</Alignment>"
    )
    return _Alignment(unique, text, course, heights, start, equations, notes + warnings)


def _elements(writer: _Writer) -> tuple[list[str], list[Stretch], list[str]]:
    """Elements of a CoordGeom, their parts of the line, and the warnings that they need."""
    rng = writer.rng
    count = int(rng.integers(1, 6))
    kinds = [str(kind) for kind in rng.choice(["line", "arc", "spiral", "irregular"], count, p=[0.3, 0.35, 0.25, 0.1])]
    kinked = [bool(rng.random() < 0.1) for _ in range(count - 1)]  # the joint after each element
    at = (float(rng.uniform(-2000, 2000)), float(rng.uniform(-2000, 2000)), float(rng.uniform(-3, 3)))
    if writer.base == (0.0, 0.0) and rng.random() < 0.2:
        at = (0.0, 0.0, at[2])
    texts: list[str] = []
    parts: list[Stretch] = []
    notes: set[str] = set()
    s = 0.0
    for i, kind in enumerate(kinds):
        if rng.random() < 0.06:
            texts.append(_zero(writer, at))
            notes.add("elements of zero length that are left out")
        has_kink = (i > 0 and kinked[i - 1]) or (i < count - 1 and kinked[i])
        beside = [kinds[j] for j in (i - 1, i + 1) if 0 <= j < count]
        by_neighbour = not has_kink and "line" in beside
        match kind:
            case "line":
                own = [integrate(at, s, float(rng.uniform(5, 150)), 0.0, 0.0)]
                length = f' length="{writer.length(float(own[0].s[-1] - s))}"' if rng.random() < 0.7 else ""
                texts.append(f"<Line{length}>{_ends(writer, own[0])}</Line>")
            case "irregular":
                own, text = _irregular(writer, at, s)
                texts.append(text)
            case _:
                write = _arc if kind == "arc" else _spiral
                stretch, text, note = write(writer, at, s, has_kink, by_neighbour)
                own = [stretch]
                texts.append(text)
                notes |= {note} if note else set()
        parts += own
        x, y, hdg = own[-1].end
        turn = float(rng.uniform(0.1, 0.4) * rng.choice([-1, 1])) if i < count - 1 and kinked[i] else 0.0
        at, s = (x, y, hdg + turn), float(own[-1].s[-1])
    if rng.random() < 0.1:
        texts.append('<Feature code="x"><Property label="a" value="1"/></Feature>')
    return texts, parts, sorted(notes)


def _ends(writer: _Writer, part: Stretch, *more: tuple[str, float, float]) -> str:
    """Start, End and other points in any order, as the schema allows."""
    points = [("Start", float(part.x[0]), float(part.y[0])), ("End", float(part.x[-1]), float(part.y[-1])), *more]
    if writer.rng.random() < 0.3:
        writer.rng.shuffle(points)
    return "".join(writer.point(*point) for point in points)


def _zero(writer: _Writer, at: tuple[float, float, float]) -> str:
    """An element that ends where it starts."""
    place = writer.pair(at[0], at[1])
    ends = f"<Start>{place}</Start><End>{place}</End>"
    centre = f"<Center>{writer.pair(at[0], at[1] + 100)}</Center>"
    return str(
        writer.rng.choice(
            [
                f'<Line length="0">{ends}</Line>',
                f"<Line>{ends}</Line>",
                f'<Curve rot="cw" radius="{writer.length(100)}" length="0">{ends}{centre}</Curve>',
                f'<Spiral rot="cw" spiType="clothoid" length="0" radiusStart="INF" radiusEnd="{writer.length(100)}">'
                f"{ends}</Spiral>",
            ]
        )
    )


def _irregular(writer: _Writer, at: tuple[float, float, float], s: float) -> tuple[list[Stretch], str]:
    """A polyline; its list of points may hold Start and End."""
    parts: list[Stretch] = []
    for _ in range(int(writer.rng.integers(1, 6))):
        parts.append(integrate(at, s, float(writer.rng.uniform(2, 30)), 0.0, 0.0))
        x, y, hdg = parts[-1].end
        at, s = (x, y, hdg + float(writer.rng.uniform(-0.3, 0.3))), float(parts[-1].s[-1])
    points = [(float(part.x[0]), float(part.y[0])) for part in parts] + [parts[-1].end[:2]]
    has_ends, is_3d = writer.rng.random() < 0.5, bool(writer.rng.random() < 0.5)
    inner = points if has_ends else points[1:-1]
    tag = "PntList3D" if is_3d else "PntList2D"
    listed = f"<{tag}>{' '.join(writer.pair(*point, is_3d) for point in inner)}</{tag}>"
    ends = writer.point("Start", *points[0]) + writer.point("End", *points[-1])
    return parts, f"<IrregularLine>{ends}{listed if inner else ''}</IrregularLine>"


def _arc(
    writer: _Writer, at: tuple[float, float, float], s: float, has_kink: bool, by_neighbour: bool
) -> tuple[Stretch, str, str]:
    """An arc with some of Center, PI, length and radius, enough to know it; `rot` is wrong where they show the side."""
    rng = writer.rng
    if rng.random() < 0.25:
        radius, turn = float(rng.uniform(20, 80)), float(rng.uniform(math.pi + 0.05, 5.5))
    elif rng.random() < 0.3:
        radius, turn = float(rng.uniform(20, 80)), float(rng.uniform(2.4, math.pi - 0.05))
    else:
        radius, turn = float(rng.uniform(30, 900)), float(rng.uniform(0.05, 2.4))
        turn = max(min(turn, 300 / radius), 0.05)
    side = float(rng.choice([-1, 1]))
    part = integrate(at, s, radius * turn, side / radius, side / radius)
    has_centre = bool(rng.random() < 0.7)
    # Without a centre the ends and the radius are those of two arcs, about which the length or the angle decide.
    sized = "" if has_centre or turn < 2.3 else str(rng.choice(["length", "delta"]))
    has_length = sized == "length" or bool(rng.random() < 0.5)
    has_delta = sized == "delta" or bool(rng.random() < 0.3)
    has_pi = abs(math.sin(turn)) > 0.1 and bool(rng.random() < 0.4)
    if has_kink and not (has_centre and has_length):
        has_centre = has_length = True
    # Of both arcs about a centre the same point is the PI, ahead of the start of the short one and behind the long one.
    shown = (has_pi and not has_centre) or (has_centre and (has_length or has_delta)) or by_neighbour
    attributes, note = _rot(writer, side, shown and (not has_kink))
    attributes += ' crvType="arc"' if rng.random() < 0.5 else ""
    attributes += f' radius="{writer.length(radius)}"' if not has_centre or rng.random() < 0.7 else ""
    attributes += f' length="{writer.length(radius * turn)}"' if has_length else ""
    attributes += f' delta="{_angle(turn, writer.angular)}"' if has_delta else ""
    more = []
    if has_centre:
        more.append(("Center", at[0] - side * radius * math.sin(at[2]), at[1] + side * radius * math.cos(at[2])))
    more += _pi(part) if has_pi else []
    return part, f"<Curve{attributes}>{_ends(writer, part, *more)}</Curve>", note


def _angle(turn: float, unit: str) -> str:
    if unit == "decimal dd.mm.ss":
        minutes, seconds = divmod(round(math.degrees(turn) * 3600 * 1e4), 600_000)  # of 0.1 ms
        return f"{minutes // 60}.{minutes % 60:02d}{seconds:06d}"
    return f"{turn * {'grads': 200 / math.pi, 'decimal degrees': 180 / math.pi}.get(unit, 1.0):.9f}"


def _spiral(
    writer: _Writer, at: tuple[float, float, float], s: float, has_kink: bool, by_neighbour: bool
) -> tuple[Stretch, str, str]:
    """A clothoid from or to a straight line, or between two radii."""
    rng = writer.rng
    length, kind = float(rng.uniform(20, 120)), int(rng.integers(3))
    one, two = float(rng.uniform(60, 300)), float(rng.uniform(60, 300))
    k0, k1 = (0.0 if kind == 0 else 1 / one), (0.0 if kind == 1 else 1 / two)
    side = float(rng.choice([-1, 1]))
    part = integrate(at, s, length, side * k0, side * k1)
    has_pi = has_kink or bool(rng.random() < 0.5)
    infinite = str(rng.choice(["INF", "INF", "Infinity"]))
    attributes, note = _rot(writer, side, (has_pi or by_neighbour) and not has_kink)
    attributes += f' length="{writer.length(length)}" spiType="clothoid"'
    attributes += f' radiusStart="{writer.length(one) if kind else infinite}"'
    attributes += f' radiusEnd="{infinite if kind == 1 else writer.length(two)}"'
    return part, f"<Spiral{attributes}>{_ends(writer, part, *(_pi(part) if has_pi else []))}</Spiral>", note


def _rot(writer: _Writer, side: float, shown: bool) -> tuple[str, str]:
    """The attribute, wrong or missing in some curves whose side is shown by something else, and its warning."""
    right, wrong = ("ccw", "cw") if side > 0 else ("cw", "ccw")
    if shown and writer.rng.random() < 0.15:
        return (f' rot="{wrong}"' if writer.rng.random() < 0.7 else ""), _ROT_NOTE
    return f' rot="{right}"', ""


def _pi(part: Stretch) -> list[tuple[str, float, float]]:
    """Where the lines through both ends along the curve meet."""
    chord = float(part.x[-1] - part.x[0]), float(part.y[-1] - part.y[0])
    h0, h1 = float(part.hdg[0]), float(part.hdg[-1])
    along = (chord[0] * math.sin(h1) - chord[1] * math.cos(h1)) / math.sin(h1 - h0)
    return [("PI", float(part.x[0]) + along * math.cos(h0), float(part.y[0]) + along * math.sin(h0))]


# === Stations and heights.


def _equations(writer: _Writer, start: float, length_m: float) -> tuple[tuple[StationEquation, ...], str]:
    """Gaps and overlaps of the displayed stations, all as they are printed."""
    rng, unit_m = writer.rng, writer.unit_m
    places = np.sort(rng.uniform(0, length_m, int(rng.integers(0, 3)) if rng.random() < 0.5 else 0)) / unit_m
    found, texts = [], []
    before, ahead = 0.0, start  # the place of the equation before, and what it displays [unit]
    sign = 1.0  # -1 where stations fall
    for place in places.tolist():
        back_text = f"{ahead + sign * (place - before):.{writer.decimals}f}"
        ahead_text = f"{float(back_text) + float(rng.uniform(-500, 500)) / unit_m:.{writer.decimals}f}"
        internal = f"{start + place:.{writer.decimals}f}"
        form = int(rng.integers(3))
        attributes = f' staAhead="{ahead_text}"'
        attributes += f' staInternal="{internal}"' if form != 0 else ""
        attributes += f' staBack="{back_text}"' if form != 1 else ""
        increment = str(rng.choice(["", "increasing", "decreasing"]))
        attributes += f' staIncrement="{increment}"' if increment else ""
        texts.append(f"<StaEquation{attributes}/>")
        at = float(internal) - start if form != 0 else before + sign * (float(back_text) - ahead)
        back = float(back_text) if form != 1 else ahead + sign * (at - before)
        before, ahead, sign = at, float(ahead_text), -1.0 if increment == "decreasing" else 1.0
        found.append(StationEquation(at * unit_m, back * unit_m, ahead * unit_m, sign))
    return tuple(found), "".join(texts)


def _profile(
    writer: _Writer, start: float, length_m: float, height_m: float
) -> tuple[tuple[_Vertical, ...], str, list[str]]:
    """A profile as it is printed, which may begin late and end early, and its text and warnings."""
    rng, unit_m = writer.rng, writer.unit_m
    if rng.random() < 0.25:
        return (), "", []
    first = float(rng.choice([0.0, 0.0, -20.0, min(12.0, length_m / 4)]))
    last = length_m + float(rng.choice([0.0, 0.0, 30.0, -min(12.0, length_m / 4)]))
    count = int(rng.integers(2, 6))
    places = np.linspace(first, last, count)
    if count > 2:
        places[1:-1] += rng.uniform(-0.2, 0.2, count - 2) * (last - first) / (count - 1)
    z = float(rng.uniform(-50, 800)) if rng.random() < 0.9 else 0.0
    decimals = max(math.ceil(math.log10(height_m)) + int(rng.integers(3, 7)), 0)
    printed = []
    for i, place in enumerate(places.tolist()):
        station = f"{start + place / unit_m:.{writer.decimals + 1}f}"
        z += float(rng.uniform(-0.06, 0.06)) * (place - float(places[i - 1]) if i else 0.0)
        printed.append((station, f"{z / height_m:.{decimals}f}"))
    s = [(float(station) - start) * unit_m for station, _ in printed]
    heights = [float(height) * height_m for _, height in printed]
    found, texts = [], []
    for i, (station, height) in enumerate(printed):
        text, inner = f"{station} {height}", 0 < i < count - 1
        kind = str(rng.choice(["PVI", "ParaCurve", "UnsymParaCurve", "CircCurve"])) if inner else "PVI"
        room = 0.5 * min(s[i] - s[i - 1], s[i + 1] - s[i]) if inner else 0.0
        one, two = (f"{float(rng.uniform(0.3, 1)) * room / unit_m:.{writer.decimals + 3}f}" for _ in range(2))
        match kind:
            case "ParaCurve":
                half = float(one) * unit_m
                texts.append(f'<ParaCurve length="{2 * float(one)!r}">{text}</ParaCurve>')
                found.append(_Vertical(s[i], heights[i], half, half))
            case "UnsymParaCurve":
                texts.append(f'<UnsymParaCurve lengthIn="{one}" lengthOut="{two}">{text}</UnsymParaCurve>')
                found.append(_Vertical(s[i], heights[i], float(one) * unit_m, float(two) * unit_m))
            case "CircCurve":
                angles = [math.atan2(heights[j + 1] - heights[j], s[j + 1] - s[j]) for j in (i - 1, i)]
                tangent = float(rng.uniform(0.3, 0.99)) * room
                radius = tangent / math.tan(max(abs(angles[1] - angles[0]), 1e-4) / 2)
                shown = f"{radius / unit_m:.{writer.decimals + 3}f}"
                length = f"{radius * abs(angles[1] - angles[0]) / unit_m:.{writer.decimals}f}"
                texts.append(f'<CircCurve length="{length}" radius="{shown}">{text}</CircCurve>')
                found.append(_Vertical(s[i], heights[i], radius=float(shown) * unit_m))
            case _:
                texts.append(f"<PVI>{text}</PVI>")
                found.append(_Vertical(s[i], heights[i]))
    warnings = ["the profile begins"] if max(first, length_m - last) > 1.0 else []
    other = '<ProfAlign name="2"><PVI>0 1</PVI><PVI>9 1</PVI></ProfAlign>' if rng.random() < 0.1 else ""
    warnings += ["it has 2 profiles"] if other else []
    surface = '<ProfSurf name="ground"><PntList2D>0 1 5 2</PntList2D></ProfSurf>' if rng.random() < 0.2 else ""
    body = f'{surface}<ProfAlign name="design">{"".join(texts)}</ProfAlign>{other}'
    return tuple(found), f'<Profile name="p">{body}</Profile>', warnings


def height_at(points: Sequence[_Vertical], s: float) -> float:
    """Height of a profile at a distance along the line; NaN beyond its ends. [m]"""
    if not points or not points[0].s <= s <= points[-1].s:
        return math.nan
    grades = [(b.z - a.z) / (b.s - a.s) for a, b in pairwise(points)]
    for i, point in enumerate(points[1:-1], 1):
        g1, g2, x = grades[i - 1], grades[i], s - point.s
        if point.radius:
            a1, a2 = math.atan(g1), math.atan(g2)
            tangent, sign = point.radius * math.tan(abs(a2 - a1) / 2), math.copysign(1.0, a2 - a1)
            if -tangent * math.cos(a1) <= x <= tangent * math.cos(a2):
                centre_s = -tangent * math.cos(a1) - sign * point.radius * math.sin(a1)
                centre_z = point.z - tangent * math.sin(a1) + sign * point.radius * math.cos(a1)
                return centre_z - sign * math.sqrt(point.radius**2 - (x - centre_s) ** 2)
        elif point.before and -point.before <= x <= point.after:
            # Two parabolas that meet below the point, or above it, by the distance of the vertex from the curve.
            vertex = point.before * point.after / (2 * (point.before + point.after)) * (g2 - g1)
            if x <= 0:
                return point.z + g1 * x + vertex * ((point.before + x) / point.before) ** 2
            return point.z + g2 * x + vertex * ((point.after - x) / point.after) ** 2
    i = min(max(sum(point.s <= s for point in points) - 1, 0), len(grades) - 1)
    return points[i].z + grades[i] * (s - points[i].s)


# === What was read.


def _compare(file: AlignmentFile, found: Sequence[_Alignment], writer: _Writer, warnings: Sequence[str]) -> str:
    if problem := compare_warnings(file.warnings, warnings, (_LONG_ARC_NOTE,)):
        return problem
    if [lane.name for lane in file.lanes] != [one.name for one in found]:
        return f"the names are {[lane.name for lane in file.lanes]}"
    if file.unit_m is None or abs(file.unit_m / writer.unit_m - 1) > 1e-12:
        return f"the unit is {file.unit_m} m"
    for lane, alignment in zip(file.lanes, found, strict=True):
        stationing = file.stationing[alignment.name]
        if abs(stationing.start_m - alignment.start * writer.unit_m) > 1e-9:
            return f"alignment {alignment.name}: the start station is {stationing.start_m} m"
        if len(stationing.equations) != len(alignment.equations):
            return f"{len(stationing.equations)} station equations of {len(alignment.equations)}"
        for one, two in zip(stationing.equations, alignment.equations, strict=True):
            pairs = ((one.distance_m, two.distance_m), (one.back_m, two.back_m), (one.ahead_m, two.ahead_m))
            if max(abs(a - b) for a, b in pairs) > 1e-6 or one.rate != two.rate:
                return f"the station equation is {one}, not {two}"
        if problem := _compare_lane(lane, alignment, writer):
            return f"alignment {alignment.name}: {problem}"
    return ""


def _compare_lane(lane: LaneGeometry, alignment: _Alignment, writer: _Writer) -> str:
    if lane.centre is None or lane.station_m is None:
        return "no centre, or no stations"
    s, xy = lane.station_m, (lane.centre[:, :2] - writer.base) * writer.unit_m
    # doubles of the coordinates' size have their own last digit
    last = (_PRINTED + len(alignment.course.parts)) * (writer.digit_m + 2e-9) + 1e-7
    problem = compare_plan(alignment.course, s, xy, lane.curvature_per_m, last, 1e-7 + last / 20)
    if problem:
        return problem
    heights = lane.centre[:, 2] * writer.unit_m
    at = partial(height_at, alignment.heights)
    return _compare_heights(s, heights, at, last)


def _compare_heights(s: Floats, heights: Floats, at: partial[float], last: float) -> str:
    wanted = np.array([at(float(one)) for one in s])
    inner = np.array([max((abs(at(float(one) + d) - at(float(one))) for d in (-last, last)), default=0.0) for one in s])
    # Where the profile ends, the rounding of stations decides whether there is a height.
    missing = np.isnan(heights) != np.isnan(wanted)
    if (missing & ~np.isnan(inner)).any():
        return f"heights are there and missing in other places: s {s[missing][0]:.3f}"
    off = np.abs(np.nan_to_num(heights - wanted))
    if off.max() > last / 5 + 1e-6:
        return f"a height is {off.max():.5f} m off at s {s[int(off.argmax())]:.2f}"
    middle = (s[1:] + s[:-1]) / 2
    chord = (heights[1:] + heights[:-1]) / 2 - [at(float(one)) for one in middle]
    if np.abs(np.nan_to_num(chord)).max() > 0.0011 + last:
        return f"the height of a chord is {np.nanmax(np.abs(chord)):.4f} m off"
    return ""
