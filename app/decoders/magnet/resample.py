"""Blocks resampled to bins of equal length along the road, the common mode of all sensors removed."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel, ieee_routine
from app.decoders.magnet.matched_filter import BIN_M

Floats = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int64]

LAG_BINS = 8
"""Bins on each side of the second difference (the bend) by which noise is measured: 40 cm. Source: chosen by hand,
longer than a magnet's pulse at METRO's clearance."""
NOISE_RATE = 0.01
"""Share of a bin in the running mean squares: 5 m of road. Source: chosen by hand, no measurement kept."""
CLIP_VARIANCES = 9.0
"""Squares count up to so many variances, three standard deviations: magnets are no noise. Source: chosen by hand."""
OWN_NOISE_FACTOR = 1.5
"""The common mode's mean square must exceed so many times what the sensors' own noise gives. Source: chosen by hand."""
QUIET_RATIO = 0.5
"""A channel is noisier than the others from twice the median on; less is chance, or the magnets. Source: by hand."""
MIN_VARIANCE = 1e-9
"""Keeps ratios of variances finite. [uT2] Source: chosen by hand, far below a chip's noise."""
GROWTH_BINS, FORGET_BINS = 256, 400
"""Bins by which the arrays grow, and after which old ones are dropped. Source: chosen by hand, speed only."""


class _Bins(NamedTuple):
    """Arrays of N bins, A array sensors."""

    x: Floats32  # (N, 3 A) field without common mode, channels x0 y0 z0 x1 .. [uT]
    common_share: Floats  # (N, 3) share of the common mode that was taken out
    loudness: Floats32  # (N, A, 3) variance of each channel over the median of its axis, 1 or more


class _Noise(NamedTuple):
    """Running mean squares of the bends."""

    common: Floats  # (3,) of the mean of all sensors [uT2]
    own: Floats  # (3,) of the sensors about that mean
    channel: Floats  # (A, 3) of each channel about that mean
    recent: Floats  # (2 LAG_BINS + 1, A, 3) the newest bins [uT]
    sorted: Floats  # (A,) work space of the median


class _OpenBin(NamedTuple):
    """Blocks of the bin that is being filled."""

    total: Floats  # (A, 3) sum of its blocks [uT]
    previous: Floats  # (A, 3) the newest block [uT]
    state: Floats  # (4,): number of the bin, blocks in it, s of the newest block, 1 once begun


class FieldBins:
    """Bins not yet forgotten; the first has the number `start`, and `ready` of them are complete."""

    def __init__(self, positions_m: Floats) -> None:
        sensors = len(positions_m)
        self.shift: Integers = np.round((positions_m[:, 0] - positions_m[:, 0].min()) / BIN_M).astype(np.int64)
        self.start = 0
        self.ready = 0
        self._bins = _empty_bins(int(self.shift.max()) + 1, sensors)
        self._noise = _Noise(
            np.ones(3), np.ones(3), np.ones((sensors, 3)), np.zeros((2 * LAG_BINS + 1, sensors, 3)), np.empty(sensors)
        )
        self._open = _OpenBin(np.zeros((sensors, 3)), np.zeros((sensors, 3)), np.zeros(4))

    @property
    def x(self) -> Floats32:
        """Field of the bins, shape (N, 3 A). [uT]"""
        return self._bins.x

    @property
    def common_share(self) -> Floats:
        """Share of the common mode that was taken out of each bin, shape (N, 3)."""
        return self._bins.common_share

    @property
    def loudness(self) -> Floats32:
        """Variance of each channel over the median of its axis, 1 or more, shape (N, A, 3)."""
        return self._bins.loudness

    def append(self, s: Floats, x: Floats) -> None:
        """Add blocks (N,), (N, A, 3)."""
        if not s.size:
            return
        need = max(math.floor(s[-1] / BIN_M), 0) - self.start + int(self.shift.max()) + 2
        if need > len(self.x):
            grown = _empty_bins(need + GROWTH_BINS, x.shape[1])
            count = len(self.x)
            grown.x[:count] = self._bins.x
            grown.common_share[:count] = self._bins.common_share
            grown.loudness[:count] = self._bins.loudness
            self._bins = grown
        self.ready = _bin_blocks(s, x, self.shift, self.start, self._bins, self._noise, self._open) - self.start

    def forget(self, before: int) -> None:
        """Drop bins before a number, in large pieces."""
        n = min(before - self.start, self.ready)
        if n > FORGET_BINS:
            self._bins = _Bins(self.x[n:].copy(), self.common_share[n:].copy(), self.loudness[n:].copy())
            self.start += n
            self.ready -= n


def _empty_bins(count: int, sensors: int) -> _Bins:
    return _Bins(
        np.zeros((count, 3 * sensors), np.float32), np.zeros((count, 3)), np.ones((count, sensors, 3), np.float32)
    )


