"""From samples to blocks along the road: faulty samples replaced, time turned into distance.

A sample is faulty if it is outside the chip's range, repeats the sample before, or is a spike: off by itself while the
samples before and after it, and its neighbours on the bar, agree. It is replaced by interpolation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel, ieee_routine
from app.decoders.magnet.matched_filter import BIN_M
from app.decoders.magnet.readings import NoiseFinding, NoiseKind
from app.errors import InvalidParameter
from app.sensors.magnetometer_bar import MAX_FIELD_UT, MagnetometerBar, MagnetTrace, SensorRole
from app.values import Bools, Floats, Floats32, Ints

BLOCK_M = 0.02
"""Samples nearer to each other than this are averaged. [m] Less than half a bin
(`app.decoders.magnet.matched_filter.BIN_M`)."""
MIN_GAP_S = 0.1
"""A longer interval between samples is reported as a gap. [s] 35 samples of METRO's 350 Hz."""
MAX_GAP_M = 10.0
"""Most distance that is counted over a gap. [m]"""
MAX_INTERPOLATION_S = 1.0
"""A speed is interpolated between values at most so far apart, else the last one is kept. [s] Ten values of METRO's CAN
bus (section 7.1: 10 Hz)."""
MAX_HEADING_INTERPOLATION_S = 3.0
"""The same for headings. [s] Three values of a receiver at 1 Hz."""
MIN_SPIKE_UT = 25.0
"""Smallest deviation of a spike from the samples around it. [uT]"""
SPIKE_RATIO = 4.0
"""A spike deviates so many times as much as its neighbours on the bar."""
MIN_NEIGHBOUR_UT = 4.0
"""Deviation that is assumed of neighbours that deviate less. [uT] 2 to 3 times a chip's noise."""
SPIKE_MISMATCH, SPIKE_NOISE_UT = 0.15, 3.0
"""A single outlier bends the sample before it by minus half of its own deviation. The difference may be this share, or
this much. [1, uT] Source: the second difference."""
SURE_SPIKE_UT, SURE_MISMATCH, SURE_NOISE_UT = 60.0, 0.05, 6.0
"""The same for spikes that are accepted whatever their neighbours do. [uT, 1, uT] A magnet at 30 m/s must remain
(`tests/decoders/magnet/test_preprocess.py`)."""
NEIGHBOUR_REACH_M = 0.25
"""Farthest neighbour on the bar. [m] Source: METRO's spacing of 16 cm (section 5.1), with room for other bars."""
AHEAD = 2
"""Samples that are looked at ahead: the next one may be faulty."""
FORGET_BLOCKS = 400
"""Blocks after which old ones are dropped. Speed only."""


class Blocks:
    """Averages of neighbouring samples, those not yet forgotten.

    Odometer s (N,) [m], time t (N,) [s], speed v (N,) [m/s], yaw (N,) [rad, anticlockwise from north, unwrapped; 0
    without headings], field x (N, S, 3) [uT], share of good samples w (N, S).
    """

    def __init__(self, sensors: int) -> None:
        self.s = np.empty(0)
        self.t = np.empty(0)
        self.v = np.empty(0)
        self.yaw = np.empty(0)
        self.x = np.empty((0, sensors, 3))
        self.w = np.empty((0, sensors))

    def append(self, drive: Floats, x: Floats, w: Floats) -> None:
        """Add blocks at the end: drive (N, 4) has odometer, time, speed and yaw."""
        old = (self.s, self.t, self.v, self.yaw)
        self.s, self.t, self.v, self.yaw = (np.concatenate(p) for p in zip(old, drive.T, strict=True))
        self.x, self.w = np.concatenate((self.x, x)), np.concatenate((self.w, w))

    def forget(self, before_m: float) -> None:
        """Drop what lies before a distance, in large pieces."""
        n = int(np.searchsorted(self.s, before_m))
        if n > FORGET_BLOCKS:
            self.s, self.t, self.v, self.yaw = (a[n:].copy() for a in (self.s, self.t, self.v, self.yaw))
            self.x, self.w = self.x[n:].copy(), self.w[n:].copy()


