"""The field of dipoles in the samples of a bar, whitened, and the background that is projected out of data and model.

The background of a channel is its unknown offset, slope and curvature over the stretch. The common mode, what all
sensors of the array read alike, is the earth's field as the car pitches; the share of it that is noise is tracked while
the trace is resampled.

Shapes: S array sensors, K blocks, Q background functions, axes x, y, z of the vehicle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import kernel, routine
from app.decoders.magnet.matched_filter import BIN_M
from app.markers.magnet import FIELD_UT_M3

Floats = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]

PARAMETERS = 6
"""Parameters of a dipole: s, y, h [m] and the moment's x, y, z [A m2]. Source: definition of a point dipole."""

MIN_BLOCK_M, MAX_BLOCK_M = 0.001, 1.0
"""Lengths of a block that its noise counts for. [m] Source: gaps are longer; a vehicle that stands still."""


class FitData(NamedTuple):
    """Whitened samples of a stretch of road.

    Attributes
    ----------
    s_m : ndarray, shape (K,)
        Odometer of the blocks. [m]
    field : ndarray, shape (S, 3, K)
        Field times weight, background and common mode removed. [noise standard deviations]
    weight : ndarray, shape (S, 3, K)
        1 / noise, 0 where a sample is missing. [1/uT]
    delay_m : ndarray, shape (3, K)
        Distance driven between a block's time and the time at which each axis is read. [m]
    positions_m : ndarray, shape (S, 3)
        Sensors: x and z relative to the bar's middle, y from the vehicle's middle. [m]
    basis : ndarray, shape (Q, K)
        Orthonormal background functions.
    common_share : ndarray, shape (3,)
        Share of the common mode that is taken out of each axis.
    """

    s_m: Floats
    field: Floats
    weight: Floats
    delay_m: Floats
    positions_m: Floats
    basis: Floats
    common_share: Floats


class Samples(NamedTuple):
    """Blocks about a region of road, N of them, and their noise.

    Attributes
    ----------
    s_m : ndarray, shape (N,)
        Odometer. [m]
    field_ut : ndarray, shape (S, 3, N)
        [uT]
    good : ndarray, shape (S, N)
        Share of good samples.
    quiet : ndarray, shape (S, 3)
        1 over the noise of each channel in that of its axis.
    common_share : ndarray, shape (3,)
        Share of the common mode that is taken out of each axis.
    """

    s_m: Floats
    field_ut: Floats
    good: Floats
    quiet: Floats
    common_share: Floats


@kernel
def whiten(
    samples: Samples, low: int, high: int, noise_ut: Floats, known: Floats32, degree: int
) -> tuple[Floats, Floats, Floats]:
    """Field and weight (S, 3, K) and basis of a `FitData`, of the blocks low to high less a known field (K, S, 3).

    The noise (3,) is that of bins of road; blocks are shorter.
    """
    sensors, blocks = samples.field_ut.shape[0], high - low
    s = samples.s_m[low:high]
    scale = np.empty(blocks)
    for k in range(blocks):
        before, after = max(k - 1, 0), min(k + 1, blocks - 1)
        length = (s[after] - s[before]) / (after - before)
        scale[k] = math.sqrt(min(max(length, MIN_BLOCK_M), MAX_BLOCK_M) / BIN_M)
    field, weight = np.empty((sensors, 3, blocks)), np.empty((sensors, 3, blocks))
    for j in range(sensors):
        for axis in range(3):
            share = samples.quiet[j, axis] / noise_ut[axis]
            for k in range(blocks):
                w = scale[k] * share * samples.good[j, low + k]
                weight[j, axis, k] = w
                field[j, axis, k] = w * (samples.field_ut[j, axis, low + k] + known[k, j, axis])
    basis = background_basis(s, scale, degree)
    remove_background(field, basis, samples.common_share)
    return field, weight, basis


@routine
def background_basis(s_m: Floats, scale: Floats, degree: int) -> Floats:
    """Orthonormal scale, scale s, scale s2 .. up to the degree (Gram-Schmidt), shape (degree + 1, K)."""
    mid = (s_m[0] + s_m[-1]) / 2
    half = max((s_m[-1] - s_m[0]) / 2, 1e-6)
    basis = np.empty((degree + 1, s_m.size))
    for q in range(degree + 1):
        for k in range(s_m.size):
            basis[q, k] = scale[k] * ((s_m[k] - mid) / half) ** q
        for other in range(q):
            _project_out(basis[q], basis[other])
        norm = 0.0
        for k in range(s_m.size):
            norm += basis[q, k] ** 2
        norm = 1 / math.sqrt(max(norm, 1e-30))
        for k in range(s_m.size):
            basis[q, k] *= norm
    return basis


@routine
def _project_out(row: Floats, unit: Floats) -> None:
    """Take a unit vector's share out of a row, in place."""
    dot = 0.0
    for k in range(row.size):
        dot += unit[k] * row[k]
    for k in range(row.size):
        row[k] -= dot * unit[k]


