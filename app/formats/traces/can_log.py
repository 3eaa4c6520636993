"""Speed and heading from CAN logs by python-can, with signals by a DBC (cantools) or declared bits; clocks aligned."""

from __future__ import annotations

import io
import struct
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge, WaymarkError
from app.formats.text import is_clean_text, require_columns
from app.formats.traces.declaration import CanDeclaration, CanSignal, TraceLimits, TraceReport
from app.formats.traces.parts import Part, Series
from app.values import Floats

_DEFECTS = (
    ValueError, KeyError, IndexError, TypeError, AttributeError, AssertionError, EOFError, OSError, OverflowError,
    ArithmeticError, RuntimeError, NotImplementedError, struct.error, zlib.error,
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class CanSeries:
    """Values of a signal: times after the first frame of the log [s], and values in `unit`."""

    t_s: Floats
    value: Floats
    unit: str | None


@dataclass(frozen=True, slots=True, eq=False)
class _Frames:
    """Frames of one identifier."""

    t_s: Floats
    data: list[bytes]


def read_can_log(
    part: Part,
    dbc: Sequence[Part],
    declaration: CanDeclaration,
    limits: TraceLimits,
    report: TraceReport,
) -> dict[str, CanSeries]:
    """Series `speed` and `heading` of a log, as far as they are declared.

    Raises
    ------
    UnsupportedUpload
        python-can or cantools is not installed.
    InvalidParameter
        A signal is not in the DBC, or its frames are not in the log.
    UnreadableUpload, UnsupportedUpload, UploadTooLarge
    """
    signals = {n: s for n, s in (("speed", declaration.speed), ("heading", declaration.heading)) if s is not None}
    if not signals:
        raise InvalidParameter(
            "no signal of the CAN log is declared",
            field="can.speed",
            limit="speed, heading or both",
            cure="name the signal in the DBC, or declare identifier, bits and scaling",
        )
    placed: dict[str, tuple[CanSignal, Callable[[bytes], float | None] | None]] = {}
    for name, signal in signals.items():
        placed[name] = (signal, None) if signal.name is None else _from_dbc(signal, dbc, f"can.{name}")
    wanted = {signal.arbitration_id for signal, _ in placed.values()}
    frames, seen = _read_frames(part, wanted, declaration.channel, limits, report)
    series = {}
    for name, (signal, decode) in placed.items():
        group = frames.get(signal.arbitration_id or 0)
        if group is None:
            raise InvalidParameter(
                f"{part.name} has no frames 0x{signal.arbitration_id:X}; it has "
                + ", ".join(f"0x{i:X}" for i in sorted(seen)[:16]),
                field=f"can.{name}",
                limit=f"0x{signal.arbitration_id:X}",
                cure="declare the identifier that carries it",
            )
        value = _extract(group.data, signal) if decode is None else _decode(group.data, decode)
        t, value = _valid(group.t_s, value, signal, part.name, name, report)
        series[name] = CanSeries(t, value, signal.unit)
    return series


def _read_frames(
    part: Part, wanted: set[int | None], channel: int | str | None, limits: TraceLimits, report: TraceReport
) -> tuple[dict[int, _Frames], set[int]]:
    times: dict[int, list[float]] = defaultdict(list)
    data: dict[int, list[bytes]] = defaultdict(list)
    seen: set[int] = set()
    first: float | None = None
    count = 0
    messages = _messages(part)
    try:
        for message in messages:
            count += 1
            if count > limits.can_frames:
                raise UploadTooLarge(
                    f"{part.name} holds more frames than the limit",
                    field=part.name,
                    limit=f"{limits.can_frames} frames",
                    cure="filter the log by identifier, or cut it",
                )
            if first is None:
                first = float(message.timestamp)
            if message.is_error_frame or message.is_remote_frame:
                continue
            if channel is not None and str(message.channel) != str(channel):
                continue
            if len(seen) < 4096:
                seen.add(message.arbitration_id)
            if message.arbitration_id in wanted:
                times[message.arbitration_id].append(float(message.timestamp) - first)
                data[message.arbitration_id].append(bytes(message.data))
    except WaymarkError:
        raise
    except _DEFECTS as error:
        if not count:
            raise UnreadableUpload(
                f"{part.name} cannot be read as a CAN log",
                field=part.name,
                limit="asc, blf, csv, log (candump) or trc",
                cure="export it again; give the file the suffix of its format",
            ) from error
        report.leave_out(part.name, "log-cut-short", 1, f"the log is damaged after frame {count}; the rest is left out")
    if not count:
        raise UnreadableUpload(
            f"{part.name} holds no CAN frames", field=part.name, limit="one or more", cure="check the log's format"
        )
    return {i: _Frames(np.array(times[i]), data[i]) for i in times}, seen


def _messages(part: Part) -> Iterator[Any]:
    """Frames by the reader of the file's format."""
    try:
        import can
    except ImportError as error:
        raise UnsupportedUpload(
            "this server reads no CAN logs: python-can is not installed",
            field=part.name,
            cure="send speed as CSV, or install waymark-roads[can]",
        ) from error
    content = part.content()
    if content.startswith(b"LOGG"):
        return iter(can.BLFReader(io.BytesIO(content)))
    if not is_clean_text(content):
        raise UnsupportedUpload(
            f"{part.name} is no CAN log that is read here", field=part.name, limit="asc, blf, csv, log, trc"
        )
    text = io.StringIO(content.decode("utf-8-sig", "replace"))
    suffix = part.name.rsplit(".", 1)[-1].lower()
    head = content[:4096].lower()
    if b"arbitration_id" in head.split(b"\n", 1)[0]:
        return iter(can.CSVReader(text))
    if suffix == "trc" or head.startswith(b";$fileversion"):
        return iter(can.TRCReader(text))
    if suffix == "log" or head.lstrip().startswith(b"("):
        return iter(can.CanutilsLogReader(text))
    return iter(can.ASCReader(text))


def _from_dbc(
    signal: CanSignal, dbc: Sequence[Part], field: str
) -> tuple[CanSignal, Callable[[bytes], float | None] | None]:
    """The bits of a named signal, and its decoder if bits alone are not enough (multiplexed, floating point)."""
    message, entry = _find_signal(str(signal.name), _load_signals(dbc, str(signal.name), field), field)
    conversion = entry.conversion
    placed = signal.model_copy(
        update={
            "name": None,
            "arbitration_id": int(message.frame_id),
            "start_bit": int(entry.start),
            "length": int(entry.length),
            "byte_order": "little" if entry.byte_order == "little_endian" else "big",
            "signed": bool(entry.is_signed),
            "factor": float(getattr(conversion, "scale", 1) or 1),
            "offset": float(getattr(conversion, "offset", 0) or 0),
            "unit": signal.unit or entry.unit,
            "minimum": signal.minimum if signal.minimum is not None else _bound(entry, "minimum"),
            "maximum": signal.maximum if signal.maximum is not None else _bound(entry, "maximum"),
        }
    )
    if not (entry.multiplexer_ids or entry.is_multiplexer or conversion.is_float):
        return placed, None
    return placed, partial(_decode_signal, message, entry)


def _load_signals(dbc: Sequence[Part], name: str, field: str) -> dict[str, tuple[object, object]]:
    """Messages and signals of all DBCs, by `Message.Signal`."""
    try:
        import cantools
        from cantools.database.errors import Error as DatabaseError
    except ImportError as error:
        raise UnsupportedUpload(
            "this server reads no DBC: cantools is not installed",
            field=field,
            cure="declare identifier, bits and scaling, or install waymark-roads[can]",
        ) from error
    if not dbc:
        raise InvalidParameter(
            f"signal {name!r} is declared by name and no DBC was sent",
            field=field,
            limit="a .dbc file, or identifier and bits",
            cure="send the DBC with the log, or declare identifier, bits and scaling",
        )
    found: dict[str, tuple[object, object]] = {}
    for part in dbc:
        try:
            database = cantools.database.load_string(_text(part), "dbc", strict=False)
        except (DatabaseError, *_DEFECTS) as error:
            raise UnreadableUpload(
                f"{part.name} cannot be read as a DBC", field=part.name, cure="export it again"
            ) from error
        for message in getattr(database, "messages", []):
            found |= {f"{message.name}.{entry.name}": (message, entry) for entry in message.signals}
    return found


def _find_signal(name: str, found: dict[str, tuple[object, object]], field: str) -> tuple[Any, Any]:
    """The message and the signal that a name, with or without its message, stands for."""
    matching = [k for k in found if k == name or k.split(".", 1)[1] == name]
    if len(matching) > 1:
        raise InvalidParameter(
            f"several messages have a signal {name!r}: {', '.join(matching[:6])}",
            field=field,
            limit="one",
            cure="name it as Message.Signal",
        )
    if not matching:
        plain = [k.split(".", 1)[1] for k in found]
        require_columns("the DBC", plain, [name], cure="name a signal of the DBC")
    return found[matching[0]]


def _decode_signal(message: Any, entry: Any, data: bytes) -> float | None:
    from cantools.database.errors import Error as DatabaseError

    try:
        value = message.decode(data, decode_choices=False, allow_truncated=True).get(entry.name)
    except (DatabaseError, *_DEFECTS):
        return None
    return float(value) if isinstance(value, int | float) else None


def _bound(entry: Any, name: str) -> float | None:
    """A limit of the DBC; 0 to 0 means none."""
    if entry.minimum is None or entry.maximum is None or not entry.minimum < entry.maximum:
        return None
    return float(getattr(entry, name))


def _text(part: Part) -> str:
    content = part.content()
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252", "replace")


def _extract(data: list[bytes], signal: CanSignal) -> Floats:
    """Values of a signal in many frames; NaN where a frame is too short."""
    size = max(map(len, data))
    length = np.array([len(d) for d in data])
    table = np.frombuffer(b"".join(d.ljust(size, b"\0") for d in data), np.uint8).reshape(len(data), size)
    bits, need = _bit_places(signal)
    raw = np.zeros(len(data), np.uint64)
    if need > size:
        return np.full(len(data), np.nan)
    for byte, bit in bits:  # most significant first
        raw = (raw << np.uint64(1)) | ((table[:, byte] >> np.uint8(bit)) & np.uint8(1)).astype(np.uint64)
    if signal.signed:
        shift = np.uint64(64 - signal.length)
        number = ((raw << shift).view(np.int64) >> np.int64(shift)).astype(float)
    else:
        number = raw.astype(float)
    return np.where(length >= need, number * signal.factor + signal.offset, np.nan)


def _bit_places(signal: CanSignal) -> tuple[list[tuple[int, int]], int]:
    """Byte and bit of each bit of a signal, most significant first; and the bytes that a frame needs."""
    places = []
    if signal.byte_order == "little":
        places = [divmod(signal.start_bit + i, 8) for i in range(signal.length - 1, -1, -1)]
    else:
        byte, bit = divmod(signal.start_bit, 8)
        for _ in range(signal.length):
            places.append((byte, bit))
            byte, bit = (byte, bit - 1) if bit else (byte + 1, 7)
    return places, max(byte for byte, _ in places) + 1


def _decode(data: list[bytes], decode: Callable[[bytes], float | None]) -> Floats:
    return np.array([np.nan if (v := decode(d)) is None else v for d in data])


def _valid(
    t: Floats, value: Floats, signal: CanSignal, part: str, name: str, report: TraceReport
) -> tuple[Floats, Floats]:
    """Leave out what is no value."""
    low = -np.inf if signal.minimum is None else signal.minimum
    high = np.inf if signal.maximum is None else signal.maximum
    ok = np.isfinite(value) & (value >= low) & (value <= high)
    report.leave_out(
        part, f"{name}-invalid", int((~ok).sum()), "frames too short, or values beyond the signal's minimum and maximum"
    )
    return t[ok], value[ok]


# === The offset between a CAN log's clock and the trace's, by the wheels that the reference sensors hear.
#
# A magnetised wheel turns with the frequency v / circumference: where the speed changes, the lines in the spectrogram
# of the reference sensors follow it at one offset only. Without wheels or changes of speed there is nothing to align
# by.


_RATE_HZ = 100.0  # [Hz] of the spectrogram's signal; a wheel's second harmonic is slower
_WINDOW, _PADDED = 128, 512  # samples of a window and of its transform; 1.3 s, bins of 0.2 Hz
_FRAMES = 1200  # windows at most; bounds the time
_COARSE_S, _FINE_S = 0.2, 0.02  # [s] steps of the offset; below the length of a window
_CIRCUMFERENCE_M = np.linspace(1.5, 2.6, 56)  # [m] trial lengths of a turn; source: tyres from small cars to vans
_MIN_SPEED_M_S = 2.0  # [m/s] slower windows are left out; the lines are below 1 Hz there
_MIN_DEVIATIONS = 6.0  # by which the best offset must exceed the mean of the others
_MIN_LEAD = 1.15  # of the best offset over the next one
_APART_S = 1.5  # [s] offsets further apart than this are others; longer than a window
_MAX_WORK = 3e8  # offsets times windows times circumferences; bounds the time


def align_speed(
    t: Floats,
    field_ut: npt.NDArray[np.floating],
    references: Sequence[int] | npt.NDArray[np.intp],
    speed: Series | None,
    part: str,
    report: TraceReport,
) -> float:
    """Trace time of the CAN log's first frame. [s]

    Parameters
    ----------
    t : ndarray, shape (T,)
    field_ut : ndarray, shape (T, S, 3)
    references : sequence of int
        Indices of the sensors near the wheels.
    speed : Series or None
        Over times after the log's first frame.

    Raises
    ------
    InvalidParameter
        There is nothing to align by, or no offset stands out.
    """
    near = [i for i in references if i < field_ut.shape[1]]
    if speed is None or speed.t_s.size < 10 or not near:
        raise _undecided(part, "it holds no speed" if near else "no reference sensor near a wheel is declared")
    at, lines = _spectrogram(t, field_ut[:, near])
    if not at.size:
        raise _undecided(part, "the trace is too short")
    duration, log = t[-1] - t[0], speed.t_s[-1] - speed.t_s[0]
    shared = 0.6 * min(duration, log)
    lags = np.arange(t[0] - log + shared, t[-1] - shared + _COARSE_S, _COARSE_S) - speed.t_s[0]
    if lags.size * at.size * _CIRCUMFERENCE_M.size > _MAX_WORK:
        raise _undecided(part, "trace and log are too long to search all offsets")
    coarse = np.array([_follow(at, lines, speed, lag, _CIRCUMFERENCE_M) for lag in lags])
    best = int(np.argmax(coarse.max(1)))
    score = coarse.max(1)
    others = score[np.abs(lags - lags[best]) > _APART_S]
    if others.size < 5:
        raise _undecided(part, "trace and log are too short")
    deviations = (score[best] - others.mean()) / max(float(others.std()), 1e-9)
    if deviations < _MIN_DEVIATIONS or score[best] < _MIN_LEAD * others.max():
        lead = score[best] / max(float(others.max()), 1e-9)
        raise _undecided(part, f"no offset stands out ({deviations:.1f} deviations, {lead:.2f} times the next)")
    around = _CIRCUMFERENCE_M[int(np.argmax(coarse[best]))] * np.linspace(0.98, 1.02, 17)
    fine = np.arange(lags[best] - 2 * _COARSE_S, lags[best] + 2 * _COARSE_S, _FINE_S)
    curve = np.array([_follow(at, lines, speed, lag, around).max() for lag in fine])
    top = curve > curve.max() - 0.25 * (curve.max() - curve.min())
    offset = float(np.average(fine[top], weights=curve[top] - curve[top].min() + 1e-9))
    report.warn(f"{part} was aligned by the wheels' noise: its first frame is at {offset:.2f} s of the trace")
    return offset


def _spectrogram(t: Floats, field_ut: npt.NDArray[np.floating]) -> tuple[Floats, Floats]:
    """Middle times of windows (W,) and how far each frequency stands out in them (W, F), clipped."""
    grid = np.arange(t[0], t[-1], 1 / _RATE_HZ)
    last = grid.size - _WINDOW
    if last < 10:
        return np.empty(0), np.empty((0, 0))
    starts = np.arange(0, last, max(25, last // _FRAMES))
    window = np.hanning(_WINDOW)
    power = np.zeros((starts.size, _PADDED // 2 + 1))
    ramp = np.linspace(-1, 1, _WINDOW)
    for channel in field_ut.reshape(len(field_ut), -1).T:
        ok = np.isfinite(channel)
        if ok.sum() < 2:
            continue
        even = np.interp(grid, t[ok], channel[ok].astype(float))
        pieces = even[starts[:, None] + np.arange(_WINDOW)]
        pieces = pieces - pieces.mean(1, keepdims=True)
        pieces -= (pieces @ ramp)[:, None] / (ramp @ ramp) * ramp
        power += np.abs(np.fft.rfft(pieces * window, _PADDED, axis=1)) ** 2
    level = np.log(power + 1e-9)
    level -= np.median(level, axis=1, keepdims=True)
    return grid[starts] + _WINDOW / 2 / _RATE_HZ, np.clip(level, 0, 5)


def _follow(at: Floats, lines: Floats, speed: Series, lag: float, circumference_m: Floats) -> Floats:
    """How much stands out at the wheel's frequency and twice it, mean over the windows, for each circumference."""
    v = np.abs(np.interp(at - lag, speed.t_s, speed.value, left=np.nan, right=np.nan))
    moving = np.flatnonzero(v > _MIN_SPEED_M_S)
    if moving.size < 0.3 * at.size:
        return np.zeros(circumference_m.size)
    bin_hz = _RATE_HZ / _PADDED
    index = v[moving, None] / (circumference_m * bin_hz)
    limit = lines.shape[1] - 1
    first = np.minimum(np.round(index).astype(np.intp), limit)
    second = np.minimum(np.round(2 * index).astype(np.intp), limit)
    rows = moving[:, None]
    standing: Floats = (lines[rows, first] + lines[rows, second]).mean(0)
    return standing - float(lines[moving].mean())


def _undecided(part: str, why: str) -> InvalidParameter:
    return InvalidParameter(
        f"the clock of {part} cannot be aligned with the trace: {why}",
        field="can.offset_s",
        limit="changes of speed and wheels that the reference sensors hear, or a declared offset",
        cure="declare the trace time of the log's first frame",
    )