@ieee_routine
def _median(values: Floats) -> float:
    """Median of values, which are sorted in place (np.median takes two seconds to compile)."""
    n = values.size
    for i in range(1, n):
        value, k = values[i], i
        while k > 0 and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value
    return float((values[(n - 1) // 2] + values[n // 2]) / 2)


@ieee_routine
def _bend(recent: Floats, sensor: int, axis: int) -> float:
    """Second difference of a channel over 2 LAG_BINS. [uT]"""
    return float(recent[LAG_BINS, sensor, axis] - (recent[0, sensor, axis] + recent[-1, sensor, axis]) / 2)


@ieee_routine
def _track_noise(axis: int, noise: _Noise) -> float:
    """Renew the mean squares of an axis; returns the share of the common mode that is noise of all sensors alike."""
    sensors = noise.channel.shape[0]
    mean = 0.0
    for j in range(sensors):
        mean += _bend(noise.recent, j, axis)
    mean /= sensors
    own = 0.0
    for j in range(sensors):
        square = (_bend(noise.recent, j, axis) - mean) ** 2
        own += min(square, CLIP_VARIANCES * noise.own[axis])
        channel = noise.channel[j, axis]
        noise.channel[j, axis] += NOISE_RATE * (min(square, CLIP_VARIANCES * channel) - channel)
    own /= sensors - 1
    noise.own[axis] += NOISE_RATE * (own - noise.own[axis])
    common = noise.common[axis]
    noise.common[axis] += NOISE_RATE * (min(mean * mean, CLIP_VARIANCES * common) - common)
    alone = noise.own[axis] / sensors
    return float(max(0.0, 1 - OWN_NOISE_FACTOR * alone / max(noise.common[axis], MIN_VARIANCE)))


@ieee_routine
def _write_bin(at: int, value: Floats, shift: Integers, bins: _Bins, noise: _Noise) -> None:
    """Write one bin (A, 3), its common mode removed; sensors further ahead go into later bins."""
    sensors = value.shape[0]
    for k in range(noise.recent.shape[0] - 1):
        for j in range(sensors):
            for axis in range(3):
                noise.recent[k, j, axis] = noise.recent[k + 1, j, axis]
    for j in range(sensors):
        for axis in range(3):
            noise.recent[-1, j, axis] = value[j, axis]
    for axis in range(3):
        share = _track_noise(axis, noise)
        for j in range(sensors):
            noise.sorted[j] = noise.channel[j, axis]
        median = max(_median(noise.sorted), MIN_VARIANCE)
        mean = 0.0
        for j in range(sensors):
            bins.loudness[at, j, axis] = max(1.0, QUIET_RATIO * noise.channel[j, axis] / median)
            mean += value[j, axis]
        mean *= share / sensors
        bins.common_share[at, axis] = share
        for j in range(sensors):
            bins.x[at + shift[j], 3 * j + axis] = value[j, axis] - mean


@ieee_routine
def _begin(number: int, s: float, block: Floats, noise: _Noise, opened: _OpenBin) -> None:
    """Open the first bin; the bins before it are taken to be like its first block."""
    opened.state[0], opened.state[2], opened.state[3] = number, s, 1.0
    for j in range(block.shape[0]):
        for axis in range(3):
            opened.previous[j, axis] = block[j, axis]
            for k in range(noise.recent.shape[0]):
                noise.recent[k, j, axis] = block[j, axis]


@ieee_routine
def _set_value(s: float, block: Floats, opened: _OpenBin, value: Floats) -> None:
    """Value of the open bin: the mean of two or more blocks, else interpolated to its middle."""
    middle = (opened.state[0] + 0.5) * BIN_M
    u = min(max((middle - opened.state[2]) / max(s - opened.state[2], 1e-9), 0.0), 1.0)
    for j in range(block.shape[0]):
        for axis in range(3):
            if opened.state[1] >= 2:
                value[j, axis] = opened.total[j, axis] / opened.state[1]
            else:
                before = opened.previous[j, axis]
                value[j, axis] = before + u * (block[j, axis] - before)


@ieee_kernel
def _bin_blocks(
    s: Floats, blocks: Floats, shift: Integers, start: int, bins: _Bins, noise: _Noise, opened: _OpenBin
) -> int:
    """Fill bins from blocks (N, A, 3) at s (N,); `bins` begin at the number `start`. Returns the open bin's number."""
    sensors = blocks.shape[1]
    value = np.empty((sensors, 3))
    for i in range(s.size):
        number = int(s[i] / BIN_M)
        if opened.state[3] == 0:
            _begin(number, s[i], blocks[i], noise, opened)
        while opened.state[0] < number:
            _set_value(s[i], blocks[i], opened, value)
            _write_bin(int(opened.state[0]) - start, value, shift, bins, noise)
            opened.state[0] += 1
            opened.state[1] = 0
            opened.total[:] = 0.0
        opened.state[1] += 1
        opened.state[2] = s[i]
        for j in range(sensors):
            for axis in range(3):
                opened.total[j, axis] += blocks[i, j, axis]
                opened.previous[j, axis] = blocks[i, j, axis]
    return int(opened.state[0])
