"""Plain CSV and Parquet: names, units, axes, times."""

from __future__ import annotations

import io
import sys
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.traces.declaration import (
    TraceColumns,
    TraceDeclaration,
    TraceFile,
    TraceLimits,
)
from app.formats.traces.read import read_trace
from tests.formats.traces.recordings import bar_of, make_trace, plain_csv
from tests.machine import require_module

DECLARED = TraceDeclaration(unit="uT", axes="ISO8855")


def declared(**changes: Any) -> TraceDeclaration:
    return TraceDeclaration(**{"unit": "uT", "axes": "ISO8855", **changes})


def read(content: bytes, declaration: TraceDeclaration = DECLARED, name: str = "drive.csv") -> TraceFile:
    return read_trace({name: content}, declaration)


def test_a_plain_csv_comes_back() -> None:
    trace = make_trace(1000)
    result = read(plain_csv(trace))
    assert np.allclose(result.trace.field_ut, trace.field_ut, rtol=1e-6, atol=1e-5)
    assert np.allclose(result.trace.t_s, trace.t_s, atol=1e-6)
    assert np.allclose(result.trace.speed_m_s, np.interp(trace.t_s, trace.speed_t_s, trace.speed_m_s), atol=1e-4)


@pytest.mark.parametrize(("unit", "scale"), [("nT", 1e3), ("mT", 1e-3), ("gauss", 1e-2), ("mG", 10.0), ("uT", 1.0)])
def test_units(unit: str, scale: float) -> None:
    trace = make_trace(300)
    result = read(plain_csv(trace, scale=scale), declared(unit=unit))
    assert np.allclose(result.trace.field_ut, trace.field_ut, rtol=1e-5, atol=1e-4)


def test_axes_and_rotations() -> None:
    trace = make_trace(300)
    down = read(plain_csv(trace), declared(axes="FRD")).trace.field_ut
    assert np.allclose(down, trace.field_ut * (1, -1, -1), atol=1e-3)
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    turns = np.tile(np.eye(3), (14, 1, 1))
    turns[6] = quarter
    turned = read(plain_csv(trace), declared(axes=None, bar=bar_of(14, turns))).trace.field_ut
    assert np.allclose(turned[:, 5], trace.field_ut[:, 5], atol=1e-3)
    assert np.allclose(turned[:, 6, 0], -trace.field_ut[:, 6, 1], atol=1e-3)
    assert np.allclose(turned[:, 6, 1], trace.field_ut[:, 6, 0], atol=1e-3)
    with pytest.raises(ValidationError, match="rotation matrix"):
        bar_of(14, turns * (1, 1, -1))


@pytest.mark.parametrize("missing", ["unit", "axes"])
def test_unit_and_axes_must_be_declared(missing: str) -> None:
    with pytest.raises(InvalidParameter) as error:
        read(plain_csv(make_trace(100)), declared(**{missing: None}))
    assert error.value.field == missing
    assert error.value.limit
    assert error.value.cure


@pytest.mark.parametrize(
    ("scale", "unit", "cure"),
    [(1.0, "gauss", "uT"), (0.01, "uT", "gauss"), (1.0, "mT", "uT"), (1e3, "uT", "nT"), (1.0, "nT", "uT")],
)
@pytest.mark.parametrize("offset_ut", [200.0, 2.0])
def test_a_wrong_unit_is_found_by_the_earths_field(scale: float, unit: str, cure: str, offset_ut: float) -> None:
    trace = make_trace(500, offset_ut=offset_ut)
    with pytest.raises(InvalidParameter) as error:
        read(plain_csv(trace, scale=scale), declared(unit=unit))
    assert error.value.field == "unit"
    assert cure in (error.value.cure or "")


def test_calibrated_sensors_that_agree_show_a_factor_of_ten() -> None:
    trace = make_trace(500, offset_ut=2.0)
    with pytest.raises(InvalidParameter, match="the same at all"):
        read(plain_csv(trace, scale=10.0))


def test_a_field_without_background_is_declared_so() -> None:
    trace = make_trace(500, offset_ut=2.0)
    bare = trace.field_ut - np.median(trace.field_ut, axis=0)
    content = plain_csv(type(trace)(trace.t_s, bare, trace.speed_t_s, trace.speed_m_s))
    with pytest.raises(InvalidParameter, match="has a field of"):
        read(content)
    assert len(read(content, declared(background_removed=True)).trace.t_s) == 500


