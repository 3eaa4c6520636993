"""Speed and heading from CAN logs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.traces.declaration import (
    CanDeclaration,
    CanSignal,
    TraceDeclaration,
    TraceFile,
    TraceFormat,
    TraceLimits,
)
from app.formats.traces.read import read_trace
from app.sensors.magnetometer_bar import MagnetTrace
from app.simulation.magnetic.drive import Course, Scene, Vehicle, simulate_drive
from app.simulation.magnetic.recorder import write_array_stream
from app.simulation.magnetic.road import Road
from tests.formats.traces.recordings import make_trace
from tests.machine import require_module

can = require_module("can", "the extra can")
cantools = require_module("cantools", "the extra can")

DBC = b"""VERSION ""
NS_ :
BS_:
BU_: ECU
BO_ 874 VehicleSpeed: 8 ECU
 SG_ Speed : 23|12@0+ (0.015625,0) [0|300] "km/h" ECU
BO_ 1796 Attitude: 8 ECU
 SG_ Mux M : 0|8@1+ (1,0) [0|255] "" ECU
 SG_ Heading m1 : 8|16@1+ (0.01,0) [0|360] "deg" ECU
 SG_ Pitch m2 : 8|16@1- (0.01,0) [-90|90] "deg" ECU
"""
SPEED = CanSignal(
    arbitration_id=0x36A, start_bit=23, length=12, byte_order="big", factor=1 / 64, unit="km/h", maximum=300
)
HEADING = CanSignal(arbitration_id=0x705, start_bit=0, length=16, signed=True, factor=0.01, offset=180, unit="deg")
EPOCH_S = 1_700_000_000.0


def messages(trace: MagnetTrace, *, after_s: float = 0.0) -> list[Any]:
    """Frames of a drive with a clock of their own: speed at 10 Hz, heading at 100 Hz, and others."""
    assert trace.heading_t_s is not None
    assert trace.heading_deg is not None
    found = []
    for t, v in zip(trace.speed_t_s, trace.speed_m_s, strict=True):
        raw = round(float(v) * 3.6 * 64)
        found.append((t, 0x36A, bytes([7, 0, raw >> 4, (raw & 15) << 4 | 9, 0, 0, 0, 0])))
    for t, heading in zip(trace.heading_t_s, trace.heading_deg, strict=True):
        raw = round((float(heading) - 180) * 100)
        found.append((t, 0x705, raw.to_bytes(2, "little", signed=True) + bytes(6)))
        found.append((t + 0.001, 0x704, bytes([1]) + round(float(heading) * 100).to_bytes(2, "little") + bytes(5)))
        found.append((t + 0.002, 0x704, bytes([2]) + (-100).to_bytes(2, "little", signed=True) + bytes(5)))
    return [
        can.Message(timestamp=float(EPOCH_S + t), arbitration_id=i, data=data, is_extended_id=False, channel=0)
        for t, i, data in sorted(found)
        if t >= after_s
    ]


def log(trace: MagnetTrace, suffix: str, folder: Path, *, after_s: float = 0.0) -> bytes:
    path = folder / f"log.{suffix}"
    with can.Logger(path) as writer:
        for message in messages(trace, after_s=after_s):
            writer.on_message_received(message)
    return path.read_bytes()


def declared(**changes: Any) -> TraceDeclaration:
    return TraceDeclaration(can=CanDeclaration(**{"speed": SPEED, "heading": HEADING, "offset_s": 0.0, **changes}))


def read(trace: MagnetTrace, name: str, content: bytes, declaration: TraceDeclaration, **parts: bytes) -> TraceFile:
    return read_trace({"array.bin": write_array_stream(trace), name: content, **parts}, declaration)


@pytest.mark.parametrize("suffix", ["asc", "blf", "csv", "log", "trc"])
def test_every_format_with_declared_bits(suffix: str, tmp_path: Path) -> None:
    trace = make_trace(1500)
    result = read(trace, f"drive.{suffix}", log(trace, suffix, tmp_path), declared())
    assert result.report.formats[f"drive.{suffix}"] is TraceFormat.CAN
    assert np.allclose(result.trace.speed_t_s, trace.speed_t_s, atol=2e-3)
    assert np.allclose(result.trace.speed_m_s, trace.speed_m_s, atol=0.5 / 64 / 3.6)
    assert result.trace.heading_t_s is not None
    assert np.allclose(result.trace.heading_deg, trace.heading_deg, atol=0.006)


def test_a_dbc_with_multiplexed_signals(tmp_path: Path) -> None:
    trace = make_trace(800)
    content = log(trace, "blf", tmp_path)
    by_name = declared(speed=CanSignal(name="Speed"), heading=CanSignal(name="Attitude.Heading"))
    result = read(trace, "drive.blf", content, by_name, **{"car.dbc": DBC})
    assert np.allclose(result.trace.speed_m_s, trace.speed_m_s, atol=0.5 / 64 / 3.6)
    assert result.trace.heading_deg is not None
    assert np.allclose(result.trace.heading_deg, trace.heading_deg, atol=0.006)


def test_bits_are_read_as_cantools_reads_them() -> None:
    from app.formats.traces.can_log import _extract

    rng = np.random.default_rng(4)
    for _ in range(300):
        length = int(rng.integers(1, 65))
        big, signed = bool(rng.integers(2)), bool(rng.integers(2))
        start = int(rng.integers(0, 65 - length))
        if big:  # the place of the highest bit, as a DBC has it
            start = 8 * (start // 8) + 7 - start % 8
        name = f"{start}|{length}@{0 if big else 1}{'-' if signed else '+'}"
        text = f'VERSION ""\nBO_ 5 M: 8 E\n SG_ S : {name} (0.5,-3) [0|0] "" E\n'
        message = cantools.database.load_string(text, "dbc").messages[0]
        frames = [rng.bytes(8) for _ in range(5)]
        order = "big" if big else "little"
        signal = CanSignal(
            arbitration_id=5, start_bit=start, length=length, byte_order=order, signed=signed, factor=0.5, offset=-3
        )
        want = [float(message.decode(frame)["S"]) for frame in frames]
        assert np.allclose(_extract(frames, signal), want, rtol=1e-15), name


def test_absolute_times_of_the_log_mean_nothing(tmp_path: Path) -> None:
    trace = make_trace(2000)
    result = read(trace, "drive.log", log(trace, "log", tmp_path, after_s=2.0), declared(offset_s=2.0))
    assert result.trace.speed_t_s[0] == pytest.approx(2.0, abs=0.01)
    assert result.report.clock_offsets_s["drive.log"] == 2.0
    speed = np.interp(3.0, trace.speed_t_s, trace.speed_m_s)
    assert np.interp(3.0, result.trace.speed_t_s, result.trace.speed_m_s) == pytest.approx(speed, abs=0.01)


def _drive(seed: int, *, wheels_am2: float, steady: bool = False) -> MagnetTrace:
    speeds = () if steady else ((0, 8), (120, 14), (230, 8), (420, 16.5), (600, 12))
    scene = Scene(Road(600.0), Vehicle.compact(wheel_moment_am2=wheels_am2), Course(speeds=speeds))
    return simulate_drive(scene, np.random.default_rng(seed)).trace


@pytest.mark.parametrize("seed", [1, 2])
def test_an_undeclared_offset_is_found_by_the_wheels(seed: int, tmp_path: Path) -> None:
    trace = _drive(seed, wheels_am2=0.1)
    start = 3.7 * seed
    result = read(trace, "drive.blf", log(trace, "blf", tmp_path, after_s=start), declared(offset_s=None))
    # the simulated bus stamps speeds 50 ms late, which the alignment takes off

    assert result.report.clock_offsets_s["drive.blf"] == pytest.approx(start - 0.05, abs=0.06)
    assert any("aligned by the wheels" in text for text in result.report.warnings)


@pytest.mark.parametrize(("wheels_am2", "steady"), [(0.0, False), (0.1, True)])
def test_without_wheels_or_changes_of_speed_the_offset_is_asked_for(
    wheels_am2: float, steady: bool, tmp_path: Path
) -> None:
    trace = _drive(3, wheels_am2=wheels_am2, steady=steady)
    with pytest.raises(InvalidParameter) as error:
        read(trace, "drive.blf", log(trace, "blf", tmp_path), declared(offset_s=None))
    assert error.value.field == "can.offset_s"
    assert error.value.cure


def test_values_that_say_no_value_are_left_out(tmp_path: Path) -> None:
    trace = make_trace(1500)
    speeds = trace.speed_m_s.copy()
    speeds[5:8] = 0xFFF / 64 / 3.6
    broken = MagnetTrace(trace.t_s, trace.field_ut, trace.speed_t_s, speeds, trace.heading_t_s, trace.heading_deg)
    tight = SPEED.model_copy(update={"maximum": 60.0})
    result = read(trace, "a.log", log(broken, "log", tmp_path), declared(speed=tight))
    assert len(result.trace.speed_t_s) == len(speeds) - 3
    assert ("speed-invalid", 3) in [(e.what, e.count) for e in result.report.left_out]


# --- channels, identifiers and times as the files of other programs write them ------------------------------------


SIGNAL = CanSignal(arbitration_id=0x123, length=16, factor=0.01, unit="km/h")
ASC_HEAD = "date Thu May 16 06:16:50.884 pm 2024\nbase hex  timestamps {}\ninternal events logged\n"
SAVVYCAN = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"


def frame(t_s: float, speed_km_h: float, number: int = 0x123, *, extended: bool = False, channel: Any = 0) -> Any:
    """A frame with a speed in its first two bytes."""
    data = round(100 * speed_km_h).to_bytes(2, "little") + bytes(6)
    return can.Message(timestamp=t_s, arbitration_id=number, data=data, is_extended_id=extended, channel=channel)


def written(frames: list[Any], suffix: str, folder: Path) -> bytes:
    """A log by python-can."""
    path = folder / f"frames.{suffix}"
    with can.Logger(path) as writer:
        for one in frames:
            writer.on_message_received(one)
    return path.read_bytes()


def read_km_h(
    content: str | bytes, name: str = "drive.log", dbc: bytes | None = None, signal: CanSignal = SIGNAL, **can_log: Any
) -> tuple[list[float], TraceFile]:
    """Speeds of a log beside a recording of two seconds."""
    trace = make_trace(800)
    parts = {} if dbc is None else {"car.dbc": dbc}
    data = content.encode() if isinstance(content, str) else content
    found = read(trace, name, data, declared(speed=signal, heading=None, **can_log), **parts)
    return [round(3.6 * float(v), 2) for v in found.trace.speed_m_s], found


def refused_log(content: str | bytes, name: str = "drive.log", **changes: Any) -> InvalidParameter | UnsupportedUpload:
    with pytest.raises((InvalidParameter, UnsupportedUpload)) as error:
        read_km_h(content, name, **changes)
    assert error.value.cure
    return error.value


@pytest.mark.parametrize(
    ("suffix", "channels", "declared_channel"),
    [
        ("asc", (0, 1), 1),
        ("blf", (0, 1), 1),
        ("trc", (0, 1), 1),
        ("log", ("can0", "vcan1"), "can0"),
    ],
)
def test_channels_are_those_of_the_file(
    suffix: str, channels: tuple[Any, Any], declared_channel: int | str, tmp_path: Path
) -> None:
    frames = [
        frame(EPOCH_S + 0.1 * i, speed, channel=channel)
        for i in range(1, 20)
        for channel, speed in zip(channels, (50.0, 90.0), strict=True)
    ]
    content = written(frames, suffix, tmp_path)
    assert set(read_km_h(content, f"drive.{suffix}", channel=declared_channel)[0]) == {50.0}
    shown = refused_log(content, f"drive.{suffix}", channel="9")
    assert shown.field == "can.channel"
    assert str(declared_channel) in str(shown.limit)
    assert "several channels" in refused_log(content, f"drive.{suffix}").message
    own = SIGNAL.model_copy(update={"channel": declared_channel})
    assert set(read_km_h(content, f"drive.{suffix}", signal=own, channel="9")[0]) == {50.0}, "of the signal itself"


def test_a_log_without_channels_has_none_to_declare(tmp_path: Path) -> None:
    content = written([frame(EPOCH_S + 0.1 * i, 50) for i in range(20)], "csv", tmp_path)
    assert set(read_km_h(content, "drive.csv")[0]) == {50.0}
    assert "does not write channels" in refused_log(content, "drive.csv", channel=1).message


@pytest.mark.parametrize("suffix", ["asc", "blf", "trc", "log", "csv"])
def test_identifiers_of_11_and_29_bits_are_others(suffix: str, tmp_path: Path) -> None:
    frames = [frame(EPOCH_S + 0.1 * i + 0.05 * e, 50 + 40 * e, extended=bool(e)) for i in range(1, 20) for e in (0, 1)]
    content = written(frames, suffix, tmp_path)
    name = f"drive.{suffix}"
    assert set(read_km_h(content, name)[0]) == {50.0}
    assert set(read_km_h(content, name, signal=SIGNAL.model_copy(update={"extended": True}))[0]) == {90.0}
    only_long = written(frames[1::2], suffix, tmp_path)
    speeds, found = read_km_h(only_long, name)
    assert set(speeds) == {90.0}
    assert any("29-bit identifier" in text for text in found.report.warnings)
    error = refused_log(only_long, name, signal=SIGNAL.model_copy(update={"extended": False}))
    assert "0x00000123" in error.message
    with pytest.raises(ValidationError):
        CanSignal(arbitration_id=0x800, extended=False)


def test_a_dbc_marks_identifiers_of_29_bits(tmp_path: Path) -> None:
    frames = [frame(EPOCH_S + 0.1 * i + 0.05 * e, 50 + 40 * e, extended=bool(e)) for i in range(1, 20) for e in (0, 1)]
    content = written(frames, "log", tmp_path)
    by_name = CanSignal(name="Speed")
    for number, speed in ((0x123, 50.0), (0x80000123, 90.0)):
        dbc = f'VERSION ""\nBU_: E\nBO_ {number} V: 8 E\n SG_ Speed : 0|16@1+ (0.01,0) [0|300] "km/h" E\n'
        assert set(read_km_h(content, dbc=dbc.encode(), signal=by_name)[0]) == {speed}


def test_j1939_messages_of_any_source(tmp_path: Path) -> None:
    # CCVS is parameter group 65265; the DBC leaves the source open by the null address 254
    dbc = f'VERSION ""\nBU_: E\nBO_ {0x98FEF1FE} CCVS: 8 E\n SG_ Speed : 0|16@1+ (0.01,0) [0|300] "km/h" E\n'.encode()
    by_name = CanSignal(name="Speed")
    one = [frame(EPOCH_S + 0.1 * i, 50, 0x18FEF100, extended=True) for i in range(1, 20)]
    other = [frame(m.timestamp + 0.01, 90, 0x18FEF121, extended=True) for m in one]
    unrelated = [frame(m.timestamp + 0.02, 70, 0x18FEF200, extended=True) for m in one]
    speeds, _found = read_km_h(written([*one, *unrelated], "log", tmp_path), dbc=dbc, signal=by_name)
    assert set(speeds) == {50.0}
    both = written([*one, *other], "log", tmp_path)
    error = refused_log(both, dbc=dbc, signal=by_name)
    assert "0x18FEF100, 0x18FEF121" in error.message
    assert error.field == "can.speed.arbitration_id"
    chosen = CanSignal(name="Speed", arbitration_id=0x18FEF121)
    assert set(read_km_h(both, dbc=dbc, signal=chosen)[0]) == {90.0}


def test_asc_times_that_are_intervals() -> None:
    # every line counts, also those that hold no frame
    lines = "   0.000000 Start of measurement\n" + "".join(
        "   0.060000 1  123             Rx   d 8 88 13 00 00 00 00 00 00\n   0.040000 1  Statistic: D 0 R 0\n"
        for _ in range(20)
    )
    speeds, found = read_km_h(ASC_HEAD.format("relative") + lines, "drive.asc")
    assert set(speeds) == {50.0}
    assert np.allclose(np.diff(found.trace.speed_t_s), 0.1)
    assert len(found.trace.speed_t_s) == 20
    trigger = "Begin Triggerblock Thu May 16 06:16:50.884 pm 2024\n"
    twice = ASC_HEAD.format("relative") + 2 * (trigger + lines + "End TriggerBlock\n")
    assert "trigger blocks" in refused_log(twice, "drive.asc").message


@pytest.mark.parametrize("stamp", ["", "(1716000000.{i:06d})  ", "(000.{i:06d})  ", "(2024-05-18 02:40:00.{i:06d})  "])
@pytest.mark.parametrize("name", ["drive.log", "drive.txt"])
@pytest.mark.parametrize(
    "line", ["{}can0  123   [8]  88 13 00 00 00 00 00 00", " {}vcan1  RX - -  00000123  [08]  88 13"]
)
def test_what_candump_shows_on_a_console_is_refused_by_name(stamp: str, name: str, line: str) -> None:
    text = "".join(" " + line.format(stamp.format(i=i)) + "\n" for i in range(20))
    error = refused_log(text, name)
    assert "candump shows on a console" in error.message
    assert "candump -l" in str(error.cure)


def test_candumps_log_under_any_name(tmp_path: Path) -> None:
    content = written([frame(EPOCH_S + 0.1 * i, 50) for i in range(20)], "log", tmp_path)
    assert set(read_km_h(content, "drive.txt")[0]) == {50.0}


def test_savvycan() -> None:
    rows = "".join(
        f"{1_000_000 + 100_000 * i},00000123,false,Rx,{bus},8,{low},13,00,00,00,00,00,00,\n"
        for i in range(20)
        for bus, low in ((0, "88"), (1, "00"))
    )
    broken = "-5,00000123,false,Rx,0,8,FF,FF,00,00,00,00,00,00,\n"
    speeds, found = read_km_h(SAVVYCAN + broken + rows, "drive.csv", channel=0)
    assert found.report.formats["drive.csv"] is TraceFormat.CAN
    assert set(speeds) == {50.0}
    assert np.allclose(np.diff(found.trace.speed_t_s), 0.1)
    assert ("frames-before-zero", 1) in [(left.what, left.count) for left in found.report.left_out]
    older = (SAVVYCAN + rows).replace("Dir,", "").replace("Rx,", "")
    assert set(read_km_h(older, "drive.csv", channel=1)[0]) == {48.64}


def test_asc_frames_before_the_trigger_are_reported() -> None:
    lines = "".join(
        f"   {t:.6f} 1  123             Rx   d 8 88 13 00 00 00 00 00 00\n" for t in np.arange(-0.3, 1.6, 0.1)
    )
    speeds, found = read_km_h(ASC_HEAD.format("absolute") + lines, "drive.asc")
    assert len(speeds) == 16
    assert [left.count for left in found.report.left_out if left.what == "frames-before-zero"] == [3]


def test_bad_declarations(tmp_path: Path) -> None:
    trace = make_trace(400)
    content = log(trace, "log", tmp_path)

    def refused(field: str, declaration: TraceDeclaration, **parts: bytes) -> str:
        with pytest.raises(InvalidParameter) as error:
            read(trace, "a.log", content, declaration, **parts)
        assert error.value.field == field
        assert error.value.cure
        return error.value.message

    refused("can", TraceDeclaration())
    refused("can.speed", TraceDeclaration(can=CanDeclaration()))
    assert "0x36A" in refused("can.speed", declared(speed=CanSignal(arbitration_id=0x111, unit="km/h")))
    refused("can.speed.unit", declared(speed=CanSignal(arbitration_id=0x36A)))
    refused("can.heading.unit", declared(heading=CanSignal(arbitration_id=0x705, unit="furlong")))
    refused("can.speed", declared(speed=CanSignal(name="Speed")))
    assert "'Speed'" in refused("the DBC", declared(speed=CanSignal(name="Sped")), **{"car.dbc": DBC})
    refused("speed", declared(speed=CanSignal(arbitration_id=0x36A, start_bit=0, length=64, unit="m/s")))
    for wrong in ({}, {"arbitration_id": 1, "length": 65}, {"arbitration_id": 1, "factor": 0.0}):
        with pytest.raises(ValidationError):
            CanSignal.model_validate(wrong)


def test_damaged_logs(tmp_path: Path) -> None:
    trace = make_trace(400)
    declaration = declared(heading=None)
    for suffix in ("asc", "blf", "log", "trc", "csv"):
        content = log(trace, suffix, tmp_path)
        half = read(trace, f"a.{suffix}", content[: int(0.7 * len(content))], declaration)
        assert 3 < len(half.trace.speed_t_s) <= len(trace.speed_t_s)
        for seed in range(15):
            rng = np.random.default_rng(seed)
            noisy = bytearray(content)
            for at in rng.integers(0, len(noisy), 8):
                noisy[at] = int(rng.integers(0, 256))
            try:
                result = read(trace, f"a.{suffix}", bytes(noisy), declaration)
            except (InvalidParameter, UnreadableUpload):
                continue
            assert np.isfinite(result.trace.speed_m_s).all()
            assert (np.diff(result.trace.speed_t_s) > 0).all()
    with pytest.raises(UnreadableUpload):
        read(trace, "a.blf", b"LOGG" + bytes(300), declaration)
    with pytest.raises(UnreadableUpload):
        read(trace, "a.asc", b"hello\nworld\n", declaration)
    with pytest.raises(UnreadableUpload):
        read(trace, "a.log", log(trace, "log", tmp_path), declared(speed=CanSignal(name="S")), **{"c.dbc": b"BO_ x"})
    limits = TraceLimits(can_frames=50)
    with pytest.raises(UploadTooLarge):
        read_trace({"b.bin": write_array_stream(trace), "a.log": log(trace, "log", tmp_path)}, declared(), limits)


@pytest.mark.parametrize("library", ["can", "cantools"])
def test_without_the_libraries(library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trace = make_trace(200)
    content = log(trace, "log", tmp_path)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(UnsupportedUpload) as error:
        read(trace, "a.log", content, declared(speed=CanSignal(name="Speed") if library == "cantools" else SPEED))
    assert "waymark-roads[can]" in (error.value.cure or "")
