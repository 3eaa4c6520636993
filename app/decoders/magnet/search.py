"""Where magnets may be: matched filters for upright and forward dipoles over all sensors and axes.

The field of a dipole along a straight pass is made of three functions of the distance dx (Anderson's functions of
magnetic anomaly detection), with D the shortest distance between the sensor and the magnet:

    A = 1/r3, E0 = 1/r5, E1 = dx/r5, r2 = dx2 + D2

so each channel is filtered with three kernels for a few D, and the filters for every place on the bar, clearance and
moment are sums of the results.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba as nb
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]

BIN_M = 0.05
HALF_BINS = 24
"""Bins on each side that the widest filter needs."""
HOLE_BINS = 10
"""Quiet bins that end a region."""
MAX_BINS = 160
DISTANCES_M = np.array([0.10, 0.145, 0.20, 0.27, 0.36, 0.48, 0.64])
_HEIGHTS_M = np.array([0.11, 0.17, 0.26, 0.38])
_LATERAL_STEP_M = 0.08
_BEYOND_M = 0.16
"""How far beyond its outermost sensors the bar is searched."""


@dataclass(frozen=True, slots=True, eq=False)
class SearchBank:
    """Filters of a bar.

    Attributes
    ----------
    kernels : ndarray, shape (3, nD, HALF_BINS + 1)
        A, E0 (even) and E1 (odd), offset or slope removed, for dx >= 0. [uT / (A m2) times powers of m]
    taps : ndarray, shape (nD,)
        Bins on each side that each D uses.
    products : ndarray, shape (nD, 4)
        <A, A>, <A, E0>, <E0, E0>, <E1, E1>.
    lateral_m, height_m : ndarray, shape (P,)
        Cells: places on the bar and clearances.
    first : ndarray, shape (P + 1,)
        Where the rows of each cell begin in the arrays below.
    sensor, distance : ndarray of int, shape (R,)
        Sensor (of the array's) and index of D.
    geometry : ndarray, shape (R, 4)
        Scale, h, dy, D of each row.
    """

    kernels: Floats32
    taps: npt.NDArray[np.int64]
    products: Floats32
    lateral_m: Floats
    height_m: Floats
    first: npt.NDArray[np.int64]
    sensor: npt.NDArray[np.int64]
    distance: npt.NDArray[np.int64]
    geometry: Floats32


def make_search_bank(positions_m: Floats) -> SearchBank:
    """Filters for array sensors at positions (S, 3) in vehicle axes; the along-track places are handled elsewhere."""
    kernels = np.zeros((3, DISTANCES_M.size, HALF_BINS + 1))
    taps = np.minimum(np.ceil((2.3 * DISTANCES_M + 0.12) / BIN_M).astype(np.int64), HALF_BINS)
    products = np.zeros((DISTANCES_M.size, 4))
    for d, (distance, n) in enumerate(zip(DISTANCES_M, taps, strict=True)):
        dx = np.arange(-n, n + 1) * BIN_M
        r = np.sqrt(dx * dx + distance * distance)
        a, e0, e1 = 0.1 / r**3, 0.1 / r**5, 0.1 * dx / r**5
        a, e0, e1 = a - a.mean(), e0 - e0.mean(), e1 - dx * (e1 @ dx) / (dx @ dx)
        kernels[:, d, : n + 1] = np.stack([a, e0, e1])[:, n:]
        products[d] = a @ a, a @ e0, e0 @ e0, e1 @ e1
    y, z = positions_m[:, 1], positions_m[:, 2] - np.median(positions_m[:, 2])
    places = np.arange(y.min() - _BEYOND_M, y.max() + _BEYOND_M + 1e-9, _LATERAL_STEP_M)
    lateral, height, first, sensor, index, geometry = [], [], [0], [], [], []
    for h in _HEIGHTS_M:
        for place in places:
            for j in range(len(y)):
                dy, dz = y[j] - place, h + z[j]
                distance = math.hypot(dy, dz)
                if abs(dy) > 1.6 * h + 0.1 or dz < 0.03:
                    continue
                d = int(np.argmin(np.abs(np.log(DISTANCES_M / distance))))
                k = DISTANCES_M[d] / distance
                sensor.append(j)
                index.append(d)
                geometry.append((k**3, dz * k, dy * k, DISTANCES_M[d]))
            if len(sensor) > first[-1]:
                lateral.append(place)
                height.append(h)
                first.append(len(sensor))
    return SearchBank(
        kernels.astype(np.float32), taps, products.astype(np.float32), np.array(lateral), np.array(height),
        np.array(first), np.array(sensor), np.array(index), np.array(geometry, np.float32),
    )  # fmt: skip


@nb.njit(cache=True, nogil=True, fastmath=True)
def project_bin(x, b, kernels, taps, even, odd, out):  # type: ignore[no-untyped-def]
    """out (3, nD, C): products of the kernels with the channels x (bins, C) about bin b."""
    n_d, channels = kernels.shape[1], x.shape[1]
    for k in range(taps.max() + 1):
        for c in range(channels):
            even[k, c] = x[b + k, c] + x[b - k, c] if k else x[b, c]
            odd[k, c] = x[b + k, c] - x[b - k, c]
    for d in range(n_d):
        for c in range(channels):
            out[0, d, c] = 0
            out[1, d, c] = 0
            out[2, d, c] = 0
        for k in range(taps[d] + 1):
            a, e0, e1 = kernels[0, d, k], kernels[1, d, k], kernels[2, d, k]
            for c in range(channels):
                out[0, d, c] += a * even[k, c]
                out[1, d, c] += e0 * even[k, c]
                out[2, d, c] += e1 * odd[k, c]


@nb.njit(cache=True, nogil=True, fastmath=True)
def best_cells(p, variance, products, first, sensor, distance, geometry, score, cells):  # type: ignore[no-untyped-def]
    """Largest statistic over the cells and the cell, for forward (0) and for upright magnets (1).

    Each statistic is chi-squared with one degree of freedom where there is no magnet.

    p (3, nD, 3 S): of `project_bin`, channels x0 y0 z0 x1 ...; variance (nD, 3).
    """
    inverse = 1 / variance
    score[0] = score[1] = 0
    cells[0] = cells[1] = 0
    for cell in range(first.size - 1):
        b_x = b_z = g_x = g_z = np.float32(0)
        for row in range(first[cell], first[cell + 1]):
            j, d = 3 * sensor[row], distance[row]
            scale, h, dy, dist = geometry[row, 0], geometry[row, 1], geometry[row, 2], geometry[row, 3]
            ix, iy, iz = inverse[d, 0], inverse[d, 1], inverse[d, 2]
            aa, ae, ee, oo = products[d, 0], products[d, 1], products[d, 2], products[d, 3]
            q = 3 * dist * dist
            u = 3 * h * h
            f = 3 * dy
            b_x += scale * (
                (2 * p[0, d, j] - q * p[1, d, j]) * ix + 3 * h * p[2, d, j + 2] * iz + f * p[2, d, j + 1] * iy
            )
            b_z += scale * (
                3 * h * p[2, d, j] * ix + (u * p[1, d, j + 2] - p[0, d, j + 2]) * iz + f * h * p[1, d, j + 1] * iy
            )
            g_x += scale * scale * ((4 * aa - 4 * q * ae + q * q * ee) * ix + 9 * h * h * oo * iz + f * f * oo * iy)
            g_z += scale * scale * (9 * h * h * oo * ix + (u * u * ee - 2 * u * ae + aa) * iz + f * f * h * h * ee * iy)
        value = b_x * b_x / g_x
        if value > score[0]:
            score[0], cells[0] = value, cell
        value = b_z * b_z / g_z
        if value > score[1]:
            score[1], cells[1] = value, cell


@nb.njit(cache=True, nogil=True, fastmath=True)
def track_variance(p, products, variance, rate):  # type: ignore[no-untyped-def]
    """Move each variance (nD, 3) towards the median square of what its filters give: magnets are few, noise is all."""
    n_d, sensors = variance.shape[0], p.shape[2] // 3
    for d in range(n_d):
        q = 3 * _D2[d]
        norm_odd = products[d, 3]
        norm_even = 4 * products[d, 0] - 4 * q * products[d, 1] + q * q * products[d, 2]
        for axis in range(3):
            above = 0
            limit = np.float32(0.455) * variance[d, axis]
            for j in range(sensors):
                c = 3 * j + axis
                even = 2 * p[0, d, c] - q * p[1, d, c]
                above += p[2, d, c] * p[2, d, c] > limit * norm_odd
                above += even * even > limit * norm_even
            variance[d, axis] *= math.exp(rate * (above / (2.0 * sensors) - 0.5))


_D2 = (DISTANCES_M**2).astype(np.float32)


@nb.njit(cache=True, nogil=True, fastmath=True)
def search_bins(x, start, stop, kernels, taps, products, first, sensor, distance, geometry, variance, score, cell):  # type: ignore[no-untyped-def]
    """Score bins start..stop of x (bins, 3 S), each with HALF_BINS neighbours on both sides."""
    n_d = taps.size
    even = np.empty((taps.max() + 1, x.shape[1]), np.float32)
    odd = np.empty_like(even)
    p = np.empty((3, n_d, x.shape[1]), np.float32)
    for b in range(start, stop):
        project_bin(x, b, kernels, taps, even, odd, p)
        k = b - start
        best_cells(p, variance, products, first, sensor, distance, geometry, score[k], cell[k])


@nb.njit(cache=True, nogil=True, fastmath=True)
def scan_bins(  # type: ignore[no-untyped-def]
    x, start, stop, kernels, taps, products, first, sensor, distance, geometry, variance, state, threshold, score, cell
):
    """Like `search_bins` while the noise is learnt, until a region is complete; returns the number of bins scored.

    variance (nD, 3) is carried on. state (4,): bins seen so far, 1 in an open region, its bins, its bins since one
    was above the threshold. A region is complete after HOLE_BINS below it, or at MAX_BINS.
    """
    even = np.empty((taps.max() + 1, x.shape[1]), np.float32)
    odd = np.empty_like(even)
    p = np.empty((3, taps.size, x.shape[1]), np.float32)
    for b in range(start, stop):
        project_bin(x, b, kernels, taps, even, odd, p)
        track_variance(p, products, variance, 0.4 if state[0] < 40 else 0.06)
        state[0] += 1
        k = b - start
        best_cells(p, variance, products, first, sensor, distance, geometry, score[k], cell[k])
        if max(score[k, 0], score[k, 1]) > threshold:
            state[1] = 1
            state[3] = -1
        if state[1]:
            state[2] += 1
            state[3] += 1
            if state[3] >= HOLE_BINS or state[2] >= MAX_BINS:
                return b - start + 1
    return stop - start
