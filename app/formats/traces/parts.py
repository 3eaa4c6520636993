"""Files by name, as bytes or open streams, read in pieces and counted while they are read; series of numbers."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.format import ArchiveLimits, SpooledFile, count_members, is_archive, is_file
from app.formats.traces.declaration import (
    M_S_PER_UNIT,
    AngleUnit,
    SpeedUnit,
    TraceGap,
    TraceLimits,
    TraceReport,
)
from app.values import Floats

BLOCK_BYTES = 4 * 1024**2
"""Bytes that are read at a time. Bounds the memory."""
_HEAD = 65536  # [byte] by which formats are detected
_MAX_MEMBERS = 32  # files of an archive; a recorder writes three
_MAX_RATIO = 400  # expanded over compressed size; deflate reaches 1032 with zeros only
_DEFECTS = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, ValueError, RuntimeError)


@dataclass(slots=True)
class Part:
    """A file of an upload."""

    name: str  # shown in messages; its suffix is a hint
    head: bytes  # its beginning
    stream: BinaryIO  # the rest
    limit_bytes: int  # [byte] largest size, expanded

    def blocks(self) -> Iterator[bytes]:
        """The content in pieces.

        Raises
        ------
        UploadTooLarge
            The limit is passed.
        UnreadableUpload
            The archive that holds it is damaged here.
        """
        size, block = 0, self.head
        while block:
            size += len(block)
            if size > self.limit_bytes:
                raise self.too_large()
            yield block
            block = _read(self.stream, BLOCK_BYTES, self.name)

    def too_large(self) -> UploadTooLarge:
        """The error of a file that passes its limit."""
        return UploadTooLarge(
            f"{self.name} is too large",
            field=self.name,
            limit=f"{self.limit_bytes} bytes expanded",
            cure="cut the recording into shorter ones",
        )

    def as_file(self) -> SpooledFile:
        """All of it, as a file; one in an archive, or in memory, is held in memory.

        Raises
        ------
        UploadTooLarge
            The limit is passed.
        """
        name = getattr(self.stream, "name", None)
        path = Path(name) if isinstance(self.stream, io.BufferedReader) and isinstance(name, str | Path) else None
        if path is None:
            return SpooledFile.of(self.content())
        found = SpooledFile.at(path)
        if found.size > self.limit_bytes:
            raise self.too_large()
        return found

    def content(self) -> bytes:
        """All of it."""
        return b"".join(self.blocks())


def open_parts(parts: Mapping[str, bytes | BinaryIO], limits: TraceLimits) -> list[Part]:
    """Open files, and those within ZIP archives. A stream that is an archive is sought in, so it has to allow that.

    Raises
    ------
    UnreadableUpload
        No file, an empty file, a damaged archive.
    """
    opened: list[Part] = []
    for name, content in parts.items():
        stream: BinaryIO = io.BytesIO(content) if isinstance(content, bytes | bytearray | memoryview) else content
        part = Part(_printable(name), _read(stream, _HEAD, name), stream, limits.file_bytes)
        if is_archive(part.head):
            opened += _members(part, limits)
        else:
            opened.append(part)
    if not opened:
        raise UnreadableUpload("there is no file", field="parts", limit="one or more", cure="send the recording")
    for part in opened:
        if not part.head:
            raise UnreadableUpload(
                f"{part.name} is empty", field=part.name, limit="at least one sample", cure="send the file again, whole"
            )
    return opened


def _members(archive: Part, limits: TraceLimits) -> list[Part]:
    if archive.stream.seek(0, io.SEEK_END) > archive.limit_bytes:
        raise archive.too_large()
    count_members(archive.stream, ArchiveLimits(members=_MAX_MEMBERS, total_bytes=limits.file_bytes))
    opened = []
    try:
        packed = zipfile.ZipFile(archive.stream)
        for info in packed.infolist():
            if not is_file(info):
                continue
            if info.flag_bits & 1 or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise UnsupportedUpload(
                    f"{_printable(info.filename)} is encrypted or compressed by another method than deflate",
                    field=archive.name,
                    limit="stored or deflate",
                    cure="pack it again as a plain ZIP",
                )
            stream = packed.open(info)  # read later, piece by piece
            name = _printable(info.filename)
            limit = min(limits.file_bytes, max(info.compress_size, 1024) * _MAX_RATIO)
            opened.append(Part(name, _read(stream, _HEAD, name), stream, limit))  # type: ignore[arg-type]
    except _DEFECTS as error:
        raise UnreadableUpload(
            f"{archive.name} is damaged or cut short", field=archive.name, cure="pack it again and send it whole"
        ) from error
    return opened


def _read(stream: BinaryIO, size: int, name: str) -> bytes:
    try:
        return stream.read(size)
    except _DEFECTS as error:
        raise UnreadableUpload(
            f"{name} is damaged or cut short in its archive", field=name, cure="pack it again and send it whole"
        ) from error


def _printable(name: str) -> str:
    last = name.replace("\\", "/").rsplit("/", 1)[-1]
    return "".join(c if c.isprintable() and not 0xD800 <= ord(c) <= 0xDFFF else "?" for c in last)[:120]


# === Rising times, plausible speeds and headings, gaps.


MAX_SPEED_M_S = 100.0
"""Largest plausible speed of a vehicle. [m/s] 360 km/h."""
NEAR_S = 1.0
"""A sample has a speed or a heading if a value is so near. [s] As
`app.decoders.magnet.preprocess.MAX_INTERPOLATION_S`."""
_GAP_INTERVALS, _GAP_S = 5.0, 0.02  # a gap is longer than both: in median intervals, [s]
_MAX_RATE_HZ = 20_000.0  # [Hz] largest plausible rate of a bar; METRO's has 350


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """A quantity over time."""

    part: str  # file that it comes from
    # `t_s`, `value`: shape (N,)
    t_s: Floats
    value: Floats


def rising_rows(t: Floats, part: str, limits: TraceLimits, report: TraceReport) -> npt.NDArray[np.intp]:
    """Rows whose times rise; a few others are left out.

    Raises
    ------
    InvalidParameter
        Time runs backwards for more than a few rows.
    UnreadableUpload
        No row has a time.
    """
    rows = np.flatnonzero(np.isfinite(t))
    report.leave_out(part, "rows-without-time", t.size - rows.size, "the time is empty or not a finite number")
    if not rows.size:
        raise UnreadableUpload(
            f"{part} holds no rows that can be read", field=part, limit="one or more", cure="send the file again, whole"
        )
    at = t[rows]
    if at.size > 2:  # a single time far ahead must not hide all that follow
        ahead = np.flatnonzero((at[1:-1] > at[2:]) & (at[2:] > at[:-2]) & (at[1:-1] > at[:-2])) + 1
        report.leave_out(part, "rows-out-of-time", ahead.size, _where(rows, at, ahead))
        rows, at = np.delete(rows, ahead), np.delete(at, ahead)
    highest = np.maximum.accumulate(at)
    back = np.flatnonzero(at[1:] <= highest[:-1]) + 1
    if back.size > max(limits.left_out * at.size, 1):
        still = np.mean(at[back] == highest[back - 1])
        i = int(back[0])
        raise InvalidParameter(
            f"time {'stands still' if still > 0.5 else 'runs backwards'} in {part} from row {rows[i - 1] + 1} "
            f"({at[i - 1]:.6f} s) to row {rows[i] + 1} ({at[i]:.6f} s), and in {back.size} rows in all",
            field=part,
            limit=f"rising, but for {100 * limits.left_out:g} % of the rows",
            cure="give each row its own time, and cut the recording where the clock was set",
        )
    report.leave_out(part, "rows-out-of-time", back.size, _where(rows, at, back))
    return np.delete(rows, back)


def _where(rows: npt.NDArray[np.intp], at: Floats, which: npt.NDArray[np.intp]) -> str:
    return f"time does not rise at row {rows[which[0]] + 1} ({at[which[0]]:.6f} s)" if which.size else ""


def check_sampling(t: Floats, part: str, limits: TraceLimits, report: TraceReport) -> None:
    """Rate, duration and gaps of the samples.

    Raises
    ------
    InvalidParameter
        A rate that no bar has: most often another unit of time.
    UploadTooLarge
        Longer than the limit.
    """
    if t.size < 2:
        raise UnreadableUpload(
            f"{part} holds {t.size} sample{'s' * (t.size != 1)}", field=part, limit="two or more",
            cure="send the file again, whole",
        )  # fmt: skip
    step = np.diff(t)
    usual = float(np.median(step))
    rate = 1 / usual
    if not max(limits.min_rate_hz * 0.95, 1e-9) <= rate <= _MAX_RATE_HZ:
        units = [
            unit
            for unit, scale in (("ms", 1e3), ("us", 1e6), ("ns", 1e9))
            if limits.min_rate_hz <= rate * scale <= 2000
        ]
        cure = f"times look like {units[0]}: declare the unit of time" if units else "record at a higher rate"
        raise InvalidParameter(
            f"{part} has {rate:.4g} samples a second",
            field="columns.time_unit" if units or rate > _MAX_RATE_HZ else part,
            limit=f"{limits.min_rate_hz:g} to {_MAX_RATE_HZ:g} Hz",
            cure=cure if rate < _MAX_RATE_HZ else "declare the unit of time",
        )
    if t[-1] - t[0] > limits.duration_s:
        raise UploadTooLarge(
            f"{part} lasts {t[-1] - t[0]:.0f} s",
            field=part,
            limit=f"{limits.duration_s:g} s",
            cure="cut the recording into shorter ones",
        )
    for i in np.flatnonzero(step > max(_GAP_INTERVALS * usual, _GAP_S)):
        report.add_gap(TraceGap(part, int(i) + 1, float(t[i]), float(step[i] - usual)))


def clean_speed(series: Series, unit: SpeedUnit, limits: TraceLimits, report: TraceReport) -> Series:
    """Speeds in metres a second, without those that are none.

    Raises
    ------
    InvalidParameter
        Most values are implausible: another unit or scaling.
    """
    value = series.value * M_S_PER_UNIT[unit]
    fast = np.isfinite(value) & (np.abs(value) > MAX_SPEED_M_S)
    if fast.sum() > 0.5 * max(np.isfinite(value).sum(), 1):
        raise InvalidParameter(
            f"most speeds in {series.part} are above {MAX_SPEED_M_S:g} m/s, their median is "
            f"{np.nanmedian(np.abs(value)):.4g} m/s",
            field="speed",
            limit=f"{MAX_SPEED_M_S:g} m/s",
            cure="declare the unit of speed, or the factor of the signal",
        )
    report.leave_out(series.part, "speeds-implausible", int(fast.sum()), f"faster than {MAX_SPEED_M_S:g} m/s")
    cleaned = _finite(Series(series.part, series.t_s, np.where(fast, np.nan, value)), "speed", limits, report)
    if cleaned.value.size and not cleaned.value.any():
        report.warn(f"all speeds in {series.part} are zero")
    return cleaned


def clean_heading(series: Series, unit: AngleUnit, limits: TraceLimits, report: TraceReport) -> Series:
    """Headings in degrees from 0 to 360, without those that are none."""
    value = np.degrees(series.value) if unit == "rad" else series.value
    wild = np.isfinite(value) & (np.abs(value) > 720)
    report.leave_out(series.part, "headings-implausible", int(wild.sum()), "beyond two turns")
    with np.errstate(invalid="ignore"):
        value = np.where(wild, np.nan, value) % 360
    return _finite(Series(series.part, series.t_s, value), "heading", limits, report)


def _finite(series: Series, name: str, limits: TraceLimits, report: TraceReport) -> Series:
    ok = np.isfinite(series.value)
    report.leave_out(series.part, f"{name}-missing", int((~ok).sum()), "empty or not a finite number")
    if not ok.any():
        return Series(series.part, np.empty(0), np.empty(0))
    t, value = series.t_s[ok], series.value[ok]
    rows = rising_rows(t, series.part, limits, report)
    return Series(series.part, t[rows], value[rows])


def coverage(t: Floats, series_t: Floats) -> float:
    """Share of the samples with a value of a series nearby."""
    if not series_t.size or not t.size:
        return 0.0
    after = np.clip(np.searchsorted(series_t, t), 0, series_t.size - 1)
    before = np.maximum(after - 1, 0)
    near = np.minimum(np.abs(series_t[after] - t), np.abs(series_t[before] - t)) <= NEAR_S
    return float(near.mean())
