"""Features of a file with a road: lines, points and areas with their properties, before their meaning is known."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy
import shapely
from pyproj import CRS
from pyproj.exceptions import CRSError

from app.errors import InvalidParameter, UnreadableUpload
from app.formats.alignments.geometry import (
    MAX_COORDINATE,
    MAX_VERTICES,
    AlignmentFile,
    AreaGeometry,
    BoundaryStyle,
    EventGeometry,
    EventKind,
    LaneGeometry,
)
from app.values import Floats

AREA_KINDS = ("joints", "manholes", "crossings", "bridges")
"""Areas that are recognized by a line's or an area's kind; areas may have other kinds too. Source: issue 13."""
EVENT_KINDS = tuple(kind.value for kind in EventKind)
SPEEDS_KMH = (2.0, 250.0)
"""Lowest and highest plausible speed limit. [km/h] Source: `app.planning.rules.SpeedKmh`."""
KMH_PER_MPH = 1.609344
"""International mile. Source: NIST SP 811, table 6."""
_MAX_FEATURES = 200_000  # bounds the time of a file
_SINGULAR = {"joint": "joints", "manhole": "manholes", "crossing": "crossings", "bridge": "bridges"}
_SPEED = re.compile(r"\s*(?P<value>[0-9]+(\.[0-9]+)?)\s*(?P<unit>mph|km/?h|kph)?\s*", re.IGNORECASE)
_SPEED_NAMES = ("speed_limit_kmh", "speed_limit_mph", "maxspeed")
_STYLE_SYNONYMS = {"broken": "dashed", "dash": "dashed", "continuous": "solid", "virtual": "none"}


class Shape(StrEnum):
    """Kind of a feature's geometry."""

    LINE = "line"
    POINT = "point"
    AREA = "area"


@dataclass(frozen=True, slots=True, eq=False)
class RoadFeature:
    """A feature of a file."""

    where: str  # place in the file, for messages: ``feature 3``
    shape: Shape
    parts: tuple[Floats, ...]  # shape (N, 3): lines, points, or outer rings of areas; height is NaN where there is none
    properties: Mapping[str, object] = field(default_factory=dict)  # by lower-case name
    layer: str = ""  # name of its layer; decides the kind of a feature that states none
    curvature_per_m: Floats | None = None  # shape (N,), or None: [1/m] of a line with one part; left positive

    @property
    def kind(self) -> str:
        """As stated by the property `kind`, or by the layer; in lower case with underscores."""
        return normalize_kind(self.text("kind") or self.layer)

    def text(self, name: str) -> str | None:
        """A property as text; whole numbers without decimals; None if it is empty."""
        value = self.properties.get(name)
        if value is None or isinstance(value, bool) or (isinstance(value, float) and math.isnan(value)):
            return None
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        return str(value).strip()[:120] or None

    def number(self, name: str) -> float | None:
        """A property as a number; None if it is empty.

        Raises
        ------
        InvalidParameter
            It is no finite number.
        """
        text = self.text(name)
        if text is None:
            return None
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InvalidParameter(
                f"{self.where}: {name} is {text[:40]!r}",
                field=f"properties.{name}",
                limit="a finite number",
                cure="write a number, or leave the property out",
            )
        return value

    def speed_limit_m_s(self) -> float:
        """Speed limit; NaN without one. [m/s]

        Raises
        ------
        InvalidParameter
            It is not between 2 and 250 km/h.
        """
        for name in _SPEED_NAMES:
            text = self.text(name)
            if text is None or (name == "maxspeed" and _SPEED.fullmatch(text) is None):
                continue  # maxspeed=none, walk or DE:urban states no number
            found = _SPEED.fullmatch(text) if name == "maxspeed" else None
            value = float(found["value"]) if found else self.number(name) or 0.0
            mph = name.endswith("_mph") or (found is not None and (found["unit"] or "").lower() == "mph")
            speed_kmh = value * KMH_PER_MPH if mph else value
            if not SPEEDS_KMH[0] <= speed_kmh <= SPEEDS_KMH[1]:
                raise InvalidParameter(
                    f"{self.where}: {name} is {text[:40]}",
                    field=f"properties.{name}",
                    limit=f"{SPEEDS_KMH[0]:g} to {SPEEDS_KMH[1]:g} km/h",
                    cure="correct the speed limit, or leave it out",
                )
            return speed_kmh / 3.6
        return math.nan

    def style(self, *names: str) -> BoundaryStyle:
        """Style of the first of several properties that is there.

        Raises
        ------
        InvalidParameter
            ``left_style`` or ``right_style`` is no style; other properties may hold anything.
        """
        name, text = next(((name, found) for name in names if (found := self.text(name)) is not None), ("", "unknown"))
        style = _STYLE_SYNONYMS.get(text.lower(), text.lower())
        if style in set(BoundaryStyle):
            return BoundaryStyle(style)
        if name in ("left_style", "right_style"):
            raise InvalidParameter(
                f"{self.where}: {name} is {text[:40]!r}",
                field=f"properties.{name}",
                limit=", ".join(BoundaryStyle),
                cure="name one of these, or leave the property out",
            )
        return BoundaryStyle.UNKNOWN