def test_wrong_names_of_columns() -> None:
    with pytest.raises(InvalidParameter) as error:
        read(plain_csv(make_trace(100)).replace(b"t_s", b"T_s", 1))
    assert "'t_s'" in error.value.message
    assert "near: 'T_s'" in error.value.message
    with pytest.raises(InvalidParameter) as error:
        read(plain_csv(make_trace(100)).replace(b"s3_y", b"s3y", 1))
    assert "'s3_y'" in error.value.message
    assert "'s3y'" in error.value.message


def test_names_of_columns_can_be_declared() -> None:
    trace = make_trace(200, sensors=3)
    names = tuple((f"B{i}x", f"B{i}y", f"B{i}z") for i in range(3))
    content = plain_csv(trace).split(b"\n", 1)
    header = "Zeit," + ",".join(n for triple in names for n in triple) + ",v"
    columns = TraceColumns(time="Zeit", field=names, speed="v", speed_unit="km/h")
    result = read(header.encode() + b"\n" + content[1], declared(bar=bar_of(3), columns=columns))
    assert np.allclose(result.trace.field_ut, trace.field_ut, atol=1e-3)
    assert np.allclose(3.6 * result.trace.speed_m_s.mean(), trace.speed_m_s.mean(), rtol=0.05)


def test_semicolons_and_decimal_commas_are_declared_or_refused() -> None:
    trace = make_trace(200)
    content = plain_csv(trace, delimiter=";", decimal=",")
    with pytest.raises(InvalidParameter) as error:
        read(content)
    assert error.value.field == "columns.delimiter"
    assert "';'" in (error.value.cure or "")
    with pytest.raises(UnreadableUpload) as unreadable:
        read(content, declared(columns=TraceColumns(delimiter=";")))
    assert "decimal" in (unreadable.value.cure or "")
    columns = TraceColumns(delimiter=";", decimal=",")
    result = read(content, declared(columns=columns))
    assert np.allclose(result.trace.field_ut, trace.field_ut, atol=1e-3)
    with pytest.raises(UnreadableUpload, match="text where numbers"):  # a point may stand between thousands
        read(plain_csv(trace, delimiter=";"), declared(columns=columns))


def test_empty_cells_are_missing_values_of_one_sensor() -> None:
    trace = make_trace(200)
    lines = plain_csv(trace).split(b"\n")
    cells = lines[5].split(b",")
    cells[4] = b""
    lines[5] = b",".join(cells)
    result = read(b"\n".join(lines))
    assert np.isnan(result.trace.field_ut[4, 1]).all()
    assert np.isnan(result.trace.field_ut).sum() == 3
    assert np.allclose(np.delete(result.trace.field_ut, 4, 0), np.delete(trace.field_ut, 4, 0), atol=1e-3)


def test_text_times() -> None:
    trace = make_trace(300)
    start = datetime(2026, 3, 1, 12, tzinfo=UTC)
    lines = plain_csv(trace).decode().split("\n")
    for i, t in enumerate(trace.t_s, 1):
        lines[i] = (start + timedelta(seconds=float(t))).isoformat() + "," + lines[i].split(",", 1)[1]
    lines[2] = lines[2].replace("+00:00,", "z,")
    result = read("\n".join(lines).encode(), declared(columns=TraceColumns(time_unit="iso")))
    assert np.abs(result.trace.t_s - trace.t_s).max() < 2e-6
    assert result.report.clock_offsets_s["drive.csv"] == pytest.approx(-start.timestamp(), abs=1e-3)


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6)])
def test_times_in_another_unit(unit: str, factor: float) -> None:
    trace = make_trace(300)
    scaled = type(trace)(trace.t_s * factor, trace.field_ut, trace.speed_t_s * factor, trace.speed_m_s)
    with pytest.raises(InvalidParameter) as error:
        read(plain_csv(scaled))
    assert f"look like {unit}" in (error.value.cure or "")
    result = read(plain_csv(scaled), declared(columns=TraceColumns(time_unit=unit)))
    assert np.allclose(result.trace.t_s, trace.t_s, atol=1e-6)


def _with_times(times: np.ndarray) -> bytes:
    lines = plain_csv(make_trace(len(times))).decode().split("\n")
    for i, t in enumerate(times, 1):
        lines[i] = f"{t:.6f}," + lines[i].split(",", 1)[1]
    return "\n".join(lines).encode()


