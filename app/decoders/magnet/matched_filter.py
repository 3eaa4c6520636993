"""Detection of candidate magnets: matched filters for upright and forward dipoles over all sensors and axes.

The field of a dipole along a straight pass is made of three functions of the distance dx (Anderson's functions of
magnetic anomaly detection: Anderson, Magnetic airborne detection, 1949), with D the shortest distance between the
sensor and the magnet::

    A = 1/r3, E0 = 1/r5, E1 = dx/r5, r2 = dx2 + D2

So each channel is filtered with three kernels for a few D, and the filter for every position on the bar, clearance and
moment is a sum of these results.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import ieee_routine, kernel, routine
from app.markers.magnet import FIELD_UT_M3
from app.values import Floats, Floats32, Ints

Counts = npt.NDArray[np.int32]

BIN_M = 0.05
"""Length of a bin of road. [m] A third of the lowest clearance."""
HALF_BINS = 24
"""Bins on each side that the widest filter may use: 1.2 m. Source: 2.3 heights of 0.48 m, for speed."""
REGION_END_BINS = 10
"""Bins below the threshold that end a region: 0.5 m. Source: `app.markers.magnet.MIN_GAP_M`, at which fields part."""
MAX_REGION_BINS = 160
"""Longest region: 8 m. Source: bounds the delay of a streamed trace, `python -m benchmarks.magnets speed`."""
THRESHOLD = 32.0
"""Smallest statistic of a candidate, chi-squared with one degree of freedom: noise alone exceeds it with probability
1.5e-8 for each bin, cell and kind. Source: chi-squared distribution."""
DISTANCES_M = np.array([0.10, 0.145, 0.20, 0.27, 0.36, 0.48, 0.64])
"""D of the kernels, about a factor of 1.36 apart. [m] Source: clearances of 0.15 to 0.35 m (METRO section 7.3) and the
sensors beside the magnet."""
HEIGHTS_M = np.array([0.11, 0.17, 0.26, 0.38])
"""Clearances of the cells, a factor of 1.5 apart. [m] Source: as `DISTANCES_M`."""
LATERAL_STEP_M = 0.08
"""Distance between cells on the bar. [m] Source: half of METRO's sensor spacing (section 5.1)."""
BEYOND_M = 0.16
"""How far beyond its outermost sensors the bar is searched. [m] Source: METRO's sensor spacing (section 5.1)."""
KERNEL_HEIGHTS, KERNEL_M = 2.3, 0.12
"""Half length of a kernel: times D, and metres more. An upright magnet's field straight above the pass has its negative
lobe's peak at 2 D."""
CELL_HEIGHTS, CELL_M = 1.6, 0.1
"""Sensors whose filters a cell adds up, across the road: times the clearance, and metres more."""
MIN_DEPTH_M = 0.03
"""Least height of a sensor above a cell. [m] Nearer, the field is no point dipole's."""
MEDIAN_CHI2 = 0.455
"""Median of chi-squared with one degree of freedom, 0.4549. Source: chi-squared distribution."""
ONE, TWO, THREE = np.float32(1), np.float32(2), np.float32(3)
"""Numbers that keep the arithmetic of the kernels in single precision, which vectorises twice as wide."""
BLOCK_BINS = 32
"""Bins that are scored together: the arithmetic then runs along them, and vectorises. Source: `python -m
benchmarks.magnets speed`; 16 and 64 take as long."""
SITE_SUMS = 7
"""Sums of products for each D and sensor, of which the filters of a cell are made: three forward, four upright."""
FAST_BINS, FAST_RATE, SLOW_RATE = 40, 0.4, 0.06
"""The noise is learnt fast over the first bins (2 m), then slowly: change of its logarithm per bin."""


