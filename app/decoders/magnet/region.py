"""A stretch in which something stood out -> dipoles that explain it, one after the other, overlapping ones together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.bins import Bins
from app.decoders.magnet.fit import PARAMETERS
from app.decoders.magnet.front import Blocks
from app.decoders.magnet.iron import is_iron
from app.decoders.magnet.search import BIN_M, HALF_BINS, SearchBank, search_bins
from app.decoders.magnet.window import SURE, Dipole, Expectation, Window, add_field

Floats = npt.NDArray[np.float64]

_STOP_SHARE = 0.015
"""What is left of a strong magnet's energy by a model that is not quite right."""
_MAX_MAGNETS = 12
_PER_MAGNET = 30.0
_TOO_CLOSE = 30.0
_CLUSTER_M = 1.2
_POLISH = 6
"""Most magnets that are fitted together."""
_ENOUGH = 4
_MAX_FAILED = 3
"""Fits that do not bear out what the filters saw, after which a region counts as iron."""
_MAX_JOINT_FITS, _ROW_WIDTH_M = 12, 0.3
"""Fits of several magnets that a region may take if its magnets stand in no row so narrow [m]: bounds the delay."""
_TOGETHER_M = 1.1
_SAME_M = 0.3
_MAX_TOGETHER = 3
_FIELD_M = 2.0
_CHANGE_M, _CHANGE_HEIGHTS = 0.9, 3.0
"""Reach of a magnet's field, and of what it changes in the filters' results. [m]"""


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

    @property
    def _half_width_m(self) -> float:
        return float(np.ptp(self.positions_m[:, 1])) / 2

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
        window = Window(
            self.positions_m,
            self.array,
            self.axis_delay_s,
            blocks,
            first * BIN_M - 1.6,
            until_m,
            variance,
            alpha,
            quiet,
            expected,
        )
        region = _Region(window, x, low, alpha, score, cell, variance, expected, threshold)
        found, iron = self._explain(region, (0, 2), [])
        if iron:
            return found
        for cluster in _clusters(found):
            if self._is_slow(region, found):
                return found
            if _doubtful(cluster) and 2 * sum(d.unlike for d in cluster) <= len(cluster):
                found = self._rekind(region, found, cluster)
        return self._polish(region, found)

    def _is_slow(self, region: _Region, found: list[Dipole]) -> bool:
        """Whether the fits took so much that only a row of magnets is worth more."""
        width = np.ptp([d.params[1] for d in found]) if found else 0.0
        return bool(region.window.joint_fits > _MAX_JOINT_FITS and width > _ROW_WIDTH_M)

    def _rekind(self, region: _Region, found: list[Dipole], cluster: list[Dipole]) -> list[Dipole]:
        """Explain a cluster by magnets of one kind, if that is as likely."""
        others = [d for d in found if all(d is not c for c in cluster)]
        places = [float(d.params[0]) for d in cluster]
        part = region.between(min(places) - 0.6, max(places) + 0.6)
        span = min(places), max(places)
        costs = [(region.window.cost(found, *span) + _penalty(found), found)]
        for kind in (0, 2):
            if any(d.kind != kind for d in cluster):
                whole = others + self._explain(part, (kind,), others)[0]
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

    def _explain(self, region: _Region, kinds: tuple[int, ...], known: list[Dipole]) -> tuple[list[Dipole], bool]:
        """Magnets of some kinds that explain what known ones leave of a region, the strongest first; and whether it
        is iron, of which further poles would only take time."""
        x, left, left_cell = region.x.copy(), region.score.copy(), region.cell.copy()
        if known:
            self._subtract(x, region.low, region.alpha, [d.params for d in known], [])
            self._score_near(x, region, [d.params for d in known], left, left_cell)
        columns = [0 if kind == 0 else 1 for kind in kinds]
        found: list[Dipole] = []
        strongest, failed = 0.0, 0
        while len(found) < _MAX_MAGNETS:
            k = int(np.argmax(left[:, columns].max(axis=1)))
            best = float(left[k, columns].max())
            strongest = max(strongest, best)
            if best < max(region.threshold, _STOP_SHARE * strongest):
                break
            order = sorted(zip(kinds, columns, strict=True), key=lambda c: -float(left[k, c[1]]))
            starts = {kind: self._start(region, k, column, left, left_cell) for kind, column in order}
            start = starts[order[0][0]]
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
                failed += 1
                if (failed >= _MAX_FAILED and failed > len(found)) or self._is_slow(region, found):
                    return found, True
                continue
            for i, dipole in zip(group, fitted, strict=False):
                found[i] = replace(dipole, margin=found[i].margin)
            found.append(added)
            if is_iron(found, self._half_width_m) or self._is_slow(region, found):
                return found, True
            if len(found) in (_ENOUGH, 2 * _ENOUGH) and 2 * sum(d.unlike for d in found) > len(found):
                found = self._polish(region, found)
                if 2 * sum(d.unlike for d in found) > len(found) and not _in_a_row(found):
                    return found, True
            self._subtract(x, region.low, region.alpha, [d.params for d in fitted], [d.params for d in before])
            self._score_near(x, region, [d.params for d in (*fitted, *before)], left, left_cell)
        return found, False

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
        rows = x.reshape(len(x), -1, 3)
        for sign, magnets in ((-1.0, add), (1.0, undo)):
            for p in magnets:
                low, high = np.searchsorted(middles, (p[0] - _FIELD_M, p[0] + _FIELD_M))
                add_field(p, middles[low:high], self.positions_m, sign, alpha, rows[low:high])

    def _score_near(
        self, x: npt.NDArray[np.float32], region: _Region, changed: list[Floats], score: npt.NDArray[np.float32],
        cell: npt.NDArray[np.int64],
    ) -> None:  # fmt: skip
        """Score the bins again about magnets that changed, in place."""
        first = region.low + HALF_BINS
        low = min(p[0] - _CHANGE_M - _CHANGE_HEIGHTS * p[2] for p in changed)
        high = max(p[0] + _CHANGE_M + _CHANGE_HEIGHTS * p[2] for p in changed)
        a, b = max(int(low / BIN_M) - first, 0), min(int(high / BIN_M) - first + 1, len(score))
        if a < b:
            k = self.bank
            search_bins(
                x, HALF_BINS + a, HALF_BINS + b, k.kernels, k.taps, k.products, k.first, k.sensor, k.distance,
                k.geometry, region.variance, score[a:b], cell[a:b],
            )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Region:
    """What the search saw: bins from the number `low` on, scores and cells of those that count."""

    window: Window
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


def _doubtful(cluster: list[Dipole]) -> bool:
    """Whether its magnets may be others, of another kind: their fields overlap."""
    places = [float(d.params[0]) for d in cluster]
    kinds = {d.kind for d in cluster}
    return len(cluster) > 1 and bool(
        len(kinds) > 1 or min(np.diff(places)) < 0.42 or min(d.margin for d in cluster) < SURE
    )


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
