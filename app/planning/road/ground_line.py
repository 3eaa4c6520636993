"""Lines on the ground: vertices in WGS 84 with true distances, in pieces so short that straight lines are exact."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from app.errors import InvalidParameter
from app.formats.alignments.geometry import CHORD_ERROR_M, MAX_COORDINATE
from app.geodesy.frames import metres_per_radian
from app.values import Floats

Indices = npt.NDArray[np.intp]

MAX_LANES_M = 500_000.0
"""Length of all lanes of a plan at most. [m] 100 km of four lanes fit, a road of 1,000 km does not."""
PIECE_M = 50.0
"""Longest piece between vertices: at 60 degrees of latitude straight lines in degrees, in a projection and on the
ellipsoid differ by less than 0.1 mm on it. [m] Source: L^2 tan(lat) / (8 R)."""
SAME_PLACE_M = 1e-4
"""Vertices that are this near are one. [m] Source: app/roads/axis.py."""
MAX_DEG = (360.0, 90.0)
"""Longitudes and latitudes at most; lines across the antimeridian run beyond 180. [deg] Source: RFC 7946, 3.1.9."""
_M_PER_DEG = 111_195.0  # [m/deg] on a sphere of 6371 km, the Earth's mean radius


@dataclass(frozen=True, slots=True, eq=False)
class DenseLine:
    """A line of the file with vertices at most 50 m apart, in the coordinates of the file."""

    vertices: Floats  # shape (M, 3): longitudes do not jump at the antimeridian
    index: Floats  # shape (M,): numbers of the file's vertices from 0, with fractions between them


def densify(vertices: Floats, *, geographic: bool, unit_m: float, name: str) -> DenseLine:
    """Add vertices on straight lines in the file's coordinates, as RFC 7946 and projections define them.

    Raises
    ------
    InvalidParameter
        A coordinate is not finite, or the line is longer than 500 km.
    """
    _check_vertices(vertices, geographic, name)
    if geographic:
        vertices = np.column_stack([np.unwrap(vertices[:, 0], period=360.0), vertices[:, 1:]])
    length = np.hypot(*np.diff(vertices[:, :2], axis=0).T) * (_M_PER_DEG if geographic else unit_m)
    if not length.sum() < 10 * MAX_LANES_M:  # degrees of longitude are short near the poles
        raise InvalidParameter(
            f"lane {name} is about {length.sum() / 1000:.0f} km long",
            field="file",
            limit=f"{MAX_LANES_M / 1000:g} km",
            cure="plan the road in sections; check the unit, the CRS and the order of the coordinates",
        )
    steps = np.maximum(np.ceil(length / PIECE_M), 1).astype(np.intp)
    if not len(steps) or steps.max() == 1:
        return DenseLine(vertices, np.arange(len(vertices), dtype=np.float64))
    edge = np.repeat(np.arange(len(steps)), steps)
    share = (np.arange(len(edge)) - np.repeat(np.cumsum(steps) - steps, steps)) / steps[edge]
    dense = vertices[edge] + share[:, None] * (vertices[edge + 1] - vertices[edge])
    return DenseLine(np.concatenate([dense, vertices[-1:]]), np.append(edge + share, float(len(vertices) - 1)))


def _check_vertices(vertices: Floats, geographic: bool, name: str) -> None:
    bad = np.flatnonzero(~(np.abs(vertices[:, :2]) <= MAX_COORDINATE).all(axis=1))
    if len(bad):
        raise InvalidParameter(
            f"lane {name}: vertex {int(bad[0]) + 1} is not finite",
            field="file",
            limit="finite coordinates",
            cure="correct or remove the vertex",
        )
    bad = np.flatnonzero((np.abs(vertices[:, :2]) > MAX_DEG).any(axis=1)) if geographic else bad
    if len(bad):
        x, y = vertices[bad[0], :2]
        raise InvalidParameter(
            f"lane {name}: vertex {int(bad[0]) + 1} at {x:.9g}, {y:.9g} is no longitude and latitude",
            field="crs",
            limit=f"-{MAX_DEG[0]:g} to {MAX_DEG[0]:g} and -{MAX_DEG[1]:g} to {MAX_DEG[1]:g} degrees",
            cure="declare the crs of the coordinates, or check their order (longitude first)",
        )


@dataclass(frozen=True, slots=True, eq=False)
class GroundLine:
    """A line in WGS 84 by its pieces: vertices that stand twice are dropped."""

    # `lon_deg`, `lat_deg`, `height_m`: shape (K + 1,): vertices; longitudes do not jump
    lon_deg: Floats
    lat_deg: Floats
    height_m: Floats
    # `start_index`, `end_index`: shape (K,): numbers of the file's vertices at the start and the end of each piece,
    # with fractions
    start_index: Floats
    end_index: Floats
    # `east_m`, `north_m`: shape (K,): [m] of each piece, at true scale
    east_m: Floats
    north_m: Floats
    chainage_m: Floats  # shape (K + 1,): [m] True distance of the vertices on the ellipsoid
    dropped: int  # vertices of the file that stood twice

    @property
    def length_m(self) -> float:
        """[m]"""
        return float(self.chainage_m[-1])

    @property
    def piece_m(self) -> Floats:
        """Lengths of the pieces, shape (K,). [m]"""
        return np.diff(self.chainage_m)

    def place(self, chainage_m: float) -> str:
        """Longitude and latitude of a chainage, for messages."""
        lon = (float(np.interp(chainage_m, self.chainage_m, self.lon_deg)) + 180.0) % 360.0 - 180.0
        return f"{lon:.7f}, {float(np.interp(chainage_m, self.chainage_m, self.lat_deg)):.7f}"


def make_ground_line(lon_deg: Floats, lat_deg: Floats, height_m: Floats, index: Floats, name: str) -> GroundLine:
    """A line of placed vertices, at most about 50 m apart.

    Raises
    ------
    InvalidParameter
        There are fewer than two different vertices.
    """
    lon = np.unwrap(lon_deg, period=360.0)
    east, north = steps_m(lon, lat_deg)
    length = np.hypot(east, north)
    kept = np.flatnonzero(length > SAME_PLACE_M)
    if not len(kept):
        raise InvalidParameter(
            f"lane {name} is one point",
            field="file",
            limit="two different vertices at least",
            cure="remove the line, or give the vertices along the road",
        )
    vertices = np.append(kept, kept[-1] + 1)
    return GroundLine(
        lon[vertices],
        lat_deg[vertices],
        height_m[vertices],
        index[kept],
        index[kept + 1],
        east[kept],
        north[kept],
        np.concatenate([[0.0], np.cumsum(length[kept])]),
        len(length) - len(kept),
    )


def steps_m(lon_deg: Floats, lat_deg: Floats) -> tuple[Floats, Floats]:
    """East and north of each vertex from the one before, by the radii at the latitude between them. [m]"""
    per_east, per_north = metres_per_radian(np.radians((lat_deg[1:] + lat_deg[:-1]) / 2))
    return np.radians(np.diff(lon_deg)) * per_east, np.radians(np.diff(lat_deg)) * per_north


# === Direction and curvature along lines: from the file's curvature, or estimated from the vertices of a polyline.
#
# A polyline turns only at its vertices. The estimate spreads the turn of a vertex over the halves of its two pieces, so
# that a polyline in an arc has the arc's curvature everywhere, however its vertices are spaced. Then a Gaussian removes
# the noise of the vertices; its width follows from the noise, which is estimated from the vertices themselves.


_REACH_M = 7.0  # [m] over which a vertex between long pieces turns, to each side; source: half of 14 m, the longest
# spacing of the Karlsruhe map's bends (issue 13)
_NOISE_PER_M = 4e-4  # [1/m] standard deviation of curvature that noise may cause; source: radii above 500 m at 5 sigma
_SMOOTHING_M = (2.0, 8.0)  # [m] least and most standard deviation of the Gaussian; a bend with
# a radius of 6 m keeps 97 % of its curvature at the least, one of 60 m turning 30 degrees 95 % at the most
_END_FIT = 6.0  # widths of the Gaussian over which the ends are fitted; noise as between the ends
_BEND_NORM = 3 / (8 * math.sqrt(math.pi))  # integral of the squared second derivative of a Gaussian of width 1
_THIRD_DIFFERENCE = math.sqrt(20.0)  # of white noise; root of 1 + 9 + 9 + 1
_MAD = 0.6745  # median of the absolute value of a normal variable with standard deviation 1
_GRADE_SMOOTHING_M = 5.0  # [m] of heights before their slope is taken; 1 cm noise at 1 m is 0.1 %


def piece_directions_rad(line: GroundLine) -> Floats:
    """Directions of a line's pieces, anticlockwise from east, unwrapped, shape (K,). [rad]"""
    return np.asarray(np.unwrap(np.arctan2(line.north_m, line.east_m)))


