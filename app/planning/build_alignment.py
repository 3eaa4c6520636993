"""The road of a file as lanes in WGS 84, with true distances, curvature, speeds, events and areas to avoid."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from app.errors import InvalidParameter, UnreadableUpload
from app.formats.alignments.geometry import AlignmentDeclaration, AlignmentFile, LaneGeometry
from app.planning.alignment import Alignment, AvoidedArea, Lane
from app.planning.road.events import find_events
from app.planning.road.ground_line import MAX_DEG, DenseLine, GroundLine, densify, make_ground_line
from app.planning.road.lanes import (
    check_curvature,
    check_length,
    check_line,
    check_radii,
    check_simple,
    check_speed,
    clear_width,
    lane_errors,
    make_lane,
)
from app.planning.road.reference import PlacedRoad, RoadReference, find_reference
from app.planning.rules import RoadRules
from app.values import Floats

MIN_LANE_M = 5.0
"""Shorter lanes get no markers. [m] Source: issue 13; a plate's spacing is at least 5 m."""
_SHOWN = 10  # names of lanes in a message


@dataclass(frozen=True, slots=True, eq=False)
class _PlacedFile:
    """Positions of everything in a file: lines of the lanes, places of the events, rings of the areas."""

    road: PlacedRoad
    lines: list[tuple[GroundLine, ...]]
    events: Floats
    rings: list[Floats]


def build_alignment(
    file: AlignmentFile,
    rules: RoadRules | None = None,
    declaration: AlignmentDeclaration | None = None,
    *,
    name: str = "road",
    accuracy_m: float = 0.1,
    needs_speed: bool = True,
) -> Alignment:
    """Lanes of a file in WGS 84, sampled at even steps of at most 1 m.

    Parameters
    ----------
    rules : RoadRules, optional
        Lanes to use, and widths and speeds that the file does not state.
    declaration : AlignmentDeclaration, optional
        Reference system and units, or the origin of local coordinates.
    name : str
        Of the alignment, and of a road without a name.
    accuracy_m : float
        Worst stated accuracy of a transformation that is used. [m]
    needs_speed : bool
        Refuse lanes without a speed, as plans must; without, such speeds are NaN.

    Raises
    ------
    ReferenceSystemError
        The road is not placed on Earth, or the file and the declaration contradict each other.
    InvalidParameter
        A lane cannot be used; the message names the lane, the chainage and the position.
    UnreadableUpload
        There are no lanes.

    Notes
    -----
    Chainages are distances on the ellipsoid. Where the file defines curvature, samples lie within 1 mm of its curves;
    polylines are kept, and their directions and curvatures are estimated (`app.planning.road.ground_line`).
    """
    rules, declaration = rules or RoadRules(), declaration or AlignmentDeclaration()
    geometries = _chosen(file, rules)
    flat = _has_no_heights(geometries)
    reference = find_reference(file, declaration, has_heights=not flat and not declaration.ignore_heights)
    placed = _place(file, geometries, reference, accuracy_m, flat)
    source = _with_earlier(file, placed.road)
    check_length(placed.lines)
    warnings = list(file.warnings)
    lanes: list[Lane] = []
    for geometry, lines in zip(geometries, placed.lines, strict=True):
        with lane_errors(geometry.name, lines):
            lane = _lane(geometry, lines, rules, name, warnings, needs_speed)
        if lane is not None:
            lanes.append(lane)
    if not lanes:
        raise InvalidParameter(
            "no lane is left",
            field="road.lanes",
            limit=f"a lane of {MIN_LANE_M:g} m at least",
            cure="send longer lanes, or join lanes in sections under one name",
        )
    warnings += check_radii(lanes)
    events = find_events(file, geometries, lanes, placed.events, rules, warnings)
    if source.note is not None:
        warnings.append(source.note)
    has_heights = any(bool(np.isfinite(lane.height_m).any()) for lane in lanes)
    return Alignment(
        name,
        tuple(lanes),
        tuple(events),
        tuple(_areas(file, placed.rings)),
        source.surveyed,
        source.crs,
        source.realization,
        source.epoch,
        reference.declaration.vertical_datum if has_heights else None,
        source.transform_accuracy_m,
        declaration.realization,
        file.stationing,
        tuple(warnings),
    )


def _with_earlier(file: AlignmentFile, road: PlacedRoad) -> PlacedRoad:
    """What the transformation before the file leaves of the accuracy."""
    earlier = file.earlier
    if earlier is None:
        return road
    if not earlier.exact:
        return replace(road, transform_accuracy_m=None, note=earlier.note or road.note)
    return road if earlier.accuracy_m is None else replace(road, transform_accuracy_m=earlier.accuracy_m)


def _areas(file: AlignmentFile, rings: Sequence[Floats]) -> Iterator[AvoidedArea]:
    """Areas with longitudes that do not jump; one across the antimeridian stands on both sides of it."""
    for number, (area, ring) in enumerate(zip(file.areas, rings, strict=True), 1):
        if not np.isfinite(ring).all():
            raise InvalidParameter(
                f"area {number} ({area.kind}) at {area.ring[0, 0]:.9g}, {area.ring[0, 1]:.9g} cannot be placed",
                field="file",
                limit="finite coordinates in the area of use of the CRS",
                cure="correct or remove the area",
            )
        ring = np.column_stack([np.unwrap(ring[:, 0], period=360.0), ring[:, 1]])
        yield AvoidedArea(area.kind, ring)
        if np.abs(ring[:, 0]).max() > 180.0:
            yield AvoidedArea(area.kind, ring - np.array([math.copysign(360.0, ring[:, 0].mean()), 0.0]))