def test_time_running_backwards() -> None:
    times = make_trace(400).t_s.copy()
    times[200:] -= 0.4
    with pytest.raises(InvalidParameter, match=r"runs backwards .* row 200 .* row 201"):
        read(_with_times(times))
    with pytest.raises(InvalidParameter, match="stands still"):
        read(_with_times(np.repeat(times[:200], 2)))


def test_a_few_times_out_of_order_are_left_out() -> None:
    times = make_trace(400).t_s.copy()
    times[100] += 50
    times[200] = times[198]
    result = read(_with_times(times))
    assert len(result.trace.t_s) == 398
    assert ("rows-out-of-time", 2) in [(e.what, e.count) for e in result.report.left_out]
    with pytest.raises(UnreadableUpload):
        read(_with_times(np.full(400, np.nan)))


def test_gaps_are_reported() -> None:
    times = make_trace(400).t_s.copy()
    times[250:] += 1.5
    result = read(_with_times(times))
    assert [(gap.sample, round(gap.lost_s, 2)) for gap in result.report.gaps] == [(250, 1.5)]


def test_speed_of_another_file_and_clock() -> None:
    trace = make_trace(2000)
    field = plain_csv(trace).replace(b"speed_m_s", b"note", 1)
    speed = "t_s,speed_m_s,heading_deg\n" + "".join(
        f"{t + 1000:.3f},{v:.3f},{(359 + t) % 360:.2f}\n" for t, v in zip(trace.speed_t_s, trace.speed_m_s, strict=True)
    )
    parts = {"field.csv": field, "speed.csv": speed.encode()}
    with pytest.raises(InvalidParameter) as error:
        read_trace(parts, DECLARED)
    assert error.value.field == "clock_offsets_s"
    result = read_trace(parts, declared(clock_offsets_s={"speed.csv": -1000.0}))
    assert result.report.clock_offsets_s == {"speed.csv": -1000.0}
    assert np.allclose(result.trace.speed_m_s, trace.speed_m_s, atol=1e-3)
    assert result.trace.heading_deg is not None
    assert result.trace.heading_deg[0] == pytest.approx(359)


def test_a_speed_that_covers_a_part() -> None:
    trace = make_trace(3500)
    field = plain_csv(trace).replace(b"speed_m_s", b"note", 1)
    speed = b"t_s,speed_m_s\n" + b"".join(b"%.2f,10\n" % t for t in np.arange(0, 4, 0.1))
    result = read_trace({"field.csv": field, "speed.csv": speed}, DECLARED)
    assert 0.4 < result.report.speed_coverage < 0.6
    assert any("no speed within a second" in text for text in result.report.warnings)


def test_impossible_speeds() -> None:
    trace = make_trace(500)
    fast = type(trace)(trace.t_s, trace.field_ut, trace.speed_t_s, trace.speed_m_s * 36)
    with pytest.raises(InvalidParameter) as error:
        read(plain_csv(fast))
    assert error.value.field == "speed"
    lines = plain_csv(trace).split(b"\n")
    for i in range(1, len(lines) - 1):
        lines[i] = lines[i].rsplit(b",", 1)[0] + b",nan"
    with pytest.raises(InvalidParameter) as error:
        read(b"\n".join(lines))
    assert error.value.field == "speed"


@pytest.mark.parametrize("content", [b"", b"t_s,s1_x\n", b"\n\n\n", plain_csv(make_trace(100)).split(b"\n")[0] + b"\n"])
def test_empty_files(content: bytes) -> None:
    with pytest.raises((UnreadableUpload, InvalidParameter)) as error:
        read(content)
    assert error.value.field == "drive.csv"
    assert error.value.cure


def test_no_files_and_files_of_other_kinds() -> None:
    with pytest.raises(UnreadableUpload):
        read_trace({}, DECLARED)
    with pytest.raises(UnsupportedUpload):
        read(b"\x89PNG\r\n\x1a\n\0\0\0" + bytes(500))
    with pytest.raises((UnreadableUpload, InvalidParameter)):
        read("t_s,größe\n".encode("latin-1") + b"0,1\n")
    content = plain_csv(make_trace(100))
    with pytest.raises(InvalidParameter, match="both hold"):
        read_trace({"a.csv": content, "b.csv": content}, DECLARED)