class FilterBank(NamedTuple):
    """Filters of a bar with S array sensors."""

    # shape (3, nD, HALF_BINS + 1): a, E0 (even) and E1 (odd), offset or slope removed, for dx >= 0. [uT / (A m2) times
    # powers of m]
    kernels: Floats32
    taps: Ints  # shape (nD,): bins on each side that each D uses
    # shape (nD, 2): squared filters of a channel for which the moment is along the axis, even (2 A - 3 D2 E0) and odd
    # (E1)
    energy: Floats32
    distances_m: Floats32  # shape (nD,): [m] d of the kernels
    # `lateral_m`, `height_m`: shape (P,): [m] counts: positions on the bar and clearances
    lateral_m: Floats
    height_m: Floats
    first: Ints  # shape (P + 1,): where the rows of each cell begin in the arrays below
    site: Ints  # shape (R,): index of D times S, plus the array sensor, of each row
    # shape (R, SITE_SUMS): what each sum of `_sum_sites` contributes to the filters: the field is that of the kernel's
    # D times a scale
    share: Floats32
    squared: Floats32  # shape (2, 3 nD, P): squared filters of each cell, forward and upright, for each D and axis


class BinScores(NamedTuple):
    """Scores of N bins, for forward (column 0) and upright magnets (column 1)."""

    # shape (N, 2): largest matched-filter statistic over the cells: chi-squared with one degree of freedom without a
    # magnet
    statistic: Floats32
    cell: Ints  # shape (N, 2): its cell in the bank

    @classmethod
    def empty(cls, count: int) -> BinScores:
        """Scores of a number of bins, to be filled."""
        return cls(np.empty((count, 2), np.float32), np.empty((count, 2), np.int64))

    def part(self, start: int, stop: int) -> BinScores:
        """Scores of some of the bins; they share their memory."""
        return BinScores(self.statistic[start:stop], self.cell[start:stop])


BINS_SEEN, REGION_OPEN, REGION_BINS, QUIET_BINS = range(4)
"""Places in the state of `scan_bins`: bins so far, whether a region is open, its bins, those since one above
threshold."""


def make_filter_bank(positions_m: Floats) -> FilterBank:
    """Filters for array sensors at positions (S, 3) in vehicle axes; different x are aligned when resampling.

    With m along x or z, the filters of the three axes are, in A, E0, E1 (times a scale)::

        forward: 2 A - 3 D2 E0 | 3 dy E1    | 3 h E1
        upright: 3 h E1        | 3 h dy E0  | 3 h2 E0 - A
    """
    kernels, taps, products = _make_kernels()
    y, z = positions_m[:, 1], positions_m[:, 2] - np.median(positions_m[:, 2])
    places = np.arange(y.min() - BEYOND_M, y.max() + BEYOND_M + 1e-9, LATERAL_STEP_M)
    lateral, height, first, site, share, squared = [], [], [0], [], [], []
    for h in HEIGHTS_M:
        for place in places:
            of_cell = np.zeros((2, DISTANCES_M.size, 3))
            for j in range(len(y)):
                dy, dz = y[j] - place, h + z[j]
                distance = math.hypot(dy, dz)
                if abs(dy) > CELL_HEIGHTS * h + CELL_M or dz < MIN_DEPTH_M:
                    continue
                d = int(np.argmin(np.abs(np.log(DISTANCES_M / distance))))
                k = DISTANCES_M[d] / distance
                f, u, w = k**3, 3 * dz * k, 3 * dy * k  # scale, 3 h and 3 dy at the kernel's D
                site.append(d * len(y) + j)
                share.append((f, f * w, f * u, f * u, f * w * u / 3, f * u * u / 3, -f))
                aa, ae, ee, oo = products[d]
                q, v = 3 * DISTANCES_M[d] ** 2, u * u / 3
                along, up = 4 * aa - 4 * q * ae + q * q * ee, v * v * ee - 2 * v * ae + aa
                of_cell[0, d] += f * f * np.array((along, w * w * oo, u * u * oo))
                of_cell[1, d] += f * f * np.array((u * u * oo, (w * u / 3) ** 2 * ee, up))
            if len(site) > first[-1]:
                lateral.append(place)
                height.append(h)
                first.append(len(site))
                squared.append(of_cell.reshape(2, -1))
    aa, ae, ee, oo = products.T
    q = 3 * DISTANCES_M**2
    energy = np.stack([4 * aa - 4 * q * ae + q * q * ee, oo], 1)
    return FilterBank(
        kernels.astype(np.float32), taps, energy.astype(np.float32), DISTANCES_M.astype(np.float32),
        np.array(lateral), np.array(height), np.array(first), np.array(site), np.array(share, np.float32),
        np.ascontiguousarray(np.stack(squared, 2), np.float32),
    )  # fmt: skip