def normalize_kind(text: str) -> str:
    """A kind in lower case with underscores; plurals of event kinds are made singular."""
    kind = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
    singular = kind.removesuffix("s")
    return singular if singular in EVENT_KINDS and kind not in AREA_KINDS else kind


def area_kind(kind: str) -> str:
    """Kind of an area as the rules name it: ``bridge`` becomes ``bridges``."""
    return _SINGULAR.get(kind, kind)


def read_vertices(values: object, where: str) -> Floats:
    """Vertices as an array, shape (N, 3), with NaN as height where there is none.

    Parameters
    ----------
    values : array_like, shape (N, 2) or (N, 3), or nested lists
        Further coordinates are left out.

    Raises
    ------
    InvalidParameter
        A coordinate is not a finite number.
    """
    try:
        array = _array(values)
    except ValueError as error:
        raise _bad_vertex(where, "the coordinates are not pairs of numbers") from error
    if array.ndim != 2 or array.shape[1] < 2 or array.dtype.kind not in "iuf":
        raise _bad_vertex(where, "the coordinates are not pairs of numbers")
    vertices = np.full((len(array), 3), np.nan)
    vertices[:, : min(array.shape[1], 3)] = array[:, :3]
    vertices[~np.isfinite(vertices[:, 2]), 2] = np.nan
    check_vertices(vertices, where)
    return vertices


def check_vertices(vertices: Floats, where: str) -> None:
    """Raises InvalidParameter if a coordinate is not a plausible number; heights may be NaN."""
    usable = np.abs(vertices[:, :2]).max(axis=1, initial=0.0) <= MAX_COORDINATE
    bad = np.flatnonzero(~usable | (np.abs(vertices[:, 2]) > MAX_COORDINATE))
    if len(bad):
        raise _bad_vertex(where, f"vertex {int(bad[0]) + 1} is not finite")


def _array(values: Any) -> npt.NDArray[Any]:
    try:
        return np.asarray(values)
    except ValueError:  # some vertices have heights, others none
        return np.asarray([[*vertex, math.nan][:3] if isinstance(vertex, list) else vertex for vertex in values])


def read_ring(values: object, where: str) -> Floats:
    """Closed ring of an area; raises InvalidParameter if it has fewer than three different vertices."""
    ring = read_vertices(values, where)
    if len(ring) and not np.array_equal(ring[0, :2], ring[-1, :2]):
        ring = np.concatenate([ring, ring[:1]])
    if len(ring) < 4:
        raise _bad_vertex(where, "the area has fewer than three vertices")
    return ring


