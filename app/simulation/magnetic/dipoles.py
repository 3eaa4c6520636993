"""The fields of point dipoles, cuboid and cylindrical magnets."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from app.compiled import kernel
from app.errors import InvalidParameter
from app.markers.magnet import FIELD_UT_M3
from app.values import Floats


def dipole_field_ut(points_m: Floats, dipole_m: Floats, moment_am2: Floats) -> Floats:
    """Field of one dipole.

    Parameters
    ----------
    points_m : ndarray, shape (N, 3)
        Where the field is wanted. [m]
    dipole_m, moment_am2 : ndarray, shape (3,)
        Place and moment of the dipole. [m, A m2]

    Returns
    -------
    ndarray of float64, shape (N, 3)
        Flux density. [uT]
    """
    r = np.asarray(points_m, float) - dipole_m
    square = np.sum(r * r, axis=1)[:, None]
    field: Floats = FIELD_UT_M3 * (3 * r * (r @ moment_am2)[:, None] / square - moment_am2) / square**1.5
    return field


@kernel
def add_static_field(out, points, axes, chainage, dipoles, at, reach):  # type: ignore[no-untyped-def]
    """Add what dipoles in the road give along one axis of each sensor.

    out (T, S): field along the axis [uT]; points (T, S, 3): sensors [m]; axes (T, S, 3): unit vectors; chainage (T,):
    of the bar [m]; dipoles (D, 6): place and moment; at (D,): their chainage, rising [m]; reach: of the field [m].
    """
    low = 0
    limit = reach * reach
    for i in range(out.shape[0]):
        while low < at.size and at[low] < chainage[i] - reach:
            low += 1
        # a vehicle that turns back would need a search here; drives only go forward
        for d in range(low, at.size):
            if at[d] > chainage[i] + reach:
                break
            for j in range(out.shape[1]):
                x = points[i, j, 0] - dipoles[d, 0]
                y = points[i, j, 1] - dipoles[d, 1]
                z = points[i, j, 2] - dipoles[d, 2]
                square = x * x + y * y + z * z
                if square > limit:
                    continue
                along = 3 * (x * dipoles[d, 3] + y * dipoles[d, 4] + z * dipoles[d, 5]) / square
                f = FIELD_UT_M3 / (square * math.sqrt(square))
                out[i, j] += f * (
                    (along * x - dipoles[d, 3]) * axes[i, j, 0]
                    + (along * y - dipoles[d, 4]) * axes[i, j, 1]
                    + (along * z - dipoles[d, 5]) * axes[i, j, 2]
                )


# === Magnets of finite size: uniformly magnetised cylinders as clusters of dipoles, in place of one dipole each.


_ALONG_AXIS = 3
"""Gauss-Legendre nodes along the axis. As far from a face as the magnet is long or wide the field on the axis is good
to 2 %, at three times that to 0.1 % (tests/simulation/test_magnetic_physics.py)."""
_ACROSS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
"""Directions of the four nodes of a cross section, at its radius over sqrt(2): exact for polynomials of degree 3 on a
disc. Source: Abramowitz and Stegun 1964, 25.4.61."""


@dataclass(frozen=True, slots=True)
class Cylinder:
    """Size of a magnet that is magnetised along its axis.

    Raises
    ------
    InvalidParameter
        A value is outside its limits.
    """

    # `diameter_m`, `length_m`: [m] above 0, at most 0.5 m
    diameter_m: float
    length_m: float
    sunk_m: float = 0.0  # [m] how much lower its centre lies than that of METRO's magnet, which lies on the road

    def __post_init__(self) -> None:
        for name, low in (("diameter_m", 1e-4), ("length_m", 1e-4), ("sunk_m", 0.0)):
            if not low <= getattr(self, name) <= 0.5:
                raise InvalidParameter(
                    f"{name} is {getattr(self, name):g} m", field=f"cylinder.{name}", limit=f"{low:g} to 0.5 m"
                )


METRO_CYLINDER = Cylinder(0.0169, 0.0095)
"""The cylinder with the length and the cross section of METRO's cuboid of 15 x 15 x 9.5 mm. [m] Source: METRO section
6.2."""


def cylinder_dipoles(dipoles: Floats, chainage_m: Floats, cylinder: Cylinder) -> tuple[Floats, Floats]:
    """Dipoles whose field is that of uniformly magnetised cylinders.

    Parameters
    ----------
    dipoles : ndarray, shape (N, 6)
        Place and moment of each magnet: east, north, up. Moments are not 0. [m, A m2]
    chainage_m : ndarray, shape (N,)
        Of each magnet. [m]
    cylinder : Cylinder
        Of all magnets; each one's axis is the direction of its moment.

    Returns
    -------
    ndarray of float64, shape (12 N, 6)
        Place and moment of the dipoles. [m, A m2]
    ndarray of float64, shape (12 N,)
        Chainage of the magnet that each dipole belongs to. [m]

    Notes
    -----
    The field of a uniformly magnetised body is the integral of the dipole field over its volume. Here the integral is
    a quadrature with three nodes along the axis and four in each cross section, which is good outside a sphere about
    the magnet, but not close to its faces.
    """
    node, weight = np.polynomial.legendre.leggauss(_ALONG_AXIS)
    moment = dipoles[:, 3:]
    axis = moment / np.linalg.norm(moment, axis=1, keepdims=True)
    first = np.cross(axis, np.where(np.abs(axis[:, 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(axis, first)
    centre = dipoles[:, :3] - (0.0, 0.0, cylinder.sunk_m)
    parts = []
    for at, share in zip(node, weight / 2, strict=True):
        for u, v in _ACROSS:
            radial = cylinder.diameter_m / np.sqrt(8) * (u * first + v * second)
            place = centre + cylinder.length_m / 2 * at * axis + radial
            parts.append(np.hstack([place, share / len(_ACROSS) * moment]))
    return np.concatenate(parts), np.tile(chainage_m, len(parts))