def _make_kernels() -> tuple[Floats, Ints, Floats]:
    """Kernels and taps of a `FilterBank`, and the inner products <A, A>, <A, E0>, <E0, E0>, <E1, E1> (nD, 4)."""
    kernels = np.zeros((3, DISTANCES_M.size, HALF_BINS + 1))
    taps = np.minimum(np.ceil((KERNEL_HEIGHTS * DISTANCES_M + KERNEL_M) / BIN_M).astype(np.int64), HALF_BINS)
    products = np.zeros((DISTANCES_M.size, 4))
    for d, (distance, n) in enumerate(zip(DISTANCES_M, taps, strict=True)):
        dx = np.arange(-n, n + 1) * BIN_M
        r = np.sqrt(dx * dx + distance * distance)
        a, e0, e1 = FIELD_UT_M3 / r**3, FIELD_UT_M3 / r**5, FIELD_UT_M3 * dx / r**5
        a, e0, e1 = a - a.mean(), e0 - e0.mean(), e1 - dx * (e1 @ dx) / (dx @ dx)
        kernels[:, d, : n + 1] = np.stack([a, e0, e1])[:, n:]
        products[d] = a @ a, a @ e0, e0 @ e0, e1 @ e1
    return kernels, taps, products


# --- kernels --------------------------------------------------------------------------------------------------------


class _Projection(NamedTuple):
    """Products of the kernels with the channels about a block of B bins; channels are x0 y0 z0 x1 .. of the S sensors.

    Channels of a block lie behind each other: B times 3 S.
    """

    even: Floats32  # (HALF_BINS + 1, 3 S B) sums of bins at equal distances ahead and behind
    odd: Floats32  # (HALF_BINS + 1, 3 S B) differences of them
    product: Floats32  # (3, nD, 3 S B) with A, E0 and E1
    variance: Floats32  # (B, nD, 3) of the noise at each bin
    sums: Floats32  # (nD S, SITE_SUMS, B) products over the variance, combined
    squared: Floats32  # (2, P, B) squared filters of each cell over the variance
    of_bin: Floats32  # (P,) the same of a bin
    sum_x: Floats32  # (B,) filter times channel over the variance of a cell, forward
    sum_z: Floats32  # (B,) upright
    best: Floats32  # (2, B) largest statistic
    cell: Counts  # (2, B) its cell


