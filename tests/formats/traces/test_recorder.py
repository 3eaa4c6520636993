"""The recorder's three CSV files."""

from __future__ import annotations

import time

import numpy as np
import pytest

from app.errors import InvalidParameter, UnreadableUpload, UploadTooLarge
from app.formats.traces.declaration import TraceDeclaration, TraceFormat, TraceLimits
from app.formats.traces.read import read_trace
from app.simulation.magnetic.recorder import write_array_stream, write_recorder_files
from tests.formats.traces.recordings import bar_of, make_trace, zipped


def test_a_zip_of_the_three_files_comes_back() -> None:
    trace = make_trace(3000)
    files = write_recorder_files(trace)
    assert sorted(files) == ["RawData_drive_1.csv", "RawSWA_drive_1.csv", "RawSpeed_drive_1.csv"]
    header, first = files["RawData_drive_1.csv"].decode().split("\n")[:2]
    assert header.startswith(",Time Stamp,Sensor 1,")
    assert header.endswith(",Sensor 14")
    assert first.startswith('0,0.0,"(')
    result = read_trace({"upload.zip": zipped(files)})
    assert np.array_equal(result.trace.field_ut, trace.field_ut)
    assert np.array_equal(result.trace.t_s, trace.t_s)
    assert set(result.report.formats.values()) == {
        TraceFormat.RECORDER_FIELD, TraceFormat.RECORDER_SPEED, TraceFormat.RECORDER_STEERING,
    }  # fmt: skip
    speed = np.interp(trace.t_s[50:-50], result.trace.speed_t_s, result.trace.speed_m_s)
    assert np.abs(speed - np.interp(trace.t_s[50:-50], trace.speed_t_s, trace.speed_m_s)).max() < 0.05


def test_held_speeds_do_not_lag() -> None:
    trace = make_trace(3000)
    result = read_trace(write_recorder_files(trace))
    assert len(result.trace.speed_t_s) < 1.2 * len(trace.speed_t_s)
    grid = np.arange(0.5, trace.t_s[-1] - 0.5, 0.01)
    got = np.interp(grid, result.trace.speed_t_s, result.trace.speed_m_s)
    lag = [np.abs(got - np.interp(grid - d, trace.speed_t_s, trace.speed_m_s)).mean() for d in (0.0, 0.03, 0.06)]
    assert np.argmin(lag) == 0


def test_the_steering_wheel_is_never_the_heading() -> None:
    trace = make_trace(500)
    result = read_trace(write_recorder_files(trace, steering_wheel_deg=np.linspace(-90, 90, 500)))
    assert result.trace.heading_deg is None
    assert any("not the heading" in text for text in result.report.warnings)
    assert [e.count for e in result.report.left_out if e.what == "steering-wheel-angle"] == [500]


def test_a_stream_with_the_recorders_speed() -> None:
    trace = make_trace(1000)
    speed = write_recorder_files(trace)["RawSpeed_drive_1.csv"]
    result = read_trace({"a.bin": write_array_stream(trace), "RawSpeed_1.csv": speed})
    assert np.array_equal(result.trace.field_ut, trace.field_ut)
    assert result.report.speed_coverage == 1.0


def test_axes_can_be_declared() -> None:
    trace = make_trace(300)
    result = read_trace(write_recorder_files(trace), TraceDeclaration(axes="ISO8855"))
    assert np.array_equal(result.trace.field_ut[:, :, 1:], -trace.field_ut[:, :, 1:])


def test_numpys_own_numbers_are_read() -> None:
    """pandas writes tuples by repr, and NumPy 2 writes the type into it."""
    trace = make_trace(300)
    files = write_recorder_files(trace)
    raw = files["RawData_drive_1.csv"].decode().split("\n")
    for i in range(1, 200):
        cells = raw[i].split('"(')
        rest = [
            ", ".join(f"np.float64({x})" for x in cell.split(")")[0].split(", ")) + ")" + cell.split(")", 1)[1]
            for cell in cells[1:]
        ]
        raw[i] = cells[0] + "".join('"(' + cell for cell in rest)
    assert raw[1].count("np.float64(") == 42
    files["RawData_drive_1.csv"] = "\n".join(raw).encode()
    assert np.array_equal(read_trace(files).trace.field_ut, trace.field_ut)


