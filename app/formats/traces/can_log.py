"""Speed and heading from CAN logs by python-can, with signals by a DBC (cantools) or declared bits; clocks aligned."""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge, WaymarkError
from app.formats.text import is_clean_text, require_columns
from app.formats.traces.declaration import MAX_STANDARD, CanDeclaration, CanSignal, TraceLimits, TraceReport
from app.formats.traces.parts import Part, Series
from app.values import Floats

_DEFECTS = (
    ValueError, KeyError, IndexError, TypeError, AttributeError, AssertionError, EOFError, OSError, OverflowError,
    ArithmeticError, RuntimeError, NotImplementedError, struct.error, zlib.error,
)  # fmt: skip
_LOGS = "asc, blf, csv (python-can, SavvyCAN), log (candump -l or -L) or trc"
_MAX_KINDS = 4096  # kinds of frames that messages name
_BEFORE_ZERO = "frames with negative times"
SAVVYCAN_HEADER = re.compile(r"time stamp,\s*id,\s*extended,(.*,)?\s*bus,\s*len", re.IGNORECASE)
"""The first line of SavvyCAN's CSV; older versions leave out Dir."""
CANDUMP_CONSOLE = re.compile(
    r"^\s*(?:\([^()\n]*\)\s+)?[A-Za-z]\S{0,15}\s+(?:[RT]X [-B ]{3}\s+)?(?:[0-9A-F]{3}|[0-9A-F]{8})\s+\[\d{1,2}\]",
    re.MULTILINE,
)
"""A frame as candump shows it, with a time (-ta, -td, -tz, -tA) or without one."""
_ASC_RELATIVE = re.compile(r"^\s*base\s+(?:hex|dec)\s+timestamps\s+relative", re.IGNORECASE | re.MULTILINE)
_ASC_TRIGGER = re.compile(r"^\s*begin\s+triggerblock", re.IGNORECASE | re.MULTILINE)
_ASC_TIME = re.compile(r"^[ \t]*\d+\.\d+(?=\s)", re.MULTILINE)
_ASC_BEFORE_ZERO = re.compile(r"^[ \t]*-\d+\.\d+\s+(?:\d+\s+\w+\s+[RT]x|CANFD)\b", re.MULTILINE)


@dataclass(frozen=True, slots=True, eq=False)
class CanSeries:
    """Values of a signal: times after the first frame of the log [s], and values in `unit`."""

    t_s: Floats
    value: Floats
    unit: str | None


_ANY_SOURCE = 0xFE
"""From this source address on, J1939 names no single sender: 0xFE is the null address, 0xFF the global one."""


class _FrameKind(NamedTuple):
    """What frames of one sender share."""

    arbitration_id: int
    is_extended: bool  # of 29 bits, not of 11
    channel: str | None  # as the file writes it; None where it writes none

    @property
    def identifier(self) -> str:
        """As logs write it: 8 digits if it is of 29 bits."""
        return f"0x{self.arbitration_id:08X}" if self.is_extended else f"0x{self.arbitration_id:X}"

    def matches(self, signal: CanSignal) -> bool:
        """Whether such frames may hold a signal."""
        wanted = signal.arbitration_id or 0
        if self.arbitration_id == wanted:
            return True
        wants_extended = signal.extended or wanted > MAX_STANDARD
        if not (self.is_extended and wants_extended and wanted & 0xFF >= _ANY_SOURCE):
            return False
        return _parameter_group(self.arbitration_id) == _parameter_group(wanted)


def _parameter_group(arbitration_id: int) -> int:
    """The parameter group number (PGN) of an identifier of J1939: without priority, destination and source."""
    group = arbitration_id >> 8 & 0x3FFFF
    return group if group >> 8 & 0xFF >= 240 else group & 0x3FF00  # PDU1: the low byte is the destination


@dataclass(slots=True)
class _Frames:
    """Frames of one kind: times after the first frame of the log [s], and bytes."""

    t_s: list[float] = field(default_factory=list)
    data: list[bytes] = field(default_factory=list)


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
    frames = _read_frames(part, [signal for signal, _ in placed.values()], limits, report)
    series = {}
    for name, (signal, decode) in placed.items():
        channel = declaration.channel if signal.channel is None else signal.channel
        kind = _choose_kind(part.name, frames, signal, channel, f"can.{name}", report)
        group = frames[kind]
        value = _extract(group.data, signal) if decode is None else _decode(group.data, decode)
        t, value = _valid(np.array(group.t_s), value, signal, part.name, name, report)
        series[name] = CanSeries(t, value, signal.unit)
    return series


