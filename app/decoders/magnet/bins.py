"""Blocks on an even grid along the road, with what all sensors have in common taken out."""

from __future__ import annotations

import math

import numba as nb
import numpy as np
import numpy.typing as npt

from app.decoders.magnet.search import BIN_M

_LAG = 8
"""Bins on each side for the bend that tells common noise from single noise: 40 cm."""


class Bins:
    """Bins not yet forgotten: x (N, 3 A) float32 for the A array sensors; the first has the number `start`."""

    def __init__(self, positions_m: npt.NDArray[np.float64]) -> None:
        sensors = len(positions_m)
        ahead = np.round((positions_m[:, 0] - positions_m[:, 0].min()) / BIN_M).astype(np.int64)
        self.shift = ahead
        self.start = 0
        self.ready = 0
        """Bins from `start` that are complete."""
        self.x = np.zeros((int(ahead.max()) + 1, 3 * sensors), np.float32)
        self.alpha = np.zeros((len(self.x), 3))
        """Share of the common signal that was taken out of each bin."""
        self._common = np.array([[1.0, 1.0]] * 3)  # mean squares of the common bend and of the rest
        self.loudness = np.ones((len(self.x), sensors, 3), np.float32)
        """Variance of each channel against the others of its axis, 1 or more."""
        self._channel = np.ones((sensors, 3))
        self._sum = np.zeros((sensors, 3))
        self._state = np.zeros(4)  # number of the open bin, blocks in it, previous block's s, 1 once begun
        self._previous = np.zeros((sensors, 3))
        self._recent = np.zeros((2 * _LAG + 1, sensors, 3))

    def append(self, s: npt.NDArray[np.float64], x: npt.NDArray[np.float64]) -> None:
        """Add blocks (N,), (N, A, 3)."""
        if not s.size:
            return
        last = max(math.floor(s[-1] / BIN_M), 0)
        need = last - self.start + int(self.shift.max()) + 2
        if need > len(self.x):
            grown = np.zeros((need + 256, self.x.shape[1]), np.float32)
            grown[: len(self.x)] = self.x
            self.x = grown
            alpha = np.zeros((len(grown), 3))
            alpha[: len(self.alpha)] = self.alpha
            self.alpha = alpha
            loudness = np.ones((len(grown), *self.loudness.shape[1:]), np.float32)
            loudness[: len(self.loudness)] = self.loudness
            self.loudness = loudness
        done = _bin_blocks(
            s, x, self.shift, self.x, self.start, self.alpha, self.loudness, self._channel, self._common, self._sum,
            self._state, self._previous, self._recent,
        )  # fmt: skip
        self.ready = int(done) - self.start

    def forget(self, before: int) -> None:
        """Drop bins before a number, in large pieces."""
        n = min(before - self.start, self.ready)
        if n > 400:
            self.x, self.alpha = self.x[n:].copy(), self.alpha[n:].copy()
            self.loudness = self.loudness[n:].copy()
            self.start += n
            self.ready -= n


@nb.njit(cache=True, nogil=True)
def _write(number, value, shift, x, start, alpha, loudness, channel, common, recent):  # type: ignore[no-untyped-def]
    """One bin: track how much of the noise is common, take that share out, store."""
    sensors = value.shape[0]
    for k in range(recent.shape[0] - 1):
        recent[k] = recent[k + 1]
    recent[-1] = value
    for axis in range(3):
        mean_bend = 0.0
        for j in range(sensors):
            mean_bend += recent[_LAG, j, axis] - (recent[0, j, axis] + recent[-1, j, axis]) / 2
        mean_bend /= sensors
        rest = 0.0
        for j in range(sensors):
            bend = recent[_LAG, j, axis] - (recent[0, j, axis] + recent[-1, j, axis]) / 2 - mean_bend
            rest += min(bend * bend, 9 * common[axis, 1])
            channel[j, axis] += 0.01 * (min(bend * bend, 9 * channel[j, axis]) - channel[j, axis])
        rest /= sensors - 1
        usual = np.median(channel[:, axis])
        for j in range(sensors):
            # up to twice the usual is chance, or the magnets themselves
            loudness[number - start, j, axis] = max(1.0, 0.5 * channel[j, axis] / max(usual, 1e-9))
        common[axis, 1] += 0.01 * (rest - common[axis, 1])
        common[axis, 0] += 0.01 * (min(mean_bend * mean_bend, 9 * common[axis, 0]) - common[axis, 0])
        alone = common[axis, 1] / sensors
        share = max(0.0, 1 - 1.5 * alone / max(common[axis, 0], 1e-9))
        mean = 0.0
        for j in range(sensors):
            mean += value[j, axis]
        mean *= share / sensors
        alpha[number - start, axis] = share
        for j in range(sensors):
            x[number - start + shift[j], 3 * j + axis] = value[j, axis] - mean


@nb.njit(cache=True, nogil=True)
def _bin_blocks(s, blocks, shift, x, start, alpha, loudness, channel, common, total, state, previous, recent):  # type: ignore[no-untyped-def]
    """Fill bins from blocks: the mean of two or more, else interpolated; returns the next bin's number."""
    for i in range(s.size):
        number = int(s[i] / BIN_M)
        if state[3] == 0:
            state[0], state[2], state[3] = number, s[i], 1
            previous[:] = blocks[i]
            for k in range(recent.shape[0]):
                recent[k] = blocks[i]
        while state[0] < number:
            middle = (state[0] + 0.5) * BIN_M
            if state[1] >= 2:
                value = total / state[1]
            else:
                u = min(max((middle - state[2]) / max(s[i] - state[2], 1e-9), 0.0), 1.0)
                value = previous + u * (blocks[i] - previous)
            _write(int(state[0]), value, shift, x, start, alpha, loudness, channel, common, recent)
            state[0] += 1
            state[1] = 0
            total[:] = 0
        state[1] += 1
        total += blocks[i]
        state[2] = s[i]
        previous[:] = blocks[i]
    return int(state[0])
