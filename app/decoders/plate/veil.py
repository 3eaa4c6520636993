"""Light in the image of a plate that the plate does not send: haze over all of it, a veil of glare over a part.

Shade divides the light of the units, glare adds to it. Both are Gaussian processes over the units, and so are the two
explanations of a plate's units: uneven light and even haze, or a veil besides. Their marginal likelihoods say which
holds. A veil is smooth over several units, so it is no explanation of a spot of paint.
"""

from __future__ import annotations

import math
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
VEIL_LENGTH = 2.0
"""[units of 8] length over which a veil changes: 80 mm, several units, where spots of paint have 8 to 30 mm. Source:
the standard deviation of the simulated glare is 50 to 500 mm (`simulation.conditions`)."""
VEIL_SPREADS = (0.1, 0.3)
"""[light level] standard deviations of a veil, each as likely. Source: the simulated glare adds 0.05 to 0.35."""
LIGHT_SPREADS, LIGHT_LENGTH = (0.1, 0.25, 0.5), 4.0
"""[1, units of 8] standard deviations of uneven light, relative, each as likely, and distance over which its
correlation falls to 1/e. Source: fair light, shade and deep shade, chosen by hand."""
LEVEL_SPREAD, HAZE_SPREAD = 0.5, 0.3
"""[1, light level] standard deviations of the light and of the haze over the whole plate, which leave both open.
Source: chosen by hand."""
LIGHT_WEAR, DARK_WEAR = 0.09, 0.05
"""[light level] standard deviations of what light and dark units differ by themselves. Source: as
`verify_units.WHITE_SPREAD`."""
VEIL_PRIOR = 0.05
"""[probability] of a veil. Source: chosen by hand."""
SEARCH_SPREAD, SEARCH_WEAR = 0.3, 0.12
"""[span] standard deviations of the veil and of what units differ by themselves, while the pattern under a veil is
searched. Source: chosen by hand."""
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


def estimate_veil(values: Array, covariance: Array, span: float, n: int) -> tuple[Veil, npt.NDArray[np.bool_]]:
    """The veil that changes over the plate, and the pattern of dark units under it.

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
    order = unit_index(n).reshape(-1)
    by_grid = span**2 * (SEARCH_SPREAD**2 * _correlations(n).veil + 4.0)
    total = by_grid[order] + covariance
    total[np.diag_indices_from(total)] += (SEARCH_WEAR * span) ** 2
    mean = float(values.mean())
    # a unit is dark to begin with where it is darker than the units around it are on average
    around = total.copy()
    around[np.diag_indices_from(around)] += (CONTRAST * span / 2) ** 2
    dark = (values - mean < by_grid[order] @ np.linalg.solve(around, values - mean)).astype(float)
    weight = invert(total)
    residual, contrast = minimize_pattern(weight, values - mean, dark, CONTRAST * span, CONTRAST_SPREAD * span)
    level = contrast / (1 - DARK_SHARE)
    lightest = mean + by_grid @ (weight @ residual)
    return Veil(np.maximum(lightest - level, 0.0).reshape(n, n), level), dark > 0.5


def veil_log_odds(values: Array, covariance: Array, haze: Veil, patterns: list[Array], n: int) -> float:
    """Logarithm of the odds that there is a veil, by the marginal likelihoods of the units' light.

    Parameters
    ----------
    values, covariance : ndarray
        As in `estimate_veil`.
    haze : Veil
        The even one.
    patterns : list of ndarray of bool, shape (units,)
        Patterns of dark units that are likely under either explanation.
    n : int
        Units along a side.
    """
    order = unit_index(n).reshape(-1)
    even = [_log_likelihood(values, covariance, haze, dark, s, None, n) for dark in patterns for s in LIGHT_SPREADS]
    veil = _correlations(n).veil[order]
    veiled = [
        _log_likelihood(values, covariance, haze, dark, s, v**2 * veil, n)
        for dark in patterns
        for s in LIGHT_SPREADS[:1]
        for v in VEIL_SPREADS
    ]
    even_mean = np.logaddexp.reduce(even) - math.log(len(LIGHT_SPREADS))
    veiled_mean = np.logaddexp.reduce(veiled) - math.log(len(VEIL_SPREADS))
    return float(veiled_mean - even_mean) + math.log(VEIL_PRIOR / (1 - VEIL_PRIOR))


def _log_likelihood(
    values: Array, covariance: Array, haze: Veil, dark: Array, light_spread: float, veil: Array | None, n: int
) -> float:
    """Of the units' light under a pattern, without the constant."""
    seen, scale = np.where(dark, DARK_SHARE, 1.0), haze.level
    light = light_spread**2 * _correlations(n).light + LEVEL_SPREAD**2
    total = light * np.outer(seen, seen) + HAZE_SPREAD**2 + np.diag(np.where(dark, DARK_WEAR, LIGHT_WEAR) ** 2)
    if veil is not None:
        total = total + veil
    total = scale**2 * total + covariance
    residual = values - float(haze.light[0, 0]) - scale * seen
    factor = np.linalg.cholesky(total)
    half = np.linalg.solve(factor, residual)
    return float(-0.5 * half @ half - np.log(np.diag(factor)).sum())


class _Correlations(NamedTuple):
    """Of the veil between all units and markers and the symbols' units, and of the light between the latter."""

    veil: Array
    light: Array


@lru_cache
def _correlations(n: int) -> _Correlations:
    grid = np.stack(np.divmod(np.arange(n * n), n), axis=1).astype(float) * (8 / n)
    units = grid[unit_index(n).reshape(-1)]
    apart = np.linalg.norm(grid[:, None] - units[None], axis=2)
    between = np.linalg.norm(units[:, None] - units[None], axis=2)
    return _Correlations(np.exp(-0.5 * (apart / VEIL_LENGTH) ** 2), np.exp(-between / LIGHT_LENGTH))