def _read_frames(
    part: Part, signals: Collection[CanSignal], limits: TraceLimits, report: TraceReport
) -> dict[_FrameKind, _Frames]:
    """Frames by their kind; those that hold no signal are only named, with empty lists."""
    kinds: dict[tuple[int, bool, object], tuple[_Frames, bool]] = {}
    first: float | None = None
    count = negative = 0
    messages, first_channel = _messages(part, report)
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
            if message.timestamp < 0:
                negative += 1
                continue
            if first is None:
                first = float(message.timestamp)
            if message.is_error_frame or message.is_remote_frame:
                continue
            key = (message.arbitration_id, message.is_extended_id, message.channel)
            known = kinds.get(key)
            if known is None:
                kind = _FrameKind(*key[:2], None)
                known = _Frames(), any(kind.matches(signal) for signal in signals)
                if known[1] or len(kinds) < _MAX_KINDS:
                    kinds[key] = known
            if known[1]:
                known[0].t_s.append(float(message.timestamp) - first)
                known[0].data.append(bytes(message.data))
    except WaymarkError:
        raise
    except _DEFECTS as error:
        if not count:
            raise UnreadableUpload(
                f"{part.name} cannot be read as a CAN log",
                field=part.name,
                limit=_LOGS,
                cure="export it again; give the file the suffix of its format",
            ) from error
        report.leave_out(part.name, "log-cut-short", 1, f"the log is damaged after frame {count}; the rest is left out")
    report.leave_out(part.name, "frames-before-zero", negative, _BEFORE_ZERO)
    if count == negative:
        raise UnreadableUpload(
            f"{part.name} holds no CAN frames" + (" at times from 0 s on" if negative else ""),
            field=part.name,
            limit="one or more",
            cure="check the log's format",
        )
    return {
        _FrameKind(number, extended, _written_channel(channel, first_channel)): frames
        for (number, extended, channel), (frames, _wanted) in kinds.items()
    }


def _written_channel(channel: object, first_channel: int) -> str | None:
    """A channel as the file writes it: python-can counts those of ASC and BLF from 0, the files from 1."""
    return str(channel + first_channel) if isinstance(channel, int) else channel if isinstance(channel, str) else None


def _choose_kind(
    name: str,
    frames: dict[_FrameKind, _Frames],
    signal: CanSignal,
    channel: int | str | None,
    field: str,
    report: TraceReport,
) -> _FrameKind:
    """The one kind of frames that holds a signal.

    Raises
    ------
    InvalidParameter
        There are no such frames, or several kinds of them: on several channels, or from several senders.
    """
    number = signal.arbitration_id or 0
    extended = number > MAX_STANDARD if signal.extended is None else signal.extended
    if channel is not None and not any(kind.channel == str(channel) for kind in frames):
        shown = sorted({kind.channel for kind in frames if kind.channel is not None})
        raise InvalidParameter(
            f"{name} has no frames of channel {channel}; "
            + (f"its channels are {', '.join(shown[:16])}" if shown else "it does not write channels"),
            field="can.channel",
            limit=", ".join(shown[:16]) or "left out",
            cure="declare a channel as the file writes it, or none",
        )
    there = {kind for kind in frames if channel is None or kind.channel == str(channel)}
    found = {kind for kind in there if kind.matches(signal) and kind.is_extended == extended}
    if exact := {kind for kind in found if kind.arbitration_id == number}:
        found = exact
    if not found and signal.extended is None and (others := {kind for kind in there if kind.arbitration_id == number}):
        found = others
        report.warn(
            f"{name} has 0x{number:X} only as a 29-bit identifier, and it was read as such; "
            f"declare {field}.extended to confirm this"
        )
    senders = sorted({kind.identifier for kind in found})
    if not senders:
        seen = sorted({kind[:2]: kind.identifier for kind in there}.items())
        raise InvalidParameter(
            f"{name} has no frames {_FrameKind(number, extended, None).identifier}"
            + (f" on channel {channel}" if channel is not None else "")
            + f" ({29 if extended else 11}-bit identifier); it has "
            + ", ".join(identifier for _key, identifier in seen[:16]),
            field=field,
            limit=_FrameKind(number, extended, None).identifier,
            cure="declare the identifier that carries it, and extended if it has 29 bits although it is small",
        )
    if len(senders) > 1:
        raise InvalidParameter(
            f"several identifiers in {name} carry parameter group {_parameter_group(number)} of J1939: "
            + ", ".join(senders[:16]),
            field=f"{field}.arbitration_id",
            limit=", ".join(senders[:16]),
            cure="declare, beside the name of the signal, the identifier of one of them",
        )
    if len(found) > 1:
        shown = sorted(str(kind.channel) for kind in found)
        raise InvalidParameter(
            f"several channels of {name} carry {senders[0]}: {', '.join(shown[:16])}",
            field="can.channel",
            limit=", ".join(shown[:16]),
            cure="declare the channel",
        )
    return found.pop()


