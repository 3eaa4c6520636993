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

from app.decoders.magnet.kernels import entry, exact_step, step
from app.markers.magnet import FIELD_UT_M3

Floats = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int64]

BIN_M = 0.05
"""Length of a bin of road. [m] Source: chosen by hand, a third of the lowest clearance."""
HALF_BINS = 24
"""Bins on each side that the widest filter may use: 1.2 m. Source: 2.3 heights of 0.48 m; chosen by hand for speed."""
REGION_END_BINS = 10
"""Bins below the threshold that end a region: 0.5 m. Source: `app.markers.magnet.MIN_GAP_M`, at which fields part."""
MAX_REGION_BINS = 160
"""Longest region: 8 m. Source: bounds the delay of a streamed trace, `python -m benchmarks.magnets speed`."""
THRESHOLD = 32.0
"""Smallest statistic of a candidate, chi-squared with one degree of freedom: noise alone exceeds it with probability
1.5e-8 for each bin, cell and kind. Source: chi-squared distribution; level chosen by hand, no measurement kept."""
DISTANCES_M = np.array([0.10, 0.145, 0.20, 0.27, 0.36, 0.48, 0.64])
"""D of the kernels, about a factor of 1.36 apart. [m] Source: clearances of 0.15 to 0.35 m (METRO section 7.3) and the
sensors beside the magnet; the step was chosen by hand."""
HEIGHTS_M = np.array([0.11, 0.17, 0.26, 0.38])
"""Clearances of the cells, a factor of 1.5 apart. [m] Source: as `DISTANCES_M`."""
LATERAL_STEP_M = 0.08
"""Distance between cells on the bar. [m] Source: half of METRO's sensor spacing (section 5.1)."""
BEYOND_M = 0.16
"""How far beyond its outermost sensors the bar is searched. [m] Source: METRO's sensor spacing (section 5.1)."""
KERNEL_HEIGHTS, KERNEL_M = 2.3, 0.12
"""Half length of a kernel: times D, and metres more. Source: chosen by hand; an upright magnet's field straight above
the pass has its negative lobe's peak at 2 D."""
CELL_HEIGHTS, CELL_M = 1.6, 0.1
"""Sensors whose filters a cell adds up, across the road: times the clearance, and metres more. Source: chosen by
hand."""
MIN_DEPTH_M = 0.03
"""Least height of a sensor above a cell. [m] Source: chosen by hand; nearer, the field is no point dipole's."""
MEDIAN_CHI2 = 0.455
"""Median of chi-squared with one degree of freedom, 0.4549. Source: chi-squared distribution."""
FAST_BINS, FAST_RATE, SLOW_RATE = 40, 0.4, 0.06
"""The noise is learnt fast over the first bins (2 m), then slowly: change of its logarithm per bin. Source: chosen by
hand, no measurement kept."""


class FilterBank(NamedTuple):
    """Filters of a bar with S array sensors.

    Attributes
    ----------
    kernels : ndarray, shape (3, nD, HALF_BINS + 1)
        A, E0 (even) and E1 (odd), offset or slope removed, for dx >= 0. [uT / (A m2) times powers of m]
    taps : ndarray, shape (nD,)
        Bins on each side that each D uses.
    products : ndarray, shape (nD, 4)
        Inner products <A, A>, <A, E0>, <E0, E0>, <E1, E1> of the kernels.
    distances_m : ndarray, shape (nD,)
        D of the kernels. [m]
    lateral_m, height_m : ndarray, shape (P,)
        Cells: positions on the bar and clearances. [m]
    first : ndarray, shape (P + 1,)
        Where the rows of each cell begin in the arrays below.
    sensor, distance : ndarray of int, shape (R,)
        Array sensor and index of D of each row.
    geometry : ndarray, shape (R, 3)
        Scale, h and dy of each row: its field is that of the kernel's D, so many times as strong. [1, m, m]
    """

    kernels: Floats32
    taps: Integers
    products: Floats32
    distances_m: Floats32
    lateral_m: Floats
    height_m: Floats
    first: Integers
    sensor: Integers
    distance: Integers
    geometry: Floats32