def test_dead_sensors_are_named() -> None:
    trace = make_trace(300)
    trace.field_ut[:, 4] = 11.0
    trace.field_ut[:, 5] = np.nan
    result = read(plain_csv(trace))
    assert any("sensor 5 " in text and "same value" in text for text in result.report.warnings)
    assert any("sensor 6 " in text and "no values" in text for text in result.report.warnings)


def parquet(trace: Any, **changes: Any) -> bytes:
    """A trace as a table of Parquet."""
    pa = require_module("pyarrow", "the extra parquet")
    pq = require_module("pyarrow.parquet", "the extra parquet")
    flat = trace.field_ut.reshape(len(trace.t_s), -1)
    names = [f"s{i}_{axis}" for i in range(1, trace.field_ut.shape[1] + 1) for axis in "xyz"]
    columns: dict[str, Any] = {"t_s": trace.t_s, **{n: flat[:, i] for i, n in enumerate(names)}}
    columns["speed_m_s"] = np.interp(trace.t_s, trace.speed_t_s, trace.speed_m_s)
    out = io.BytesIO()
    pq.write_table(pa.table({**columns, **changes}), out)
    return out.getvalue()


def test_parquet_comes_back() -> None:
    trace = make_trace(1000)
    result = read(parquet(trace), name="drive.parquet")
    assert np.array_equal(result.trace.field_ut, trace.field_ut)
    stamps = (trace.t_s * 1e9).astype("datetime64[ns]") + np.timedelta64(1_700_000_000, "s")
    result = read(parquet(trace, t_s=stamps), name="drive.parquet")
    assert np.abs(result.trace.t_s - trace.t_s).max() < 1e-6


def test_parquet_that_is_damaged_or_holds_text() -> None:
    content = parquet(make_trace(1000))
    for damaged in (content[: len(content) // 2], content[:4] + content[5000:], b"PAR1" + bytes(100) + b"PAR1"):
        with pytest.raises(UnreadableUpload):
            read(damaged, name="drive.parquet")
    with pytest.raises(InvalidParameter, match="'s1_x' holds string"):
        read(parquet(make_trace(50), s1_x=["a"] * 50), name="drive.parquet")
    with pytest.raises(UploadTooLarge):
        read_trace({"drive.parquet": content}, DECLARED, TraceLimits(rows=500))


def test_rows_of_parquet_are_counted_whatever_its_footer_says() -> None:
    content = parquet(make_trace(20_000))
    footer = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
    at = content.index(_thrift_i64(20_000), footer)  # the first is that of the file, before those of its columns
    lying = content[:at] + _thrift_i64(9_000) + content[at + 3 :]
    pq = require_module("pyarrow.parquet", "the extra parquet")
    assert pq.ParquetFile(io.BytesIO(lying)).metadata.num_rows == 9_000
    with pytest.raises(UploadTooLarge):
        read_trace({"drive.parquet": lying}, DECLARED, TraceLimits(rows=10_000))


def _thrift_i64(value: int) -> bytes:
    """A positive number of three bytes as Thrift's compact protocol writes it: zigzag, seven bits a byte."""
    doubled = 2 * value
    return bytes([doubled & 127 | 128, doubled >> 7 & 127 | 128, doubled >> 14])


def test_parquet_without_its_library(monkeypatch: pytest.MonkeyPatch) -> None:
    content = parquet(make_trace(50))
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UnsupportedUpload) as error:
        read(content, name="drive.parquet")
    assert "waymark-roads[parquet]" in (error.value.cure or "")


def test_any_damage_to_a_csv_ends_in_a_trace_or_a_refusal() -> None:
    content = plain_csv(make_trace(200))
    read_ones = 0
    for seed in range(80):
        rng = np.random.default_rng(seed)
        damaged = bytearray(content)
        for _ in range(rng.integers(1, 20)):
            at = int(rng.integers(0, len(damaged)))
            match rng.integers(0, 3):
                case 0:
                    del damaged[at : at + int(rng.integers(1, 200))]
                case 1:
                    damaged[at:at] = rng.choice([b",", b"\n", b";", b"e", b"-", b'"', b"\0", b"\xff", b"1e999", b"nan"])
                case _:
                    damaged[at] = int(rng.integers(0, 256))
        try:
            result = read(bytes(damaged))
        except (InvalidParameter, UnreadableUpload):
            continue
        read_ones += 1
        assert (np.diff(result.trace.t_s) > 0).all()
        assert not np.isinf(result.trace.field_ut).any()
    assert read_ones > 20
