"""A lane sampled at even steps, from its centre line or its boundaries on the ground."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from app.errors import InvalidParameter
from app.formats.alignments.geometry import LaneGeometry
from app.geodesy.frames import metres_per_radian
from app.lanes.cross_sections import WIDTH_M, cut_lane
from app.planning.alignment import STEP_M, Lane
from app.planning.road.ground_line import (
    MAX_LANES_M,
    GroundLine,
    grade_of,
    make_ground_line,
    mean_directions,
    piece_curvatures,
    piece_directions_rad,
    polyline_directions,
    smooth,
    smoothing_m,
    vertex_noise_m,
)
from app.planning.road.reference import local_plane
from app.planning.rules import RoadRules
from app.values import Floats

# === Checks of lanes: what no vehicle can drive on is refused, with its place and the cure.


MIN_RADIUS_M = 4.39
"""Smallest radius of a lane's centre. [m] Source: AASHTO Green Book 2018, table 2-6b, inside radius of the passenger
car P at its sharpest turn, 14.4 ft; no car's middle follows a smaller one."""
MAX_TURN_DEG = 90.0
"""Largest turn at one vertex. [deg] Source: app/roads/axis.py, sharper ones are corners."""
_BRIDGE_M = 3.0  # [m] of height between two crossing lanes; below every bridge's clearance
_RADII = (  # speed [km/h] and smallest radius [m], superelevation 6 %; source: AASHTO Green Book 2018, table 3-7
    (30.0, 21.0), (40.0, 43.0), (50.0, 79.0), (60.0, 123.0), (70.0, 184.0), (80.0, 252.0), (90.0, 336.0),
    (100.0, 437.0), (110.0, 560.0), (120.0, 756.0), (130.0, 951.0),
)  # fmt: skip


@contextmanager
def lane_errors(name: str, lines: Sequence[GroundLine]) -> Iterator[None]:
    """Add lane and place to errors of computations that do not know them."""
    try:
        yield
    except InvalidParameter as error:
        if "lane " + name not in error.message:
            where = _narrowest(lines) if len(lines) == 2 else f"at {lines[0].place(0.0)}"
            error.message = f"lane {name}, {where}: {error.message}"
            error.args = (error.message,)
            error.field = "file"
            error.cure = f"{error.cure or 'correct the file'}, or leave the lane out by road.lanes"
        raise


def _narrowest(lines: Sequence[GroundLine]) -> str:
    """Where boundaries are nearest to each other."""
    left, right = (
        np.stack([np.interp(_metres(line), line.chainage_m, v) for v in (line.lon_deg, line.lat_deg)], axis=1)
        for line in lines
    )
    shrink = np.array([math.cos(math.radians(float(left[0, 1]))), 1.0])
    tree = shapely.STRtree(shapely.points(right * shrink))
    (own, _other), away = tree.query_nearest(shapely.points(left * shrink), return_distance=True, all_matches=False)
    chainage = float(_metres(lines[0])[own[int(np.argmin(away))]])
    return f"chainage {chainage:.0f} m at {lines[0].place(chainage)}, where the boundaries are nearest"


def _metres(line: GroundLine) -> Floats:
    return np.linspace(0.0, line.length_m, max(2, min(int(line.length_m), 200_000)))


def check_length(lines: Sequence[Sequence[GroundLine]]) -> None:
    """Raises InvalidParameter if all lanes together are longer than 500 km."""
    total = sum(max(line.length_m for line in one) for one in lines)
    if total > MAX_LANES_M:
        raise InvalidParameter(
            f"the lanes are {total / 1000:.0f} km long",
            field="file",
            limit=f"{MAX_LANES_M / 1000:g} km of lanes",
            cure="plan the road in sections, or choose lanes with road.lanes",
        )


