"""The array's serial stream: cuts, shifts, noise, tails."""

from __future__ import annotations

import struct
import time

import numpy as np
import pytest

from app.errors import UnreadableUpload, UploadTooLarge, WaymarkError
from app.formats.traces.declaration import TraceDeclaration, TraceFile, TraceLimits
from app.formats.traces.read import read_trace
from app.simulation.magnetic.recorder import write_array_stream
from tests.formats.traces.recordings import FRD, bar_of, make_trace

SAMPLE = 172
DECLARED = TraceDeclaration(speed_m_s=13.0)


def read(stream: bytes, declaration: TraceDeclaration = DECLARED) -> TraceFile:
    return read_trace({"array.bin": stream}, declaration)


def origin_of(rows: np.ndarray, read_rows: np.ndarray) -> np.ndarray:
    """Index of the sample that each row read is, -1 for none; sensors left out may be any."""
    where = {row.tobytes(): i for i, row in enumerate(rows)}
    found = []
    for row in read_rows:
        i = where.get(row.tobytes(), -1)
        if i < 0 and np.isnan(row).any():
            known = np.isfinite(row)
            same = np.flatnonzero((rows[:, known] == row[known]).all(1))
            i = int(same[0]) if same.size and known.sum() >= 21 else -1
        found.append(i)
    return np.array(found)


def test_a_sample_is_43_little_endian_floats_in_the_recorders_axes() -> None:
    trace = make_trace(20)
    stream = write_array_stream(trace)
    assert len(stream) == 20 * 172
    third = struct.unpack("<43f", stream[344:516])
    assert third[:3] == tuple(float(x) for x in trace.field_ut[2, 0] * FRD)
    assert third[42] == pytest.approx((trace.t_s[2] - trace.t_s[1]) * 1e6, abs=1.01)


def test_a_whole_stream_comes_back() -> None:
    trace = make_trace(6000)
    result = read(write_array_stream(trace))
    assert np.array_equal(result.trace.field_ut, trace.field_ut)
    assert np.abs(result.trace.t_s - trace.t_s).max() < 1e-6
    assert result.report.gap_count == 0
    assert result.report.left_out == []
    assert result.report.rate_hz == pytest.approx(350, rel=0.02)


@pytest.mark.parametrize("sensors", [3, 8, 20])
def test_other_numbers_of_sensors(sensors: int) -> None:
    trace = make_trace(1000, sensors=sensors)
    result = read(write_array_stream(trace), TraceDeclaration(bar=bar_of(sensors), speed_m_s=13.0))
    assert np.array_equal(result.trace.field_ut, trace.field_ut)


@pytest.mark.parametrize("cut", [1, 3, 4, 12, 100, 171, 173, 1000, 17203])
def test_a_cut_is_found_and_reported(cut: int) -> None:
    trace = make_trace(3000, seed=cut)
    stream = write_array_stream(trace)
    at = 1500 * SAMPLE + 37
    result = read(stream[:at] + stream[at + cut :])
    rows = trace.field_ut.reshape(3000, -1)
    origin = origin_of(rows, result.trace.field_ut.reshape(-1, 42))
    assert (origin >= 0).all()
    assert (np.diff(origin) > 0).all()
    assert result.report.gap_count == 1
    gap = result.report.gaps[0]
    assert 0 < gap.skipped_bytes < 4 * SAMPLE
    assert 1490 < gap.sample <= 1500
    assert gap.t_s == pytest.approx(trace.t_s[origin[gap.sample - 1]], abs=1e-4)
    lost = 3000 - cut / SAMPLE - len(origin)
    assert lost < 5
    assert 0 < gap.lost_s < 6 / 350


def test_a_field_as_large_as_an_interval_does_not_take_its_place() -> None:
    trace = make_trace(2000, offset_ut=5.0)
    trace.field_ut[:, 0, 0] += 1500
    stream = write_array_stream(trace)
    at = 1001 * SAMPLE - 4  # an interval is cut out: the next word is the first sensor's x
    result = read(stream[:at] + stream[at + 4 :])
    origin = origin_of(trace.field_ut.reshape(2000, -1), result.trace.field_ut.reshape(-1, 42))
    assert (origin >= 0).all()
    assert len(origin) > 1990


def test_a_stream_that_starts_within_a_sample() -> None:
    trace = make_trace(1000)
    result = read(write_array_stream(trace)[61:])
    origin = origin_of(trace.field_ut.reshape(1000, -1), result.trace.field_ut.reshape(-1, 42))
    assert origin[0] in (1, 2)
    assert (np.diff(origin) == 1).all()
    assert result.report.gaps[0].sample == 0


def test_inserted_bytes_are_skipped() -> None:
    trace = make_trace(2000)
    stream = write_array_stream(trace)
    noise = np.random.default_rng(5).bytes(5001)
    result = read(stream[: 700 * SAMPLE] + noise + stream[700 * SAMPLE :])
    origin = origin_of(trace.field_ut.reshape(2000, -1), result.trace.field_ut.reshape(-1, 42))
    assert (origin >= 0).all()
    assert len(origin) >= 1996
    assert result.report.gaps[0].skipped_bytes >= 5001


def test_a_truncated_tail_is_reported() -> None:
    trace = make_trace(500)
    result = read(write_array_stream(trace)[:-50])
    assert len(result.trace.t_s) == 499
    assert [(entry.what, entry.count) for entry in result.report.left_out] == [("bytes-at-the-end", 122)]


