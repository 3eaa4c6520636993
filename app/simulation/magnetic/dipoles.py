"""The field of point dipoles, and of a cuboid magnet to check them against."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from app.compiled import kernel
from app.markers.magnet import FIELD_UT_M3

Floats = npt.NDArray[np.float64]


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