def _messages(part: Part, report: TraceReport) -> tuple[Iterator[Any], int]:
    """Frames by the reader of the file's format, and what is added to their channels to get those in the file."""
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
        return iter(can.BLFReader(io.BytesIO(content))), 1
    if not is_clean_text(content):
        raise UnsupportedUpload(f"{part.name} is no CAN log that is read here", field=part.name, limit=_LOGS)
    text = content.decode("utf-8-sig", "replace")
    suffix = part.name.rsplit(".", 1)[-1].lower()
    head = text[:4096]
    first = head.split("\n", 1)[0].lower()
    if "arbitration_id" in first:
        return iter(can.CSVReader(io.StringIO(text))), 0
    if SAVVYCAN_HEADER.match(first):
        return _read_savvycan(text), 0
    if CANDUMP_CONSOLE.search(head):
        raise UnsupportedUpload(
            f"{part.name} is what candump shows on a console, not a log file of candump",
            field=part.name,
            limit=_LOGS,
            cure="record with candump -l, or with candump -L and its output in a file",
        )
    if suffix == "trc" or head.lower().startswith(";$fileversion"):
        return iter(can.TRCReader(io.StringIO(text))), 0
    if suffix == "log" or head.lstrip().startswith("("):
        return iter(can.CanutilsLogReader(io.StringIO(text))), 0
    report.leave_out(part.name, "frames-before-zero", len(_ASC_BEFORE_ZERO.findall(text)), _BEFORE_ZERO)
    if _ASC_RELATIVE.search(head):
        text = _with_absolute_times(part.name, text)
    return iter(can.ASCReader(io.StringIO(text))), 1


def _with_absolute_times(name: str, text: str) -> str:
    """An ASC file with relative times, which are intervals since the line before, with times since its first line."""
    if len(_ASC_TRIGGER.findall(text)) > 1:
        raise UnsupportedUpload(
            f"{name} has relative times and several trigger blocks, and does not show the time between them",
            field=name,
            limit="one trigger block, or absolute times",
            cure="export the log with absolute times",
        )
    passed_s = 0.0

    def absolute(found: re.Match[str]) -> str:
        nonlocal passed_s
        passed_s += float(found[0])
        return f"{passed_s:.9f}"

    return _ASC_TIME.sub(absolute, text)


def _read_savvycan(text: str) -> Iterator[Any]:
    """Frames of a CSV file as SavvyCAN writes it: times in microseconds, identifiers and bytes in hexadecimal."""
    import can

    lines = iter(text.splitlines())
    place = {name.strip().lower(): i for i, name in enumerate(next(lines).split(","))}
    time, number, extended, bus, length = (place[n] for n in ("time stamp", "id", "extended", "bus", "len"))
    for line in lines:
        if not line.strip():
            continue
        cells = [cell.strip() for cell in line.split(",")]
        data = bytes(int(cell, 16) for cell in cells[length + 1 : length + 1 + int(cells[length])])
        yield can.Message(
            timestamp=1e-6 * float(cells[time]),
            arbitration_id=int(cells[number], 16) & 0x1FFFFFFF,
            is_extended_id=cells[extended].lower() in ("true", "1"),
            channel=int(cells[bus]),
            data=data,
            is_fd=len(data) > 8,
        )


def _from_dbc(
    signal: CanSignal, dbc: Sequence[Part], field: str
) -> tuple[CanSignal, Callable[[bytes], float | None] | None]:
    """The bits of a named signal, and its decoder if bits alone are not enough (multiplexed, floating point)."""
    message, entry = _find_signal(str(signal.name), _load_signals(dbc, str(signal.name), field), field)
    conversion = entry.conversion
    placed = signal.model_copy(
        update={
            "name": None,
            "arbitration_id": int(message.frame_id) if signal.arbitration_id is None else signal.arbitration_id,
            "extended": bool(message.is_extended_frame or (signal.arbitration_id or 0) > MAX_STANDARD)
            if signal.extended is None
            else signal.extended,
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