def check_line(
    name: str, lon_deg: Floats, vertices: Floats, index: Floats, crs: str, is_inside_exchanged: Callable[[], bool]
) -> None:
    """Raises InvalidParameter if a vertex could not be placed on Earth.

    Parameters
    ----------
    is_inside_exchanged : function
        Whether the vertices can be placed with their two coordinates exchanged, for the message.
    """
    bad = np.flatnonzero(~np.isfinite(lon_deg))
    if len(bad):
        x, y = vertices[bad[0], :2]
        state, cure = "", "check the CRS and the order of the coordinates (longitude or easting first)"
        if is_inside_exchanged():
            state = ", but inside it if the two coordinates are exchanged"
            cure = "exchange the two coordinates of all points, which the file has in the other order, or check the CRS"
        raise InvalidParameter(
            f"lane {name}: vertex {int(index[bad[0]]) + 1} at {x:.9g}, {y:.9g} is outside the area of use of "
            f"{crs[:60]}{state}",
            field="crs",
            limit="coordinates in the area of use of the CRS",
            cure=cure,
        )


def clear_width(lane: Lane, warnings: list[str]) -> Lane:
    """The lane without ends that are too narrow, where lanes open and close.

    Raises
    ------
    InvalidParameter
        It is too narrow elsewhere.
    """
    wide = lane.width_m >= WIDTH_M[0]
    if wide.all():
        return lane
    found = np.flatnonzero(wide)
    narrow = np.flatnonzero(~wide)
    if len(found) < 3 or not wide[found[0] : found[-1] + 1].all():
        k = int(narrow[0] if len(found) < 3 else narrow[(narrow > found[0])][0])
        raise InvalidParameter(
            f"{_at(lane, k)}: the lane is {lane.width_m[k]:.2f} m wide",
            field="file",
            limit=f"{WIDTH_M[0]:g} m",
            cure="correct the width or the boundaries, or leave the lane out by road.lanes",
        )
    first, last = int(found[0]), int(found[-1])
    warnings.append(
        f"lane {lane.name} is used from chainage {lane.chainage_m[first]:.0f} m to {lane.chainage_m[last]:.0f} m: "
        f"elsewhere it is narrower than {WIDTH_M[0]:g} m"
    )
    kept = slice(first, last + 1)
    arrays = (
        "lon_deg", "lat_deg", "height_m", "heading_deg", "curvature_per_m", "grade", "superelevation_rad", "width_m",
        "design_speed_m_s", "station_m",
    )  # fmt: skip
    cut = {name: getattr(lane, name)[kept] for name in arrays}
    return replace(lane, chainage_m=lane.chainage_m[kept] - lane.chainage_m[first], **cut)


def check_speed(lane: Lane) -> None:
    """Check that a lane has a speed everywhere.

    Raises
    ------
    InvalidParameter
        Neither the file nor the rules state one.
    """
    missing = np.flatnonzero(~np.isfinite(lane.design_speed_m_s))
    if len(missing):
        raise InvalidParameter(
            f"{_at(lane, int(missing[0]))}: neither the file nor the rules state a speed",
            field="road.design_speed_kmh",
            limit="a speed for every lane",
            cure="give road.design_speed_kmh in the rules, or speed_limit_kmh in the file",
        )


def check_curvature(lane: Lane, geometry: LaneGeometry) -> None:
    """Check the curvature of a lane.

    Raises
    ------
    InvalidParameter
        It is larger than a car can turn.
    """
    k = int(np.argmax(np.abs(lane.curvature_per_m)))
    if abs(lane.curvature_per_m[k]) > 1 / MIN_RADIUS_M:
        raise InvalidParameter(
            f"{_at(lane, k)}: the lane turns with a radius of {1 / abs(lane.curvature_per_m[k]):.2f} m",
            field="file",
            limit=f"{MIN_RADIUS_M:g} m, the inside radius of a turning passenger car",
            cure="correct the vertices there, or leave the lane out by road.lanes",
        )


