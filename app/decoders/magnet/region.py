"""A stretch in which something stood out -> dipoles that explain it, one after the other, overlapping ones together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.bins import Bins
from app.decoders.magnet.fit import PARAMETERS, background_basis, fit_dipoles, remove_background
from app.decoders.magnet.front import Blocks
from app.decoders.magnet.search import BIN_M, DISTANCES_M, HALF_BINS, SearchBank, search_bins

Floats = npt.NDArray[np.float64]

MOMENT_SPREAD = 0.12
TILT_SPREAD = 0.10
YAW_SPREAD = 0.14
"""Of a forward magnet's axis against the heading: lanes are changed at a few degrees."""
_STOP_SHARE = 0.015
"""What is left of a strong magnet's energy by a model that is not quite right."""
_MAX_MAGNETS = 24
_TOGETHER_M = 1.1
_SAME_M = 0.3
_MAX_TOGETHER = 4


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
        return np.array(
            [m, MOMENT_SPREAD * m, self.clearance_m, self.clearance_std_m, TILT_SPREAD * m, YAW_SPREAD * m]
        )


@dataclass(slots=True, eq=False)
class RegionFitter:
    """Fits the dipoles of regions.

    Attributes
    ----------
    bank : SearchBank
    positions_m : ndarray, shape (A, 3)
        Array sensors; x and z relative to the bar's middle. [m]
    array : ndarray of int, shape (A,)
        Their places among all sensors.
    axis_delay_s : tuple of float
    """

    bank: SearchBank
    positions_m: Floats
    array: npt.NDArray[np.intp]
    axis_delay_s: tuple[float, float, float]

    def fit(
        self, blocks: Blocks, bins: Bins, first: int, last: int, score: Floats, cell: npt.NDArray[np.int64],
        variance: npt.NDArray[np.float32], expected: Expectation, threshold: float,
    ) -> tuple[list[Dipole], float]:  # fmt: skip
        """Dipoles of the bins first..last (numbers), and the largest share of the statistic left about one of them.

        score, cell : of these bins, from the search.
        """
        low = first - bins.start - HALF_BINS
        x = bins.x[low : last - bins.start + HALF_BINS + 1].copy()
        left, left_cell = score.astype(np.float32), cell.copy()
        window = _Window(self, blocks, first * BIN_M - 1.6, (last + 1) * BIN_M + 1.6, variance, bins.alpha)
        found: list[Dipole] = []
        strongest = remains = 0.0
        while len(found) < _MAX_MAGNETS:
            k = int(np.argmax(left.max(axis=1)))
            best = float(left[k].max())
            strongest = max(strongest, best)
            if best < max(threshold, _STOP_SHARE * strongest):
                break
            starts = self._starts(first, k, left, left_cell, expected)
            start = starts[int(np.argmax(left[k]))]
            if any(_apart_m(d.params, start) < _SAME_M for d in found):
                remains = max(remains, best / strongest)
                left[max(k - 2, 0) : k + 3] = 0  # what the model of that dipole missed
                continue
            near = sorted(range(len(found)), key=lambda i: abs(found[i].params[0] - start[0]))[: _MAX_TOGETHER - 1]
            group = [i for i in near if abs(found[i].params[0] - start[0]) < _TOGETHER_M]
            others = [d.params for i, d in enumerate(found) if i not in group]
            before = [found[i].params for i in group]
            fitted = window.fit_kinds(before, [found[i].kind for i in group], starts, others, expected)
            if fitted is None:
                left[k] = 0
                continue
            added = fitted[-1]
            if added.explained < threshold / 2 or any(_apart_m(d.params, added.params) < _SAME_M for d in fitted[:-1]):
                left[max(k - 3, 0) : k + 4] = 0  # the fit does not bear out what the filters saw
                continue
            for i, dipole in zip(group, fitted, strict=False):
                found[i] = replace(dipole, margin=found[i].margin)
            found.append(added)
            self._subtract(x, low + bins.start, bins.alpha, [d.params for d in fitted], before)
            left, left_cell = self._score(x, variance)
        return found, remains

    def _starts(
        self, first: int, k: int, score: npt.NDArray[np.float32], cell: npt.NDArray[np.int64], expected: Expectation
    ) -> tuple[Floats, Floats]:
        """Where a forward and an upright magnet fit best near bin k."""
        starts = []
        low = max(k - 8, 0)
        for kind in (0, 1):
            at = low + int(np.argmax(score[low : k + 9, kind])) if score[k, kind] < score[k].max() else k
            start = np.zeros(PARAMETERS)
            start[0] = (first + at + 0.5) * BIN_M
            start[1] = self.bank.lateral_m[cell[at, kind]]
            tracked = expected.clearance_std_m < 0.08
            start[2] = expected.clearance_m if tracked else self.bank.height_m[cell[at, kind]]
            starts.append(start)
        return starts[0], starts[1]

    def _subtract(self, x: npt.NDArray[np.float32], start: int, alpha: Floats, add: list[Floats], undo: list[Floats]) -> None:
        """Take fields out of the bins x, whose first has the number start, and put earlier ones back."""
        middles = (start + np.arange(len(x)) + 0.5) * BIN_M
        for sign, magnets in ((1, add), (-1, undo)):
            for p in magnets:
                near = np.flatnonzero(abs(middles - p[0]) < 2.0)
                if near.size:
                    field = _field(p, middles[near], self.positions_m)
                    field -= alpha * field.mean(axis=1, keepdims=True)
                    x[near] -= np.float32(sign) * field.reshape(near.size, -1).astype(np.float32)

    def _score(self, x: npt.NDArray[np.float32], variance: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
        n = len(x) - 2 * HALF_BINS
        score, cell = np.zeros((n, 2), np.float32), np.zeros((n, 2), np.int64)
        b = self.bank
        search_bins(
            x, HALF_BINS, HALF_BINS + n, b.kernels, b.taps, b.products, b.first, b.sensor, b.distance, b.geometry,
            variance, score, cell,
        )  # fmt: skip
        return score, cell


class _Window:
    """The blocks about a region, cut and whitened for each fit."""

    def __init__(
        self, fitter: RegionFitter, blocks: Blocks, start_m: float, end_m: float, variance: npt.NDArray[np.float32], alpha: Floats
    ) -> None:
        low, high = (int(i) for i in np.searchsorted(blocks.s, (start_m, end_m)))
        self._fitter = fitter
        self._s = blocks.s[low:high]
        self._x = np.ascontiguousarray(blocks.x[low:high][:, fitter.array].transpose(1, 2, 0))
        self._w = np.ascontiguousarray(blocks.w[low:high][:, fitter.array].T)
        self._v = blocks.v[low:high]
        self._variance = variance
        self._alpha = alpha

    def fit_kinds(
        self, known: list[Floats], kinds: list[int], new: tuple[Floats, Floats], others: list[Floats], expected: Expectation
    ) -> list[Dipole] | None:
        """Fit known magnets and a new one together, the new one (its starts as a forward and as an upright one) as
        the kind that it fits better; None if there are too few blocks."""
        fits = []
        span = np.array([*known, *new])  # costs compare over the same blocks only
        for kind, start in zip((0, 2), new, strict=True):
            fit = self.fit([*known, start], [*kinds, kind], others, expected, span)
            if fit is None:
                return None
            fits.append(fit)
        forward, up = fits
        _, best = min(up, forward, key=lambda f: f[0])
        best[-1] = replace(best[-1], margin=abs(up[0] - forward[0]))
        return best

    def fit(
        self, starts: list[Floats], kinds: list[int], others: list[Floats], expected: Expectation, span: Floats
    ) -> tuple[float, list[Dipole]] | None:
        """Cost and dipoles of magnets of given kinds, fitted together with the others as they are; over the span of places."""
        start = np.array(starts)
        height = float(span[:, 2].max())
        reach = 2.2 * height + 0.25
        low, high = (int(i) for i in np.searchsorted(self._s, (span[:, 0].min() - reach, span[:, 0].max() + reach)))
        if high - low < 6:
            return None
        s = self._s[low:high]
        spacing = np.clip(np.gradient(s), 1e-3, 1.0)
        d = int(np.argmin(abs(np.log(DISTANCES_M / (1.2 * height)))))
        scale = np.sqrt(spacing / BIN_M)
        weight = scale / np.sqrt(self._variance[d].astype(float))[None, :, None] * self._w[:, None, low:high]
        delays = np.array(self._fitter.axis_delay_s)[:, None] * self._v[low:high]
        x = self._x[:, :, low:high]
        for p in others:
            x = x - _field(p, s, self._fitter.positions_m).transpose(1, 2, 0)
        data = x * weight
        basis = background_basis(s, scale, 2 if s[-1] - s[0] < 2.5 else 4)
        remove_background(data, basis, self._alpha)
        params, covariance, explained, local, prior_costs, cost = fit_dipoles(
            s, data, weight, delays, self._fitter.positions_m, basis, self._alpha, start, np.array(kinds),
            expected.prior, 14,
        )  # fmt: skip
        if not np.isfinite(params).all():
            return None
        return cost, [
            Dipole(
                params[i], covariance[i], explained[i], max(local[i, 0] - local[i, 1], 0.0) / max(explained[i], 1.0),
                prior_costs[i], kinds[i], 0.0,
            )
            for i in range(len(params))
        ]  # fmt: skip


def _apart_m(a: Floats, b: Floats) -> float:
    return float(np.hypot(a[0] - b[0], a[1] - b[1]))


def _field(p: Floats, s: Floats, positions: Floats) -> Floats:
    """Field of magnet p at sensors when the bar is at s, shape (N, A, 3). [uT]"""
    r = np.empty((len(s), len(positions), 3))
    r[:, :, 0] = s[:, None] + positions[:, 0] - p[0]
    r[:, :, 1] = positions[:, 1] - p[1]
    r[:, :, 2] = positions[:, 2] + p[2]
    square = np.sum(r * r, axis=2)[:, :, None]
    field: Floats = 0.1 * (3 * r * (r @ p[3:])[:, :, None] / square - p[3:]) / square**1.5
    return field
