"""The clearance of a vehicle's bar as an estimated state: a mixture of magnets, which share it, and of iron.

Each fitted dipole with the moment of a magnet shows how far below the bar it lies. Magnets lie in the road, so their
depths agree; iron fitted as a magnet lies anywhere. The posterior of the clearance and of the share of iron is kept on
a grid.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.dipole_fit import MagnetPrior
from app.decoders.magnet.fit_window import CLEARANCE_M, CLEARANCE_STD_M, Dipole, magnet_prior

Floats = npt.NDArray[np.float64]

GRID_M = np.arange(0.08, 0.651, 0.005)
"""Clearances of the grid. [m] Source: bars below bumpers, 15 to 35 cm (METRO section 7.3), trucks 40 cm, and room."""
IRON_SHARES = np.array([0.05, 0.2, 0.4, 0.6, 0.8, 0.95])
"""Shares of iron among the dipoles that look like magnets, each as likely. Source: town roads and roads with tags."""
SPRING_STD_M = 0.02
"""What springs move the bar by, while magnets are passed. [m] Source: `app.simulation.magnetic.vehicle.drive_course`,
0.4 cm on ordinary and 1.2 cm on rough roads and pitch under braking; chosen by hand."""
MEMORY = 0.97
"""Weight of what was seen before each further dipole: a load changes the clearance. Source: chosen by hand, about
thirty magnets."""
MIN_STD_M, KNOWN_STD_M = 0.025, 0.035
"""Standard deviation of the clearance at least, and that below which it is known. [m] Source: springs; 3 to 20
depths of iron, evenly spread, look like a clearance in 2 % of 400 trials, and three magnets do in 88 %."""
SURE_COUNT = 8
"""Dipoles from which on a known clearance is sure. Source: chosen by hand."""
MIN_INFORMATION = 0.1
"""Share of a depth's precision that must come from the field, not from what was expected. Source: chosen by hand."""


class ClearanceEstimate:
    """What is known of the clearance after some dipoles.

    Parameters
    ----------
    moment_am2 : float
        Of the magnets on the road. [A m2]
    clearance_m, clearance_std_m : float
        That is expected before any dipole. [m]
    """

    def __init__(
        self, moment_am2: float, clearance_m: float = CLEARANCE_M, clearance_std_m: float = CLEARANCE_STD_M
    ) -> None:
        self._moment_am2 = moment_am2
        first = -0.5 * ((GRID_M - clearance_m) / clearance_std_m) ** 2
        self._first = np.repeat(first[:, None], IRON_SHARES.size, axis=1)
        self._seen = np.zeros_like(self._first)
        self._count = 0
        self._set_prior()

    @property
    def prior(self) -> MagnetPrior:
        """What the next magnet is expected to be like."""
        return self._prior

    @property
    def is_known(self) -> bool:
        """Whether magnets can be judged by their depth."""
        return self._prior.clearance_std_m < KNOWN_STD_M

    @property
    def is_sure(self) -> bool:
        """Whether it is known from so many dipoles that further ones hardly change it."""
        return self.is_known and self._count >= SURE_COUNT

    def learn(self, dipole: Dipole, expected: MagnetPrior) -> None:
        """Add the depth of a dipole that looks like a magnet, fitted under what was expected of it."""
        precision = 1 / max(float(dipole.covariance[2, 2]), 1e-8)
        own = precision - 1 / expected.clearance_std_m**2
        if own < MIN_INFORMATION * precision:
            return
        depth = (float(dipole.params[2]) * precision - expected.clearance_m / expected.clearance_std_m**2) / own
        variance = 1 / own + SPRING_STD_M**2
        magnet = np.exp(-0.5 * (GRID_M - depth) ** 2 / variance) / math.sqrt(2 * math.pi * variance)
        iron = 1 / float(np.ptp(GRID_M))
        self._count += 1
        self._seen *= MEMORY
        self._seen += np.log((1 - IRON_SHARES) * magnet[:, None] + IRON_SHARES * iron)
        self._set_prior()

    def _set_prior(self) -> None:
        log = self._first + self._seen
        weight = np.exp(log - log.max()).sum(axis=1)
        weight /= weight.sum()
        mean = float(weight @ GRID_M)
        std = math.sqrt(float(weight @ (GRID_M - mean) ** 2))
        self._prior = magnet_prior(self._moment_am2, mean, max(std, MIN_STD_M))