@ieee_routine
def _make_projection(bank: FilterBank, channels: int, most_bins: int) -> _Projection:
    half, distances, cells = bank.kernels.shape[2], bank.kernels.shape[1], bank.squared.shape[2]
    bins = min(most_bins, BLOCK_BINS)
    return _Projection(
        np.empty((half, channels * bins), np.float32),
        np.empty((half, channels * bins), np.float32),
        np.empty((3, distances, channels * bins), np.float32),
        np.empty((bins, distances, 3), np.float32),
        np.empty((distances * (channels // 3), SITE_SUMS, bins), np.float32),
        np.empty((2, cells, bins), np.float32),
        np.empty(cells, np.float32),
        np.empty(bins, np.float32),
        np.empty(bins, np.float32),
        np.empty((2, bins), np.float32),
        np.empty((2, bins), np.int32),
    )


@routine
def _project(x: Floats32, start: int, bins: int, bank: FilterBank, p: _Projection) -> None:
    """Fold the channels x (bins, 3 S) about bins from start on, as the kernels are even or odd, and multiply."""
    channels = x.shape[1]
    flat, size = x.reshape(-1), bins * channels
    here = flat[start * channels :]
    for c in range(size):
        p.even[0, c] = here[c]
        p.odd[0, c] = 0
    for k in range(1, bank.taps[-1] + 1):
        before, after = flat[(start - k) * channels :], flat[(start + k) * channels :]
        even, odd = p.even[k], p.odd[k]
        for c in range(size):
            even[c] = after[c] + before[c]
            odd[c] = after[c] - before[c]
    for d in range(bank.kernels.shape[1]):
        a, e0, e1 = p.product[0, d], p.product[1, d], p.product[2, d]
        of_a, of_e0, of_e1 = bank.kernels[0, d], bank.kernels[1, d], bank.kernels[2, d]
        even, odd = p.even[0], p.odd[0]
        for c in range(size):
            a[c] = of_a[0] * even[c]
            e0[c] = of_e0[0] * even[c]
            e1[c] = 0
        for k in range(1, bank.taps[d] + 1):
            ka, k0, k1 = of_a[k], of_e0[k], of_e1[k]
            even, odd = p.even[k], p.odd[k]
            for c in range(size):
                a[c] += ka * even[c]
                e0[c] += k0 * even[c]
                e1[c] += k1 * odd[c]


@routine
def _sum_sites(p: _Projection, bins: int, sensors: int, bank: FilterBank) -> None:
    """Set `sums` of the projection: what the filters of all cells are made of."""
    for d in range(bank.kernels.shape[1]):
        q = THREE * bank.distances_m[d] * bank.distances_m[d]
        for i in range(bins):
            ix, iy, iz = ONE / p.variance[i, d, 0], ONE / p.variance[i, d, 1], ONE / p.variance[i, d, 2]
            at = 3 * sensors * i
            a, e0, e1 = p.product[0, d, at:], p.product[1, d, at:], p.product[2, d, at:]
            for j in range(sensors):
                sums = p.sums[d * sensors + j]
                sums[0, i] = (TWO * a[3 * j] - q * e0[3 * j]) * ix
                sums[1, i] = e1[3 * j + 1] * iy
                sums[2, i] = e1[3 * j + 2] * iz
                sums[3, i] = e1[3 * j] * ix
                sums[4, i] = e0[3 * j + 1] * iy
                sums[5, i] = e0[3 * j + 2] * iz
                sums[6, i] = a[3 * j + 2] * iz


@routine
def _sum_squared(p: _Projection, bins: int, bank: FilterBank) -> None:
    """Set `squared` of the projection."""
    of_bin = p.of_bin
    for i in range(bins):
        for kind in range(2):
            of_bin[:] = 0
            for d in range(bank.kernels.shape[1]):
                ix, iy, iz = ONE / p.variance[i, d, 0], ONE / p.variance[i, d, 1], ONE / p.variance[i, d, 2]
                of_x, of_y, of_z = bank.squared[kind, 3 * d : 3 * d + 3]
                for cell in range(of_bin.size):
                    of_bin[cell] += of_x[cell] * ix + of_y[cell] * iy + of_z[cell] * iz
            for cell in range(of_bin.size):
                p.squared[kind, cell, i] = of_bin[cell]


@routine
def _score(p: _Projection, bins: int, sensors: int, bank: FilterBank, statistic: Floats32, cells: Ints) -> None:
    """Largest statistic b2 / g over the cells and its cell, for forward (0) and upright (1) magnets at each bin.

    b sums filter times channel over noise variance, g the squared filters over the variance.
    """
    _sum_sites(p, bins, sensors, bank)
    _sum_squared(p, bins, bank)
    sum_x, sum_z = p.sum_x, p.sum_z
    p.best[:] = 0
    p.cell[:] = 0
    for cell in range(bank.first.size - 1):
        sum_x[:] = 0
        sum_z[:] = 0
        for row in range(bank.first[cell], bank.first[cell + 1]):
            share, sums = bank.share[row], p.sums[bank.site[row]]
            s0, s1, s2, s3, s4, s5, s6 = share[0], share[1], share[2], share[3], share[4], share[5], share[6]
            for i in range(bins):
                sum_x[i] += s0 * sums[0, i] + s1 * sums[1, i] + s2 * sums[2, i]
                sum_z[i] += s3 * sums[3, i] + s4 * sums[4, i] + s5 * sums[5, i] + s6 * sums[6, i]
        _keep_best(sum_x, p.squared[0, cell], cell, bins, p.best[0], p.cell[0])
        _keep_best(sum_z, p.squared[1, cell], cell, bins, p.best[1], p.cell[1])
    for i in range(bins):
        for kind in range(2):
            statistic[i, kind], cells[i, kind] = p.best[kind, i], p.cell[kind, i]


@routine
def _keep_best(b: Floats32, g: Floats32, cell: int, bins: int, best: Floats32, best_cell: Counts) -> None:
    """Keep a cell's statistic at each bin where it is the largest yet."""
    number = np.int32(cell)
    for i in range(bins):
        value = b[i] * b[i] / g[i]
        larger = value > best[i]
        best[i] = value if larger else best[i]
        best_cell[i] = number if larger else best_cell[i]


@routine
def _track_variance(p: _Projection, at: int, bank: FilterBank, variance: Floats32, factors: Floats) -> None:
    """Move each variance (nD, 3) towards the median square of its filters' results: magnets are few, noise is all.

    The share of the results whose square is above the median of chi-squared is one half where the variance is right.
    `at` is where the bin's channels begin in the block, `factors` those of the variance for each number of results
    above the median.
    """
    for d in range(variance.shape[0]):
        q = THREE * bank.distances_m[d] * bank.distances_m[d]
        a, e0, e1 = p.product[0, d, at:], p.product[1, d, at:], p.product[2, d, at:]
        for axis in range(3):
            limit = np.float32(MEDIAN_CHI2) * variance[d, axis]
            of_even, of_odd = limit * bank.energy[d, 0], limit * bank.energy[d, 1]
            above = 0
            for j in range(factors.size // 2):
                even, odd = TWO * a[3 * j + axis] - q * e0[3 * j + axis], e1[3 * j + axis]
                above += (even * even > of_even) + (odd * odd > of_odd)
            variance[d, axis] *= factors[above]


@routine
def _factors(rate: float, sensors: int) -> Floats:
    """Factors of a variance, for each number of results above the median out of two for each sensor."""
    return np.exp(rate * (np.arange(2 * sensors + 1) / (2 * sensors) - 0.5))


@kernel
def score_bins(x: Floats32, start: int, bank: FilterBank, variance: Floats32, scores: BinScores) -> None:
    """Score the bins of x (bins, 3 S) from start on, as many as the scores; each has HALF_BINS neighbours each side."""
    count, sensors = scores.statistic.shape[0], x.shape[1] // 3
    p = _make_projection(bank, x.shape[1], count)
    p.variance[:] = variance
    for first in range(0, count, BLOCK_BINS):
        bins = min(BLOCK_BINS, count - first)
        _project(x, start + first, bins, bank, p)
        _score(p, bins, sensors, bank, scores.statistic[first:], scores.cell[first:])


@kernel
def scan_bins(x: Floats32, start: int, bank: FilterBank, variance: Floats32, state: Ints, scores: BinScores) -> int:
    """Score bins and track the noise until a region is complete; returns the number of bins scored.

    variance (nD, 3) and state (4,), see `BINS_SEEN`, are carried on. A region is complete after REGION_END_BINS below
    the threshold, or at MAX_REGION_BINS.
    """
    count, channels = scores.statistic.shape[0], x.shape[1]
    p = _make_projection(bank, channels, count)
    fast, slow = _factors(FAST_RATE, channels // 3), _factors(SLOW_RATE, channels // 3)
    for first in range(0, count, BLOCK_BINS):
        bins = min(BLOCK_BINS, count - first)
        _project(x, start + first, bins, bank, p)
        for i in range(bins):
            factors = fast if state[BINS_SEEN] + i < FAST_BINS else slow
            _track_variance(p, i * channels, bank, variance, factors)
            p.variance[i] = variance
        _score(p, bins, channels // 3, bank, scores.statistic[first:], scores.cell[first:])
        for i in range(bins):
            state[BINS_SEEN] += 1
            if max(p.best[0, i], p.best[1, i]) > THRESHOLD:
                state[REGION_OPEN], state[QUIET_BINS] = 1, -1
            if state[REGION_OPEN]:
                state[REGION_BINS] += 1
                state[QUIET_BINS] += 1
                if state[QUIET_BINS] >= REGION_END_BINS or state[REGION_BINS] >= MAX_REGION_BINS:
                    variance[:] = p.variance[i]
                    return first + i + 1
    return int(count)
