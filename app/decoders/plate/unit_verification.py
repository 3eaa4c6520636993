"""How well pixels agree with a pattern of units, in one frame or in several.

A server adds up frames, so nothing here is compiled.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

CLEAN, STAINED, STAINED_SHARE = (1e-4, 1e-5), (0.1, 0.05), 0.02
"""[probability] of a smooth stain and of a spot on a unit of a clean and of a stained plate, and of a stained plate.
Source: chosen by hand."""
OVERLAP = 4.0
"""[units] that share most of their pixels: the evidence of all units for stains counts one in so many. Source: by
hand."""


@dataclass(frozen=True, slots=True, eq=False)
class UnitVerification:
    """How well the pixels of one frame or of several agree with a pattern of units.

    Attributes
    ----------
    log_likelihoods : ndarray, shape (units, 5)
        Of the pixels around each unit, in the order of the symbols' units: the unit as in the pattern, flipped, the
        same two under a smooth stain, and flipped under a spot of paint.
    """

    log_likelihoods: Array

    @property
    def unit_errors(self) -> Array:
        """Probability that each unit is flipped, shape (units,)."""
        return _unit_errors(self.log_likelihoods)

    @property
    def error_probability(self) -> float:
        """Probability that any unit is flipped."""
        return float(-np.expm1(np.log1p(-np.minimum(self.unit_errors, 1 - 1e-12)).sum()))

    @property
    def cell_confidence(self) -> tuple[float, ...]:
        """Probability that all four units of each cell are right."""
        return tuple(float(p) for p in (1 - self.unit_errors).reshape(-1, 4).prod(axis=1))


def add_up(log_likelihoods: Sequence[Array]) -> UnitVerification:
    """What several frames of one plate show of one pattern together: log likelihoods are summed, priors count once."""
    return UnitVerification(np.sum(log_likelihoods, axis=0))


def _unit_errors(likelihoods: Array) -> Array:
    """Probability that each unit is flipped, from the log likelihoods of its hypotheses."""
    read, flipped, read_stained, flipped_stained, flipped_spot = likelihoods.T

    def under(stain: float, spot: float) -> tuple[float, Array]:
        as_read = np.logaddexp(math.log1p(-stain) + read, math.log(stain) + read_stained)
        other = np.logaddexp(math.log1p(-stain - spot) + flipped, math.log(stain) + flipped_stained)
        other = np.logaddexp(other, math.log(spot) + flipped_spot)
        return float(np.logaddexp(as_read, other).sum()), 1 / (1 + np.exp(np.clip(as_read - other, -700, 700)))

    clean_total, clean = under(*CLEAN)
    stained_total, stained = under(*STAINED)
    log_odds = math.log(STAINED_SHARE / (1 - STAINED_SHARE)) + (stained_total - clean_total) / OVERLAP
    share = 1 / (1 + math.exp(-min(max(log_odds, -700.0), 700.0)))
    return share * stained + (1 - share) * clean
