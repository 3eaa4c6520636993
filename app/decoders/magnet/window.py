"""Fits of dipoles to a stretch of a trace: what a magnet is expected to be like, and what a fit says of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numba as nb
import numpy as np
import numpy.typing as npt

from app.decoders.magnet.fit import PARAMETERS, background_basis, fit_dipoles, remove_background, residual_cost
from app.decoders.magnet.front import Blocks
from app.decoders.magnet.search import BIN_M, DISTANCES_M

Floats = npt.NDArray[np.float64]

MOMENT_SPREAD = 0.12
TILT_SPREAD = 0.10
YAW_SPREAD = 0.14
"""Of a forward magnet's axis against the heading: lanes are changed at a few degrees."""
LIMIT_MISFIT = 0.12
LIMIT_PRIOR = 13.0
SURE = 60.0
"""Margin at which a kind is sure though the other's neighbours were not fitted again."""


@dataclass(frozen=True, slots=True, eq=False)
class Dipole:
    """A fitted dipole.

    Attributes
    ----------
    params : ndarray, shape (6,)
        s, y, h [m], moment [A m2].
    covariance : ndarray, shape (6, 6)
    explained : float
        Energy that it explains, in variances of the noise.
    misfit : float
        Energy left about it beyond the noise, as a share of what it explains.
    prior_cost : float
        How unlike the expected clearance, moment and axis it is, chi-squared with four degrees of freedom.
    kind : int
        2: upright, 0: forward.
    margin : float
        By how much its kind costs less than the other.
    """

    params: Floats
    covariance: Floats
    explained: float
    misfit: float
    prior_cost: float
    kind: int
    margin: float

    @property
    def unlike(self) -> bool:
        """Whether it is no magnet on the road: not a dipole, or with another moment, clearance or axis."""
        return self.misfit > LIMIT_MISFIT or self.prior_cost > LIMIT_PRIOR


@dataclass(frozen=True, slots=True)
class Expectation:
    """What magnets are expected to be like: moment [A m2] and clearance [m] with their standard deviations."""

    moment_am2: float
    clearance_m: float = 0.24
    clearance_std_m: float = 0.12

    @property
    def prior(self) -> Floats:
        """As `fit_dipoles` takes it."""
        m = self.moment_am2
        return np.array([m, MOMENT_SPREAD * m, self.clearance_m, self.clearance_std_m, TILT_SPREAD * m, YAW_SPREAD * m])