def _chosen(file: AlignmentFile, rules: RoadRules) -> list[LaneGeometry]:
    if not file.lanes:
        raise UnreadableUpload("the file has no lanes", field="file", limit="at least one lane", cure="draw the lanes")
    names = [geometry.name for geometry in file.lanes]
    twice = next((one for one in names if names.count(one) > 1), None) if len(set(names)) < len(names) else None
    if twice is not None:
        raise InvalidParameter(
            f"there are several lanes {twice!r}", field="file", limit="different names", cure="rename the lanes"
        )
    if rules.lanes is None:
        return list(file.lanes)
    unknown = [one for one in rules.lanes if one not in names]
    if unknown or not rules.lanes:
        shown = ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
        raise InvalidParameter(
            f"the file has no lane {unknown[0]!r}" if unknown else "the rules name no lane",
            field="road.lanes",
            limit=shown,
            cure="name lanes of the file, or leave road.lanes out to use all",
        )
    return [geometry for geometry in file.lanes if geometry.name in rules.lanes]


def _has_no_heights(geometries: Sequence[LaneGeometry]) -> bool:
    """Whether no height is there, or all are exactly 0, as drawings in plan have them."""
    lines = [line for one in geometries for line in (one.centre, one.left, one.right) if line is not None]
    return all(bool((~np.isfinite(line[:, 2]) | (line[:, 2] == 0.0)).all()) for line in lines)


def _place(
    file: AlignmentFile, geometries: Sequence[LaneGeometry], reference: RoadReference, accuracy_m: float, flat: bool
) -> _PlacedFile:
    """All positions of a file in one transformation."""
    dense: list[tuple[DenseLine, ...]] = []
    for one in geometries:
        own = (one.centre,) if one.centre is not None else (one.left, one.right)
        lines = [line for line in own if line is not None]
        dense.append(
            tuple(
                densify(line, geographic=reference.geographic, unit_m=reference.unit_m, name=one.name) for line in lines
            )
        )
    points = np.array([event.point for event in file.events], dtype=np.float64).reshape(-1, 2)
    parts = [line.vertices for lines in dense for line in lines]
    parts += [np.column_stack([ring, np.full(len(ring), np.nan)]) for ring in (points, *(a.ring for a in file.areas))]
    vertices = np.concatenate(parts)
    if flat:
        vertices[:, 2] = np.nan
    road = reference.place(vertices, accuracy_m)

    def is_inside_exchanged() -> bool:
        exchanged = vertices[:, [1, 0, 2]]
        if reference.geographic and not (np.abs(exchanged[:, 1]) <= MAX_DEG[1]).all():
            return False
        return bool(np.isfinite(reference.place(exchanged, accuracy_m).lon_deg).all())

    ends = np.cumsum([len(part) for part in parts]).tolist()
    spans = [slice(end - len(part), end) for end, part in zip(ends, parts, strict=True)]
    grounds = []
    position = 0
    for one, own_lines in zip(geometries, dense, strict=True):
        found = []
        for line in own_lines:
            span = spans[position]
            check_line(one.name, road.lon_deg[span], vertices[span], line.index, reference.name, is_inside_exchanged)
            found.append(
                make_ground_line(road.lon_deg[span], road.lat_deg[span], road.height_m[span], line.index, one.name)
            )
            position += 1
        grounds.append(tuple(found))
    flats = [np.column_stack([road.lon_deg[span], road.lat_deg[span]]) for span in spans[position:]]
    return _PlacedFile(road, grounds, flats[0], flats[1:])


def _lane(
    geometry: LaneGeometry,
    lines: tuple[GroundLine, ...],
    rules: RoadRules,
    road: str,
    warnings: list[str],
    needs_speed: bool,
) -> Lane | None:
    """The lane; None, with a warning, if it is too short."""
    length_m = min(line.length_m for line in lines)
    if length_m < MIN_LANE_M:
        place = lines[0].place(0.0)
        if rules.lanes is not None:
            raise InvalidParameter(
                f"lane {geometry.name} at {place} is {length_m:.2f} m long",
                field="road.lanes",
                limit=f"{MIN_LANE_M:g} m",
                cure="leave the lane out, or join it with the next one",
            )
        warnings.append(f"lane {geometry.name} at {place} is left out: it is {length_m:.2f} m long")
        return None
    dropped = sum(line.dropped for line in lines)
    if dropped and geometry.curvature_per_m is None:
        warnings.append(f"lane {geometry.name}: {dropped} vertices that stand twice are left out")
    for line in lines:
        check_simple(geometry.name, line)
    lane = make_lane(geometry, lines, rules, road)
    lane = clear_width(lane, warnings)
    check_curvature(lane, geometry)
    if needs_speed:
        check_speed(lane)
    return lane
