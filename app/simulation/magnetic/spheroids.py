"""Iron as prolate spheroids: induced and permanent magnetisation, and the dipoles that give their field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import scipy

Floats = npt.NDArray[np.float64]

STEEL_SUSCEPTIBILITY = 200.0
"""Of structural steel in weak fields. Source: assumed, within the 100 to 300 of mild steel's initial permeability."""
_UT_PER_A_M = 0.4 * math.pi
"""mu0. [uT / (A/m)] Source: SI."""
_NODE_M = 0.05
"""Mean distance between the dipoles of a long spheroid. [m] Source: a bar's field 16 cm above it is good to 1 %, with
8 cm only to 8 % (tests/simulation/test_magnetic_physics.py)."""
_SPHERE_ASPECT = 1.001
"""Below this ratio of axes the factors are a sphere's; they differ by less than 3e-4. Source: Osborn 1945."""


@dataclass(frozen=True, slots=True)
class Spheroid:
    """A body of iron with one long axis, in lane coordinates (along, left, up).

    Attributes
    ----------
    centre_m : tuple of float
        [m]
    axis : tuple of float
        Unit vector along its long axis.
    half_length_m, half_width_m : float
        Semi-axes; the first is not the shorter one. [m]
    permanent_am : tuple of float
        Permanent magnetisation as seen from outside, along, left and up. [A/m]
    susceptibility : float
        Of the iron; for a hull or a frame, the iron's times the share of the volume that it fills.
    """

    centre_m: tuple[float, float, float]
    axis: tuple[float, float, float]
    half_length_m: float
    half_width_m: float
    permanent_am: tuple[float, float, float] = (0.0, 0.0, 0.0)
    susceptibility: float = STEEL_SUSCEPTIBILITY

    @property
    def volume_m3(self) -> float:
        """[m3]"""
        return 4 / 3 * math.pi * self.half_length_m * self.half_width_m**2


def demagnetising_factors(aspect: float) -> tuple[float, float]:
    """Demagnetising factors of a prolate spheroid along and across its long axis.

    Parameters
    ----------
    aspect : float
        Long over short axis, 1 or more.

    Notes
    -----
    Osborn, "Demagnetizing factors of the general ellipsoid", Physical Review 67 (1945), 351, prolate spheroid; the
    three factors add up to 1.
    """
    if aspect < _SPHERE_ASPECT:
        return 1 / 3, 1 / 3
    root = math.sqrt(aspect**2 - 1)
    along = (aspect / root * math.log(aspect + root) - 1) / root**2
    return along, (1 - along) / 2


def spheroid_moment_am2(spheroid: Spheroid, earth_ut: Floats) -> Floats:
    """Moment of a spheroid in the earth's field, shape (3,). [A m2]

    Parameters
    ----------
    spheroid : Spheroid
    earth_ut : ndarray, shape (3,)
        The earth's field along, left and up. [uT]

    Notes
    -----
    Volume times magnetisation, which is the permanent one plus chi H / (1 + chi N) for each axis of the spheroid, with
    its demagnetising factor N. Fields of other iron are neglected.
    """
    along, across = demagnetising_factors(spheroid.half_length_m / spheroid.half_width_m)
    axis, chi = np.array(spheroid.axis), spheroid.susceptibility
    field_am = np.asarray(earth_ut, float) / _UT_PER_A_M
    lengthwise = axis * (axis @ field_am)
    induced_am = chi * lengthwise / (1 + chi * along) + chi * (field_am - lengthwise) / (1 + chi * across)
    moment: Floats = spheroid.volume_m3 * (induced_am + np.array(spheroid.permanent_am))
    return moment


def spheroid_dipoles(spheroid: Spheroid, earth_ut: Floats, *, nodes: int | None = None) -> Floats:
    """Dipoles whose field outside a spheroid is the spheroid's, shape (K, 6): place and moment. [m, A m2]

    Parameters
    ----------
    spheroid : Spheroid
    earth_ut : ndarray, shape (3,)
        The earth's field along, left and up. [uT]
    nodes : int, optional
        K; by default one for every 5 cm between the foci.

    Notes
    -----
    The potential of a uniform prolate spheroid is that of a line between its foci with a density of 1 - (s/c)^2, c the
    distance of a focus from the centre (MacMillan, The Theory of the Potential, 1930). By Poisson's theorem a uniformly
    magnetised one has the field of dipoles with that density. The line is a Gauss-Jacobi quadrature. A test compares
    the field at the tip with that inside.
    """
    focus_m = math.sqrt(max(spheroid.half_length_m**2 - spheroid.half_width_m**2, 0.0))
    at, share = _line_of_foci(nodes or math.ceil(2 * focus_m / _NODE_M) + 1)
    place = np.array(spheroid.centre_m) + focus_m * at[:, None] * np.array(spheroid.axis)
    return np.hstack([place, share[:, None] * spheroid_moment_am2(spheroid, earth_ut)])


@lru_cache(maxsize=64)
def _line_of_foci(nodes: int) -> tuple[Floats, Floats]:
    """Nodes from -1 to 1 and their shares of the whole, for the density 1 - x^2."""
    at, weight = scipy.special.roots_jacobi(nodes, 1.0, 1.0)
    return at, weight / weight.sum()
