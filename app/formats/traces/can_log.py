"""Speed and heading from CAN logs: files by python-can, signals by a DBC (cantools) or by declared bits."""

from __future__ import annotations

import io
import struct
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge, WaymarkError
from app.formats.columns import require_columns
from app.formats.text import is_clean_text
from app.formats.traces.declaration import ByteOrder, CanDeclaration, CanSignal, TraceLimits
from app.formats.traces.parts import Part
from app.formats.traces.report import TraceReport

Floats = npt.NDArray[np.float64]

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
    placed = replace(
        signal,
        name=None,
        arbitration_id=int(message.frame_id),
        start_bit=int(entry.start),
        length=int(entry.length),
        byte_order=ByteOrder.LITTLE if entry.byte_order == "little_endian" else ByteOrder.BIG,
        signed=bool(entry.is_signed),
        factor=float(getattr(conversion, "scale", 1) or 1),
        offset=float(getattr(conversion, "offset", 0) or 0),
        unit=signal.unit or entry.unit,
        minimum=signal.minimum if signal.minimum is not None else _bound(entry, "minimum"),
        maximum=signal.maximum if signal.maximum is not None else _bound(entry, "maximum"),
    )
    if not (entry.multiplexer_ids or entry.is_multiplexer or conversion.is_float):
        return placed, None
    return placed, partial(_decode_signal, message, entry)


def _load_signals(dbc: Sequence[Part], name: str, field: str) -> dict[str, tuple[Any, Any]]:
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
    found: dict[str, tuple[Any, Any]] = {}
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


def _find_signal(name: str, found: dict[str, tuple[Any, Any]], field: str) -> tuple[Any, Any]:
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
    if signal.byte_order is ByteOrder.LITTLE:
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
