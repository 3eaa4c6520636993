"""Checks of lanes: what no vehicle can drive on is refused, with its place and the cure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from app.errors import InvalidParameter
from app.formats.alignments.geometry import LaneGeometry
from app.lanes.cross_sections import WIDTH_M
from app.planning.alignment import Lane
from app.planning.road.direction import piece_directions_rad
from app.planning.road.ground_line import MAX_LANES_M, GroundLine

Floats = npt.NDArray[np.float64]

MIN_RADIUS_M = 4.39
"""Smallest radius of a lane's centre. [m] Source: AASHTO Green Book 2018, table 2-6b, inside radius of the passenger
car P at its sharpest turn, 14.4 ft; no car's middle follows a smaller one."""
MAX_TURN_DEG = 90.0
"""Largest turn at one vertex. [deg] Source: app/roads/axis.py, sharper ones are corners."""
_BRIDGE_M = 3.0  # [m] of height between two crossing lanes; source: chosen by hand, below every bridge's clearance
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


def check_line(name: str, lon_deg: Floats, vertices: Floats, index: Floats, crs: str) -> None:
    """Raises InvalidParameter if a vertex could not be placed on Earth."""
    bad = np.flatnonzero(~np.isfinite(lon_deg))
    if len(bad):
        x, y = vertices[bad[0], :2]
        raise InvalidParameter(
            f"lane {name}: vertex {int(index[bad[0]]) + 1} at {x:.9g}, {y:.9g} is outside the area of use of "
            f"{crs[:60]}",
            field="crs",
            limit="coordinates in the area of use of the CRS",
            cure="check the CRS and the order of the coordinates (longitude or easting first)",
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
        "design_speed_mps", "station_m",
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
    missing = np.flatnonzero(~np.isfinite(lane.design_speed_mps))
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
        speed_kmh = lane.design_speed_mps * 3.6
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