class BinScores(NamedTuple):
    """Scores of N bins, for forward (column 0) and upright magnets (column 1).

    Attributes
    ----------
    statistic : ndarray, shape (N, 2)
        Largest matched-filter statistic over the cells: chi-squared with one degree of freedom without a magnet.
    cell : ndarray of int, shape (N, 2)
        Its cell in the bank.
    """

    statistic: Floats32
    cell: Integers

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
    """Filters for array sensors at positions (S, 3) in vehicle axes; different x are aligned when resampling."""
    kernels, taps, products = _make_kernels()
    y, z = positions_m[:, 1], positions_m[:, 2] - np.median(positions_m[:, 2])
    places = np.arange(y.min() - BEYOND_M, y.max() + BEYOND_M + 1e-9, LATERAL_STEP_M)
    lateral, height, first, sensor, index, geometry = [], [], [0], [], [], []
    for h in HEIGHTS_M:
        for place in places:
            for j in range(len(y)):
                dy, dz = y[j] - place, h + z[j]
                distance = math.hypot(dy, dz)
                if abs(dy) > CELL_HEIGHTS * h + CELL_M or dz < MIN_DEPTH_M:
                    continue
                d = int(np.argmin(np.abs(np.log(DISTANCES_M / distance))))
                k = DISTANCES_M[d] / distance
                sensor.append(j)
                index.append(d)
                geometry.append((k**3, dz * k, dy * k))
            if len(sensor) > first[-1]:
                lateral.append(place)
                height.append(h)
                first.append(len(sensor))
    return FilterBank(
        kernels.astype(np.float32), taps, products.astype(np.float32), DISTANCES_M.astype(np.float32),
        np.array(lateral), np.array(height), np.array(first), np.array(sensor), np.array(index),
        np.array(geometry, np.float32),
    )  # fmt: skip


def _make_kernels() -> tuple[Floats, Integers, Floats]:
    """Kernels, taps and products of a `FilterBank`."""
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
    """Products of the kernels with the channels about a bin; channels are x0 y0 z0 x1 .. of the S sensors."""

    even: Floats32  # (HALF_BINS + 1, 3 S) sums of bins at equal distances ahead and behind
    odd: Floats32  # (HALF_BINS + 1, 3 S) differences of them
    product: Floats32  # (3, nD, 3 S) with A, E0 and E1


@exact_step
def _make_projection(bank: FilterBank, channels: int) -> _Projection:
    half, distances = bank.kernels.shape[2], bank.kernels.shape[1]
    return _Projection(
        np.empty((half, channels), np.float32),
        np.empty((half, channels), np.float32),
        np.empty((3, distances, channels), np.float32),
    )


@step
def _project_bin(x: Floats32, b: int, bank: FilterBank, p: _Projection) -> None:
    """Fold the channels x (bins, 3 S) about bin b, as the kernels are even or odd, and multiply with the kernels."""
    channels, last = x.shape[1], bank.taps[-1]
    for k in range(last + 1):
        for c in range(channels):
            p.even[k, c] = x[b + k, c] + x[b - k, c] if k else x[b, c]
            p.odd[k, c] = x[b + k, c] - x[b - k, c]
    for d in range(bank.kernels.shape[1]):
        for c in range(channels):
            p.product[0, d, c] = 0
            p.product[1, d, c] = 0
            p.product[2, d, c] = 0
        for k in range(bank.taps[d] + 1):
            a, e0, e1 = bank.kernels[0, d, k], bank.kernels[1, d, k], bank.kernels[2, d, k]
            for c in range(channels):
                p.product[0, d, c] += a * p.even[k, c]
                p.product[1, d, c] += e0 * p.even[k, c]
                p.product[2, d, c] += e1 * p.odd[k, c]