def polyline_directions(line: GroundLine) -> tuple[Floats, Floats]:
    """Chainages and directions between which the direction of a polyline is linear, each of shape (2 K,). [m], [rad]"""
    piece, direction = line.piece_m, piece_directions_rad(line)
    if len(piece) == 1:
        return line.chainage_m, np.repeat(direction, 2)
    before, after = piece[:-1], piece[1:]
    reach = np.maximum(_REACH_M, np.minimum(before, after) / 2)
    start = line.chainage_m[1:-1] - np.minimum(before / 2, reach)
    end = line.chainage_m[1:-1] + np.minimum(after / 2, reach)
    rate = np.diff(direction) / (end - start)
    first = direction[0] - (rate[0] * piece[0] / 2 if piece[0] <= 2 * reach[0] else 0.0)
    last = direction[-1] + (rate[-1] * piece[-1] / 2 if piece[-1] <= 2 * reach[-1] else 0.0)
    chainage = np.concatenate([[0.0], np.stack([start, end], axis=1).ravel(), [line.length_m]])
    turns = np.concatenate([[first], np.stack([direction[:-1], direction[1:]], axis=1).ravel(), [last]])
    return chainage, turns


def mean_directions(knots_m: Floats, direction_rad: Floats, chainage_m: Floats) -> Floats:
    """Means of directions, linear between knots, over the surroundings of each chainage, shape (N,). [rad]

    The surroundings reach half way to the neighbours. Single values instead would keep one vertex in many where
    vertices are denser than chainages, and with it the whole noise of that vertex.
    """
    middles = (chainage_m[1:] + chainage_m[:-1]) / 2
    cells = np.concatenate([chainage_m[:1], middles, chainage_m[-1:]])
    at = np.concatenate([knots_m, cells])
    order = np.argsort(at, kind="stable")
    places = at[order]
    values = np.interp(places, knots_m, direction_rad)
    area = np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(places))])
    at_cells = np.empty(len(at))
    at_cells[order] = area
    return np.asarray(np.diff(at_cells[len(knots_m) :]) / np.maximum(np.diff(cells), 1e-12))


