"""Valid OpenDRIVE with known lanes, and the list of the grammars of roads, for `benchmarks.fuzz.grammar`."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise

import numpy as np
from pyproj import CRS, Transformer

from app.formats.alignments.geometry import AlignmentFile, LaneGeometry
from app.formats.alignments.read import read_alignment
from app.values import Floats
from benchmarks.fuzz.courses import CHORD_M, Course, Stretch, chord_errors, compare_warnings, integrate
from benchmarks.fuzz.grammar import Check, Grammar, Rng
from benchmarks.fuzz.grammar_dxf import write_dxf, write_dxf_survey
from benchmarks.fuzz.grammar_landxml import write_landxml

_TOLERANCE_M = 1e-5
"""Greatest difference of places. [m] Numbers are written with all digits; the integrals here are good to 1e-7 m."""
_ALONG_M = 0.008
"""Greatest difference along a paramPoly3 by arcLength. [m] Its parameter is the length only about so well."""
_CURVATURE = 2e-5  # [1/m] of second differences of the places
_JUMP_M = 0.1  # [m] at which a lane is divided
_DRIVEN = ("driving", "driving", "driving", "driving", "entry", "exit")
_OTHER = ("shoulder", "border", "sidewalk", "none", "median", "parking")
_UTM = "+proj=utm +zone=32 +ellps=GRS80 +units=m +no_defs"
_LOCAL = "+proj=tmerc +lat_0=48.7 +lon_0=8.5 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs"

Records = list[tuple[float, ...]]
"""Cubics: start, a, b, c, d."""


@dataclass(slots=True)
class _Lane:
    """One lane number, the same in all sections that have it."""

    id: int
    type: str
    width: Records
    is_reversed: bool = False
    is_level: bool = False

    @property
    def is_driven(self) -> bool:
        return self.type in _DRIVEN


@dataclass(slots=True)
class _Section:
    start: float
    end: float
    ids: list[int]
    late: dict[int, float] = field(default_factory=dict)  # [m] from where an outermost lane has a width
    is_linked: bool = False  # with the section before
    raised: dict[int, tuple[float, float]] = field(default_factory=dict)  # [m] heights of lanes, inner and outer
    side: int = 0  # the only one that it has; the lanes of the other one go on

    def continues(self, lane_id: int) -> bool:
        """Whether a lane is not written, because it is that of the section before."""
        return self.side * lane_id < 0


@dataclass(slots=True)
class _Road:
    """What a road is, and how it is written."""

    id: int
    course: Course
    lanes: dict[int, _Lane]
    sections: list[_Section]
    offset: Records
    elevation: Records
    roll: Records
    is_left_hand: bool
    has_borders: bool
    along_m: float
    text: str = ""

    def place(self, section: _Section, lane_id: int, s: Floats, lookup: Floats) -> Floats:
        """Places of the middle of a lane, shape (N, 3), by the records that hold at `lookup`."""
        x, y, hdg, _k = self.course.at(s, lookup)
        inner, outer, first_level = self.edges(section, lane_id, s, lookup)
        middle, roll = (inner + outer) / 2, _values(self.roll, s, lookup)
        on_slope = middle if first_level is None else first_level
        across = on_slope * np.cos(roll) + (middle - on_slope)
        z = _values(self.elevation, s, lookup) + on_slope * np.sin(roll) + sum(section.raised.get(lane_id, (0, 0))) / 2
        return np.stack([x - np.sin(hdg) * across, y + np.cos(hdg) * across, z], axis=1)

    def edges(self, section: _Section, lane_id: int, s: Floats, lookup: Floats) -> tuple[Floats, Floats, Floats | None]:
        """Inner and outer edge left of the reference line, and the inner edge of the first level lane up to it."""
        side, edge, first_level = (1 if lane_id > 0 else -1), _values(self.offset, s, lookup), None
        inner = edge
        for number in sorted((n for n in section.ids if n * side > 0), key=abs):
            lane, inner = self.lanes[number], edge
            if lane.is_level and first_level is None:
                first_level = edge
            width = _values(lane.width, s, lookup)
            if number in section.late:
                width = np.where(lookup < section.start + section.late[number], 0.0, width)
            edge = edge + side * width
            if number == lane_id:
                break
        return inner, edge, first_level

    def breaks(self) -> Floats:
        """Where records begin. [m]"""
        places = [record[0] for one in (self.offset, self.elevation, self.roll) for record in one]
        places += [record[0] for lane in self.lanes.values() for record in lane.width]
        places += [one.start for one in self.sections] + [
            one.start + at for one in self.sections for at in one.late.values()
        ]
        return np.concatenate([self.course.joints, places])


def _values(records: Records, s: Floats, lookup: Floats) -> Floats:
    """Cubics of the records that hold at `lookup`; 0 before the first one."""
    found = np.zeros_like(s)
    for (start, a, b, c, d), end in zip(records, [*(one[0] for one in records[1:]), math.inf], strict=False):
        on = (lookup >= start) & (lookup < end)
        ds = s[on] - start
        found[on] = a + ds * (b + ds * (c + ds * d))
    return found


def _xodr(rng: Rng) -> tuple[bytes, Check]:
    """Roads of any geometry with lanes on both sides, whose middles are computed from the integral of the curvature."""
    minor = int(rng.integers(4, 9))
    form = str(rng.choice(["epsg", "utm", "wkt", "local", "none", "empty"], p=[0.3, 0.2, 0.1, 0.2, 0.1, 0.1]))
    base = (0.0, 0.0) if form == "local" else (458_000.0 + float(rng.uniform(0, 500)), 5_428_000.0)
    offset = (0.0, 0.0, 0.0, 0.0)
    if rng.random() < 0.4:
        offset = (*base, float(rng.choice([0.0, 12.5])), float(rng.choice([0.0, rng.uniform(-3, 3)])))
        base = (0.0, 0.0)
    warnings: list[str] = []
    roads = [_road(rng, number, base, minor, warnings) for number in range(1, int(rng.choice([2, 2, 2, 3])))]
    is_placed = form not in ("none", "empty")
    if any(offset) and not is_placed:
        warnings.append("offset is not applied")
    reference = {
        "epsg": "<geoReference><![CDATA[EPSG:25832]]></geoReference>",
        "utm": f"<geoReference><![CDATA[\n{_UTM} ]]></geoReference>",
        "wkt": f"<geoReference><![CDATA[{_wkt()}]]></geoReference>",
        "local": f"<geoReference>{_LOCAL}</geoReference>",
        "none": "",
        "empty": "<geoReference></geoReference>",
    }[form]
    names = zip(("x", "y", "z", "hdg"), offset, strict=True)
    values = " ".join(f'{name}="{value!r}"' for name, value in names)
    moved = f"<offset {values}/>" if any(offset) else ""
    encoding = str(rng.choice(["", "UTF-8", "utf-16", "ISO-8859-1", "gb2312"]))
    stated = f' encoding="{encoding}"' if encoding else ""
    text = (
        f'<?xml version="1.0"{stated}?><OpenDRIVE><header revMajor="1" revMinor="{minor}" name="Straße"'
        f' north="0" south="0" east="0" west="0">{reference}{moved}</header>{"".join(road.text for road in roads)}'
        "</OpenDRIVE>"
    )
    if encoding == "gb2312":
        text = text.replace("Straße", "道路")

    def check() -> str:
        file = read_alignment(text.encode(encoding or "utf-8"))
        return _compare(file, roads, offset if is_placed else (0.0, 0.0, 0.0, 0.0), form, warnings)

    return text.encode(encoding or "utf-8"), check


@cache
def _wkt() -> str:
    return CRS.from_epsg(25832).to_wkt("WKT1_GDAL")


# === Roads.


def _road(rng: Rng, number: int, base: tuple[float, float], minor: int, warnings: list[str]) -> _Road:
    start = (base[0] + 2000.0 * (number - 1) + float(rng.uniform(10, 90)), base[1] + float(rng.uniform(10, 90)))
    geometries, parts, along_m = _geometries(rng, (*start, float(rng.uniform(-3, 3))), minor)
    course = Course(parts)
    length = course.end_s
    has_borders = bool(rng.random() < 0.15)  # lane offsets are not used together with borders
    offset = _cubics(rng, length, float(rng.uniform(-2, 2)), 0.004, is_late=bool(rng.random() < 0.3))
    if has_borders or rng.random() < 0.4:
        offset = []
    elevation, roll = Records(), Records()
    if rng.random() < 0.7:
        elevation = _cubics(rng, length, float(rng.uniform(0, 300)), 0.05, is_late=bool(rng.random() < 0.2))
        if elevation[0][0] > 0:
            warnings.append("the file states no elevation before")
            if rng.random() < 0.5:  # to be reported, as it cannot be right
                elevation = [(s, a + 100.0, *rest) for s, a, *rest in elevation]
    if rng.random() < 0.5:
        roll = _cubics(rng, length, float(rng.uniform(-0.05, 0.05)), 2e-4, is_late=bool(rng.random() < 0.3))
    lanes, sections = _lanes(rng, length, minor, has_borders)
    if rng.random() < 0.1:
        _raise_lanes(rng, lanes, sections)
    rule = str(rng.choice(["", "RHT", "LHT"])) if minor >= 5 else ""
    road = _Road(number, course, lanes, sections, offset, elevation, roll, rule == "LHT", has_borders, along_m)
    elevations = "".join(_record("elevation", "s", one) for one in elevation)
    rolls = "".join(_record("superelevation", "s", one) for one in roll)
    offsets = "".join(_record("laneOffset", "s", one) for one in offset)
    stated = f' rule="{rule}"' if rule else ""
    road.text = (
        f'<road name="" length="{length!r}" id="{number}" junction="-1"{stated}><link/>'
        f"<planView>{''.join(geometries)}</planView><elevationProfile>{elevations}</elevationProfile>"
        f"<lateralProfile>{rolls}</lateralProfile><lanes>{offsets}"
        f"{''.join(_section(rng, road, k, minor) for k in range(len(sections)))}</lanes></road>"
    )
    return road


def _geometries(rng: Rng, at: tuple[float, float, float], minor: int) -> tuple[list[str], list[Stretch], float]:
    """Elements, their stretches, and how well the parameters of cubics are lengths. [m]"""
    texts: list[str] = []
    parts: list[Stretch] = []
    s, along_m = 0.0, 0.0
    kinds = ["line", "arc", "spiral", "normalized", "arcLength", *(["poly3"] if minor <= 5 else [])]
    for _ in range(int(rng.integers(1, 5))):
        kind = str(rng.choice(kinds))
        length, k0, k1 = (
            float(rng.uniform(30, 110)),
            float(rng.uniform(-0.015, 0.015)),
            float(rng.uniform(-0.015, 0.015)),
        )
        match kind:
            case "line":
                part, shape = integrate(at, s, length, 0.0, 0.0), "<line/>"
            case "arc":
                part, shape = integrate(at, s, length, k0, k0), f'<arc curvature="{k0!r}"/>'
            case "spiral":
                k0 = 0.0 if rng.random() < 0.4 else k0
                part, shape = integrate(at, s, length, k0, k1), f'<spiral curvStart="{k0!r}" curvEnd="{k1!r}"/>'
            case _:
                part, shape = _cubic(rng, at, s, kind, length)
                length = float(part.s[-1] - s)
                along_m += _ALONG_M if kind == "arcLength" else 0.0
        extra = str(rng.choice(["", "", "", '<userData code="a" value="b"/>']))
        if minor >= 5 and rng.random() < 0.1:
            extra += (
                '<dataQuality><error xyAbsolute="0.1" xyRelative="0.1" zAbsolute="0.1" zRelative="0.1"/></dataQuality>'
            )
        x, y, hdg = at
        texts.append(
            f'<geometry s="{s!r}" x="{x!r}" y="{y!r}" hdg="{hdg!r}" length="{length!r}">{shape}{extra}</geometry>'
        )
        parts.append(part)
        at, s = part.end, float(part.s[-1])
    return texts, parts, along_m


def _cubic(rng: Rng, at: tuple[float, float, float], s: float, kind: str, length: float) -> tuple[Stretch, str]:
    """A cubic along and across the direction at its start, by its arc length."""
    bend, twist = float(rng.uniform(-1, 1)), float(rng.uniform(-1, 1))
    u, v = np.array([0.0, length, 0.0, 0.0]), np.array([0.0, 0.0, 0.12 * bend, 0.08 * twist]) * length
    if kind == "normalized":
        u[2:] = np.array([0.06, -0.05]) * twist * length
    if kind == "arcLength":  # nearly a clothoid, so that the parameter is the length
        v[2:] = np.array([0.04 * bend, 0.001 * twist]) * length
        u[3] = -2 / 3 * v[2] ** 2 / length
    p = np.linspace(0, 1, 4001)
    halfway = (p[:-1] + p[1:]) / 2
    speed, between = (np.hypot(*(_derivative(one, at, 1) for one in (u, v))) for at in (p, halfway))
    run = np.concatenate([[0.0], np.cumsum((speed[:-1] + 4 * between + speed[1:]) / 6 / 4000)])
    total = length if kind == "arcLength" else float(run[-1])
    nodes = np.linspace(0, total, math.ceil(total / 0.2) + 1)
    q = np.interp(nodes, run * (total / run[-1]), p)
    x, y, hdg = at
    (u0, v0), (u1, v1), (u2, v2) = ([_derivative(one, q, order) for one in (u, v)] for order in range(3))
    place = x + u0 * math.cos(hdg) - v0 * math.sin(hdg), y + u0 * math.sin(hdg) + v0 * math.cos(hdg)
    k = (u1 * v2 - v1 * u2) / np.hypot(u1, v1) ** 3
    part = Stretch(s + nodes, *place, hdg + np.arctan2(v1, u1), k)
    if kind == "poly3":  # across by the distance along the direction
        a, b, c, d = (float(value) / length**n for n, value in enumerate(v))
        return part, f'<poly3 a="{a!r}" b="{b!r}" c="{c!r}" d="{d!r}"/>'
    scale = length if kind == "arcLength" else 1.0
    shown = " ".join(
        f'{letter}{axis}="{float(value) / scale**n!r}"'
        for axis, one in (("U", u), ("V", v))
        for n, (letter, value) in enumerate(zip("abcd", one, strict=True))
    )
    stated = "" if kind == "normalized" and rng.random() < 0.1 else f' pRange="{kind}"'
    return part, f"<paramPoly3 {shown}{stated}/>"


def _derivative(coefficients: Floats, p: Floats, order: int) -> Floats:
    return np.asarray(
        np.polynomial.Polynomial(coefficients).deriv(order)(p) if order else np.polyval(coefficients[::-1], p)
    )


def _cubics(rng: Rng, length: float, level: float, slope: float, *, is_late: bool, max_records: int = 4) -> Records:
    """Records that join in value, from a start on; those that begin late begin at 0."""
    starts = [float(rng.uniform(10, min(40, length / 2))) if is_late else 0.0]
    while starts[-1] < length - 60 and len(starts) < max_records:
        starts.append(starts[-1] + float(rng.uniform(30, 60)))
    records = Records()
    value = 0.0 if is_late else level
    for at, end in pairwise([*starts, length]):
        b, c, d = rng.uniform(-slope, slope), rng.uniform(-1, 1) * slope / 400, rng.uniform(-1, 1) * slope / 400_000
        records.append((at, value, float(b), float(c), float(d)))
        ds = end - at
        value += b * ds + c * ds**2 + d * ds**3
    return records


def _lanes(rng: Rng, length: float, minor: int, has_borders: bool) -> tuple[dict[int, _Lane], list[_Section]]:
    """Lanes on both sides; only the outermost ones come and go between sections."""
    most = (int(rng.integers(1, 4)), int(rng.integers(0, 4)))
    if rng.random() < 0.5:
        most = most[::-1]
    lanes = {}
    for side, count in ((-1, most[0]), (1, most[1])):
        for n in range(1, count + 1):
            width = _cubics(
                rng, length, float(rng.uniform(2.8, 4)), 0.002, is_late=False, max_records=1 if has_borders else 4
            )
            type_ = str(rng.choice(_DRIVEN if rng.random() < 0.75 else _OTHER))
            lanes[side * n] = _Lane(side * n, type_, width, minor >= 8 and bool(rng.random() < 0.15))
    if not any(lane.is_driven and abs(lane.id) == 1 for lane in lanes.values()):
        lanes[next(iter(lanes))].type = "driving"
    cuts = [0.0, *np.sort(rng.uniform(0.2, 0.8, int(rng.integers(0, 3)))) * length, length]
    sections: list[_Section] = []
    for k, (start, end) in enumerate(pairwise([float(cut) for cut in cuts])):
        if end - start < 5:
            sections[-1].end = end
            continue
        right, left = (count - int(count > 1 and rng.random() < 0.3) for count in most)
        ids = [*range(left, 0, -1), *range(-1, -right - 1, -1)]
        late = {}
        for side, count in ((1, left), (-1, right)):
            if count > 1 and end - start > 20 and not has_borders and rng.random() < 0.08:
                late[side * count] = float(rng.uniform(3, 10))
        sections.append(_Section(start, end, ids, late, bool(k and rng.random() < 0.75)))
        if k and min(most) and rng.random() < 0.2:
            _make_one_sided(sections[-1], sections[-2], int(rng.choice([-1, 1])))
    return lanes, sections


def _make_one_sided(section: _Section, before: _Section, side: int) -> None:
    """The lanes of the other side are those of the section before."""
    section.side = side
    section.ids = sorted(
        [n for n in section.ids if n * side > 0] + [n for n in before.ids if n * side < 0], reverse=True
    )
    section.late = {n: late for n, late in section.late.items() if n * side > 0}


def _raise_lanes(rng: Rng, lanes: dict[int, _Lane], sections: list[_Section]) -> None:
    """The outermost lanes are level, although the road is inclined, or raised above it."""
    last = max(lanes, key=abs)
    if rng.random() < 0.5:
        lanes[last].is_level = True
        return
    for section in sections:
        if last in section.ids:
            section.raised[last] = (0.12, 0.14)


def _section(rng: Rng, road: _Road, k: int, minor: int) -> str:
    section = road.sections[k]
    before = road.sections[k - 1] if section.is_linked else None
    form = (k + road.id) % 3  # a link is stated by both lanes, or by one of them
    parts: dict[str, list[str]] = {"left": [], "right": []}
    for number in section.ids:
        lane = road.lanes[number]
        if section.continues(number):
            continue
        last = k  # the section up to which this element describes the lane
        while last + 1 < len(road.sections) and road.sections[last + 1].continues(number):
            last += 1
        after = road.sections[last + 1] if last + 1 < len(road.sections) and road.sections[last + 1].is_linked else None
        links = ""
        if before is not None and number in before.ids and road.id % 3 != 1:
            links += f'<predecessor id="{number}"/>'
        if after is not None and number in after.ids and road.id % 3 != 2:
            links += f'<successor id="{number}"/>'
        sized = _borders(road, section, number) if road.has_borders else _widths(lane, section, road.sections[last].end)
        inner, outer = section.raised.get(number, (0.0, 0.0))
        raised = f'<height sOffset="0" inner="{inner!r}" outer="{outer!r}"/>' if number in section.raised else ""
        direction = str(rng.choice(["", ' direction="standard"'])) if minor >= 8 else ""
        direction = ' direction="reversed"' if lane.is_reversed else direction
        level = "true" if lane.is_level else "false"
        mark = '<roadMark sOffset="0" type="broken" weight="standard" color="standard"/>' if form else ""
        parts["left" if number > 0 else "right"].append(
            f'<lane id="{number}" type="{lane.type}" level="{level}"{direction}><link>{links}</link>'
            f"{sized}{mark}{raised}</lane>"
        )
    sides = {name: f"<{name}>{''.join(found)}</{name}>" if found else "" for name, found in parts.items()}
    centre = '<center><lane id="0" type="none" level="false"/></center>'
    single = ' singleSide="true"' if section.side else ""
    return f'<laneSection s="{section.start!r}"{single}>{sides["left"]}{centre}{sides["right"]}</laneSection>'


def _widths(lane: _Lane, section: _Section, end: float) -> str:
    """Records of a section: the one that holds at its start begins there, moved by Taylor's formula."""
    first = section.start + section.late.get(lane.id, 0.0)
    inside = [one for one in lane.width if first < one[0] < end]
    held = [one for one in lane.width if one[0] <= first][-1]
    records = [_shifted(held, first), *inside]
    return "".join(_record("width", "sOffset", (one[0] - section.start, *one[1:])) for one in records)


