"""Lines on the ground: vertices in WGS 84 with true distances, in pieces so short that straight lines are exact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.formats.alignments.geometry import MAX_COORDINATE
from app.geodesy.ellipsoid import metres_per_radian

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

MAX_LANES_M = 500_000.0
"""Length of all lanes of a plan at most. [m] Source: chosen by hand; 100 km of four lanes fit, a road of 1,000 km does
not."""
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
    """A line of the file with vertices at most 50 m apart, in the coordinates of the file.

    Attributes
    ----------
    vertices : ndarray, shape (M, 3)
        Longitudes do not jump at the antimeridian.
    index : ndarray, shape (M,)
        Numbers of the file's vertices from 0, with fractions between them.
    """

    vertices: Floats
    index: Floats


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
    """A line in WGS 84 by its pieces: vertices that stand twice are dropped.

    Attributes
    ----------
    lon_deg, lat_deg, height_m : ndarray, shape (K + 1,)
        Vertices; longitudes do not jump.
    start_index, end_index : ndarray, shape (K,)
        Numbers of the file's vertices at the start and the end of each piece, with fractions.
    east_m, north_m : ndarray, shape (K,)
        Of each piece, at true scale. [m]
    chainage_m : ndarray, shape (K + 1,)
        True distance of the vertices on the ellipsoid. [m]
    dropped : int
        Vertices of the file that stood twice.
    """

    lon_deg: Floats
    lat_deg: Floats
    height_m: Floats
    start_index: Floats
    end_index: Floats
    east_m: Floats
    north_m: Floats
    chainage_m: Floats
    dropped: int

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
