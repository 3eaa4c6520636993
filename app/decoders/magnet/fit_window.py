"""Fits of dipoles to the blocks about a region of the road, and the figures by which they are compared."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.dipole_fit import (
    FORWARD,
    PARAMETERS,
    UPRIGHT,
    FitData,
    MagnetPrior,
    Samples,
    add_dipole_field,
    fit_dipoles,
    residual_cost,
    whiten,
)
from app.decoders.magnet.matched_filter import DISTANCES_M, BinScores
from app.decoders.magnet.preprocess import Blocks
from app.values import Floats

TILT_SPREAD = 0.10
"""Standard deviation of a moment's components across its axis, share of it: 6 degrees. Source: 3 degrees between
magnets (`Spread`) and the vehicle's pitch and roll."""
YAW_SPREAD = 0.14
"""The same for a forward magnet's axis against the heading: 8 degrees. Source: lanes are changed at a few degrees."""
MAX_MISFIT = 0.12
"""Largest misfit of a magnet."""
MAX_REGION_PRIOR_COST = 13.0
"""Prior cost from which on a dipole is unlike a magnet. The 98.9 % point of chi-squared with four degrees of
freedom."""
SURE_MARGIN = 60.0
"""Margin at which an orientation is accepted before the neighbours were fitted again. For speed, no measurement
kept."""
WINDOW_M = 1.6
"""Road on each side of a region that fits may use. [m] Source: reach of a fit (`FIT_HEIGHTS`, `FIT_M`) at 0.5 m."""
FIT_HEIGHTS, FIT_M, FIT_ACROSS_M = 2.4, 0.3, 0.2
"""Reach of a fit: times the height, and metres more along and across the road."""
MIN_COST_HEIGHT_M, MAX_COST_HEIGHT_M = 0.12, 0.45
"""Clearances between which the reach of a cost stays. [m] Source: 15 to 35 cm, METRO section 7.3, with some room."""
NOISE_HEIGHTS = 1.2
"""The noise is that of the matched filter whose D is nearest to so many heights. D of a sensor beside the magnet."""
MIN_BLOCKS = 6
"""Fewest blocks of a fit. More than the functions of the background."""
BACKGROUND_DEGREE, BACKGROUND_FREE_M, BACKGROUND_STEP_M = 2, 2.0, 1.5
"""Degree of the background's polynomial, up to a length, and the length for which one more is added. [1, m, m]"""


@dataclass(frozen=True, slots=True, eq=False)
class Dipole:
    """A fitted dipole."""

    params: Floats  # shape (6,): [A m2] s, y, h [m], moment
    covariance: Floats  # shape (6, 6)
    explained: float  # energy that it explains, in variances of the noise
    misfit: float  # energy left about it beyond the noise, as a share of what it explains
    prior_cost: float  # Chi-squared of its clearance, moment and axis under the prior, with four degrees of freedom
    kind: int  # `UPRIGHT` or `FORWARD`: index of the moment's main component
    margin: float  # by how much its kind costs less than the other
    log_odds: float = 0.0  # of a magnet against iron, by its depth and moment alone (`app.decoders.magnet.classify`)

    @property
    def resembles_iron(self) -> bool:
        """Whether iron explains its depth and moment better than a magnet, or its field is not a dipole's."""
        return self.log_odds < 0 or self.misfit > MAX_MISFIT

    @property
    def unlike_magnet(self) -> bool:
        """Whether its field is not a dipole's, or its moment, clearance or axis not a magnet's."""
        return self.misfit > MAX_MISFIT or self.prior_cost > MAX_REGION_PRIOR_COST


def magnet_prior(moment_am2: float, moment_spread: float, clearance_m: float, clearance_std_m: float) -> MagnetPrior:
    """What magnets are expected to be like whose moments differ by a share of their mean."""
    return MagnetPrior(
        moment_am2=moment_am2,
        moment_std_am2=moment_spread * moment_am2,
        clearance_m=clearance_m,
        clearance_std_m=clearance_std_m,
        tilt_std_am2=TILT_SPREAD * moment_am2,
        yaw_std_am2=YAW_SPREAD * moment_am2,
    )