def check_counts(features: int, vertices: int) -> None:
    """Raises UnreadableUpload if a file has too many features or vertices."""
    if features > _MAX_FEATURES or vertices > MAX_VERTICES:
        raise UnreadableUpload(
            f"the file has {features} features and {vertices} vertices",
            field="file",
            limit=f"{_MAX_FEATURES} features, {MAX_VERTICES} vertices",
            cure="cut the road into sections and plan each of them",
        )


def is_geographic(crs: str | None) -> bool:
    """Whether coordinates in a CRS are longitudes and latitudes; False for one that cannot be read."""
    try:
        return crs is not None and bool(CRS.from_user_input(crs).is_geographic)
    except CRSError:
        return False


def unit_of_crs_m(crs: str | None) -> float:
    """Length of the unit of a projected CRS; 1 for others. [m]"""
    try:
        system = CRS.from_user_input(crs) if crs is not None else None
    except CRSError:
        return 1.0
    return float(system.axis_info[0].unit_conversion_factor) if system is not None and system.is_projected else 1.0


def _bad_vertex(where: str, what: str) -> InvalidParameter:
    return InvalidParameter(
        f"{where}: {what}", field="file", limit="finite coordinates", cure="correct or remove the feature"
    )


# === Lines in parts, joined where their ends meet.


JOIN_M = 0.02
"""Ends that are this near meet. [m] Twice the last digit of 1e-7 degrees."""
_EARTH_M = 6_371_000.0  # [m] mean radius; source: IUGG


@dataclass(frozen=True, slots=True)
class Link:
    """A part in a chain, by its number; `turned` if it runs against the direction in which it is drawn."""

    part: int
    turned: bool


def chain_parts(
    parts: Sequence[Floats], *, geographic: bool, unit_m: float, reversible: Sequence[bool] | None = None
) -> list[list[Link]]:
    """Chains of parts that meet end to start, each in order.

    Parameters
    ----------
    parts : sequence of ndarray, shape (N, 3)
        Vertices, N >= 1; only places of the ends count.
    geographic : bool
        Longitudes and latitudes [deg]; ends on both sides of the antimeridian can meet.
    unit_m : float
        Length of the unit of projected coordinates. [m]
    reversible : sequence of bool, optional
        Parts without a direction of their own; without, all have one.

    Notes
    -----
    A chain ends where more than two ends meet, and where two parts with directions meet head to head.
    """
    count = len(parts)
    if count == 1:
        return [[Link(0, False)]]
    turns = list(reversible) if reversible is not None else [False] * count
    places = _places_m(np.array([vertices[k, :2] for vertices in parts for k in (0, -1)]), geographic, unit_m)
    opposite = _meeting_ends(places)
    chains = []
    left = [True] * count
    for seed in sorted(range(count), key=lambda part: turns[part]):
        if not left[seed]:
            continue
        left[seed] = False
        ahead = _follow(2 * seed + 1, opposite, turns, left)
        behind = _follow(2 * seed, opposite, turns, left, backwards=True)
        chains.append([*reversed(behind), Link(seed, False), *ahead])
    return sorted(chains, key=lambda chain: min(link.part for link in chain))


def join_chain(parts: Sequence[Floats], chain: Sequence[Link]) -> Floats:
    """Vertices of a chain, shape (N, 3); the first vertex of each following part is left out."""
    return np.concatenate([turned_part(parts[link.part], link)[min(k, 1) :] for k, link in enumerate(chain)])


def turned_part(values: Floats, link: Link) -> Floats:
    """Values of a part in the direction of its chain."""
    return values[::-1] if link.turned else values


def gap_m(
    parts: Sequence[Floats], first: Sequence[Link], other: Sequence[Link], geographic: bool, unit_m: float
) -> float:
    """Distance from the end of a chain to the start of another. [m]"""
    end, start = turned_part(parts[first[-1].part], first[-1])[-1], turned_part(parts[other[0].part], other[0])[0]
    places = _places_m(np.array([end[:2], start[:2]]), geographic, unit_m)
    return float(np.linalg.norm(places[0] - places[1]))