def _borders(road: _Road, section: _Section, lane_id: int) -> str:
    """The outer edge of a lane, by the widths of the lanes up to it."""
    side = 1 if lane_id > 0 else -1
    total = np.zeros(4)
    for number in section.ids:
        if number * side > 0 and abs(number) <= abs(lane_id):
            total += np.array(_shifted(road.lanes[number].width[0], section.start)[1:])
    return _record("border", "sOffset", (0.0, *(side * float(value) for value in total)))


def _shifted(record: tuple[float, ...], s: float) -> tuple[float, ...]:
    start, a, b, c, d = record
    ds = s - start
    return s, a + ds * (b + ds * (c + ds * d)), b + ds * (2 * c + 3 * ds * d), c + 3 * ds * d, d


def _record(tag: str, s_name: str, record: tuple[float, ...]) -> str:
    s, a, b, c, d = (float(value) for value in record)
    return f'<{tag} {s_name}="{s!r}" a="{a!r}" b="{b!r}" c="{c!r}" d="{d!r}"/>'


# === What was read.


def _compare(file: AlignmentFile, roads: list[_Road], offset: tuple[float, ...], form: str, warnings: list[str]) -> str:
    if problem := compare_warnings(file.warnings, warnings, ("narrower than", "it jumps by")):
        return problem
    if (file.crs is None) != (form in ("none", "empty")) or (file.crs is None) != (file.crs_problem is not None):
        return f"the CRS is {file.crs}, {file.crs_problem}"
    if file.crs is not None:
        wanted = _degrees(_LOCAL if form == "local" else _UTM)
        if max(abs(a - b) for a, b in zip(_degrees(file.crs), wanted, strict=True)) > 1e-9:
            return f"the CRS is {file.crs}"
    has_heights = any(road.elevation for road in roads)
    count = 0
    for road in roads:
        for lane_id, start, end in _expected(road):
            count += 1
            found = [lane for lane in file.lanes if re.match(rf"road {road.id} lane {lane_id}\b", lane.name)
                     and lane.station_m is not None and start < lane.station_m.mean() < end]  # fmt: skip
            place = f"road {road.id} lane {lane_id} from s {start:.3f} to {end:.3f}"
            if len(found) != 1:
                return f"{place}: {len(found)} lanes of {[lane.name for lane in file.lanes]}"
            if problem := _compare_lane(found[0], road, lane_id, (start, end), offset, has_heights):
                return f"{place}: {problem}"
    return f"{len(file.lanes)} lanes of {count}" if len(file.lanes) != count else ""


