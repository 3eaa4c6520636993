"""Cancel the noise of magnetised wheels: it repeats with each turn, and a reference sensor tells the turns.

A wheel's field at a sensor is a sum of harmonics of its rotation (rotating dipoles in its belt), the same turn after
turn. What a bar sensor and a reference see of it differ in shape and phase, so the reference itself cannot be
subtracted. It gives the length of a turn; the harmonics are then learnt for each channel by least mean squares.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

HARMONICS = 8
_CIRCUMFERENCES_M = np.geomspace(1.55, 2.45, 90)
_BANK_HARMONICS = 4
_BANK_M = 30.0
"""Distance over which the length of a turn is found. [m]"""
_LEARN_M, _FIRST_M = 14.0, 3.0
"""Distance over which harmonics are learnt, in the long run and at first. [m]"""
_BASE_M = 6.0
_PERIODIC = 0.35
"""Share of a reference's signal that repeats with the turns, from which on a wheel counts as noisy."""
_CLIP = 3.0


class WheelCanceller:
    """Takes wheel noise out of blocks, in their order.

    Parameters
    ----------
    references : ndarray of int
        Reference sensors, one for each wheel; without any, nothing is changed.
    sensors : int
        All sensors.
    """

    def __init__(self, references: npt.NDArray[np.intp], sensors: int) -> None:
        self._references = references.astype(np.int64)
        wheels = len(references)
        self._bank = np.zeros((wheels, _CIRCUMFERENCES_M.size, _BANK_HARMONICS, 3), np.complex128)
        self._power = np.zeros((wheels, 3))
        self._phase = np.zeros(wheels)
        self._weights = np.zeros((sensors, 3, wheels * HARMONICS * 2))
        self._base = np.zeros((sensors, 3))
        self._error = np.full((sensors, 3), 3.0)
        self._state = np.zeros(3)  # 1 once begun, last s, distance driven
        self._locked_m = np.zeros(wheels)

    def clean(self, s: Floats, x: Floats) -> None:
        """Take the noise out of blocks at odometers s (N,): x (N, S, 3), in place."""
        if self._references.size and s.size:
            _clean(
                s, x, self._references, _CIRCUMFERENCES_M, self._bank, self._power, self._phase, self._weights,
                self._base, self._error, self._state, self._locked_m,
            )  # fmt: skip


@nb.njit(cache=True, nogil=True, fastmath=True)
def _clean(s, x, references, lengths, bank, power, phase, weights, base, error, state, locked):  # type: ignore[no-untyped-def]
    wheels, sensors = references.size, x.shape[1]
    regressors = np.zeros(weights.shape[2])
    per_wheel = 2 * HARMONICS
    for i in range(s.size):
        if state[0] == 0:
            state[0], state[1] = 1, s[i]
            base[:] = x[i]
            continue
        step = min(max(s[i] - state[1], 0.0), 0.5)
        state[1] = s[i]
        state[2] += step
        if step <= 0:
            continue
        rate = min(step / min(_BASE_M, 0.5 + state[2]), 1.0)
        base += rate * (x[i] - base)
        keep = math.exp(-step / _BANK_M)
        any_locked = False
        for w in range(wheels):
            signal = x[i, references[w]] - base[references[w]]
            for axis in range(3):
                power[w, axis] = keep * power[w, axis] + step * signal[axis] ** 2
            best, at = 0.0, 0
            total = power[w].sum() + 1e-9
            for c in range(lengths.size):
                turn = 2 * math.pi * (s[i] / lengths[c] % 1.0)
                one = complex(math.cos(turn), -math.sin(turn))
                spin = one
                value = 0.0
                for h in range(bank.shape[2]):
                    for axis in range(3):
                        z = keep * bank[w, c, h, axis] + step * signal[axis] * spin
                        bank[w, c, h, axis] = z
                        value += z.real * z.real + z.imag * z.imag
                    spin = spin * one
                if value > best:
                    best, at = value, c
            seen = _BANK_M * (1 - math.exp(-state[2] / _BANK_M)) + 1e-6
            periodic = 2 * best / (seen * total)
            length = lengths[at]
            if 0 < at < lengths.size - 1:
                left = _height(bank[w, at - 1])
                right = _height(bank[w, at + 1])
                bend = left - 2 * best + right
                if bend < 0:
                    shift = 0.5 * (left - right) / bend
                    length *= (lengths[1] / lengths[0]) ** shift
            phase[w] = (phase[w] + 2 * math.pi * step / length) % (2 * math.pi)
            if periodic > _PERIODIC and state[2] > 8 and total / seen > 4.0:
                locked[w] += step
                any_locked = True
            else:
                locked[w] = 0.0
            for h in range(HARMONICS):
                k = w * per_wheel + 2 * h
                regressors[k] = math.cos((h + 1) * phase[w]) if locked[w] > 0 else 0.0
                regressors[k + 1] = math.sin((h + 1) * phase[w]) if locked[w] > 0 else 0.0
        if not any_locked:
            continue
        since = locked.max()
        gain = 2 * step / min(_LEARN_M, _FIRST_M + 0.3 * since)
        share = min(step / 10.0, 1.0)
        for j in range(sensors):
            for axis in range(3):
                told = 0.0
                for k in range(regressors.size):
                    told += weights[j, axis, k] * regressors[k]
                miss = x[i, j, axis] - base[j, axis] - told
                limit = _CLIP * error[j, axis] * (3.0 if since < 6 else 1.0)
                clipped = min(max(miss, -limit), limit)
                error[j, axis] += share * (1.25 * abs(clipped) - error[j, axis])
                for k in range(regressors.size):
                    weights[j, axis, k] += gain * clipped * regressors[k]
                if since > 4:
                    x[i, j, axis] -= told


@nb.njit(cache=True, nogil=True, fastmath=True)
def _height(z):  # type: ignore[no-untyped-def]
    value = 0.0
    for h in range(z.shape[0]):
        for axis in range(3):
            value += z[h, axis].real ** 2 + z[h, axis].imag ** 2
    return value