def _places_m(ends: Floats, geographic: bool, unit_m: float) -> Floats:
    if not geographic:
        return ends * unit_m
    lon, lat = np.radians(ends[:, 0]), np.radians(ends[:, 1])
    across = np.cos(lat)
    return _EARTH_M * np.stack([across * np.cos(lon), across * np.sin(lon), np.sin(lat)], axis=1)


def _meeting_ends(places: Floats) -> dict[int, int]:
    """For each end that meets exactly one other end, that one. Part k has the ends 2 k (start) and 2 k + 1."""
    pairs = scipy.spatial.cKDTree(places).query_pairs(JOIN_M, output_type="ndarray")
    graph = scipy.sparse.coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(places), len(places)))
    node = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    order = np.argsort(node, kind="stable")
    first = np.flatnonzero(np.diff(node[order], prepend=-1))
    twos = first[np.diff(first, append=len(order)) == 2]
    one, two = order[twos].tolist(), order[twos + 1].tolist()
    return dict(zip(one + two, two + one, strict=True))


def _follow(
    end: int, opposite: dict[int, int], turns: Sequence[bool], left: list[bool], *, backwards: bool = False
) -> list[Link]:
    """Parts that follow an end (or precede it), marked as used."""
    found = []
    while (entry := opposite.get(end)) is not None and left[entry // 2]:
        part = entry // 2
        turned = entry % 2 == (0 if backwards else 1)
        if turned and not turns[part]:
            break
        left[part] = False
        found.append(Link(part, turned))
        end = entry ^ 1
    return found


# === Lanes, events and areas from a file's features, by their properties.


_LINE_KINDS = ("", "lane", "lanes", "boundary", "boundaries", "centre", "center", "centreline", "centerline", "road")
_SIDES = {
    "l": "left",
    "r": "right",
    "c": "centre",
    "left": "left",
    "right": "right",
    "centre": "centre",
    "center": "centre",
}
_AREA_HALF_WIDTH_M = 0.005  # [m] of a line that is an area to avoid, such as a joint
_M_PER_DEG = 111_195.0  # [m/deg] on a sphere of 6371 km, the Earth's mean radius
_BACKWARDS = ("-1", "reverse", "backward")
_TWO_WAY = ("no", "false", "0")
_MAX_WARNINGS = 50  # what people read


@dataclass(frozen=True, slots=True)
class Frame:
    """Coordinates of a file: whether they are degrees, and the length of their unit. [m]"""

    geographic: bool
    unit_m: float

    def length(self, metres: float) -> float:
        """About this length in the unit of the coordinates."""
        return metres / (_M_PER_DEG if self.geographic else self.unit_m)

    def unwrapped(self, vertices: Floats) -> Floats:
        """Vertices with longitudes that do not jump at the antimeridian."""
        if not self.geographic:
            return vertices
        return np.column_stack([np.unwrap(vertices[:, 0], period=360.0), vertices[:, 1:]])


def assemble_road(
    format_name: str,
    features: Sequence[RoadFeature],
    *,
    defaults: Mapping[str, object] | None = None,
    crs: str | None = None,
    unit_m: float | None = None,
    warnings: Iterable[str] = (),
) -> AlignmentFile:
    """A road of features.

    Parameters
    ----------
    features : sequence of RoadFeature
        At least one line.
    defaults : mapping, optional
        Properties that hold for all features.
    crs : str, optional
        As in `AlignmentFile`.
    unit_m : float, optional
        Length of the file's unit; that of the CRS without. [m]
    warnings : iterable of str
        Of reading the features.

    Raises
    ------
    UnreadableUpload
        There is no lane, or more than can be planned.
    InvalidParameter
        A property or a geometry contradicts the others; the message names the feature.
    """
    check_counts(len(features), sum(len(part) for feature in features for part in feature.parts))
    shared = {name.lower(): value for name, value in (defaults or {}).items() if isinstance(value, str | int | float)}
    named = [replace(feature, properties=_with_defaults(shared, feature)) for feature in features]
    degrees = is_geographic(crs) or (crs is None and format_name == "geojson" and _are_degrees(features))
    frame = Frame(degrees, unit_m or unit_of_crs_m(crs))
    notes = list(warnings)
    lines: list[RoadFeature] = []
    events: list[EventGeometry] = []
    areas: list[AreaGeometry] = []
    for feature in named:
        kind = feature.kind
        if feature.shape is Shape.AREA or (area_kind(kind) in AREA_KINDS and not _is_event(feature)):
            areas += _areas(feature, frame, notes)
        elif feature.shape is Shape.LINE and _is_lane(feature):
            lines.append(feature)
        else:
            events += _events(feature, frame, notes)
    lanes = _lanes(lines, frame, notes)
    if not lanes:
        raise UnreadableUpload(
            "the file has no lanes", field="file", limit="at least one line", cure="draw the lanes as lines"
        )
    return AlignmentFile(
        format_name, tuple(lanes), crs, None, unit_m, tuple(events), tuple(areas), warnings=_limited(notes)
    )


def _are_degrees(features: Sequence[RoadFeature]) -> bool:
    """Whether coordinates may be longitudes and latitudes; others need a declaration."""
    ends = [part[[0, -1], :2] for feature in features for part in feature.parts if len(part)]
    return bool(ends) and bool((np.abs(np.concatenate(ends)) <= (360.0, 90.0)).all())


def _with_defaults(shared: Mapping[str, object], feature: RoadFeature) -> dict[str, object]:
    own = {name: value for name, value in feature.properties.items() if value is not None}
    speeds = any(name in own for name in ("speed_limit_kmh", "speed_limit_mph", "maxspeed"))
    usable = {k: v for k, v in shared.items() if k not in ("kind", "lane", "side", "name", "id", "crs")}
    if speeds:
        usable = {k: v for k, v in usable.items() if k not in ("speed_limit_kmh", "speed_limit_mph", "maxspeed")}
    if "lane_width_m" in usable:
        usable["width_m"] = usable.pop("lane_width_m")
    if "name" in shared:
        usable.setdefault("road", shared["name"])
    return usable | own


def _is_lane(feature: RoadFeature) -> bool:
    if feature.kind in _LINE_KINDS or feature.text("side") is not None:
        return True
    stated = feature.text("kind") is not None
    if stated and feature.kind not in EVENT_KINDS:
        raise _wrong(
            feature, "kind", f"kind is {feature.text('kind')!r}", ", ".join((*EVENT_KINDS, *AREA_KINDS, "lane"))
        )
    return not stated and feature.kind not in EVENT_KINDS  # a layer's name, which can be anything


def _wrong(feature: RoadFeature, name: str, what: str, limit: str) -> InvalidParameter:
    return InvalidParameter(
        f"{feature.where}: {what}", field=f"properties.{name}", limit=limit, cure="correct the property of the feature"
    )


# --- lanes ------------------------------------------------------------------------------------------------------------


def _lanes(lines: Sequence[RoadFeature], frame: Frame, notes: list[str]) -> list[LaneGeometry]:
    groups: dict[tuple[str | None, str], dict[str, list[RoadFeature]]] = {}
    for number, feature in enumerate(lines, 1):
        side = _side(feature)
        road, lane = feature.text("road"), feature.text("lane")
        if lane is None:
            lane = "1" if side != "centre" else feature.text("name") or str(number)
            if side == "centre" and (road, lane) in groups:
                lane = f"{lane} {number}"
        groups.setdefault((road, lane), {}).setdefault(side, []).append(feature)
    times = Counter(lane for _road, lane in groups)
    return [
        _lane(lane if times[lane] == 1 else f"{road}/{lane}", road, sides, frame, notes)
        for (road, lane), sides in groups.items()
    ]


def _side(feature: RoadFeature) -> str:
    text = feature.text("side") or "centre"
    if text.lower() not in _SIDES:
        raise _wrong(feature, "side", f"side is {text[:40]!r}", "left (L), right (R), or centre (C) of the lane")
    return _SIDES[text.lower()]


def _lane(
    name: str, road: str | None, sides: Mapping[str, list[RoadFeature]], frame: Frame, notes: list[str]
) -> LaneGeometry:
    if "left" in sides and "right" in sides:
        if "centre" in sides:
            notes.append(f"lane {name}: the centre line is left out, because the lane has both boundaries")
        left, right = (_join(name, sides[side], frame, notes) for side in ("left", "right"))
        values, styles = left, (left.style("style", "left_style"), right.style("style", "right_style"))
        speed = left.speed if left.speed is not None else right.constant_speed(len(left.line))
        return LaneGeometry(
            name, None, left.line, right.line, speed_limit_m_s=speed, left_style=styles[0], right_style=styles[1],
            road=road,
        )  # fmt: skip
    if "centre" not in sides:
        there, missing = ("left", "right") if "left" in sides else ("right", "left")
        raise InvalidParameter(
            f"{sides[there][0].where}: lane {name} has a {there} boundary and no {missing} one",
            field="properties.side",
            limit="a left and a right boundary for each lane",
            cure=f"add the {missing} boundary with the same lane, or remove side to give the centre line",
        )
    values = _join(name, sides["centre"], frame, notes)
    return LaneGeometry(
        name,
        values.line,
        curvature_per_m=values.curvature,
        width_m=values.width,
        speed_limit_m_s=values.speed,
        left_style=values.style("left_style"),
        right_style=values.style("right_style"),
        road=road,
    )


@dataclass(frozen=True, slots=True)
class _Joined:
    """A line of one or more features, with their values at its vertices."""

    line: Floats
    speed: Floats | None
    width: Floats | None
    curvature: Floats | None
    features: Sequence[RoadFeature]

    def constant_speed(self, count: int) -> Floats | None:
        """Its speed limit for another line with this number of vertices; None if it has several."""
        if self.speed is None or not (self.speed == self.speed[0]).all():
            return None
        return np.full(count, self.speed[0])

    def style(self, *names: str) -> BoundaryStyle:
        """The one style of all features."""
        found = {feature.style(*names) for feature in self.features}
        return found.pop() if len(found) == 1 else BoundaryStyle.UNKNOWN


def _join(name: str, features: Sequence[RoadFeature], frame: Frame, notes: list[str]) -> _Joined:
    parts = [part for feature in features for part in feature.parts if len(part)]
    owners = [feature for feature in features for part in feature.parts if len(part)]
    if not parts:
        raise InvalidParameter(
            f"{features[0].where}: lane {name} has no vertices", field="file", limit="two vertices", cure="remove it"
        )
    chains = chain_parts(parts, geographic=frame.geographic, unit_m=frame.unit_m)
    if len(chains) > 1:
        gap = gap_m(parts, chains[0], chains[1], frame.geographic, frame.unit_m)
        end = parts[chains[0][-1].part][-1]
        raise InvalidParameter(
            f"{owners[chains[1][0].part].where}: the parts of lane {name} do not join: {gap:.2f} m from the end of one "
            f"part at {end[0]:.9g}, {end[1]:.9g} to the start of the next",
            field="file",
            limit="each part begins where another one ends, all in the direction of travel",
            cure="close the gap, turn parts that run backwards, or give the parts different lanes",
        )
    chain = chains[0]

    def along(value: Any) -> Floats | None:
        each = [value(owner) for owner in owners]
        if all(math.isnan(number) for number in each):
            return None
        return join_chain([np.full(len(part), number) for part, number in zip(parts, each, strict=True)], chain)

    line, curvature = join_chain(parts, chain), owners[0].curvature_per_m if len(parts) == 1 else None
    speed, width = along(RoadFeature.speed_limit_m_s), along(_width)
    ways = {(feature.text("oneway") or "yes").lower() for feature in features}
    if ways & set(_TWO_WAY):
        notes.append(f"lane {name} is driven in both directions; it is planned for the direction in which it is drawn")
    if ways & set(_BACKWARDS):
        if len(ways) > 1:
            raise _wrong(features[0], "oneway", f"parts of lane {name} have different directions", "one direction")
        line, speed, width = line[::-1], _turned(speed), _turned(width)
        curvature = -curvature[::-1] if curvature is not None else None
    return _Joined(line, speed, width, curvature, features)


def _turned(values: Floats | None) -> Floats | None:
    return values[::-1] if values is not None else None


def _width(feature: RoadFeature) -> float:
    value = feature.number("width_m")
    return math.nan if value is None else value


# --- events and areas -------------------------------------------------------------------------------------------------


def _is_event(feature: RoadFeature) -> bool:
    """Whether it is what vehicles are notes of; a crossing is one unless it is drawn as an area."""
    return feature.kind in EVENT_KINDS or (feature.shape is Shape.POINT and feature.kind == "crossings")


def _events(feature: RoadFeature, frame: Frame, notes: list[str]) -> list[EventGeometry]:
    if not _is_event(feature):
        if feature.text("kind") is not None:
            raise _wrong(feature, "kind", f"kind is {feature.text('kind')!r}", ", ".join(EVENT_KINDS))
        notes.append(f"{feature.where} is left out: it states no kind")
        return []
    kind = EventKind(feature.kind.removesuffix("s"))
    value = _event_value(feature, kind)
    if feature.shape is Shape.POINT:
        points = [row for part in feature.parts for row in part]
    else:
        points = [frame.unwrapped(part)[[0, -1]].mean(axis=0) for part in feature.parts if len(part)]
    return [EventGeometry(kind, (float(p[0]), float(p[1])), feature.text("lane"), value) for p in points]


def _event_value(feature: RoadFeature, kind: EventKind) -> float | str | None:
    if kind is EventKind.ARROW:
        text = feature.text("value")
        return text.lower() if text is not None else None
    if kind is not EventKind.SPEED_LIMIT:
        return None
    value = feature.number("value")
    if value is None:
        speed = feature.speed_limit_m_s()
        value = None if math.isnan(speed) else speed * 3.6
    if value is None or not SPEEDS_KMH[0] <= value <= SPEEDS_KMH[1]:
        raise _wrong(feature, "value", f"the speed limit is {value}", f"{SPEEDS_KMH[0]:g} to {SPEEDS_KMH[1]:g} km/h")
    return value


def _areas(feature: RoadFeature, frame: Frame, notes: list[str]) -> list[AreaGeometry]:
    kind = area_kind(feature.kind)
    if not kind:
        notes.append(f"{feature.where} is left out: it states no kind of area")
        return []
    if feature.shape is Shape.AREA:
        return [AreaGeometry(kind, part[:, :2]) for part in feature.parts]
    if feature.shape is Shape.POINT:
        raise InvalidParameter(
            f"{feature.where}: the {kind} are a point",
            field="file",
            limit="areas, or lines such as joints",
            cure="draw the outline of the area",
        )
    thin = [
        shapely.buffer(
            shapely.LineString(frame.unwrapped(part)[:, :2]), frame.length(_AREA_HALF_WIDTH_M), cap_style="square"
        )
        for part in feature.parts
        if len(part) > 1
    ]
    return [AreaGeometry(kind, shapely.get_coordinates(area.exterior)) for area in thin]


def _limited(notes: Sequence[str]) -> tuple[str, ...]:
    if len(notes) <= _MAX_WARNINGS:
        return tuple(notes)
    return (*notes[:_MAX_WARNINGS], f"{len(notes) - _MAX_WARNINGS} further warnings")