@dataclass(frozen=True, slots=True, eq=False)
class SensorArray:
    """The array sensors of a bar."""

    positions_m: Floats  # shape (A, 3): [m] x and z relative to the bar's middle
    indices: npt.NDArray[np.intp]  # shape (A,): their places among all sensors
    axis_delay_s: tuple[float, float, float]  # [s] times after the time stamp at which x, y and z are read

    @property
    def half_width_m(self) -> float:
        """Half of the distance between the outermost sensors. [m]"""
        return float(np.ptp(self.positions_m[:, 1])) / 2


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """A stretch of road in which the matched filters saw something."""

    x: npt.NDArray[np.float32]  # shape (N + 2 HALF_BINS, 3 A): [uT] field of the bins
    start: int  # number of the first of them
    scores: BinScores  # of the N bins in the middle
    variance: npt.NDArray[np.float32]  # shape (nD, 3): noise of the matched filters
    common_share: Floats  # shape (3,): share of the common mode that was taken out
    loudness: npt.NDArray[np.float32]  # shape (A, 3): variance of each channel over the median of its axis
    window_m: tuple[float, float]  # [m] from where to where blocks count in fits


class FitWindow:
    """The blocks about a region, cut and whitened for each fit."""

    def __init__(self, array: SensorArray, blocks: Blocks, region: Region, prior: MagnetPrior) -> None:
        low, high = (int(i) for i in np.searchsorted(blocks.s, region.window_m))
        self._array = array
        self._prior = prior
        self._variance = region.variance
        self._samples = Samples(
            blocks.s[low:high].copy(),
            np.ascontiguousarray(blocks.x[low:high][:, array.indices].transpose(1, 2, 0)),
            np.ascontiguousarray(blocks.w[low:high][:, array.indices].T),
            1 / np.sqrt(region.loudness.astype(float)),
            region.common_share,
        )
        self._delay_m = np.array(array.axis_delay_s)[:, None] * blocks.v[low:high]
        self._costed: tuple[tuple[float, float], FitData | None] | None = None  # the last stretch of `cost`
        self.joint_fits = 0
        """Fits of two or more magnets so far: what takes time."""

    def fit_either_kind(
        self, known: list[Dipole], starts: dict[int, Floats], others: list[Dipole]
    ) -> list[Dipole] | None:
        """Fit known magnets and a new one together, the new one as the kind that fits better.

        Parameters
        ----------
        known : list of Dipole
            Fitted again.
        starts : dict of int to ndarray
            Start of the new one as each kind, the likelier kind first.
        others : list of Dipole
            Kept as they are.

        Returns
        -------
        list of Dipole or None
            The known ones and the new one; None if there are too few blocks.
        """
        first, *rest = starts
        fit = self._fit_with(known, starts[first], first, others)
        if fit is None or not rest:
            return fit
        second = rest[0]
        places = [float(p[0]) for p in (*(d.params for d in known), *starts.values())]
        span = min(places), max(places)  # costs compare over the same blocks only
        cost = self.cost([*others, *fit], *span)
        if known:  # the other kind, with the known ones as they are: cheap, and often clear
            beside = [*others, *fit[:-1]]
            alone = self.fit([starts[second]], [second], beside)
            if alone is None:
                return None
            margin = self.cost([*beside, *alone], *span) - cost
            if margin > SURE_MARGIN:
                return [*fit[:-1], replace(fit[-1], margin=margin)]
        other = self._fit_with(known, starts[second], second, others)
        if other is None:
            return None
        margin = self.cost([*others, *other], *span) - cost
        best = fit if margin >= 0 else other
        return [*best[:-1], replace(best[-1], margin=abs(margin))]

    def _fit_with(self, known: list[Dipole], start: Floats, kind: int, others: list[Dipole]) -> list[Dipole] | None:
        return self.fit([*(d.params for d in known), start], [*(d.kind for d in known), kind], others)

    def fit(self, starts: list[Floats], kinds: list[int], others: list[Dipole]) -> list[Dipole] | None:
        """Magnets of known kinds, fitted together with the others as they are; None if there are too few blocks."""
        start = np.array(starts)
        height = float(start[:, 2].max())
        reach = FIT_HEIGHTS * height + FIT_M
        data = self._whitened(start[:, 0].min() - reach, start[:, 0].max() + reach, height, others)
        if data is None:
            return None
        away = abs(data.positions_m[:, 1, None] - start[:, 1]).min(axis=1)
        near = np.flatnonzero(away < FIT_HEIGHTS * height + FIT_ACROSS_M)
        if near.size < len(data.positions_m):  # the others see next to nothing
            data = data._replace(
                field=np.ascontiguousarray(data.field[near]),
                weight=np.ascontiguousarray(data.weight[near]),
                positions_m=data.positions_m[near],
                common_share=data.common_share * near.size / len(data.positions_m),
            )
        self.joint_fits += len(starts) > 1
        fitted = fit_dipoles(data, start, np.array(kinds, np.int64), self._prior)
        if not np.isfinite(fitted.dipoles).all():
            return None
        left = np.maximum(fitted.local_energy - fitted.local_rows, 0.0)
        misfit = left / np.maximum(fitted.explained, 1.0)
        return [
            Dipole(
                fitted.dipoles[i], fitted.covariance[i], fitted.explained[i], misfit[i], fitted.prior_cost[i], kind, 0.0
            )
            for i, kind in enumerate(kinds)
        ]

    def _whitened(self, start_m: float, end_m: float, height_m: float, others: list[Dipole]) -> FitData | None:
        """The blocks between two odometers, less the fields of others, for fits at a height; None if too few."""
        samples, positions = self._samples, self._array.positions_m
        low, high = (int(i) for i in np.searchsorted(samples.s_m, (start_m, end_m)))
        if high - low < MIN_BLOCKS:
            return None
        s = samples.s_m[low:high]
        d = int(np.argmin(abs(np.log(DISTANCES_M / (NOISE_HEIGHTS * height_m)))))
        noise_ut = np.sqrt(self._variance[d].astype(float))
        known = np.zeros((len(s), len(positions), 3), np.float32)
        for other in others:
            add_dipole_field(other.params, s, positions, -1.0, np.zeros(3), known)
        length_m = float(s[-1] - s[0])
        degree = BACKGROUND_DEGREE + max(0, int((length_m - BACKGROUND_FREE_M) / BACKGROUND_STEP_M))
        field, weight, basis = whiten(samples, low, high, noise_ut, known, degree)
        delay_m = np.ascontiguousarray(self._delay_m[:, low:high])
        return FitData(s, field, weight, delay_m, positions, basis, samples.common_share)

    def cost(self, dipoles: list[Dipole], start_m: float, end_m: float) -> float:
        """-2 log likelihood of the blocks about a stretch of road and of the dipoles, but for a constant."""
        height = self._prior.clearance_m
        reach = FIT_HEIGHTS * min(max(height, MIN_COST_HEIGHT_M), MAX_COST_HEIGHT_M) + FIT_M
        if self._costed is None or self._costed[0] != (start_m, end_m):  # fits of both kinds are compared in turn
            self._costed = (start_m, end_m), self._whitened(start_m - reach, end_m + reach, height, [])
        data = self._costed[1]
        if data is None:
            return 0.0
        params = np.array([d.params for d in dipoles]).reshape(-1, PARAMETERS)
        return float(residual_cost(data, params)) + sum(d.prior_cost for d in dipoles)


__all__ = ["FORWARD", "UPRIGHT", "Dipole", "FitWindow", "MagnetPrior", "Region", "SensorArray", "magnet_prior"]