@step
def _score_bin(p: _Projection, variance: Floats32, bank: FilterBank, statistic: Floats32, cells: Integers) -> None:
    """Largest statistic b2 / g over the cells and its cell, for forward (0) and upright (1) magnets.

    b sums filter times channel over noise variance (nD, 3), g the squared filters over the variance. With m along x or
    z, the filters of the three axes are, in A, E0, E1 (times scale)::

        forward: 2 A - 3 D2 E0 | 3 dy E1    | 3 h E1
        upright: 3 h E1        | 3 h dy E0  | 3 h2 E0 - A
    """
    inverse, product = 1 / variance, p.product
    statistic[0] = statistic[1] = 0
    cells[0] = cells[1] = 0
    for cell in range(bank.first.size - 1):
        b_x = b_z = g_x = g_z = np.float32(0)
        for row in range(bank.first[cell], bank.first[cell + 1]):
            j, d = 3 * bank.sensor[row], bank.distance[row]
            scale, h, dy = bank.geometry[row, 0], bank.geometry[row, 1], bank.geometry[row, 2]
            ix, iy, iz = inverse[d, 0], inverse[d, 1], inverse[d, 2]
            aa, ae, ee, oo = bank.products[d, 0], bank.products[d, 1], bank.products[d, 2], bank.products[d, 3]
            q = 3 * bank.distances_m[d] * bank.distances_m[d]
            u = 3 * h * h
            f = 3 * dy
            b_x += scale * (
                (2 * product[0, d, j] - q * product[1, d, j]) * ix
                + 3 * h * product[2, d, j + 2] * iz
                + f * product[2, d, j + 1] * iy
            )
            b_z += scale * (
                3 * h * product[2, d, j] * ix
                + (u * product[1, d, j + 2] - product[0, d, j + 2]) * iz
                + f * h * product[1, d, j + 1] * iy
            )
            g_x += scale * scale * ((4 * aa - 4 * q * ae + q * q * ee) * ix + 9 * h * h * oo * iz + f * f * oo * iy)
            g_z += scale * scale * (9 * h * h * oo * ix + (u * u * ee - 2 * u * ae + aa) * iz + f * f * h * h * ee * iy)
        value = b_x * b_x / g_x
        if value > statistic[0]:
            statistic[0], cells[0] = value, cell
        value = b_z * b_z / g_z
        if value > statistic[1]:
            statistic[1], cells[1] = value, cell


@step
def _track_variance(p: _Projection, bank: FilterBank, variance: Floats32, rate: float) -> None:
    """Move each variance (nD, 3) towards the median square of its filters' results: magnets are few, noise is all.

    The share of the results whose square is above the median of chi-squared is one half where the variance is right.
    """
    distances, sensors = variance.shape[0], p.product.shape[2] // 3
    for d in range(distances):
        q = 3 * bank.distances_m[d] * bank.distances_m[d]
        norm_odd = bank.products[d, 3]
        norm_even = 4 * bank.products[d, 0] - 4 * q * bank.products[d, 1] + q * q * bank.products[d, 2]
        for axis in range(3):
            above = 0
            limit = np.float32(MEDIAN_CHI2) * variance[d, axis]
            for j in range(sensors):
                c = 3 * j + axis
                odd = p.product[2, d, c]
                even = 2 * p.product[0, d, c] - q * p.product[1, d, c]
                above += odd * odd > limit * norm_odd
                above += even * even > limit * norm_even
            variance[d, axis] *= math.exp(rate * (above / (2.0 * sensors) - 0.5))


@entry
def score_bins(x: Floats32, start: int, bank: FilterBank, variance: Floats32, scores: BinScores) -> None:
    """Score the bins of x (bins, 3 S) from start on, as many as the scores; each has HALF_BINS neighbours each side."""
    p = _make_projection(bank, x.shape[1])
    for k in range(scores.statistic.shape[0]):
        _project_bin(x, start + k, bank, p)
        _score_bin(p, variance, bank, scores.statistic[k], scores.cell[k])


@entry
def scan_bins(x: Floats32, start: int, bank: FilterBank, variance: Floats32, state: Integers, scores: BinScores) -> int:
    """Score bins and track the noise until a region is complete; returns the number of bins scored.

    variance (nD, 3) and state (4,), see `BINS_SEEN`, are carried on. A region is complete after REGION_END_BINS below
    the threshold, or at MAX_REGION_BINS.
    """
    p = _make_projection(bank, x.shape[1])
    for k in range(scores.statistic.shape[0]):
        _project_bin(x, start + k, bank, p)
        _track_variance(p, bank, variance, FAST_RATE if state[BINS_SEEN] < FAST_BINS else SLOW_RATE)
        state[BINS_SEEN] += 1
        _score_bin(p, variance, bank, scores.statistic[k], scores.cell[k])
        if max(scores.statistic[k, 0], scores.statistic[k, 1]) > THRESHOLD:
            state[REGION_OPEN], state[QUIET_BINS] = 1, -1
        if state[REGION_OPEN]:
            state[REGION_BINS] += 1
            state[QUIET_BINS] += 1
            if state[QUIET_BINS] >= REGION_END_BINS or state[REGION_BINS] >= MAX_REGION_BINS:
                return k + 1
    return int(scores.statistic.shape[0])