@cache
def _degrees(crs: str) -> tuple[float, float]:
    """Longitude and latitude of a place in a system."""
    system = CRS.from_user_input(crs)
    place = (1000.0, 2000.0) if "lat_0=48.7" in crs or "48.7" in crs else (458_000.0, 5_428_000.0)
    lon, lat = Transformer.from_crs(system, system.geodetic_crs, always_xy=True).transform(*place)
    return float(lon), float(lat)


def _expected(road: _Road) -> list[tuple[int, float, float]]:
    """Lanes that are driven, from and to which distance along the road."""
    found = []
    for lane in road.lanes.values():
        if not lane.is_driven:
            continue
        runs: list[list[float]] = []
        before: _Section | None = None
        for section in road.sections:
            if lane.id not in section.ids:
                before = None
                continue
            start = section.start + section.late.get(lane.id, 0.0)
            is_joined = section.continues(lane.id) or section.is_linked
            if before is not None and is_joined and start == section.start:
                runs[-1][1] = section.end
            else:
                runs.append([start, section.end])
            before = section
        cuts = [one[0] for one in road.elevation[:1] if one[0] > 0 and abs(one[1]) > _JUMP_M]
        for start, end in runs:
            inner = [cut for cut in cuts if start < cut < end]
            found += [(lane.id, a, b) for a, b in pairwise([start, *inner, end])]
    return found