class Preprocessor:
    """Replaces faulty samples, integrates the speed and averages samples to blocks; the same for any chunking."""

    def __init__(self, bar: MagnetometerBar) -> None:
        self._bar = bar
        n = bar.sensor_count
        self._t = np.empty(0)
        self._x = np.empty((0, n, 3))
        self._speed_t = np.empty(0)
        self._speed = np.empty(0)
        self._yaw_t = np.empty(0)
        self._yaw = np.empty(0)  # [rad] anticlockwise, unwrapped
        self._has_headings = False
        self._last: tuple[float, float, float] | None = None  # time, speed and odometer of the newest sample used
        self._repair = _Repair(
            np.full((n, 3), np.nan), np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3)), _neighbours(bar)
        )
        self._open = _OpenBlock(np.zeros((n, 3)), np.zeros(n), np.zeros(6))
        self.findings: list[NoiseFinding] = []

    def feed(self, chunk: MagnetTrace) -> None:
        """Take a piece of the trace."""
        if chunk.field_ut.shape[1] != self._bar.sensor_count:
            raise InvalidParameter(
                f"the trace has {chunk.field_ut.shape[1]} sensors, the bar {self._bar.sensor_count}",
                field="trace.field_ut",
                limit=f"{self._bar.sensor_count} sensors",
                cure="declare the bar that recorded it",
            )
        before = self._t[-1] if self._t.size else (self._last[0] if self._last else -np.inf)
        if chunk.t_s.size and chunk.t_s[0] <= before:
            raise InvalidParameter(
                f"the piece starts at {chunk.t_s[0]:.6f} s, the one before ended at {before:.6f} s",
                field="trace.t_s",
                limit="rising",
                cure="feed the pieces in their order",
            )
        self._t = np.concatenate((self._t, chunk.t_s))
        self._x = np.concatenate((self._x, chunk.field_ut.astype(float)))
        self._speed_t = np.concatenate((self._speed_t, chunk.speed_t_s))
        self._speed = np.concatenate((self._speed, np.abs(chunk.speed_m_s)))
        if chunk.heading_t_s is not None and chunk.heading_deg is not None:
            self._has_headings = True
            self._yaw_t = np.concatenate((self._yaw_t, chunk.heading_t_s))
            self._yaw = np.concatenate((self._yaw, _unwrap(-np.radians(chunk.heading_deg), self._yaw[-1:])))

    def take(self, blocks: Blocks, *, final: bool = False) -> None:
        """Move what is complete into the blocks; all of it if final."""
        ready = self._ready(final)
        if ready < 1:
            if final:
                self._close(blocks)
            return
        t, raw = self._t[:ready], self._x[: ready + AHEAD]
        if lacking := ready + AHEAD - len(raw):  # the very last samples have no sample after them
            raw = np.concatenate((raw, np.repeat(raw[-1:], lacking, axis=0)))
        s, v = self._odometer(t)
        yaw = np.zeros(ready)
        if self._yaw_t.size:
            yaw = _interpolate(t, self._yaw_t, self._yaw, MAX_HEADING_INTERPOLATION_S)
        out = _OpenBlock(np.empty((ready, *raw.shape[1:])), np.empty((ready, raw.shape[1])), np.empty((ready, 6)))
        n = _repair_and_average(raw, np.stack([s, t, v, yaw], axis=1), self._repair, self._open, out)
        blocks.append(out.drive[:n, 2:], out.field[:n], out.good[:n])
        self._t, self._x = self._t[ready:], self._x[ready:]
        self._speed_t, self._speed = _still_needed(t[-1], self._speed_t, self._speed)
        self._yaw_t, self._yaw = _still_needed(t[-1], self._yaw_t, self._yaw)
        if final:
            self._close(blocks)

    def _ready(self, final: bool) -> int:
        """Samples that can be used: their speed and heading are known, and so are the samples after them."""
        if final:
            return self._t.size
        if not self._t.size or not self._speed_t.size:
            return 0
        if self._has_headings and not self._yaw_t.size and self._t[-1] < self._t[0] + MAX_HEADING_INTERPOLATION_S:
            return 0
        ready = self._t.size - AHEAD
        for times, longest_s in ((self._speed_t, MAX_INTERPOLATION_S), (self._yaw_t, MAX_HEADING_INTERPOLATION_S)):
            if times.size and self._t[-1] <= times[-1] + longest_s:
                ready = min(ready, int(np.searchsorted(self._t, times[-1], side="right")))
        return ready

    def _odometer(self, t: Floats) -> tuple[Floats, Floats]:
        """Distance and speed at times."""
        if not self._speed_t.size:
            raise InvalidParameter(
                "the trace has no speed", field="trace.speed_m_s", limit="one value or more", cure="upload the CAN log"
            )
        v = _interpolate(t, self._speed_t, self._speed, MAX_INTERPOLATION_S)
        if self._last is None:
            self._last = (float(t[0]), float(v[0]), 0.0)
        time = np.concatenate(([self._last[0]], t))
        speed = np.concatenate(([self._last[1]], v))
        step = np.diff(time) * (speed[1:] + speed[:-1]) / 2
        for i in np.flatnonzero(np.diff(time) > MIN_GAP_S):
            step[i] = min(step[i], MAX_GAP_M)
            self.findings.append(
                NoiseFinding(
                    float(time[i]), self._last[2], 0.0, NoiseKind.GAP,
                    f"no samples for {time[i + 1] - time[i]:.3f} s from {time[i]:.3f} s",
                )
            )  # fmt: skip
        s = np.cumsum(np.concatenate(([self._last[2]], step)))[1:]
        self._last = (float(t[-1]), float(v[-1]), float(s[-1]))
        return s, v

    def _close(self, blocks: Blocks) -> None:
        """Move the open block into the blocks."""
        count = self._open.drive[0]
        if count:
            drive, x, w = (a / count for a in (self._open.drive[2:], self._open.field, self._open.good))
            blocks.append(drive[None], x[None], w[None])
            self._open.drive[0] = 0


