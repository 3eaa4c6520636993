"""Valid traces of magnetometers as CSV, and signals in CAN logs, with known content."""

from __future__ import annotations

import struct
import tempfile
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from app.formats.traces.can_log import read_can_log
from app.formats.traces.declaration import (
    CanDeclaration,
    CanSignal,
    TraceColumns,
    TraceDeclaration,
    TraceLimits,
    TraceReport,
)
from app.formats.traces.parts import open_parts
from app.formats.traces.read import read_trace
from app.sensors.magnetometer_bar import BarDeclaration
from app.values import Floats
from benchmarks.fuzz.grammar import Check, Grammar, Rng
from benchmarks.fuzz.grammar_tables import calendar_text, chance, instants, pick, zone_text

# === CSV: fields of several sensors, speeds and headings in the same file or in one beside it.

_PER_UT = {"uT": 1.0, "nT": 1000.0, "mT": 0.001, "gauss": 0.01, "mG": 10.0}
_PER_M_S = {"m/s": 1.0, "km/h": 3.6, "mph": 3600 / 1609.344, "kn": 3600 / 1852}


@dataclass(frozen=True, slots=True)
class _Csv:
    """How the files of a recording are written."""

    delimiter: str
    point: str
    line_end: str
    time_unit: str
    is_exponential: bool

    def number(self, value: float) -> str:
        """An empty cell where there is none."""
        if np.isnan(value):
            return ""
        return (f"{value:.9e}" if self.is_exponential else f"{value:.9f}").replace(".", self.point)

    def times(self, rng: Rng, begins: datetime, t_s: Floats) -> list[str]:
        """Of a clock that begins at some time; `begins` in 1970 is a clock that counts from zero."""
        steps_us = [round(at * 1e6) for at in t_s.tolist()]
        if self.time_unit == "iso":
            zone_s, middle = int(pick(rng, 0, 7200, -19_800)), str(pick(rng, "T", " "))
            zone = str(pick(rng, "Z", "z", "+00:00", "")) if not zone_s else zone_text(zone_s)
            form = f"%Y-%m-%d{middle}%H:%M:%S"
            return [calendar_text(at, form, 6, zone_s, self.point) + zone for at in instants(begins, steps_us)]
        start_us = round(begins.timestamp()) * 1_000_000
        counts = [(start_us + step_us) * 1000 for step_us in steps_us]  # [ns]
        decimals = {"s": 9, "ms": 6, "us": 3, "ns": 0}[self.time_unit]
        whole = [divmod(count, 10**decimals) for count in counts]
        return [f"{a}{self.point}{b:0{decimals}d}" if decimals else str(a) for a, b in whole]

    def write(self, rng: Rng, columns: dict[str, list[str]]) -> bytes:
        """Columns in any order, some names in quotes."""
        names = list(columns)
        names = [names[int(place)] for place in rng.permutation(len(names))]
        header = self.delimiter.join(f'"{name}"' if chance(rng, 0.1) else name for name in names)
        rows = [self.delimiter.join(cells) for cells in zip(*(columns[name] for name in names), strict=True)]
        mark = "\ufeff" if chance(rng, 0.2) else ""
        return (mark + self.line_end.join([header, *rows]) + self.line_end).encode()