def _compare_lane(
    lane: LaneGeometry,
    road: _Road,
    lane_id: int,
    span: tuple[float, float],
    offset: tuple[float, ...],
    has_heights: bool,
) -> str:
    if lane.centre is None or lane.station_m is None or lane.curvature_per_m is None or lane.width_m is None:
        return "no centre, stations, curvature or width"
    is_forward = ((lane_id < 0) != road.is_left_hand) != road.lanes[lane_id].is_reversed
    turn = 1 if is_forward else -1
    s, side = lane.station_m[::turn], float(turn)
    if (np.diff(s) < 0).any() or abs(s[0] - span[0]) > 1e-6 or abs(s[-1] - span[1]) > 1e-3:
        return f"stations are from {lane.station_m[0]:.4f} to {lane.station_m[-1]:.4f}"
    xyz = _unmoved(lane.centre[::turn], offset)
    if has_heights == bool(np.isnan(xyz[:, 2]).all()):
        return "there are no heights" if has_heights else "heights without an elevation"
    wanted = _nearest(road, lane_id, s, xyz, span)
    off = np.hypot(*(xyz - wanted)[:, :2].T)
    limit = _TOLERANCE_M + road.along_m
    if off.max() > limit:
        return f"{off.max():.6f} m off at s {s[int(off.argmax())]:.3f}"
    away = np.abs(xyz - wanted)[:, 2]
    if has_heights and away.max() > limit:
        return f"a height is {away.max():.5f} m off at s {s[int(away.argmax())]:.3f}"
    middle = (s[1:] + s[:-1]) / 2
    truth = _place(road, lane_id, middle, middle)
    chord = chord_errors((xyz[1:] + xyz[:-1])[:, :2] / 2, xyz[:, :2], truth[:, :2])
    if chord.max() > CHORD_M + road.along_m:
        return f"a chord is {chord.max():.5f} m off at s {middle[int(chord.argmax())]:.2f}"
    smooth = (np.abs(s[:, None] - road.breaks()).min(axis=1) > 0.15) & (s > span[0] + 0.15) & (s < span[1] - 0.15)
    return _compare_values(lane, road, lane_id, s, smooth, turn, side)


