"""A lane sampled at even steps, from its centre line or its boundaries on the ground."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.formats.alignments.geometry import LaneGeometry
from app.geodesy.ellipsoid import metres_per_radian
from app.lanes.cross_sections import cut_lane
from app.planning.alignment import STEP_M, Lane
from app.planning.road.direction import (
    grade_of,
    mean_directions,
    piece_curvatures,
    piece_directions_rad,
    polyline_directions,
    smooth,
    smoothing_m,
    vertex_noise_m,
)
from app.planning.road.ground_line import GroundLine, make_ground_line
from app.planning.road.reference import local_plane
from app.planning.rules import RoadRules

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

_CUT_STEP_M = 0.5  # [m] between cuts of a lane with boundaries; source: the sagitta at 20 m radius is 1.6 mm


@dataclass(frozen=True, slots=True, eq=False)
class _Centre:
    """Samples of a centre line at even steps, each of shape (N,).

    Attributes
    ----------
    index : ndarray
        Numbers of the vertices that values belong to, with fractions.
    direction_rad : ndarray
        Anticlockwise from east.
    width_m : ndarray or None
    """

    chainage_m: Floats
    lon_deg: Floats
    lat_deg: Floats
    height_m: Floats
    index: Floats
    direction_rad: Floats
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
        _speeds(geometry.speed_limit_mps, centre.index, rules),
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