def _trace(rng: Rng) -> tuple[bytes, Check]:
    """A bar of three or four sensors."""
    delimiter = str(pick(rng, ",", ";", "\t"))
    form = _Csv(
        delimiter, str(pick(rng, ".", ",")) if delimiter != "," else ".", str(pick(rng, "\n", "\r\n")),
        str(pick(rng, "s", "ms", "us", "ns", "iso")), chance(rng, 0.2),
    )  # fmt: skip
    sensors, count = int(rng.integers(3, 5)), int(rng.integers(20, 80))
    t_s = np.cumsum(rng.integers(1800, 2600, count)) / 1e6
    if chance(rng, 0.3):
        t_s[count // 2 :] += 0.75  # samples were lost
    begins = datetime(1970, 1, 1, tzinfo=UTC)
    if form.time_unit == "iso" or chance(rng):
        begins = datetime(2018, 1, 1, tzinfo=UTC) + timedelta(seconds=int(rng.integers(0, 400_000_000)))
    unit, axes = str(pick(rng, *_PER_UT)), str(pick(rng, "ISO8855", "FLU", "FRD"))
    offset_ut = rng.uniform(-150, 150, (sensors, 3))
    # fields that agree within 20 % are taken to be the earth's, whose size is checked (_check_unit): offsets differ
    offset_ut[:, 0] = 120 * (-1.0) ** np.arange(sensors) + offset_ut[:, 0] / 5
    field_ut = offset_ut + np.array((20, 5, -45)) + rng.normal(0, 2, (count, sensors, 3))
    missing = rng.random((count, sensors)) < float(pick(rng, 0.0, 0.05))
    recorded = field_ut * np.array((1, -1, -1) if axes == "FRD" else (1, 1, 1)) * _PER_UT[unit]
    recorded[missing] = np.nan
    speed_unit, heading_unit = str(pick(rng, *_PER_M_S)), str(pick(rng, "deg", "rad"))
    beside = chance(rng, 0.3)  # speeds in a file of their own
    own_s = np.sort(t_s[0] + rng.choice(np.arange(1, 400), 8, replace=False) * 1e-3) if beside else t_s
    speed_m_s, heading_deg = rng.uniform(-5, 40, len(own_s)), rng.uniform(0, 359.9, len(own_s))
    has_heading = chance(rng, 0.6)
    names = [(f"s{k}_x", f"s{k}_y", f"s{k}_z") for k in range(1, sensors + 1)]
    if chance(rng):
        names = [(f"Bx {k}", f"By {k}", f"B z{k}") for k in range(sensors)]
    written_deg = heading_deg - 360 * (heading_deg > 180) if chance(rng) else heading_deg
    series = {"v": [form.number(v * _PER_M_S[speed_unit]) for v in speed_m_s.tolist()]}
    if has_heading:
        turned = np.radians(written_deg) if heading_unit == "rad" else written_deg
        series["psi"] = [form.number(value) for value in turned.tolist()]
    columns = {"clock": form.times(rng, begins, t_s)}
    for k, triple in enumerate(names):
        for axis, name in enumerate(triple):
            columns[name] = [form.number(value) for value in recorded[:, k, axis].tolist()]
    for name, cell in (("temperature", "21"), ("status", "ok"), ("empty", "")):
        if chance(rng, 0.2):
            columns[name] = [cell] * count
    files: dict[str, bytes | Any] = {"field.csv": form.write(rng, columns | ({} if beside else series))}
    if beside:
        files["speed.csv"] = form.write(rng, {"clock": form.times(rng, begins, own_s)} | series)
    table = TraceColumns.model_validate(
        {
            "time": "clock", "time_unit": form.time_unit, "field": names if names[0][0] != "s1_x" else (), "speed": "v",
            "speed_unit": speed_unit, "heading": "psi", "heading_unit": heading_unit, "delimiter": delimiter,
            "decimal": form.point,
        }
    )  # fmt: skip
    bar = BarDeclaration.model_validate({"sensors": [{"position_m": (0.0, 0.16 * k, 0.0)} for k in range(sensors)]})
    declaration = TraceDeclaration.model_validate({"bar": bar, "unit": unit, "axes": axes, "columns": table})
    zero_s = t_s[0] if begins.year > 1970 else 0.0
    shown = b"\n".join(files.values())

    def check() -> str:
        read = read_trace(files, declaration)
        trace, what = read.trace, f"{form}, {unit}, {axes}"
        if len(trace.t_s) != count or np.abs(trace.t_s - (t_s - zero_s)).max() > 2e-6:
            return f"times of {len(trace.t_s)} of {count} samples ({what}, {read.report.left_out})"
        if not np.array_equal(np.isnan(trace.field_ut).any(2), missing):
            return f"fields that are missing ({what})"
        off_ut = np.nanmax(np.abs(trace.field_ut - field_ut))
        if off_ut > 1e-4:
            return f"fields off by {off_ut:.4f} uT ({what})"
        if len(trace.speed_t_s) != len(own_s) or np.abs(trace.speed_t_s - (own_s - zero_s)).max() > 2e-6:
            return f"times of speeds ({what})"
        if np.abs(trace.speed_m_s - speed_m_s).max() > 1e-7:
            return f"speeds off by {np.abs(trace.speed_m_s - speed_m_s).max()} m/s ({what}, {speed_unit})"
        if has_heading is (trace.heading_deg is None):
            return f"headings: {trace.heading_deg} ({what})"
        if trace.heading_deg is not None and np.abs((trace.heading_deg - heading_deg + 180) % 360 - 180).max() > 1e-6:
            return f"other headings ({what}, {heading_unit})"
        if bool(read.report.gap_count) is not bool(np.diff(t_s).max() > 0.1):
            return f"{read.report.gap_count} gaps ({what})"
        return ""

    return shown, check


# === Signals in CAN logs: bits of both byte orders, signed and floating point, declared or named in a DBC.


@dataclass(frozen=True, slots=True)
class _Bits:
    """Where a signal stands, as a DBC counts: a big-endian signal begins at its highest bit."""

    start: int
    length: int
    is_big: bool
    is_signed: bool
    is_float: bool = False

    def places(self) -> list[int]:
        """Bits of the frame, the most significant first, numbered from the lowest bit of byte 0."""
        if not self.is_big:
            return [self.start + k for k in reversed(range(self.length))]
        # counted from the highest bit of byte 0 a big-endian signal is one run of bits
        first = self.start // 8 * 8 + 7 - self.start % 8
        return [place // 8 * 8 + 7 - place % 8 for place in range(first, first + self.length)]

    def put(self, frame: int, raw: int) -> int:
        """The frame, as a number in little-endian order, with this value."""
        for k, place in enumerate(self.places()):
            bit = raw >> (self.length - 1 - k) & 1
            frame = frame & ~(1 << place) | bit << place
        return frame


def _draw_bits(rng: Rng, taken: set[int], *, floats: bool) -> _Bits:
    while True:
        is_float = floats and chance(rng, 0.25)
        length = int(pick(rng, 32, 64)) if is_float else int(rng.integers(4, 33))
        bits = _Bits(int(rng.integers(0, 64)), length, chance(rng), chance(rng), is_float)
        places = bits.places()
        if min(places) >= 0 and max(places) < 64 and not taken & set(places):
            return bits


def _can_signals(rng: Rng) -> tuple[bytes, Check]:
    """Speed and heading in one identifier, in a log that python-can writes."""
    by_name, is_extended = chance(rng), chance(rng)
    own = int(rng.integers(0x800, 0x1FFFFFFF) if is_extended else rng.integers(1, 0x7FF))
    is_switched = by_name and chance(rng, 0.3)  # signals in frames of one multiplexer value only
    taken = set(range(8)) if is_switched else set()
    speed = _draw_bits(rng, taken, floats=by_name)
    signals = {"speed": speed}
    if speed.length < 64 and chance(rng, 0.8):  # signals of a DBC do not overlap
        signals["heading"] = _draw_bits(rng, taken | set(speed.places()), floats=False)
    factor, offset = float(pick(rng, 0.01, 0.1, 1.0, -0.5)), float(pick(rng, 0.0, -40.0, 12.5))
    count, step_s = int(rng.integers(12, 50)), 0.02
    frames: list[tuple[float, bytes]] = []
    wanted: dict[str, list[tuple[float, float]]] = {name: [] for name in signals}
    for k in range(count):
        frame = int.from_bytes(rng.bytes(8), "little")
        has_signal = True
        if is_switched:
            has_signal = k == 0 or chance(rng)
            frame = frame & ~0xFF | (3 if has_signal else 5)
        for name, bits in signals.items():
            value, raw = _draw_value(rng, bits)
            frame = bits.put(frame, raw)
            if has_signal:
                wanted[name].append((k * step_s, value * factor + offset))
        frames.append((100.0 + k * step_s, frame.to_bytes(8, "little")))
    declared = {
        name: CanSignal.model_validate(
            {"name": f"Car.{name}", "unit": unit} if by_name else {
                "arbitration_id": own, "extended": is_extended, "start_bit": bits.start, "length": bits.length,
                "byte_order": "big" if bits.is_big else "little", "signed": bits.is_signed, "factor": factor,
                "offset": offset, "unit": unit,
            }
        )
        for name, bits, unit in ((name, bits, {"speed": "km/h"}.get(name, "deg")) for name, bits in signals.items())
    }  # fmt: skip
    log_name, log = _write_log(rng, own, frames, is_extended=is_extended)
    files = {log_name: log}
    if by_name:
        files["car.dbc"] = _dbc(
            own | (0x80000000 if is_extended else 0), signals, factor, offset, is_switched=is_switched
        )

    def check() -> str:
        parts = {part.name: part for part in open_parts(files, TraceLimits())}
        dbc = [parts["car.dbc"]] if by_name else []
        declaration = CanDeclaration.model_validate(declared | {"offset_s": 0.0})
        read = read_can_log(parts[log_name], dbc, declaration, TraceLimits(), TraceReport())
        for name, bits in signals.items():
            times_s, values = np.array(wanted[name]).T
            found = read[name]
            if len(found.value) != len(values):
                return f"{name} in {log_name}: {len(found.value)} of {len(values)} values ({bits}, by name: {by_name})"
            if np.abs(found.t_s - times_s).max() > 2e-5:
                return f"{name} in {log_name}: times off by {np.abs(found.t_s - times_s).max():.6f} s"
            if not np.allclose(found.value, values, rtol=1e-9, atol=1e-9):
                return f"{name} in {log_name}: {found.value[:3]}, not {values[:3]} ({bits}, by name: {by_name})"
        return ""

    return b"\n".join(files.values()), check


def _draw_value(rng: Rng, bits: _Bits) -> tuple[float, int]:
    """A value before factor and offset, and its bits."""
    if bits.is_float:
        value = round(float(rng.uniform(-100, 100)), 3)
        form = "f" if bits.length == 32 else "d"
        packed = struct.pack(f">{form}", value)
        return struct.unpack(f">{form}", packed)[0], int.from_bytes(packed, "big")
    raw = int(rng.integers(0, 1 << bits.length))
    return float(raw - (1 << bits.length) if bits.is_signed and raw >> (bits.length - 1) else raw), raw


def _dbc(own: int, signals: dict[str, _Bits], factor: float, offset: float, *, is_switched: bool) -> bytes:
    """One message with its signals."""
    lines = ['VERSION ""', "NS_ :", "BS_:", "BU_: ECU", f"BO_ {own} Car: 8 ECU"]
    if is_switched:
        lines.append(' SG_ which M : 0|8@1+ (1,0) [0|0] "" ECU')
    kinds = []
    for name, bits in signals.items():
        order, sign = "0" if bits.is_big else "1", "-" if bits.is_signed or bits.is_float else "+"
        place = f"{bits.start}|{bits.length}@{order}{sign}"
        lines.append(f' SG_ {name}{" m3" if is_switched else ""} : {place} ({factor:g},{offset:g}) [0|0] "x" ECU')
        if bits.is_float:
            kinds.append(f"SIG_VALTYPE_ {own} {name} : {1 if bits.length == 32 else 2};")
    return "\n".join([*lines, "", *kinds, ""]).encode()


def _write_log(rng: Rng, own: int, frames: list[tuple[float, bytes]], *, is_extended: bool) -> tuple[str, bytes]:
    """By a writer of python-can, with frames of another identifier between."""
    import can

    kind = str(pick(rng, "asc", "blf", "csv", "log", "trc"))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"drive.{kind}"
        writer: Any = {
            "asc": can.ASCWriter, "blf": can.BLFWriter, "csv": can.CSVWriter, "log": can.CanutilsLogWriter,
            "trc": can.TRCWriter,
        }[kind](path)  # fmt: skip
        with writer:
            for at, data in frames:
                frame = can.Message(timestamp=at, arbitration_id=own, is_extended_id=is_extended, data=data, channel=1)
                writer.on_message_received(frame)
                if chance(rng, 0.4):
                    other = own ^ 1 if is_extended else own % 0x700 + 1
                    writer.on_message_received(
                        can.Message(at + 0.004, arbitration_id=other, is_extended_id=is_extended, data=b"12", channel=1)
                    )
        return path.name, path.read_bytes()


TRACE_GRAMMARS: dict[str, Grammar] = {"trace": _trace, "can-signals": _can_signals}
