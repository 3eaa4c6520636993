"""A stretch in which something stood out -> dipoles that explain it, one after the other, overlapping ones together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.bins import Bins
from app.decoders.magnet.fit import PARAMETERS, background_basis, fit_dipoles, remove_background, residual_cost
from app.decoders.magnet.front import Blocks
from app.decoders.magnet.search import BIN_M, DISTANCES_M, HALF_BINS, SearchBank, search_bins

Floats = npt.NDArray[np.float64]

MOMENT_SPREAD = 0.12
TILT_SPREAD = 0.10
YAW_SPREAD = 0.14
"""Of a forward magnet's axis against the heading: lanes are changed at a few degrees."""
_STOP_SHARE = 0.015
"""What is left of a strong magnet's energy by a model that is not quite right."""
_MAX_MAGNETS = 12
_PER_MAGNET = 30.0
_TOO_CLOSE = 30.0
_CLUSTER_M = 1.2
_POLISH = 6
"""Most magnets that are fitted together."""
_ENOUGH = 4
LIMIT_MISFIT = 0.12
LIMIT_PRIOR = 13.0
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
        self, blocks: Blocks, bins: Bins, first: int, last: int, score: npt.NDArray[np.float32],
        cell: npt.NDArray[np.int64],
        variance: npt.NDArray[np.float32], expected: Expectation, threshold: float, until_m: float,
    ) -> list[Dipole]:  # fmt: skip
        """Dipoles of the bins first..last (numbers); score and cell are those bins' from the search;
        blocks count up to until_m.

        Lines and tags keep apart, so one kind of magnet alone is tried first; both together if neither fits.
        """
        low = first - HALF_BINS
        x = bins.x[low - bins.start : last - bins.start + HALF_BINS + 1]
        alpha = bins.alpha[last - bins.start].copy()
        quiet = 1 / np.sqrt(bins.loudness[last - bins.start].astype(float))
        window = _Window(self, blocks, first * BIN_M - 1.6, until_m, variance, alpha, quiet, expected)
        region = _Region(window, x, low, alpha, score, cell, variance, expected, threshold)
        found = self._explain(region, (0, 2), [])
        for cluster in _clusters(found):
            if len(cluster) > 1 and 2 * sum(d.unlike for d in cluster) <= len(cluster):
                found = self._rekind(region, found, cluster)
        return self._polish(region, found)

    def _rekind(self, region: _Region, found: list[Dipole], cluster: list[Dipole]) -> list[Dipole]:
        """Explain a cluster by magnets of one kind, if that is as likely."""
        others = [d for d in found if all(d is not c for c in cluster)]
        places = [float(d.params[0]) for d in cluster]
        part = region.between(min(places) - 0.6, max(places) + 0.6)
        span = min(places), max(places)
        costs = [(region.window.cost(found, *span) + _penalty(found), found)]
        for kind in (0, 2):
            if any(d.kind != kind for d in cluster):
                whole = others + self._explain(part, (kind,), others)
                costs.append((region.window.cost(whole, *span) + _penalty(whole), whole))
        costs.sort(key=lambda c: c[0])
        best = costs[0][1]
        mine = [d for d in best if all(d is not o for o in others)]
        if len(costs) == 1 or len({d.kind for d in mine}) > 1:
            return best
        margin = costs[1][0] - costs[0][0]  # of the kind that they share
        return others + [replace(d, margin=max(d.margin, margin)) for d in mine]

    def _polish(self, region: _Region, found: list[Dipole]) -> list[Dipole]:
        """Fit the magnets of each cluster together: those found first did not know of the others."""
        for cluster in (c for c in _clusters(found) if len(c) > 1):
            for k in range(0, len(cluster), _POLISH):
                part = cluster[k : k + _POLISH]
                others = [d for d in found if all(d is not p for p in part)]
                fitted = region.window.fit([d.params for d in part], [d.kind for d in part], others, region.expected)
                if fitted:
                    renewed = [replace(f, margin=d.margin) for f, d in zip(fitted, part, strict=True)]
                    found = others + renewed
        return found

    def _explain(self, region: _Region, kinds: tuple[int, ...], known: list[Dipole]) -> list[Dipole]:
        """Magnets of some kinds that explain what known ones leave of a region, the strongest first."""
        x, left, left_cell = region.x.copy(), region.score.astype(np.float32), region.cell
        if known:
            self._subtract(x, region.low, region.alpha, [d.params for d in known], [])
            left, left_cell = self._score(x, region)
        columns = [0 if kind == 0 else 1 for kind in kinds]
        found: list[Dipole] = []
        strongest = 0.0
        while len(found) < _MAX_MAGNETS:
            k = int(np.argmax(left[:, columns].max(axis=1)))
            best = float(left[k, columns].max())
            strongest = max(strongest, best)
            if best < max(region.threshold, _STOP_SHARE * strongest):
                break
            starts = {
                kind: self._start(region, k, column, left, left_cell)
                for kind, column in zip(kinds, columns, strict=True)
            }
            start = starts[kinds[int(np.argmax(left[k, columns]))]]
            if any(_apart_m(d.params, start) < _SAME_M for d in found):
                left[max(k - 2, 0) : k + 3] = 0  # what the model of that dipole missed
                continue
            near = sorted(range(len(found)), key=lambda i: abs(found[i].params[0] - start[0]))[: _MAX_TOGETHER - 1]
            group = [i for i in near if abs(found[i].params[0] - start[0]) < _TOGETHER_M]
            others = [d for i, d in enumerate(found) if i not in group] + known
            before = [found[i] for i in group]
            fitted = region.window.fit_kinds(before, starts, others, region.expected)
            if fitted is None:
                left[k] = 0
                continue
            added = fitted[-1]
            if added.explained < region.threshold / 2 or any(
                _apart_m(d.params, added.params) < _SAME_M for d in fitted[:-1]
            ):
                left[max(k - 3, 0) : k + 4] = 0  # the fit does not bear out what the filters saw
                continue
            for i, dipole in zip(group, fitted, strict=False):
                found[i] = replace(dipole, margin=found[i].margin)
            found.append(added)
            if len(found) in (_ENOUGH, 2 * _ENOUGH) and 2 * sum(d.unlike for d in found) > len(found):
                found = self._polish(region, found)
                if 2 * sum(d.unlike for d in found) > len(found) and not _in_a_row(found):
                    break  # iron: more poles would only take time
            self._subtract(x, region.low, region.alpha, [d.params for d in fitted], [d.params for d in before])
            left, left_cell = self._score(x, region)
        return found

    def _start(
        self, region: _Region, k: int, column: int, score: npt.NDArray[np.float32], cell: npt.NDArray[np.int64]
    ) -> Floats:
        """Where a magnet of a kind fits best near bin k."""
        low = max(k - 8, 0)
        at = low + int(np.argmax(score[low : k + 9, column])) if score[k, column] < score[k].max() else k
        start = np.zeros(PARAMETERS)
        start[0] = (region.low + HALF_BINS + at + 0.5) * BIN_M
        start[1] = self.bank.lateral_m[cell[at, column]]
        tracked = region.expected.clearance_std_m < 0.08
        start[2] = region.expected.clearance_m if tracked else self.bank.height_m[cell[at, column]]
        return start

    def _subtract(
        self, x: npt.NDArray[np.float32], start: int, alpha: Floats, add: list[Floats], undo: list[Floats]
    ) -> None:
        """Take fields out of the bins x, whose first has the number start, and put earlier ones back."""
        middles: Floats = (start + np.arange(len(x), dtype=float) + 0.5) * BIN_M
        for sign, magnets in ((1, add), (-1, undo)):
            for p in magnets:
                near = np.flatnonzero(abs(middles - p[0]) < 2.0)
                if near.size:
                    field = _field(p, middles[near], self.positions_m)
                    field -= alpha * field.mean(axis=1, keepdims=True)
                    x[near] -= np.float32(sign) * field.reshape(near.size, -1).astype(np.float32)

    def _score(
        self, x: npt.NDArray[np.float32], region: _Region
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
        n = len(x) - 2 * HALF_BINS
        score, cell = np.zeros((n, 2), np.float32), np.zeros((n, 2), np.int64)
        b = self.bank
        search_bins(
            x, HALF_BINS, HALF_BINS + n, b.kernels, b.taps, b.products, b.first, b.sensor, b.distance, b.geometry,
            region.variance, score, cell,
        )  # fmt: skip
        return score, cell


class _Window:
    """The blocks about a region, cut and whitened for each fit."""

    def __init__(
        self,
        fitter: RegionFitter,
        blocks: Blocks,
        start_m: float,
        end_m: float,
        variance: npt.NDArray[np.float32],
        alpha: Floats,
        quiet: Floats,
        expected: Expectation,
    ) -> None:
        low, high = (int(i) for i in np.searchsorted(blocks.s, (start_m, end_m)))
        self._fitter = fitter
        self._s = blocks.s[low:high]
        self._x = np.ascontiguousarray(blocks.x[low:high][:, fitter.array].transpose(1, 2, 0))
        self._w = np.ascontiguousarray(blocks.w[low:high][:, fitter.array].T)
        self._v = blocks.v[low:high]
        self._variance = variance
        self._alpha = alpha
        self._quiet = quiet[:, :, None]
        self._height_m = expected.clearance_m

    def fit_kinds(
        self, known: list[Dipole], starts: dict[int, Floats], others: list[Dipole], expected: Expectation
    ) -> list[Dipole] | None:
        """Fit known magnets and a new one together, the new one as the kind that it fits better, from its start as
        that kind; None if there are too few blocks."""
        fits = []
        places = [float(p[0]) for p in (*(d.params for d in known), *starts.values())]
        span = min(places), max(places)  # costs compare over the same blocks only
        for kind, start in starts.items():
            fit = self.fit([*(d.params for d in known), start], [*(d.kind for d in known), kind], others, expected)
            if fit is None:
                return None
            cost = self.cost([*others, *fit], span[0], span[1]) if len(starts) > 1 else 0.0
            fits.append((cost, fit))
        fits.sort(key=lambda f: f[0])
        best = fits[0][1]
        if len(fits) > 1:
            best[-1] = replace(best[-1], margin=fits[1][0] - fits[0][0])
        return best

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
        positions, alpha = self._fitter.positions_m, self._alpha
        near = np.flatnonzero(abs(positions[:, 1, None] - start[:, 1]).min(axis=1) < 2.4 * height + 0.2)
        if near.size < len(positions):  # the others see next to nothing
            data, weight = np.ascontiguousarray(data[near]), np.ascontiguousarray(weight[near])
            alpha = alpha * near.size / len(positions)
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
        delays = np.array(self._fitter.axis_delay_s)[:, None] * self._v[low:high]
        x = self._x[:, :, low:high]
        for p in others:
            x = x - _field(p, s, self._fitter.positions_m).transpose(1, 2, 0)
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
        left = residual_cost(s, data, weight, delays, self._fitter.positions_m, basis, self._alpha, params)
        return float(left) + sum(d.prior_cost for d in dipoles)


@dataclass(frozen=True, slots=True, eq=False)
class _Region:
    """What the search saw: bins from the number `low` on, scores and cells of those that count."""

    window: _Window
    x: npt.NDArray[np.float32]
    low: int
    alpha: Floats
    score: npt.NDArray[np.float32]
    cell: npt.NDArray[np.int64]
    variance: npt.NDArray[np.float32]
    expected: Expectation
    threshold: float

    def between(self, start_m: float, end_m: float) -> _Region:
        """The part between two distances."""
        first = self.low + HALF_BINS
        a = min(max(int(start_m / BIN_M) - first, 0), len(self.score) - 1)
        b = min(max(int(end_m / BIN_M) - first, a), len(self.score) - 1)
        return replace(
            self, x=self.x[a : b + 1 + 2 * HALF_BINS], low=self.low + a, score=self.score[a : b + 1],
            cell=self.cell[a : b + 1],
        )  # fmt: skip


def _clusters(dipoles: list[Dipole]) -> list[list[Dipole]]:
    """Groups of dipoles with less than `_CLUSTER_M` from each to the next."""
    groups: list[list[Dipole]] = []
    for dipole in sorted(dipoles, key=lambda d: float(d.params[0])):
        if groups and dipole.params[0] - groups[-1][-1].params[0] < _CLUSTER_M:
            groups[-1].append(dipole)
        else:
            groups.append([dipole])
    return groups


def _in_a_row(dipoles: list[Dipole]) -> bool:
    """Whether they stand like the magnets of a tag, apart and one behind the other."""
    places = np.array([d.params[:2] for d in dipoles])
    return bool(np.ptp(places[:, 1]) < 0.15 and np.diff(np.sort(places[:, 0])).min(initial=np.inf) > 0.42)


def _penalty(dipoles: list[Dipole]) -> float:
    """What so many magnets must explain more than fewer, and what magnets cost that stand too close."""
    places = np.sort([float(d.params[0]) for d in dipoles])
    return _PER_MAGNET * len(dipoles) + _TOO_CLOSE * int(np.sum(np.diff(places) < 0.42))


def _apart_m(a: Floats, b: Floats) -> float:
    return float(np.hypot(a[0] - b[0], a[1] - b[1]))


def _field(p: Floats, s: npt.NDArray[np.floating], positions: Floats) -> Floats:
    """Field of magnet p at sensors when the bar is at s, shape (N, A, 3). [uT]"""
    r = np.empty((len(s), len(positions), 3))
    r[:, :, 0] = s[:, None] + positions[:, 0] - p[0]
    r[:, :, 1] = positions[:, 1] - p[1]
    r[:, :, 2] = positions[:, 2] + p[2]
    square = np.sum(r * r, axis=2)[:, :, None]
    field: Floats = 0.1 * (3 * r * (r @ p[3:])[:, :, None] / square - p[3:]) / square**1.5
    return field