def _unwrap(angle: Floats, before: Floats) -> Floats:
    """Angles with whole turns added so that none is more than half a turn from the one before; `before` has 0 or 1.

    Unlike `numpy.unwrap`, it gives the same to the last bit however the angles come in pieces.
    """
    step = np.diff(angle, prepend=before if before.size else angle[:1])
    return angle - 2 * np.pi * np.cumsum(np.round(step / (2 * np.pi)))


def _interpolate(t: Floats, times: Floats, values: Floats, longest_s: float) -> Floats:
    """Values at t; the last one is kept where the next one comes later than `longest_s` after it."""
    before = np.clip(np.searchsorted(times, t, side="right") - 1, 0, times.size - 1)
    after = np.minimum(before + 1, times.size - 1)
    return np.where(times[after] - times[before] > longest_s, values[before], np.interp(t, times, values))


def _still_needed(t: float, times: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Times and values without those that are not needed after t."""
    keep = max(int(np.searchsorted(times, t)) - 2, 0)
    return times[keep:], values[keep:]


def _neighbours(bar: MagnetometerBar) -> npt.NDArray[np.int64]:
    """Two nearest array sensors of each within 0.25 m, -1 for none, shape (S, 2)."""
    out = np.full((bar.sensor_count, 2), -1, np.int64)
    for i in bar.array:
        away = np.linalg.norm(bar.positions_m - bar.positions_m[i], axis=1)
        near = [
            j for j in np.argsort(away) if j != i and away[j] < NEIGHBOUR_REACH_M and bar.roles[j] is SensorRole.ARRAY
        ]
        out[i, : len(near[:2])] = near[:2]
    return out


# --- kernels; S sensors ---------------------------------------------------------------------------------------------


class _Repair(NamedTuple):
    """What the check of a sample needs of those before it; fields are relative to `offset`. [uT]"""

    offset: Floats  # (S, 3) first plausible sample, NaN until there is one
    raw: Floats  # (S, 3) the sample before, as read
    last: Floats  # (S, 3) the sample before, repaired
    earlier: Floats  # (S, 3) the one before that, repaired
    neighbours: Ints  # (S, 2) nearest array sensors, -1 for none


class _Check(NamedTuple):
    """A sample compared with its prediction from the samples around it."""

    predicted: Floats  # (S, 3) on the line through the last repaired and the next usable sample [uT]
    deviation: Floats  # (S,) distance from it, 0 where the sample or the next one is unusable [uT]
    usable: Bools  # (S,) in range and no repeat
    next_usable: Bools  # (S,)


class _OpenBlock(NamedTuple):
    """Sums over the samples of the block that is being filled; as an output, blocks that are complete."""

    field: Floats  # (S, 3) [uT]
    good: Floats  # (S,) number of good samples
    drive: Floats  # (6,) samples, s of the first, sums of s [m], t [s], v [m/s], yaw [rad]


@ieee_routine
def _in_range(x: Floats) -> bool:
    """Whether a sample (3,) is within the chip's range; NaN is not."""
    return bool(abs(x[0]) < MAX_FIELD_UT and abs(x[1]) < MAX_FIELD_UT and abs(x[2]) < MAX_FIELD_UT)


@ieee_routine
def _is_same(a: Floats, b: Floats) -> bool:
    return bool(a[0] == b[0] and a[1] == b[1] and a[2] == b[2])


@ieee_routine
def _next_sample(raw: Floats, i: int, j: int, usable: bool, repair: _Repair) -> int:
    """Samples to the one that the prediction uses: 2 if the next one is out of range, a repeat or a spike."""
    if not _in_range(raw[i + 1, j]) or _is_same(raw[i + 1, j], raw[i, j]):
        return 2
    if usable or not _in_range(raw[i + 2, j]):
        return 1
    one = two = 0.0  # beside a faulty sample a spike may follow: the flatter continuation is the likelier
    for a in range(3):
        before = repair.offset[j, a] + repair.last[j, a]
        one += (raw[i + 1, j, a] - before) ** 2
        two += (raw[i + 2, j, a] - before) ** 2
    return 2 if one > two / 4 else 1


@ieee_routine
def _check_sample(raw: Floats, i: int, repair: _Repair, check: _Check) -> None:
    """Compare sample i of every sensor with its prediction."""
    for j in range(raw.shape[1]):
        usable = _in_range(raw[i, j])
        if usable and math.isnan(repair.offset[j, 0]):
            for a in range(3):
                repair.offset[j, a] = raw[i, j, a]
                repair.last[j, a] = repair.earlier[j, a] = 0.0
        elif usable and _is_same(raw[i, j], repair.raw[j]):
            usable = False
        ahead = _next_sample(raw, i, j, usable, repair)
        square = 0.0
        for a in range(3):
            repair.raw[j, a] = raw[i, j, a]
            after = raw[i + ahead, j, a] - repair.offset[j, a]
            check.predicted[j, a] = (ahead * repair.last[j, a] + after) / (ahead + 1)
            square += (raw[i, j, a] - repair.offset[j, a] - check.predicted[j, a]) ** 2
        check.usable[j] = usable
        check.next_usable[j] = _in_range(raw[i + ahead, j])
        check.deviation[j] = math.sqrt(square) if usable and check.next_usable[j] else 0.0


@ieee_routine
def _is_spike(j: int, repair: _Repair, check: _Check) -> bool:
    """Whether a sample is off by itself: in time by its second difference, across the bar by its neighbours."""
    deviation = check.deviation[j]
    if deviation <= MIN_SPIKE_UT or repair.neighbours[j, 0] < 0:
        return False
    mismatch = 0.0
    for a in range(3):
        mismatch += (repair.last[j, a] - (repair.earlier[j, a] + check.predicted[j, a]) / 2) ** 2
    around = MIN_NEIGHBOUR_UT
    for q in range(2):
        if repair.neighbours[j, q] >= 0:
            around = max(around, check.deviation[repair.neighbours[j, q]])
    if deviation > SURE_SPIKE_UT and mismatch < (SURE_MISMATCH * deviation + SURE_NOISE_UT) ** 2:
        return True
    alone = mismatch < (SPIKE_MISMATCH * deviation) ** 2 + SPIKE_NOISE_UT**2
    return bool(alone and deviation > SPIKE_RATIO * around)


@ieee_routine
def _add_sample(sample: Floats, drive: Floats, repair: _Repair, check: _Check, block: _OpenBlock) -> None:
    """Repair a sample (S, 3) taken at drive (4,) and add it to the open block."""
    if block.drive[0] == 0:
        block.field[:] = 0.0
        block.good[:] = 0.0
        block.drive[:] = 0.0
        block.drive[1] = drive[0]
    block.drive[0] += 1
    for q in range(drive.size):
        block.drive[2 + q] += drive[q]
    for j in range(sample.shape[0]):
        good = check.usable[j] and not _is_spike(j, repair, check)
        for a in range(3):
            repair.earlier[j, a] = repair.last[j, a]
            if good:
                repair.last[j, a] = sample[j, a] - repair.offset[j, a]
            elif check.next_usable[j] and not math.isnan(repair.offset[j, 0]):
                repair.last[j, a] = check.predicted[j, a]
            block.field[j, a] += repair.last[j, a]
        block.good[j] += good


@ieee_routine
def _close_block(block: _OpenBlock, out: _OpenBlock, at: int) -> None:
    """Write the means of the open block to the place `at` of the output, and empty it."""
    count = block.drive[0]
    for j in range(block.good.size):
        out.good[at, j] = block.good[j] / count
        for a in range(3):
            out.field[at, j, a] = block.field[j, a] / count
    for q in range(block.drive.size):
        out.drive[at, q] = block.drive[q] / count
    block.drive[0] = 0.0


@ieee_kernel
def _repair_and_average(raw: Floats, drive: Floats, repair: _Repair, block: _OpenBlock, out: _OpenBlock) -> int:
    """Repair samples raw (N + AHEAD, S, 3) taken at drive (N, 4): s, t, v, yaw; average them; return how many."""
    sensors, closed = raw.shape[1], 0
    check = _Check(np.empty((sensors, 3)), np.empty(sensors), np.empty(sensors, np.bool_), np.empty(sensors, np.bool_))
    for i in range(drive.shape[0]):
        _check_sample(raw, i, repair, check)
        if block.drive[0] > 0 and drive[i, 0] - block.drive[1] > BLOCK_M:
            _close_block(block, out, closed)
            closed += 1
        _add_sample(raw[i], drive[i], repair, check, block)
    return closed


# === Blocks resampled to bins of equal length along the road, the common mode of all sensors removed.


LAG_BINS = 8
"""Bins on each side of the second difference (the bend) by which noise is measured: 40 cm. Longer than a magnet's pulse
at METRO's clearance."""
NOISE_RATE = 0.01
"""Share of a bin in the running mean squares: 5 m of road."""
CLIP_VARIANCES = 9.0
"""Squares count up to so many variances, three standard deviations: magnets are no noise."""
OWN_NOISE_FACTOR = 1.5
"""The common mode's mean square must exceed so many times what the sensors' own noise gives."""
QUIET_RATIO = 0.5
"""A channel is noisier than the others from twice the median on; less is chance, or the magnets."""
MIN_VARIANCE = 1e-9
"""Keeps ratios of variances finite. [uT2] Far below a chip's noise."""
GROWTH_BINS, FORGET_BINS = 256, 400
"""Bins by which the arrays grow, and after which old ones are dropped. Speed only."""


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
        self.shift: Ints = np.round((positions_m[:, 0] - positions_m[:, 0].min()) / BIN_M).astype(np.int64)
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
def _write_bin(at: int, value: Floats, shift: Ints, bins: _Bins, noise: _Noise) -> None:
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
    s: Floats, blocks: Floats, shift: Ints, start: int, bins: _Bins, noise: _Noise, opened: _OpenBin
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