@routine
def remove_background(field: Floats, basis: Floats, common_share: Floats) -> None:
    """Take the share of the common mode, then the background, out of a field (S, 3, K), in place."""
    sensors, blocks = field.shape[0], field.shape[2]
    mean = np.empty(blocks)
    for axis in range(3):
        if common_share[axis] > 0:
            share = common_share[axis] / sensors
            mean[:] = 0.0
            for j in range(sensors):
                for k in range(blocks):
                    mean[k] += field[j, axis, k]
            for j in range(sensors):
                for k in range(blocks):
                    field[j, axis, k] -= share * mean[k]
        for j in range(sensors):
            for q in range(basis.shape[0]):
                _project_out(field[j, axis], basis[q])


@routine
def dipole_field(dipole: Floats, data: FitData, out: Floats) -> None:
    """Whitened field of a dipole (6,) into out (S, 3, K).

    The component along the unit vector e at the place r from the dipole with moment m (Jackson, Classical
    Electrodynamics, equation 5.56)::

        B_e = mu0 / (4 pi) (3 (e r) (m r) - (e m) r2) / |r|^5
    """
    for j in range(out.shape[0]):
        ahead = data.positions_m[j, 0] - dipole[0]
        y, z = data.positions_m[j, 1] - dipole[1], data.positions_m[j, 2] + dipole[2]
        for axis in range(3):
            # 1 for the axis, 0 for the others: no branches in the loop
            ex, ey, ez = 1.0 * (axis == 0), 1.0 * (axis == 1), 1.0 * (axis == 2)
            em = ex * dipole[3] + ey * dipole[4] + ez * dipole[5]
            weight, delay, field = data.weight[j, axis], data.delay_m[axis], out[j, axis]
            for k in range(field.size):
                x = data.s_m[k] + delay[k] + ahead
                r2 = x * x + y * y + z * z
                f = FIELD_UT_M3 * weight[k] / (r2 * r2 * math.sqrt(r2))
                mr = dipole[3] * x + dipole[4] * y + dipole[5] * z
                field[k] = f * (3 * (ex * x + ey * y + ez * z) * mr - em * r2)


@routine
def dipole_derivatives(dipole: Floats, data: FitData, out: Floats) -> None:
    """Derivatives of `dipole_field` by the six parameters into out (6, S, 3, K)."""
    for j in range(out.shape[1]):
        ahead = data.positions_m[j, 0] - dipole[0]
        y, z = data.positions_m[j, 1] - dipole[1], data.positions_m[j, 2] + dipole[2]
        mx, my, mz = dipole[3], dipole[4], dipole[5]
        for axis in range(3):
            ex, ey, ez = 1.0 * (axis == 0), 1.0 * (axis == 1), 1.0 * (axis == 2)
            em = ex * mx + ey * my + ez * mz
            weight, delay = data.weight[j, axis], data.delay_m[axis]
            by_s, by_y, by_h = out[0, j, axis], out[1, j, axis], out[2, j, axis]
            by_mx, by_my, by_mz = out[3, j, axis], out[4, j, axis], out[5, j, axis]
            for k in range(by_s.size):
                x = data.s_m[k] + delay[k] + ahead
                r2 = x * x + y * y + z * z
                f = FIELD_UT_M3 * weight[k] / (r2 * r2 * math.sqrt(r2))
                mr, er = mx * x + my * y + mz * z, ex * x + ey * y + ez * z
                c = 15 * er * mr / r2 - 3 * em
                by_s[k] = -f * (3 * (er * mx + mr * ex) - c * x)
                by_y[k] = -f * (3 * (er * my + mr * ey) - c * y)
                by_h[k] = f * (3 * (er * mz + mr * ez) - c * z)
                by_mx[k] = f * (3 * er * x - r2 * ex)
                by_my[k] = f * (3 * er * y - r2 * ey)
                by_mz[k] = f * (3 * er * z - r2 * ez)


@kernel
def add_dipole_field(
    dipole: Floats, s_m: Floats, positions_m: Floats, sign: float, common_share: Floats, out: Floats32
) -> None:
    """Add sign times the field of a dipole (6,), less its common mode, to samples out (N, S, 3) at s_m (N,). [uT]"""
    sensors = positions_m.shape[0]
    mean, field = np.empty(3), np.empty((sensors, 3))
    for k in range(s_m.size):
        mean[:] = 0.0
        for j in range(sensors):
            x = s_m[k] + positions_m[j, 0] - dipole[0]
            y, z = positions_m[j, 1] - dipole[1], positions_m[j, 2] + dipole[2]
            r2 = x * x + y * y + z * z
            f = sign * FIELD_UT_M3 / (r2 * math.sqrt(r2))
            along = 3 * (x * dipole[3] + y * dipole[4] + z * dipole[5]) / r2
            field[j, 0] = f * (along * x - dipole[3])
            field[j, 1] = f * (along * y - dipole[4])
            field[j, 2] = f * (along * z - dipole[5])
            for axis in range(3):
                mean[axis] += field[j, axis]
        for j in range(sensors):
            for axis in range(3):
                out[k, j, axis] += field[j, axis] - common_share[axis] * mean[axis] / sensors
