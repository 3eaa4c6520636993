"""From samples to blocks along the road: faulty samples mended, time turned into distance."""

from __future__ import annotations

import numba as nb
import numpy as np
import numpy.typing as npt

from app.decoders.magnet.readings import NoiseFinding, NoiseKind
from app.errors import InvalidParameter
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace, SensorRole

Floats = npt.NDArray[np.float64]

BLOCK_M = 0.02
"""Samples nearer than this are averaged. [m]"""
GAP_S = 0.1
_GAP_LIMIT_M = 10.0
_HOLD_S = 1.0
"""A speed is interpolated over at most this, then the last one is kept. [s]"""
_FIELD_LIMIT_UT = 50_000.0
_SPIKE_UT = 25.0
_SPIKE_RATIO = 4.0
_SPIKE_MISMATCH = 0.15
_SURE_SPIKE_UT, _SURE_MISMATCH = 60.0, 0.05
"""A sample is a spike if it bends the row of samples so much, and so much more than its neighbours on the bar, and if
the bend of the sample before it is minus half of its own but for this share: one sample alone is off."""
_AHEAD = 2
"""Samples that are looked at ahead: the next one may be a repeat."""


class Blocks:
    """Blocks not yet forgotten: odometer s (N,) [m], time t (N,) [s], speed v (N,) [m/s], field x (N, S, 3) [uT],
    share of good samples w (N, S)."""

    def __init__(self, sensors: int) -> None:
        self.s = np.empty(0)
        self.t = np.empty(0)
        self.v = np.empty(0)
        self.x = np.empty((0, sensors, 3))
        self.w = np.empty((0, sensors))

    def append(self, s: Floats, t: Floats, v: Floats, x: Floats, w: Floats) -> None:
        """Add blocks at the end."""
        self.s, self.t, self.v = (np.concatenate(p) for p in ((self.s, s), (self.t, t), (self.v, v)))
        self.x, self.w = np.concatenate((self.x, x)), np.concatenate((self.w, w))

    def forget(self, before_m: float) -> None:
        """Drop what lies before a distance, in large pieces."""
        n = int(np.searchsorted(self.s, before_m))
        if n > 400:
            self.s, self.t, self.v, self.x, self.w = (a[n:].copy() for a in (self.s, self.t, self.v, self.x, self.w))


class FrontEnd:
    """Mends samples, integrates the speed, and averages samples to blocks; the same for any chunking."""

    def __init__(self, bar: MagnetometerBar) -> None:
        self._bar = bar
        n = bar.sensor_count
        self._t = np.empty(0)
        self._x = np.empty((0, n, 3))
        self._speed_t = np.empty(0)
        self._speed = np.empty(0)
        self._last: tuple[float, float, float] | None = None  # time, speed and odometer of the newest sample used
        self._neighbours = _neighbours(bar)
        self._previous = np.zeros((3, n, 3))  # the last sample mended and as read, the one before it mended
        self._first = np.full((n, 3), np.nan)
        self._sum = np.zeros((n, 4))
        self._open = np.zeros(5)  # count, start s, sum s, sum t, sum v
        self._stale = np.zeros(n, np.int64)
        self.findings: list[NoiseFinding] = []
        self.headings = np.empty((0, 2))

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
            self.headings = np.concatenate((self.headings, np.stack([chunk.heading_t_s, chunk.heading_deg], 1)))

    def take(self, blocks: Blocks, *, final: bool = False) -> None:
        """Move what is complete into the blocks; all of it if final."""
        ready = self._ready(final)
        if ready < 1:
            if final:
                self._close(blocks)
            return
        t, raw = self._t[:ready], self._x[: ready + _AHEAD]
        if lacking := ready + _AHEAD - len(raw):  # the very last samples have no neighbour
            raw = np.concatenate((raw, np.repeat(raw[-1:], lacking, axis=0)))
        s, v = self._odometer(t)
        out_s, out_x = np.empty((ready + 1, 3)), np.empty((ready + 1, raw.shape[1], 4))
        n = _mend_and_block(
            raw,
            t,
            s,
            v,
            self._neighbours,
            self._previous,
            self._first,
            self._stale,
            self._sum,
            self._open,
            out_s,
            out_x,
        )
        good = out_x[:n, :, 3]
        blocks.append(out_s[:n, 0], out_s[:n, 1], out_s[:n, 2], out_x[:n, :, :3], good)
        self._t, self._x = self._t[ready:], self._x[ready:]
        keep = max(int(np.searchsorted(self._speed_t, t[ready - 1])) - 2, 0)
        self._speed_t, self._speed = self._speed_t[keep:], self._speed[keep:]
        if final:
            self._close(blocks)

    def _ready(self, final: bool) -> int:
        """Samples that can be used: their speed is known, and so are the samples after them."""
        if final:
            return self._t.size
        if not self._t.size or not self._speed_t.size:
            return 0
        until = self._speed_t[-1]
        if self._t[-1] > until + _HOLD_S:
            return self._t.size - _AHEAD
        return min(int(np.searchsorted(self._t, until, side="right")), self._t.size - _AHEAD)

    def _odometer(self, t: Floats) -> tuple[Floats, Floats]:
        """Distance and speed at times."""
        if not self._speed_t.size:
            raise InvalidParameter(
                "the trace has no speed", field="trace.speed_m_s", limit="one value or more", cure="upload the CAN log"
            )
        v = np.interp(t, self._speed_t, self._speed)
        before = np.clip(np.searchsorted(self._speed_t, t, side="right") - 1, 0, self._speed_t.size - 1)
        after = np.minimum(before + 1, self._speed_t.size - 1)
        hold = self._speed_t[after] - self._speed_t[before] > _HOLD_S
        v = np.where(hold, self._speed[before], v)
        if self._last is None:
            self._last = (float(t[0]), float(v[0]), 0.0)
        time = np.concatenate(([self._last[0]], t))
        speed = np.concatenate(([self._last[1]], v))
        step = np.diff(time) * (speed[1:] + speed[:-1]) / 2
        for i in np.flatnonzero(np.diff(time) > GAP_S):
            step[i] = min(step[i], _GAP_LIMIT_M)
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
        count = self._open[0]
        if count:
            x, w = self._sum[:, :3] / count, self._sum[:, 3] / count
            s, t, v = self._open[2:] / count
            blocks.append(np.array([s]), np.array([t]), np.array([v]), x[None], w[None])
            self._open[0] = 0
            self._sum[:] = 0