def vertex_noise_m(line: GroundLine) -> tuple[float, float]:
    """Estimated standard deviation of the vertices across the line, and their median distance. [m]

    Third differences of the offsets: a line of constant curvature has none. Bends that begin and end are outliers,
    which the median leaves out.
    """
    piece = line.piece_m
    if len(piece) < 8:
        return 0.0, float(np.median(piece))
    between = (piece[:-1] + piece[1:]) / 2
    curvature = np.diff(piece_directions_rad(line)) / between
    offsets = np.diff(curvature) * between[1:] * between[:-1]
    return float(np.median(np.abs(offsets))) / _MAD / _THIRD_DIFFERENCE, float(np.median(piece))


def smoothing_m(noise_m: float, spacing_m: float) -> float:
    """Standard deviation of the Gaussian that reduces the noise of curvature to 4e-4 1/m. [m]

    Of white noise s at spacing d, a Gaussian of width w leaves a curvature with variance s^2 d 3 / (8 sqrt(pi) w^5).
    """
    width = (noise_m**2 * spacing_m * _BEND_NORM / _NOISE_PER_M**2) ** 0.2
    return float(np.clip(width, *_SMOOTHING_M))


def smooth(values: Floats, width: float) -> Floats:
    """Values after a Gaussian of a width in samples; at and beyond the ends straight lines continue them.

    The values at the ends are means over half a step, with twice the noise, and are left out.
    """
    reach = int(4 * width) + 1
    inner = values[1:-1]
    fitted = min(int(_END_FIT * width) + 2, len(inner))
    at = np.arange(fitted, dtype=np.float64)
    slope, start = np.polyfit(at, inner[:fitted], 1) if fitted > 1 else (0.0, inner[0])
    before = start + slope * np.arange(-reach - 1, 0)
    slope, start = np.polyfit(at, inner[-fitted:], 1) if fitted > 1 else (0.0, inner[0])
    after = start + slope * (fitted + np.arange(reach + 1))
    smoothed = scipy.ndimage.gaussian_filter1d(np.concatenate([before, inner, after]), width)
    return np.asarray(smoothed[reach : reach + len(values)])


def piece_curvatures(line: GroundLine, curvature_per_m: Floats) -> tuple[Floats, Floats]:
    """Curvature at the start and the end of each piece, from the values at the file's vertices, each of shape (K,).

    A piece that would leave its chord by more than the curves are sampled by is straight at its end with less
    curvature: the curvature of the other end belongs to the curve beyond.
    """
    at = np.arange(len(curvature_per_m))
    start, end = np.interp(line.start_index, at, curvature_per_m), np.interp(line.end_index, at, curvature_per_m)
    bulge = line.piece_m**2 * np.maximum(np.abs(start), np.abs(end)) / 8
    lesser = np.where(np.abs(start) < np.abs(end), start, end)
    long = bulge > 2 * CHORD_ERROR_M
    return np.where(long, lesser, start), np.where(long, lesser, end)


def grade_of(height_m: Floats, step_m: float) -> Floats:
    """Rise per distance of evenly spaced heights; 0 where they are unknown."""
    if not np.isfinite(height_m).all() or len(height_m) < 3:
        slope = np.gradient(height_m, step_m) if len(height_m) > 1 else np.zeros_like(height_m)
        return np.nan_to_num(slope, nan=0.0)
    return np.asarray(np.gradient(smooth(height_m, _GRADE_SMOOTHING_M / step_m), step_m))