def check_simple(name: str, line: GroundLine) -> None:
    """Check that a line does not cross itself or turn back.

    Raises
    ------
    InvalidParameter
        It turns by more than 90 degrees at a vertex, or crosses itself on the same level.
    """
    turn = np.degrees(np.abs(np.diff(piece_directions_rad(line))))
    if len(turn) and turn.max() > MAX_TURN_DEG:
        at = float(line.chainage_m[1:-1][np.argmax(turn)])
        raise InvalidParameter(
            f"lane {name}, chainage {at:.1f} m at {line.place(at)}: the line turns by {turn.max():.0f} degrees at one "
            "vertex",
            field="file",
            limit=f"{MAX_TURN_DEG:g} degrees",
            cure="correct the vertices there, or leave the lane out by road.lanes",
        )
    points = np.column_stack([line.lon_deg - line.lon_deg[0], line.lat_deg - line.lat_deg[0]])
    if shapely.is_simple(shapely.linestrings(points)):
        return
    pieces = shapely.linestrings(np.stack([points[:-1], points[1:]], axis=1))
    one, other = shapely.STRtree(pieces).query(pieces, predicate="intersects")
    closed = (one == 0) & (other == len(pieces) - 1) & (np.abs(points[0] - points[-1]) < 1e-9).all()
    pairs = np.flatnonzero((other > one + 1) & ~closed)
    for k in pairs.tolist():
        heights = line.height_m[[one[k], other[k]]]
        if not abs(heights[0] - heights[1]) > _BRIDGE_M:
            at, again = (_crossing_m(line, points, pieces, *pair) for pair in ((one[k], other[k]), (other[k], one[k])))
            raise InvalidParameter(
                f"lane {name} crosses itself at {line.place(at)}, chainages {at:.1f} m and {again:.1f} m",
                field="file",
                limit=f"a line that does not cross itself, or with {_BRIDGE_M:g} m of height between",
                cure="correct the order of the vertices, or split the lane into two",
            )


def _crossing_m(line: GroundLine, points: Floats, pieces: Any, own: int, other: int) -> float:
    """Chainage on a piece of a line where another piece meets it. [m]"""
    met = shapely.get_coordinates(shapely.intersection(pieces[own], pieces[other]))[0]
    along = points[own + 1] - points[own]
    share = float((met - points[own]) @ along / (along @ along))
    return float(line.chainage_m[own] + share * (line.chainage_m[own + 1] - line.chainage_m[own]))


def check_radii(lanes: Sequence[Lane]) -> list[str]:
    """Warnings where bends are sharper than the design speed allows; none where it is unknown."""
    warnings = []
    speeds, radii = np.array(_RADII).T
    for lane in lanes:
        speed_kmh = lane.design_speed_m_s * 3.6
        least = np.interp(speed_kmh, speeds, radii) * np.minimum(speed_kmh / speeds[0], 1.0) ** 2
        excess = np.nan_to_num(np.abs(lane.curvature_per_m) * least)
        k = int(np.argmax(excess))
        if excess[k] > 1.0:
            warnings.append(
                f"{_at(lane, k)}: the radius of {1 / abs(lane.curvature_per_m[k]):.0f} m is below the {least[k]:.0f} m "
                f"of the design speed {speed_kmh[k]:.0f} km/h (AASHTO Green Book 2018, table 3-7, 6 %)"
            )
    return warnings


def _at(lane: Lane, k: int) -> str:
    return f"lane {lane.name}, chainage {lane.chainage_m[k]:.1f} m at {lane.lon_deg[k]:.7f}, {lane.lat_deg[k]:.7f}"


# === A lane sampled at even steps, from its centre line or its boundaries on the ground.


Indices = npt.NDArray[np.intp]

_CUT_STEP_M = 0.5  # [m] between cuts of a lane with boundaries; source: the sagitta at 20 m radius is 1.6 mm


@dataclass(frozen=True, slots=True, eq=False)
class _Centre:
    """Samples of a centre line at even steps, each of shape (N,)."""

    chainage_m: Floats
    lon_deg: Floats
    lat_deg: Floats
    height_m: Floats
    index: Floats  # numbers of the vertices that values belong to, with fractions
    direction_rad: Floats  # anticlockwise from east
    curvature_per_m: Floats
    width_m: Floats | None = None


