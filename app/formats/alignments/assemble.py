"""Lanes, events and areas from a file's features, by their properties."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from app.errors import InvalidParameter, UnreadableUpload
from app.formats.alignments.chains import chain_parts, gap_m, join_chain
from app.formats.alignments.features import (
    AREA_KINDS,
    EVENT_KINDS,
    SPEEDS_KMH,
    RoadFeature,
    Shape,
    area_kind,
    check_counts,
    is_geographic,
    unit_of_crs_m,
)
from app.formats.alignments.geometry import (
    AlignmentFile,
    AreaGeometry,
    BoundaryStyle,
    EventGeometry,
    EventKind,
    LaneGeometry,
)

Floats = npt.NDArray[np.float64]

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
_AREA_HALF_WIDTH_M = 0.005  # [m] of a line that is an area to avoid, such as a joint; source: chosen by hand
_M_PER_DEG = 111_195.0  # [m/deg] on a sphere of 6371 km, the Earth's mean radius
_BACKWARDS = ("-1", "reverse", "backward")
_TWO_WAY = ("no", "false", "0")
_MAX_WARNINGS = 50  # source: chosen by hand, what people read


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
    defaults: Mapping[str, Any] | None = None,
    crs: str | None = None,
    unit_m: float | None = None,
    warnings: Iterable[str] = (),
) -> AlignmentFile:
    """A road of features.

    Parameters
    ----------
    format_name : str
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


def _with_defaults(shared: Mapping[str, Any], feature: RoadFeature) -> dict[str, Any]:
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
            name, None, left.line, right.line, speed_limit_mps=speed, left_style=styles[0], right_style=styles[1],
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
        speed_limit_mps=values.speed,
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
    speed, width = along(RoadFeature.speed_limit_mps), along(_width)
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
        speed = feature.speed_limit_mps()
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