def _compare_values(
    lane: LaneGeometry, road: _Road, lane_id: int, s: Floats, smooth: Floats, turn: int, side: float
) -> str:
    """Curvature, width and superelevation, where all records are smooth."""
    at = s[smooth]
    if not len(at):
        return ""
    assert lane.curvature_per_m is not None
    assert lane.width_m is not None
    assert lane.superelevation_rad is not None
    h = 0.1
    back, here, ahead = (_place(road, lane_id, at + d, at)[:, :2] for d in (-h, 0.0, h))
    first, second = (ahead - back) / (2 * h), (ahead - 2 * here + back) / h**2
    k = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / np.hypot(*first.T) ** 3
    off = np.abs(lane.curvature_per_m[::turn][smooth] * side - k).max()
    if off > _CURVATURE + road.along_m / 50:
        return f"the curvature is {off:.6f} 1/m off"
    edges = [road.edges(_at(road, one), lane_id, *[np.array([one])] * 2) for one in at[::5].tolist()]
    width = np.array([abs(float(outer[0] - inner[0])) for inner, outer, _ in edges])
    off = np.abs(lane.width_m[::turn][smooth][::5] - width).max()
    if off > _TOLERANCE_M:
        return f"the width is {off:.5f} m off"
    roll = np.zeros(len(at)) if road.lanes[lane_id].is_level else _values(road.roll, at, at)
    off = np.abs(lane.superelevation_rad[::turn][smooth] * side - roll).max()
    return f"the superelevation is {off:.6f} rad off" if off > 1e-9 else ""