def make_lane(geometry: LaneGeometry, lines: tuple[GroundLine, ...], rules: RoadRules, road: str) -> Lane:
    """A lane at even steps of at most 1 m.

    Parameters
    ----------
    geometry : LaneGeometry
        Its values; its lines are not used.
    lines : tuple of GroundLine
        The centre line, or the left and the right boundary.
    rules : RoadRules
        Width and speed where the file has none; speeds stay NaN where the rules have none either.
    road : str
        Name of the road where the file has none.

    Raises
    ------
    InvalidParameter
        The boundaries are not those of a lane.
    """
    if len(lines) == 2:
        centre = _between_boundaries(geometry.name, *lines)
    elif geometry.curvature_per_m is not None:
        centre = _along_curves(lines[0], geometry.curvature_per_m)
    else:
        centre = _along_polyline(lines[0])
    step = float(centre.chainage_m[1])
    width = centre.width_m
    if width is None:
        width = _values(geometry.width_m, centre.index)
        width = np.where(np.isfinite(width), width, rules.lane_width_m)
    return Lane(
        geometry.name,
        geometry.road or road,
        centre.chainage_m,
        (centre.lon_deg + 180.0) % 360.0 - 180.0,
        centre.lat_deg,
        centre.height_m,
        np.asarray((90.0 - np.degrees(centre.direction_rad)) % 360.0),
        centre.curvature_per_m,
        grade_of(centre.height_m, step),
        np.nan_to_num(_values(geometry.superelevation_rad, centre.index), nan=0.0),
        width,
        _speeds(geometry.speed_limit_m_s, centre.index, rules),
        centre.chainage_m if geometry.station_m is None else _values(geometry.station_m, centre.index),
        geometry.left_style,
        geometry.right_style,
    )


def _values(values: Floats | None, index: Floats) -> Floats:
    """Values between vertices, linearly; NaN without any."""
    if values is None:
        return np.full(len(index), np.nan)
    return np.asarray(np.interp(index, np.arange(len(values)), values))


def _speeds(values: Floats | None, index: Floats, rules: RoadRules) -> Floats:
    """Speed limits hold from their vertex to the next one; the rules' speed where there is none. [m/s]"""
    own = rules.design_speed_kmh / 3.6 if rules.design_speed_kmh is not None else math.nan
    if values is None or rules.override_speed:
        return np.full(len(index), own)
    found = values[np.clip(index.astype(np.intp), 0, len(values) - 1)]
    return np.where(np.isfinite(found), found, own)


def _even(length_m: float) -> Floats:
    return np.linspace(0.0, length_m, max(math.ceil(length_m / STEP_M - 1e-9), 2) + 1)


# --- centre lines -----------------------------------------------------------------------------------------------------


def _along_curves(line: GroundLine, curvature_per_m: Floats) -> _Centre:
    """Samples of a line whose curvature the file defines: its vertices lie on arcs and spirals."""
    start, end = piece_curvatures(line, curvature_per_m)
    mean = (start + end) / 2
    arcs = line.piece_m * (1 + (mean * line.piece_m) ** 2 / 24)
    along = np.concatenate([[0.0], np.cumsum(arcs)])
    chainage = _even(float(along[-1]))
    piece, share = _pieces(along, chainage)
    lon, lat, height, index = _points(line, piece, share)
    right = mean[piece] * share * (1 - share) * arcs[piece] ** 2 / 2
    direction = piece_directions_rad(line)[piece]
    lon, lat = _shifted(lon, lat, right, direction)
    curvature = start[piece] + share * (end - start)[piece]
    at_start = direction - (2 * start + end)[piece] * arcs[piece] / 6
    turned = (start[piece] + curvature) / 2 * share * arcs[piece]
    return _Centre(chainage, lon, lat, height, index, at_start + turned, curvature)


def _along_polyline(line: GroundLine) -> _Centre:
    """Samples of a polyline, with estimated directions and curvature; its places stay on it."""
    chainage = _even(line.length_m)
    lon, lat, height, index = _points(line, *_pieces(line.chainage_m, chainage))
    direction = mean_directions(*polyline_directions(line), chainage)
    direction = smooth(direction, smoothing_m(*vertex_noise_m(line)) / chainage[1])
    return _Centre(chainage, lon, lat, height, index, direction, np.gradient(direction, chainage))


