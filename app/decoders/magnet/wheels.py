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
_CIRCUMFERENCES_M = np.geomspace(1.6, 2.4, 64)
_BANK_HARMONICS = 3
_BANK_M = 30.0
"""Distance over which the length of a turn is found. [m]"""
_RENEW_M = 0.1
"""Distance after which the bank is renewed. [m]"""
_LEARN_M, _FIRST_M = 25.0, 3.0
"""Distance over which harmonics are learnt, in the long run and at first. [m]"""
_BASE_M = 6.0
_PERIODIC = 0.2
"""Share of a reference's signal that repeats with the turns, from which on a wheel counts as noisy."""
_CLIP = 3.0
_WORTH = 0.1
"""Strength of the noise, as a share of the rest's variance, at which half of it is taken out."""
_ODD = 3
"""So many channels off by more than `_CLIP` deviations: a magnet or iron, nothing to learn from."""


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
        self._pending = np.zeros((wheels, 4))  # distance and signal since the bank was renewed
        self._length = np.full((wheels, 2), 2.0)  # of a turn [m], share of the signal that repeats with it
        self._weights = np.zeros((sensors, 3, wheels * HARMONICS * 2))
        self._base = np.zeros((sensors, 3))
        self._error = np.full((sensors, 3), 3.0)
        self._strength = np.zeros((sensors, 3))
        self._state = np.zeros(3)  # 1 once begun, last s, distance driven
        self._locked_m = np.zeros(wheels)

    def clean(self, s: Floats, x: Floats) -> None:
        """Take the noise out of blocks at odometers s (N,): x (N, S, 3), in place."""
        if self._references.size and s.size:
            _clean(
                s, x, self._references, _CIRCUMFERENCES_M, self._bank, self._power, self._phase, self._pending,
                self._length, self._weights,
                self._base, self._error, self._strength, self._state, self._locked_m,
            )  # fmt: skip


@nb.njit(cache=True, nogil=True, fastmath=True)
def _clean(  # type: ignore[no-untyped-def]
    s, x, references, lengths, bank, power, phase, pending, length, weights, base, error, strength, state, locked
):
    wheels, sensors = references.size, x.shape[1]
    regressors = np.zeros(weights.shape[2])
    miss = np.empty((sensors, 3))
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
        any_locked = False
        seen = _BANK_M * (1 - math.exp(-state[2] / _BANK_M)) + 1e-6
        for w in range(wheels):
            pending[w, 0] += step
            pending[w, 1:] += step * (x[i, references[w]] - base[references[w]])
            if pending[w, 0] > _RENEW_M:
                _renew(s[i] - pending[w, 0] / 2, pending[w], lengths, bank[w], power[w], length[w], seen)
                pending[w] = 0
            phase[w] = (phase[w] + 2 * math.pi * step / length[w, 0]) % (2 * math.pi)
            if length[w, 1] > _PERIODIC and state[2] > 8:
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
        fade = min(max((since - 3) / 8, 0.0), 1.0)
        odd = 0
        for j in range(sensors):
            for axis in range(3):
                told = 0.0
                for k in range(regressors.size):
                    told += weights[j, axis, k] * regressors[k]
                miss[j, axis] = x[i, j, axis] - base[j, axis] - told
                odd += abs(miss[j, axis]) > _CLIP * error[j, axis]
                strength[j, axis] += share * (told * told - strength[j, axis])
                ratio = strength[j, axis] / (error[j, axis] ** 2 + 1e-6)
                x[i, j, axis] -= fade * told * ratio / (ratio + _WORTH)
        magnet = odd >= _ODD and since > 8
        share *= 0.1 if magnet else 1.0
        for j in range(sensors):
            for axis in range(3):
                limit = _CLIP * error[j, axis] * (3.0 if since < 6 else 1.0)
                clipped = min(max(miss[j, axis], -limit), limit)
                error[j, axis] += share * (1.25 * abs(clipped) - error[j, axis])
                if not magnet:
                    ratio = min(strength[j, axis] / (error[j, axis] ** 2 + 1e-6), 2.0)
                    for k in range(regressors.size):
                        weights[j, axis, k] += gain * (1 + ratio) * clipped * regressors[k]


@nb.njit(cache=True, nogil=True, fastmath=True)
def _renew(s, pending, lengths, bank, power, length, seen):  # type: ignore[no-untyped-def]
    """Add a piece of a reference's signal to the bank, and find the length of a turn in it."""
    step = pending[0]
    keep = math.exp(-step / _BANK_M)
    total = 1e-9
    for axis in range(3):
        power[axis] = keep * power[axis] + pending[1 + axis] ** 2 / step
        total += power[axis]
    best, at = 0.0, 0
    for c in range(lengths.size):
        turn = 2 * math.pi * (s / lengths[c] % 1.0)
        one = complex(math.cos(turn), -math.sin(turn))
        spin = one
        value = 0.0
        for h in range(bank.shape[1]):
            for axis in range(3):
                z = keep * bank[c, h, axis] + pending[1 + axis] * spin
                bank[c, h, axis] = z
                value += z.real * z.real + z.imag * z.imag
            spin = spin * one
        if value > best:
            best, at = value, c
    length[0] = lengths[at]
    length[1] = 2 * best / (seen * total) if total / seen > 4.0 else 0.0
    if 0 < at < lengths.size - 1:
        left, right = _height(bank[at - 1]), _height(bank[at + 1])
        bend = left - 2 * best + right
        if bend < 0:
            length[0] *= (lengths[1] / lengths[0]) ** (0.5 * (left - right) / bend)


@nb.njit(cache=True, nogil=True, fastmath=True)
def _height(z):  # type: ignore[no-untyped-def]
    value = 0.0
    for h in range(z.shape[0]):
        for axis in range(3):
            value += z[h, axis].real ** 2 + z[h, axis].imag ** 2
    return value