def _at(road: _Road, s: float) -> _Section:
    return [one for one in road.sections if one.start <= s][-1] if s > 0 else road.sections[0]


def _place(road: _Road, lane_id: int, s: Floats, lookup: Floats) -> Floats:
    found = np.zeros((len(s), 3))
    lookup = np.clip(lookup, 1e-9, road.course.end_s - 1e-9)
    starts = np.array([one.start for one in road.sections])
    row = np.searchsorted(starts, lookup, side="right") - 1
    for k in np.unique(row):
        on = row == k
        found[on] = road.place(road.sections[int(k)], lane_id, s[on], lookup[on])
    return found


def _nearest(road: _Road, lane_id: int, s: Floats, xyz: Floats, span: tuple[float, float]) -> Floats:
    """Places at distances, where records begin by those before or after, whichever is nearer."""
    both = [_place(road, lane_id, s, np.clip(s + d, span[0] + 1e-7, span[1] - 1e-7)) for d in (-1e-6, 1e-6)]
    is_second = np.nansum((both[1] - xyz) ** 2, axis=1) < np.nansum((both[0] - xyz) ** 2, axis=1)
    return np.where(is_second[:, None], both[1], both[0])


def _unmoved(points: Floats, offset: tuple[float, ...]) -> Floats:
    """Points before the header's offset, by which the file is turned about its origin and moved."""
    x, y, z, hdg = offset
    rest = points - (x, y, z)
    cos, sin = math.cos(hdg), math.sin(hdg)
    return np.stack([cos * rest[:, 0] + sin * rest[:, 1], cos * rest[:, 1] - sin * rest[:, 0], rest[:, 2]], axis=1)


ROAD_GRAMMARS: dict[str, Grammar] = {
    "landxml": write_landxml,
    "dxf": write_dxf,
    "dxf-survey": write_dxf_survey,
    "opendrive": _xodr,
}