def _neighbours(bar: MagnetometerBar) -> npt.NDArray[np.int64]:
    """Two nearest array sensors of each within 0.25 m, -1 for none, shape (S, 2)."""
    out = np.full((bar.sensor_count, 2), -1, np.int64)
    for i in bar.array:
        away = np.linalg.norm(bar.positions_m - bar.positions_m[i], axis=1)
        near = [j for j in np.argsort(away) if j != i and away[j] < 0.25 and bar.roles[j] is SensorRole.ARRAY]
        out[i, : len(near[:2])] = near[:2]
    return out


@nb.njit(cache=True, nogil=True)
def _mend_and_block(raw, t, s, v, neighbours, previous, first, stale, total, open_, out_s, out_x):  # type: ignore[no-untyped-def]
    """Mend samples 0..len(s)-1 of raw (`_AHEAD` more are there to look at) and average them; returns the blocks
    closed."""
    n_sensors = raw.shape[1]
    bend = np.empty(n_sensors)
    fine = np.empty(n_sensors, np.bool_)
    next_fine = np.empty(n_sensors, np.bool_)
    told = np.empty((n_sensors, 3))  # what the samples before and after say
    blocks = 0
    for i in range(s.size):
        for j in range(n_sensors):
            fine[j] = _plausible(raw[i, j])
            ahead = 1 if _plausible(raw[i + 1, j]) and not (raw[i + 1, j] == raw[i, j]).all() else 2
            if fine[j] and np.isnan(first[j, 0]):
                first[j] = raw[i, j]
                previous[0, j] = 0
                previous[2, j] = 0
            elif fine[j] and (raw[i, j] == previous[1, j]).all():
                fine[j] = False
            previous[1, j] = raw[i, j]
            if not fine[j] and ahead == 1 and _plausible(raw[i + 2, j]):
                one = two = 0.0  # a spike may follow: the flatter way on is the likelier
                for a in range(3):
                    one += (raw[i + 1, j, a] - first[j, a] - previous[0, j, a]) ** 2
                    two += (raw[i + 2, j, a] - first[j, a] - previous[0, j, a]) ** 2
                ahead = 2 if one > two / 4 else 1
            next_fine[j] = _plausible(raw[i + ahead, j])
            square = 0.0
            for a in range(3):
                told[j, a] = (ahead * previous[0, j, a] + raw[i + ahead, j, a] - first[j, a]) / (ahead + 1)
                square += (raw[i, j, a] - first[j, a] - told[j, a]) ** 2
            bend[j] = np.sqrt(square) if fine[j] and next_fine[j] else 0.0
        if open_[0] > 0 and s[i] - open_[1] > BLOCK_M:
            count = open_[0]
            for q in range(3):
                out_s[blocks, q] = open_[2 + q] / count
            out_x[blocks] = total / count
            blocks += 1
            open_[0] = 0
            total[:] = 0
        if open_[0] == 0:
            open_[1] = s[i]
            open_[2:] = 0
        open_[0] += 1
        open_[2] += s[i]
        open_[3] += t[i]
        open_[4] += v[i]
        for j in range(n_sensors):
            good = fine[j]
            if good and bend[j] > _SPIKE_UT and neighbours[j, 0] >= 0:
                mismatch = 0.0
                for a in range(3):
                    mismatch += (previous[0, j, a] - (previous[2, j, a] + told[j, a]) / 2) ** 2
                around = 4.0
                for q in range(2):
                    if neighbours[j, q] >= 0:
                        around = max(around, bend[neighbours[j, q]])
                alone = mismatch < (_SPIKE_MISMATCH * bend[j]) ** 2 + 9
                single = bend[j] > _SURE_SPIKE_UT and mismatch < (_SURE_MISMATCH * bend[j] + 6) ** 2
                good = not (single or (alone and bend[j] > _SPIKE_RATIO * around))
            stale[j] = 0 if good else stale[j] + 1
            for a in range(3):
                previous[2, j, a] = previous[0, j, a]
                if good:
                    previous[0, j, a] = raw[i, j, a] - first[j, a]
                elif next_fine[j] and not np.isnan(first[j, 0]):
                    previous[0, j, a] = told[j, a]
                total[j, a] += previous[0, j, a]
            total[j, 3] += good
    return blocks


@nb.njit(cache=True, nogil=True)
def _plausible(x):  # type: ignore[no-untyped-def]
    return abs(x[0]) < _FIELD_LIMIT_UT and abs(x[1]) < _FIELD_LIMIT_UT and abs(x[2]) < _FIELD_LIMIT_UT
