"""What the magnets of a drive share, as an estimated state: the clearance of the bar above them, and their moment.

Each fitted dipole that looks like a magnet shows how far below the bar it lies and how strong it is. Magnets of a road
lie in its surface and are of one make, so these agree; iron fitted as a magnet lies anywhere and has any strength. The
posterior of clearance, moment and share of iron is kept on a grid.

Shapes: C clearances, M moments, I shares of iron.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.dipole_fit import MagnetPrior
from app.decoders.magnet.fit_window import Dipole, magnet_prior

Floats = npt.NDArray[np.float64]

CLEARANCES_M = np.arange(0.08, 0.651, 0.01)
"""Clearances of the grid. [m] Source: bars below bumpers, 15 to 35 cm (METRO section 7.3), trucks 40 cm, and room."""
MOMENT_RATIOS = np.arange(0.5, 1.51, 0.04)
"""Moments of the grid, over the nominal one. Source: aged and hot ferrite or NdFeB to the next grades; by hand."""
MOMENT_RATIO_STD = 0.15
"""Standard deviation of the shared moment before any dipole, over the nominal one. Source: remanence of the grades N35
to N52, 1.17 to 1.48 T, and 0.1 % per kelvin for NdFeB over 40 K; rounded up."""
LIKE_STD, OWN_MOMENT_STD = 0.06, 0.12
"""Standard deviation of a magnet's moment about the shared one: of those that show it, and of any. Source: 3 % between
magnets (`app.simulation.magnetic.road.Spread`) and gains of the sensors near it; tags fade by a quarter and more
(`app.services.health.traces`), which must be read, but show nothing of the others."""
IRON_SHARES = np.array([0.01, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95])
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
MIN_PRECISION = 0.02
"""Smallest precision of the data, over that of the prior: keeps covariances finite. Source: chosen by hand."""
CLEARANCE_M, CLEARANCE_STD_M = 0.24, 0.12
"""Clearance that is expected where none is declared. [m] Source: the middle of the 15 to 35 cm of METRO section 7.3;
it covers them within a standard deviation."""
DECLARED_STD_M, DECLARED_WRONG = 0.025, 0.02
"""Standard deviation of a declared clearance, and the probability that it is wrong altogether. [m, 1] Source: load and
springs, as `SPRING_STD_M`; chosen by hand."""


class MagnetState:
    """What is known of the clearance and of the shared moment after some dipoles.

    Parameters
    ----------
    moment_am2 : float
        Nominal, of the magnets on the road. [A m2]
    declared_m : float, optional
        Clearance of the bar as it was declared. [m]

    Attributes
    ----------
    iron_before : float
        Number of the dipoles under the bar that resemble iron, of about the last thirty.
    """

    def __init__(self, moment_am2: float, declared_m: float | None = None) -> None:
        self._moment_am2 = moment_am2
        depth = _bell(CLEARANCES_M, CLEARANCE_M, CLEARANCE_STD_M)
        if declared_m is not None:
            depth = (1 - DECLARED_WRONG) * _bell(CLEARANCES_M, declared_m, DECLARED_STD_M) + DECLARED_WRONG * depth
        strength = _bell(MOMENT_RATIOS, 1.0, MOMENT_RATIO_STD)
        self._log = np.log(depth[:, None, None] * strength[:, None] * np.ones(IRON_SHARES.size))
        self._first = self._log.copy()
        self._learnt = 0
        self.iron_before = 0.0
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
        return self.is_known and self._learnt >= SURE_COUNT

    @property
    def iron_log_odds(self) -> float:
        """Log odds that a dipole of this road that looks like a magnet is iron."""
        return self._iron_log_odds

    def count_iron(self, dipole: Dipole) -> None:
        """Update `iron_before` with a dipole under the bar."""
        self.iron_before = MEMORY * self.iron_before + dipole.resembles_iron

    def learn(self, dipole: Dipole, expected: MagnetPrior) -> None:
        """Add a dipole that looks like a magnet, fitted under what was expected of it."""
        at = np.ix_((2, 3 + dipole.kind), (2, 3 + dipole.kind))
        std = np.array([expected.clearance_std_m, expected.moment_std_am2])
        middle = np.array([expected.clearance_m, expected.moment_am2])
        fitted = np.array([dipole.params[2], abs(dipole.params[3 + dipole.kind])])
        own = dipole.covariance[at] / np.outer(std, std)
        if not (np.isfinite(own).all() and 1 - own[0, 0] >= MIN_INFORMATION):
            return
        seen, covariance = without_prior(fitted / std, own, np.eye(2), (fitted - middle) / std)
        depth_m, moment = seen * std
        covariance *= np.outer(std, std)
        covariance += np.diag((SPRING_STD_M**2, (LIKE_STD * self._moment_am2) ** 2))
        off_m, off = CLEARANCES_M[:, None] - depth_m, self._moment_am2 * MOMENT_RATIOS - moment
        inverse = np.linalg.inv(covariance)
        chi2 = inverse[0, 0] * off_m**2 + 2 * inverse[0, 1] * off_m * off + inverse[1, 1] * off**2
        magnet = np.exp(-0.5 * chi2) / (2 * math.pi * math.sqrt(float(np.linalg.det(covariance))))
        iron = 1 / (float(np.ptp(CLEARANCES_M)) * self._moment_am2 * float(np.ptp(MOMENT_RATIOS)))
        self._learnt += 1
        self._log = self._first + MEMORY * (self._log - self._first)
        self._log += np.log((1 - IRON_SHARES) * magnet[:, :, None] + IRON_SHARES * iron)
        self._set_prior()

    def _set_prior(self) -> None:
        joint = np.exp(self._log - self._log.max())
        joint /= joint.sum()
        iron = float(joint.sum(axis=(0, 1)) @ IRON_SHARES)
        self._iron_log_odds = math.log(iron / (1 - iron))
        weight = joint.sum(axis=2)
        clearance_m, clearance_std_m = _moments(weight.sum(axis=1), CLEARANCES_M)
        ratio, ratio_std = _moments(weight.sum(axis=0), MOMENT_RATIOS)
        self._prior = magnet_prior(
            self._moment_am2 * ratio,
            math.hypot(ratio_std, OWN_MOMENT_STD) / ratio,
            clearance_m,
            max(clearance_std_m, MIN_STD_M),
        )


def without_prior(fitted: Floats, covariance: Floats, given: Floats, slope: Floats) -> tuple[Floats, Floats]:
    """Maximum likelihood estimate and covariance of fitted parameters, from their maximum a posteriori estimate.

    All are in standard deviations of the prior. At the maximum of the posterior, the gradients of both costs cancel.

    Parameters
    ----------
    fitted : ndarray, shape (P,)
        Maximum a posteriori estimate.
    covariance : ndarray, shape (P, P)
        Of the posterior.
    given : ndarray, shape (P, P)
        Precision of the prior.
    slope : ndarray, shape (P,)
        Gradient of half of the prior's cost at the estimate.

    Returns
    -------
    estimate : ndarray, shape (P,)
    covariance : ndarray, shape (P, P)
        Large in directions in which the data determine nothing.
    """
    sizes, axes = np.linalg.eigh(np.linalg.inv(covariance) - given)
    alone = (axes / np.maximum(sizes, MIN_PRECISION)) @ axes.T
    return fitted + alone @ slope, alone


def _bell(grid: Floats, mean: float, std: float) -> Floats:
    """Normal density on a grid, with a sum of 1."""
    density = np.exp(-0.5 * ((grid - mean) / std) ** 2) + 1e-300
    return np.asarray(density / density.sum())


def _moments(weight: Floats, grid: Floats) -> tuple[float, float]:
    """Mean and standard deviation over a grid with weights."""
    mean = float(weight @ grid)
    return mean, math.sqrt(float(weight @ (grid - mean) ** 2))