def test_a_wild_value_costs_one_sensors_sample() -> None:
    trace = make_trace(1000)
    stream = bytearray(write_array_stream(trace))
    stream[300 * SAMPLE + 24 : 300 * SAMPLE + 28] = struct.pack("<f", float("nan"))
    stream[400 * SAMPLE : 400 * SAMPLE + 4] = struct.pack("<f", 1e30)
    result = read(bytes(stream))
    assert len(result.trace.t_s) == 1000
    assert np.isnan(result.trace.field_ut[300, 2]).all()
    assert np.isnan(result.trace.field_ut[400, 0]).all()
    assert np.isnan(result.trace.field_ut).sum() == 6
    assert ("values-damaged", 2) in [(entry.what, entry.count) for entry in result.report.left_out]


def test_a_damaged_interval_is_replaced() -> None:
    trace = make_trace(1000)
    stream = bytearray(write_array_stream(trace))
    stream[300 * SAMPLE + 168 : 301 * SAMPLE] = struct.pack("<f", -7e9)
    result = read(bytes(stream))
    assert len(result.trace.t_s) == 1000
    assert np.abs(result.trace.t_s - trace.t_s).max() < 2e-3


def test_the_time_of_the_serial_write_can_be_declared() -> None:
    trace = make_trace(500)
    longer = read(write_array_stream(trace), TraceDeclaration(speed_m_s=13.0, interval_extra_us=100.0))
    assert longer.trace.t_s[-1] == pytest.approx(trace.t_s[-1] + 499 * 1e-4, abs=1e-6)
    assert any("serial write" in text for text in read(write_array_stream(trace)).report.warnings)


@pytest.mark.parametrize("content", [b"\x01\x02\x03", b"\0" * 5000, np.random.default_rng(1).bytes(100_000)])
def test_what_is_no_stream_is_refused(content: bytes) -> None:
    with pytest.raises(UnreadableUpload) as error:
        read(content)
    assert error.value.field == "array.bin"
    assert error.value.cure


def test_the_wrong_number_of_sensors_is_refused() -> None:
    with pytest.raises(UnreadableUpload) as error:
        read(write_array_stream(make_trace(500)), TraceDeclaration(bar=bar_of(12), speed_m_s=13.0))
    assert "sensors" in (error.value.cure or "")


def test_more_samples_than_the_limit() -> None:
    with pytest.raises(UploadTooLarge) as error:
        read_trace({"array.bin": write_array_stream(make_trace(500))}, DECLARED, TraceLimits(rows=400))
    assert "400" in (error.value.limit or "")


def _damage(stream: bytearray, rng: np.random.Generator, *, flips: bool) -> bytearray:
    for _ in range(rng.integers(1, 6)):
        at, size = int(rng.integers(0, len(stream))), int(rng.integers(1, 1000))
        if size % SAMPLE == 0:
            continue  # whole samples: not to be seen in the bytes
        match rng.integers(0, 4 if flips else 2):
            case 0:
                del stream[at : at + size]
            case 1:
                stream[at:at] = rng.bytes(size)
            case 2:
                stream[at : at + size] = rng.bytes(len(stream[at : at + size]))
            case _:
                for i in rng.integers(0, len(stream), 50):
                    stream[i] ^= 1 << int(rng.integers(0, 8))
    return stream


@pytest.mark.slow
def test_no_sample_is_misaligned_by_cuts_and_insertions() -> None:
    """Only a cut and an insertion that make up a whole number of samples within one sample could splice one unseen."""
    wrong = read_samples = lost = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        trace = make_trace(1500, seed=seed, offset_ut=(200, 40, 5, 900)[seed % 4])
        result = read(bytes(_damage(bytearray(write_array_stream(trace)), rng, flips=False)), DECLARED)
        origin = origin_of(trace.field_ut.reshape(1500, -1), result.trace.field_ut.reshape(-1, 42))
        known = origin[origin >= 0]
        assert (np.diff(known) > 0).all()
        wrong += int((origin < 0).sum())
        read_samples += len(origin)
        lost += 1500 - len(origin)
    assert wrong == 0
    assert lost / 60 < 20  # of which most were cut out


@pytest.mark.slow
def test_any_damage_ends_in_samples_or_in_a_refusal() -> None:
    refused = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        trace = make_trace(600, seed=seed)
        stream = _damage(bytearray(write_array_stream(trace)), rng, flips=True)
        try:
            result = read(bytes(stream))
        except WaymarkError:
            refused += 1
            continue
        assert (np.diff(result.trace.t_s) > 0).all()
        assert not np.isinf(result.trace.field_ut).any()
        # a flipped bit changes a value, a shift would change them all
        close = [
            np.sort(np.abs(trace.field_ut - row).reshape(600, -1), axis=1)[:, 38].min() for row in result.trace.field_ut
        ]
        assert np.mean(np.array(close) > 0) < 0.01
    assert refused <= 3


def test_an_hour_is_read_many_times_faster_than_it_lasts() -> None:
    trace = make_trace(100_000)
    stream = write_array_stream(trace)
    start = time.thread_time()
    result = read(stream)
    assert result.report.duration_s / (time.thread_time() - start) > 150
