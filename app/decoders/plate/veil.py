"""Light in the image of a plate that the plate does not send: haze over all of it, glare over a part.

Shade divides the light of units, which their logarithms show; glare adds to it, so it is estimated from the light
itself: a smooth field over the plate, minus one contrast where a unit is dark, plus noise.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from app.decoders.plate.linear import invert
from app.decoders.plate.unit_patterns import minimize_pattern
from app.markers.plate import unit_index

Array = npt.NDArray[Any]

DARK_SHARE = 0.12
"""[light level] light of dark units without haze: what they have beyond it is taken for haze. Source: chosen by hand;
the simulated plates (`simulation.plate_face.draw_look`) have 0.02 to 0.2."""
GLARE_SPREAD, MEAN_SPREAD = 0.5, 2.0
"""[span] standard deviations of glare over a few units, and of its mean, which that leaves open. Source: by hand."""
GLARE_LENGTH = 4.0
"""[units of 8] distance over which the correlation of glare falls to 1/e. Source: chosen by hand."""
UNIT_SPREAD = 0.1
"""[span] standard deviation of what units differ by themselves. Source: chosen by hand."""
CONTRAST, CONTRAST_SPREAD = 0.85, 0.25
"""[span] expected difference of light and dark units, and its standard deviation: glare adds to the light of the
lightest. Source: chosen by hand."""


class Veil(NamedTuple):
    """Light that the plate does not send.

    Attributes
    ----------
    light : ndarray, shape (n, n)
        On each unit and marker. [linear, 1 = saturation]
    level : float
        Light of light units without it. [linear, 1 = saturation]
    """

    light: Array
    level: float

    @property
    def is_even(self) -> bool:
        """Whether it is the same everywhere: haze, not glare."""
        return bool(np.ptp(self.light) == 0)


def uniform_haze(dark: float, light: float, n: int) -> Veil:
    """The veil that is the same everywhere, from the light of the darkest and the lightest units."""
    haze = max(0.0, (dark - DARK_SHARE * light) / (1 - DARK_SHARE))
    return Veil(np.full((n, n), haze), light - haze)


def estimate_glare(values: Array, covariance: Array, span: float, n: int) -> Veil:
    """The veil that changes over the plate.

    Parameters
    ----------
    values : ndarray, shape (units,)
        Light of the units in the order of the symbols' units.
    covariance : ndarray, shape (units, units)
        Of their errors.
    span : float
        Light of the lightest units above the darkest ones.
    n : int
        Units along a side.
    """
    by_grid = span**2 * _smooth(n)
    order = unit_index(n).reshape(-1)
    total = by_grid[order] + covariance
    total[np.diag_indices_from(total)] += (UNIT_SPREAD * span) ** 2
    mean = float(values.mean())
    # a unit is dark to begin with where it is darker than the units around it are on average
    around = total.copy()
    around[np.diag_indices_from(around)] += (CONTRAST * span / 2) ** 2
    dark = (values - mean < by_grid[order] @ np.linalg.solve(around, values - mean)).astype(float)
    weight = invert(total)
    residual, contrast = minimize_pattern(weight, values - mean, dark, CONTRAST * span, CONTRAST_SPREAD * span)
    level = contrast / (1 - DARK_SHARE)
    lightest = mean + by_grid @ (weight @ residual)
    return Veil(np.maximum(lightest - level, 0.0).reshape(n, n), level)


@lru_cache
def _smooth(n: int) -> Array:
    """Covariance of glare between all units and markers and the symbols' units, shape (n * n, units). [span2]"""
    grid = np.stack(np.divmod(np.arange(n * n), n), axis=1).astype(float)
    units = grid[unit_index(n).reshape(-1)]
    distance = np.linalg.norm(grid[:, None] - units[None], axis=2)
    covariance: Array = GLARE_SPREAD**2 * np.exp(-distance / (GLARE_LENGTH * n / 8)) + MEAN_SPREAD**2
    return covariance
