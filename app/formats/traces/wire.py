"""The array's serial stream: 43 little-endian float32 a sample, no sync word, no checksum.

A sample is x, y, z of each sensor and then the interval since the last sample. Where samples begin is found from their
content: a plausible interval in its place, fields in theirs, and fields like those of the samples before. A cut of
whole samples leaves no trace in the bytes and cannot be seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UnreadableUpload, UploadTooLarge
from app.formats.traces.declaration import TraceGap, TraceLimits, TraceReport
from app.sensors.magnetometer_bar import MAX_FIELD_UT
from app.values import Floats, Floats32

_NEAR_UT = 100.0  # [uT] change of half of the fields, at most; the earth's field turned round
_RATES_HZ = (80.0, 1000.0)  # [Hz] median rates of a stream; around the 350 Hz of METRO section 6.1
_INTERVALS_US = (200.0, 200_000.0)  # [us] plausible intervals; 5000 to 5 Hz
_MAX_BAD_WORDS = 4  # implausible fields of a sample that is kept; one sensor and a word
_ANCHOR_SAMPLES, _MIN_SAMPLES = 48, 8  # samples in a row that show where samples begin
_ANCHOR_WINDOWS = 400  # windows that are searched for them; bounds the time for other files
_BLOCK = 4096  # samples that are taken at a time; speed only
_SEARCH_BYTES, _SEARCH_LIMIT = 1 << 16, 1 << 24  # [byte] a step, and the length, of a search
_BAD, _GOOD, _ODD_INTERVAL = 0, 1, 2


@dataclass(slots=True)
class _Sync:
    """How samples looked lately: fields (3 S,) [uT] and the median interval [us]."""

    template: Floats
    interval_us: float


class StreamReader:
    """Finds the samples of a stream.

    Parameters
    ----------
    name : str
        Of the file.
    rate_hz : float or None
        Expected sample rate, if it is known. [Hz]
    report : TraceReport
        Gets gaps and losses.
    """

    def __init__(
        self, data: bytes, name: str, sensors: int, rate_hz: float | None, limits: TraceLimits, report: TraceReport
    ) -> None:
        self._data, self._name, self._limits, self._report = data, name, limits, report
        self._words = 3 * sensors + 1
        self._bytes = 4 * self._words
        low, high = (rate_hz / 1.4, rate_hz * 1.4) if rate_hz else _RATES_HZ
        self._medians_us = (1e6 / high, 1e6 / low)
        self._kept: list[Floats32] = []
        self._intervals: list[Floats] = []
        self._lost: list[tuple[int, float, int]] = []  # sample after the gap, samples lost, bytes skipped
        self._count = 0

    def read(self, interval_extra_us: float = 0.0) -> tuple[Floats, npt.NDArray[np.float32]]:
        """Times (T,) [s] from the first sample and fields (T, S, 3) [uT], as recorded.

        Parameters
        ----------
        interval_extra_us : float
            Added to each interval: what the firmware's clock leaves out. [us]

        Raises
        ------
        UnreadableUpload
            No samples are found, or where they begin is ambiguous.
        UploadTooLarge
            More samples than the limit.
        """
        anchor = self._anchor(0)
        if anchor is None:
            raise UnreadableUpload(
                f"{self._name} holds no samples of {(self._words - 1) // 3} sensors",
                field=self._name,
                limit=f"{self._bytes} bytes a sample, {1e6 / self._medians_us[1]:.0f} to "
                f"{1e6 / self._medians_us[0]:.0f} Hz, fields below {MAX_FIELD_UT:g} uT",
                cure="check that it is the array's raw stream, and declare its number of sensors and its rate",
            )
        position, sync = anchor
        if position:
            self._lost.append((0, 0.0, position))
        while True:
            position = self._walk(position, sync)
            if len(self._data) - position < self._bytes:
                break
            found = self._resync(position, sync) or self._anchor(position + 1)
            if found is None:
                break
            resume, sync = found
            self._lost.append((self._count, np.ceil((resume - position) / self._bytes), resume - position))
            position = resume
        self._report.leave_out(
            self._name, "bytes-at-the-end", len(self._data) - position, "the file does not end with a whole sample"
        )
        return self._assemble(interval_extra_us)

    def _samples(self, position: int, count: int) -> Floats32:
        flat = np.frombuffer(self._data, "<f4", count * self._words, position)
        return flat.reshape(count, self._words)

    def _sample_status(self, samples: Floats32, sync: _Sync) -> npt.NDArray[np.int8]:
        """Status of samples: good, good but for the interval, or bad where none begins here."""
        with np.errstate(invalid="ignore", over="ignore"):
            fields, interval = samples[:, :-1], samples[:, -1]
            size = np.abs(fields)
            wild = (~(size <= MAX_FIELD_UT)).sum(1)
            near = (np.abs(fields - sync.template.astype(np.float32)) <= _NEAR_UT).sum(1)
            usual = sync.interval_us
            timed = (interval >= usual / 4) & (interval <= max(8 * usual, _INTERVALS_US[1]))
            # an interval among the fields, and a field in its place: the words are shifted
            large = sync.template[sync.template > usual / 4 - 2 * _NEAR_UT]
            field_there = (np.abs(interval[:, None] - large) <= 2 * _NEAR_UT).any(1)
            interval_there = (fields >= usual / 2) & (fields <= 1.6 * usual) & (sync.template < 0.4 * usual)
            shifted = field_there & interval_there.any(1)
        fine = (wild <= _MAX_BAD_WORDS) & (near >= (self._words - 1) // 2) & ~shifted
        return np.where(fine & timed, _GOOD, np.where(fine, _ODD_INTERVAL, _BAD)).astype(np.int8)

    def _walk(self, position: int, sync: _Sync) -> int:
        """Take samples from a position on; returns where they end or the beat is lost."""
        start = self._count
        while (count := min((len(self._data) - position) // self._bytes, _BLOCK)) > 0:
            ahead = min((len(self._data) - position) // self._bytes, _BLOCK + 3)
            samples = self._samples(position, ahead)
            status = self._sample_status(samples, sync)
            good = status == _GOOD
            end = count
            for i in np.flatnonzero(~good[:count]):
                after = good[i + 1 : i + 4]
                if not after.size or after.sum() < min(2, after.size):
                    end = int(i)
                    break
            self._take(samples, np.flatnonzero(status[:end] != _BAD), status, end, sync)
            position += end * self._bytes
            if end < count:
                if self._count > start:
                    self._drop_last()
                break
        return position

    def _take(
        self, samples: Floats32, taken: npt.NDArray[np.intp], status: npt.NDArray[np.int8], end: int, sync: _Sync
    ) -> None:
        if self._count + taken.size > self._limits.rows:
            raise UploadTooLarge(
                f"{self._name} holds more samples than the limit",
                field=self._name,
                limit=f"{self._limits.rows} samples",
                cure="cut the recording into shorter ones",
            )
        interval = samples[taken, -1].astype(float)
        replaced = status[taken] == _ODD_INTERVAL
        interval[replaced] = sync.interval_us
        gone = np.diff(taken, prepend=-1) - 1
        for i in np.flatnonzero(gone):
            self._lost.append((self._count + int(i), float(gone[i]), int(gone[i]) * self._bytes))
        if taken.size and (tail := end - 1 - taken[-1]) > 0:
            self._lost.append((self._count + taken.size, float(tail), int(tail) * self._bytes))
        self._report.leave_out(
            self._name, "samples-damaged", end - taken.size, "fields beyond the sensors' range or out of place"
        )
        self._report.leave_out(
            self._name, "intervals-implausible", int(replaced.sum()), "the median interval was taken in their place"
        )
        if not taken.size:
            return
        fields = samples[taken, :-1]
        with np.errstate(invalid="ignore"):
            wild = ~(np.abs(fields).reshape(taken.size, -1, 3) <= MAX_FIELD_UT).all(2)
        if wild.any():
            fields.reshape(taken.size, -1, 3)[wild] = np.nan
            self._report.leave_out(
                self._name, "values-damaged", int(wild.sum()), f"fields beyond {MAX_FIELD_UT:g} uT or not a number"
            )
        self._kept.append(fields)
        self._intervals.append(interval)
        self._count += taken.size
        last = fields[-256:].astype(float)
        if taken.size >= 16:
            middle = np.nanmedian(last, axis=0) if np.isfinite(last).any(0).all() else sync.template
            sync.template = middle
            sync.interval_us = float(np.median(interval[-256:]))

    def _drop_last(self) -> None:
        """Leave out the sample before a break: it may be spliced of two."""
        self._kept[-1], self._intervals[-1] = self._kept[-1][:-1], self._intervals[-1][:-1]
        self._count -= 1
        self._lost = [(min(sample, self._count), lost, skipped) for sample, lost, skipped in self._lost]
        self._lost.append((self._count, 1.0, self._bytes))

    def _starts(self, position: int, size: int, medians: tuple[float, float]) -> npt.NDArray[np.intp]:
        """Bytes from a position on at which three samples in a row may begin."""
        size = min(size, len(self._data) - position - 3 * self._bytes + 1)
        found = []
        for r in range(min(4, max(size, 0))):
            count = (min(size + 3 * self._bytes, len(self._data) - position) - r) // 4
            words = np.frombuffer(self._data, "<f4", count, position + r)
            with np.errstate(invalid="ignore"):
                wild = np.concatenate(([0], np.cumsum(~(np.abs(words) <= MAX_FIELD_UT))))
                timed = (words >= medians[0]) & (words <= medians[1])
            n = (size - r + 3) // 4
            ok = np.ones(n, bool)
            for i in range(3):
                q = np.arange(n) + i * self._words
                ok &= (wild[q + self._words - 1] - wild[q] <= _MAX_BAD_WORDS) & timed[q + self._words - 1]
            found.append(4 * np.flatnonzero(ok) + r)
        return np.sort(np.concatenate(found)) if found else np.empty(0, np.intp)

    def _resync(self, position: int, sync: _Sync) -> tuple[int, _Sync] | None:
        """The next three samples in a row that look like those before."""
        intervals = (sync.interval_us / 4, max(8 * sync.interval_us, _INTERVALS_US[1]))
        template = sync.template.astype(np.float32)
        for at in range(position + 1, min(len(self._data), position + _SEARCH_LIMIT), _SEARCH_BYTES):
            best: tuple[int, int] | None = None
            first = -1
            for o in self._starts(at, _SEARCH_BYTES, intervals):
                if best and at + o >= first + self._bytes:
                    break
                samples = self._samples(at + int(o), 3)
                if (self._sample_status(samples, sync) != _GOOD).any():
                    continue
                with np.errstate(invalid="ignore"):
                    near = int((np.abs(samples[:, :-1] - template) <= _NEAR_UT / 2).sum())
                if best is None:
                    first = at + int(o)
                if best is None or near > best[0]:
                    best = (near, at + int(o))
            if best:
                return best[1] + self._bytes, sync  # the first may begin before the break
        return None

    def _anchor(self, start: int) -> tuple[int, _Sync] | None:
        """The first window from a byte on in which samples follow each other, without knowing any before."""
        whole = (len(self._data) - start) // self._bytes
        k = min(_ANCHOR_SAMPLES, whole - 1 if whole > _MIN_SAMPLES else whole)
        if k < _MIN_SAMPLES:
            return None
        step = max(k // 2, 1) * self._bytes
        for at in range(start, len(self._data) - k * self._bytes + 1, step)[:_ANCHOR_WINDOWS]:
            found = self._phases(at, k)
            if len(found) > 1 and (whole_us := [f for f in found if f[2] >= 0.9]):
                found = whole_us  # the firmware counts whole microseconds
            if len(found) > 1 and self._count:
                return None
            if len(found) > 1:
                raise UnreadableUpload(
                    f"where samples begin in {self._name} is ambiguous: intervals may be "
                    + " or ".join(f"{f[1].interval_us:.0f}" for f in found[:3])
                    + " us",
                    field=self._name,
                    limit="one possible beginning",
                    cure="declare the sample rate",
                )
            if found:
                position, sync, _ = found[0]
                position += at
                return (position + self._bytes if position else 0), sync
        return None

    def _phases(self, at: int, k: int) -> list[tuple[int, _Sync, float]]:
        """Bytes of a window at which k samples in a row may begin, with the share of whole intervals."""
        found = []
        for phase in range(min(self._bytes, len(self._data) - at - k * self._bytes + 1)):
            samples = self._samples(at + phase, k)
            interval = samples[:, -1]
            with np.errstate(invalid="ignore"):
                timed = (interval >= _INTERVALS_US[0]) & (interval <= _INTERVALS_US[1])
                if timed.mean() < 0.8:
                    continue
                usual = float(np.median(interval))
                fine = timed & ((~(np.abs(samples[:, :-1]) <= MAX_FIELD_UT)).sum(1) <= _MAX_BAD_WORDS)
            if fine.mean() < 0.8 or not self._medians_us[0] <= usual <= self._medians_us[1]:
                continue
            fields = np.median(samples[fine, :-1].astype(float), axis=0)
            sync = _Sync(fields, usual)
            whole = float((interval[timed] == np.round(interval[timed])).mean())
            if whole < 0.9 and self._holds_interval(samples[fine, :-1], fields):
                continue
            if np.isfinite(fields).all() and (self._sample_status(samples, sync) == _GOOD).mean() >= 0.8:
                found.append((phase, sync, whole))
        return found

    def _holds_interval(self, samples: Floats32, middle: Floats) -> bool:
        """Whether a word among the fields counts whole microseconds, as intervals do."""
        with np.errstate(invalid="ignore"):
            whole = (samples == np.round(samples)).mean(0) >= 0.8
        return bool((whole & (middle >= self._medians_us[0]) & (middle <= self._medians_us[1])).any())

    def _assemble(self, extra_us: float) -> tuple[Floats, npt.NDArray[np.float32]]:
        if not self._count:
            raise UnreadableUpload(f"{self._name} holds no whole sample", field=self._name, limit="one or more")
        words = np.concatenate(self._kept)
        self._kept.clear()
        interval_s = (np.concatenate(self._intervals) + extra_us) / 1e6
        fields = words.reshape(len(words), -1, 3)
        usual_s = float(np.median(interval_s))
        step = interval_s.copy()
        gaps: dict[int, tuple[float, int]] = {}
        for sample, lost, skipped in self._lost:
            known = gaps.get(sample, (0.0, 0))
            gaps[sample] = (known[0] + lost, known[1] + skipped)
        for sample, (lost, _) in gaps.items():
            if 0 < sample < len(step):
                step[sample] += lost * usual_s
        step[0] = 0.0
        t = np.cumsum(step)
        for sample, (lost, skipped) in sorted(gaps.items()):
            before = float(t[min(max(sample - 1, 0), len(t) - 1)])
            self._report.add_gap(TraceGap(self._name, sample, before, lost * usual_s, skipped))
        return t, fields


def write_stream(t_s: Floats, field_ut: npt.NDArray[np.floating]) -> bytes:
    """A stream as the array's firmware sends it, with intervals in whole microseconds.

    Parameters
    ----------
    t_s : ndarray, shape (T,)
        Rising times. [s]
    field_ut : ndarray, shape (T, S, 3)
        In the sensors' own axes. [uT]

    Raises
    ------
    InvalidParameter
        Times and fields do not fit.
    """
    if field_ut.ndim != 3 or field_ut.shape[2] != 3 or len(t_s) != len(field_ut):
        raise InvalidParameter("times and fields do not fit", field="field_ut", limit="shape (T, S, 3)")
    clock_us = np.round(np.asarray(t_s, float) * 1e6)
    interval_us = np.diff(clock_us, prepend=clock_us[0] - np.median(np.diff(clock_us)) if len(t_s) > 1 else 0.0)
    samples = np.empty((len(t_s), 3 * field_ut.shape[1] + 1), "<f4")
    samples[:, :-1] = field_ut.reshape(len(t_s), -1)
    samples[:, -1] = interval_us
    return samples.tobytes()