def _between_boundaries(name: str, left: GroundLine, right: GroundLine) -> _Centre:
    """Samples halfway between boundaries, cut square to the lane in a conformal plane about the lane's middle.

    Chainages are true distances on the ellipsoid: the plane's scale is only true at the middle. Directions are those of
    the boundaries where a cut meets them.
    """
    middle = len(left.lon_deg) // 2
    plane = local_plane(float(left.lon_deg[middle]), float(left.lat_deg[middle]))
    flat = [np.stack(plane.transform(line.lon_deg, line.lat_deg), axis=1) for line in (left, right)]
    sections = cut_lane(*flat, step_m=_CUT_STEP_M)
    lon, lat = plane.transform(sections.centre_m[:, 0], sections.centre_m[:, 1], direction="INVERSE")
    sides = ((left, flat[0], sections.along_left_m), (right, flat[1], sections.along_right_m))
    along = [_true_chainage(line, points, cuts) for line, points, cuts in sides]
    heights = (np.interp(s, line.chainage_m, line.height_m) for s, line in zip(along, (left, right), strict=True))
    height = sum(heights, np.zeros(len(lon))) / 2
    index = np.interp(along[0], left.chainage_m, np.append(left.start_index, left.end_index[-1]))
    line = make_ground_line(np.asarray(lon), np.asarray(lat), height, np.arange(len(lon), dtype=np.float64), name)
    noises = [vertex_noise_m(boundary) for boundary in (left, right)]
    width = smoothing_m(math.hypot(noises[0][0], noises[1][0]) / 2, max(noises[0][1], noises[1][1]))
    turns = [mean_directions(*polyline_directions(b), s) for s, b in zip(along, (left, right), strict=True)]
    turns[1] += 2 * math.pi * round(float(np.median(turns[0] - turns[1])) / (2 * math.pi))

    vertices = np.append(line.start_index, line.end_index[-1]).astype(np.intp)
    chainage = _even(line.length_m)
    piece, share = _pieces(line.chainage_m, chainage)
    lon, lat, height, cut = _points(line, piece, share)
    direction = mean_directions(line.chainage_m, ((turns[0] + turns[1]) / 2)[vertices], chainage)
    direction = smooth(direction, width / chainage[1])
    curvature = np.gradient(direction, chainage)
    bulge = curvature * share * (1 - share) * line.piece_m[piece] ** 2 / 2
    lon, lat = _shifted(lon, lat, bulge, direction)
    cuts = np.arange(len(index))
    return _Centre(
        chainage, lon, lat, height, np.interp(cut, cuts, index), direction, curvature,
        np.interp(cut, cuts, sections.width_m),
    )  # fmt: skip


def _true_chainage(line: GroundLine, points_m: Floats, along_m: Floats) -> Floats:
    """Chainages on the ground of chainages in a plane in which the line has these vertices."""
    plane = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points_m, axis=0).T))])
    return np.asarray(np.interp(along_m, plane, line.chainage_m))


def _pieces(along_m: Floats, chainage_m: Floats) -> tuple[Indices, Floats]:
    """Piece that each chainage lies in, and the share of the piece before it."""
    piece = np.clip(np.searchsorted(along_m, chainage_m, side="right") - 1, 0, len(along_m) - 2)
    return piece, np.clip((chainage_m - along_m[piece]) / np.diff(along_m)[piece], 0.0, 1.0)


def _points(line: GroundLine, piece: Indices, share: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Longitudes, latitudes, heights and numbers of vertices on the chords of pieces."""
    between = (line.lon_deg, line.lat_deg, line.height_m)
    lon, lat, height = (values[piece] + share * (values[piece + 1] - values[piece]) for values in between)
    index = line.start_index[piece] + share * (line.end_index - line.start_index)[piece]
    return lon, lat, height, index


def _shifted(lon_deg: Floats, lat_deg: Floats, right_m: Floats, direction_rad: Floats) -> tuple[Floats, Floats]:
    """Places to the right of directions."""
    per_east, per_north = metres_per_radian(np.radians(lat_deg))
    lon = lon_deg + np.degrees(right_m * np.sin(direction_rad) / per_east)
    return lon, lat_deg - np.degrees(right_m * np.cos(direction_rad) / per_north)