class Window:
    """The blocks about a region, cut and whitened for each fit."""

    def __init__(
        self,
        positions_m: Floats,
        array: npt.NDArray[np.intp],
        axis_delay_s: tuple[float, float, float],
        blocks: Blocks,
        start_m: float,
        end_m: float,
        variance: npt.NDArray[np.float32],
        alpha: Floats,
        quiet: Floats,
        expected: Expectation,
    ) -> None:
        low, high = (int(i) for i in np.searchsorted(blocks.s, (start_m, end_m)))
        self._positions = positions_m
        self._delay = np.array(axis_delay_s)
        self._s = blocks.s[low:high]
        self._x = np.ascontiguousarray(blocks.x[low:high][:, array].transpose(1, 2, 0))
        self._w = np.ascontiguousarray(blocks.w[low:high][:, array].T)
        self._v = blocks.v[low:high]
        self._variance = variance
        self._alpha = alpha
        self._quiet = quiet[:, :, None]
        self._height_m = expected.clearance_m
        self.joint_fits = 0
        """Fits of two or more magnets so far: what takes time."""

    def fit_kinds(
        self, known: list[Dipole], starts: dict[int, Floats], others: list[Dipole], expected: Expectation
    ) -> list[Dipole] | None:
        """Fit known magnets and a new one together, the new one as the kind that it fits better, from its start as
        that kind, the likelier kind first; None if there are too few blocks."""
        kinds = list(starts)
        fit = self.fit(
            [*(d.params for d in known), starts[kinds[0]]], [*(d.kind for d in known), kinds[0]], others, expected
        )
        if fit is None or len(kinds) == 1:
            return fit
        places = [float(p[0]) for p in (*(d.params for d in known), *starts.values())]
        span = min(places), max(places)  # costs compare over the same blocks only
        cost = self.cost([*others, *fit], *span)
        if known:  # the other kind, beside the known ones as they are
            alone = self.fit([starts[kinds[1]]], [kinds[1]], [*others, *fit[:-1]], expected)
            if alone is None:
                return None
            margin = self.cost([*others, *fit[:-1], *alone], *span) - cost
            if margin > SURE:
                return [*fit[:-1], replace(fit[-1], margin=margin)]
        other = self.fit(
            [*(d.params for d in known), starts[kinds[1]]], [*(d.kind for d in known), kinds[1]], others, expected
        )
        if other is None:
            return None
        margin = self.cost([*others, *other], *span) - cost
        best = fit if margin >= 0 else other
        return [*best[:-1], replace(best[-1], margin=abs(margin))]

    def fit(
        self, starts: list[Floats], kinds: list[int], others: list[Dipole], expected: Expectation
    ) -> list[Dipole] | None:
        """Magnets of given kinds, fitted together with the others as they are; None if there are too few blocks."""
        start = np.array(starts)
        height = float(start[:, 2].max())
        reach = 2.4 * height + 0.3
        low, high = (int(i) for i in np.searchsorted(self._s, (start[:, 0].min() - reach, start[:, 0].max() + reach)))
        if high - low < 6:
            return None
        s, data, weight, delays, basis = self._whitened(low, high, height, [d.params for d in others])
        positions, alpha = self._positions, self._alpha
        near = np.flatnonzero(abs(positions[:, 1, None] - start[:, 1]).min(axis=1) < 2.4 * height + 0.2)
        if near.size < len(positions):  # the others see next to nothing
            data, weight = np.ascontiguousarray(data[near]), np.ascontiguousarray(weight[near])
            alpha = alpha * near.size / len(positions)
        self.joint_fits += len(starts) > 1
        params, covariance, explained, local, prior_costs = fit_dipoles(
            s, data, weight, delays, positions[near], basis, alpha, start, np.array(kinds), expected.prior, 9
        )
        if not np.isfinite(params).all():
            return None
        return [
            Dipole(
                params[i], covariance[i], explained[i], max(local[i, 0] - local[i, 1], 0.0) / max(explained[i], 1.0),
                prior_costs[i], kinds[i], 0.0,
            )
            for i in range(len(params))
        ]  # fmt: skip

    def _whitened(
        self, low: int, high: int, height: float, others: list[Floats]
    ) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """Places, data with background removed, weights, delays and background of some blocks."""
        s = self._s[low:high]
        d = int(np.argmin(abs(np.log(DISTANCES_M / (1.2 * height)))))
        scale = np.sqrt(np.clip(np.gradient(s), 1e-3, 1.0) / BIN_M)
        weight = (
            scale / np.sqrt(self._variance[d].astype(float))[None, :, None] * self._w[:, None, low:high] * self._quiet
        )
        delays = self._delay[:, None] * self._v[low:high]
        x = self._x[:, :, low:high]
        if others:
            rest = np.zeros((len(s), len(self._positions), 3))
            for p in others:
                add_field(p, s, self._positions, -1.0, np.zeros(3), rest)
            x = x + rest.transpose(1, 2, 0)
        data = x * weight
        basis = background_basis(s, scale, 2 + max(0, int((s[-1] - s[0] - 2.0) / 1.5)))
        remove_background(data, basis, self._alpha)
        return s, data, weight, delays, basis

    def cost(self, dipoles: list[Dipole], start_m: float, end_m: float) -> float:
        """-2 log likelihood of the blocks about a stretch of road, but for a constant."""
        height = self._height_m
        reach = 2.4 * min(max(height, 0.12), 0.45) + 0.3
        low, high = (int(i) for i in np.searchsorted(self._s, (start_m - reach, end_m + reach)))
        if high - low < 6:
            return 0.0
        s, data, weight, delays, basis = self._whitened(low, high, height, [])
        params = np.array([d.params for d in dipoles]).reshape(-1, PARAMETERS)
        left = residual_cost(s, data, weight, delays, self._positions, basis, self._alpha, params)
        return float(left) + sum(d.prior_cost for d in dipoles)


@nb.njit(cache=True, nogil=True, fastmath=True)
def add_field(p, s, positions, sign, common, out):  # type: ignore[no-untyped-def]
    """Add sign times the field of a dipole p (6,) with the bar at s (N,) to out (N, A, 3); of what all sensors have
    in common, the shares common (3,) are left out. [uT]"""
    sensors = positions.shape[0]
    mean = np.empty(3)
    field = np.empty((sensors, 3))
    for k in range(s.size):
        mean[:] = 0
        for j in range(sensors):
            x, y, z = s[k] + positions[j, 0] - p[0], positions[j, 1] - p[1], positions[j, 2] + p[2]
            r2 = x * x + y * y + z * z
            f = sign * 0.1 / (r2 * math.sqrt(r2))
            along = 3 * (x * p[3] + y * p[4] + z * p[5]) / r2
            field[j, 0], field[j, 1], field[j, 2] = (
                f * (along * x - p[3]), f * (along * y - p[4]), f * (along * z - p[5])
            )  # fmt: skip
            mean += field[j]
        for j in range(sensors):
            for axis in range(3):
                out[k, j, axis] += field[j, axis] - common[axis] * mean[axis] / sensors