@pytest.mark.parametrize("keep", [0.999, 0.5])
def test_a_truncated_file_gives_what_it_holds(keep: float) -> None:
    trace = make_trace(1000)
    files = write_recorder_files(trace)
    raw = files["RawData_drive_1.csv"]
    files["RawData_drive_1.csv"] = raw[: int(keep * len(raw))]
    result = read_trace(files)
    n = len(result.trace.t_s)
    assert 0.9 * keep * 1000 < n < 1000
    assert np.array_equal(result.trace.field_ut, trace.field_ut[:n])
    assert ("row-cut-short", 1) in [(e.what, e.count) for e in result.report.left_out]


def test_damaged_rows_are_left_out_by_line() -> None:
    trace = make_trace(1000)
    files = write_recorder_files(trace)
    raw = files["RawData_drive_1.csv"].split(b"\n")
    raw[500] = raw[500].replace(b", ", b" ", 1)
    raw[600] = raw[600].replace(b"(", b"(x", 1)
    raw[700] = b""
    files["RawData_drive_1.csv"] = b"\n".join(raw)
    result = read_trace(files)
    assert np.array_equal(result.trace.field_ut, np.delete(trace.field_ut, [499, 599, 699], axis=0))
    entry = next(e for e in result.report.left_out if e.what == "rows-malformed")
    assert entry.count == 2
    assert "line 501" in entry.reason


def test_missing_values_are_not_numbers_and_are_counted() -> None:
    trace = make_trace(1000)
    files = write_recorder_files(trace)
    raw = files["RawData_drive_1.csv"].split(b"\n")
    cells = raw[10].split(b'"(')
    cells[3] = b'nan, inf, 3.0)",'
    raw[10] = b'"('.join(cells)
    files["RawData_drive_1.csv"] = b"\n".join(raw)
    result = read_trace(files)
    assert np.isnan(result.trace.field_ut[9, 2]).all()
    assert np.isnan(result.trace.field_ut).sum() == 3
    assert ("values-missing", 1) in [(e.what, e.count) for e in result.report.left_out]


def test_wrong_names_of_columns_are_named_with_the_near_ones() -> None:
    files = write_recorder_files(make_trace(100))
    files["RawData_drive_1.csv"] = files["RawData_drive_1.csv"].replace(b"Sensor 7", b"Sensr 7", 1)
    with pytest.raises(InvalidParameter) as error:
        read_trace(files)
    assert "'Sensor 7'" in error.value.message
    assert "'Sensr 7'" in error.value.message.split("near:")[1]
    assert error.value.field == "RawData_drive_1.csv"
    assert error.value.cure


def test_fewer_sensors_than_declared() -> None:
    files = write_recorder_files(make_trace(100, sensors=8))
    with pytest.raises(InvalidParameter, match="Sensor 9"):
        read_trace(files)
    assert read_trace(files, TraceDeclaration(bar=bar_of(8))).trace.field_ut.shape == (100, 8, 3)


def test_no_speed() -> None:
    files = write_recorder_files(make_trace(100))
    only = {"RawData_1.csv": files["RawData_drive_1.csv"]}
    with pytest.raises(InvalidParameter) as error:
        read_trace(only)
    assert error.value.field == "speed"
    assert "RawSpeed" in (error.value.cure or "")
    result = read_trace(only, TraceDeclaration(speed_m_s=10.0))
    assert any("declared" in text for text in result.report.warnings)


@pytest.mark.slow
def test_a_damaged_archive_and_a_bomb() -> None:
    archive = zipped(write_recorder_files(make_trace(2000)))
    for damaged in (archive[: len(archive) // 2], archive[:5000] + bytes(500) + archive[5500:]):
        with pytest.raises(UnreadableUpload):
            read_trace({"upload.zip": damaged})
    bomb = zipped({"RawSpeed_1.csv": b",Time Stamp,Speed\n" + b"0,0,0\n" * 5_000_000})
    with pytest.raises(UploadTooLarge):
        read_trace({"upload.zip": bomb})


def test_limits_on_bytes_rows_and_duration() -> None:
    files = write_recorder_files(make_trace(1000))
    for limits in (TraceLimits(file_bytes=100_000), TraceLimits(rows=900), TraceLimits(duration_s=2.0)):
        with pytest.raises(UploadTooLarge) as error:
            read_trace(files, None, limits)
        assert error.value.limit
        assert error.value.cure


def test_a_recording_is_read_many_times_faster_than_it_lasts() -> None:
    trace = make_trace(20_000)
    files = write_recorder_files(trace)
    start = time.thread_time()
    result = read_trace(files)
    assert result.report.duration_s / (time.thread_time() - start) > 50
