"""Lists of frames: names, times and positions of the pictures of a drive, and EXIF's times."""

from __future__ import annotations

import json
import math
import struct
from datetime import UTC, datetime

import pytest

from app.errors import InvalidParameter, UnreadableUpload, UploadTooLarge, WaymarkError
from app.formats.frame_list import MAX_LIST_BYTES, is_beside_frames, read_frame_list
from app.formats.images import read_exif
from app.formats.logs import LogClock
from app.formats.poses import PoseDeclaration

ROWS = "file;time;lon;lat;heading;accuracy\nab/1.jpg;2026-05-04T08:30:00Z;114,2;22,3;361;0,5\n2.jpg;;;;;\n"


def test_csv_with_decimal_commas() -> None:
    listed = read_frame_list("frames.csv", ROWS.encode()).frames
    first, second = listed["1.jpg"], listed["2.jpg"]
    assert (first.time_s, first.lon_deg, first.lat_deg, first.heading_deg) == (1777883400.0, 114.2, 22.3, 1.0)
    assert first.accuracy_m == 0.5
    assert math.isnan(second.time_s)
    assert not second.has_position


def test_json_and_the_declared_clock() -> None:
    rows = [{"name": "1.jpg", "time": 1777883400000, "lon_deg": 5.0, "lat_deg": 6.0}]
    declaration = PoseDeclaration(clock=LogClock(offset_s=1.5), accuracy_m=3.0)
    for document in (rows, {"frames": rows}):
        listed = read_frame_list("frames.json", json.dumps(document).encode(), declaration).frames
        assert (listed["1.jpg"].time_s, listed["1.jpg"].accuracy_m) == (1777883401.5, 3.0)


def test_times_as_spreadsheets_write_them() -> None:
    for at, shows in (("01.06.2026 08:00:00", ""), ("6/1/2026 8:00 AM", "b.jpg;6/13/2026 8:00 AM\n")):
        read = read_frame_list("frames.csv", f"file;time\na.jpg;{at}\n{shows}".encode())
        assert datetime.fromtimestamp(read.frames["a.jpg"].time_s, UTC) == datetime(2026, 6, 1, 8, tzinfo=UTC)
    with pytest.raises(InvalidParameter, match="day or the month"):
        read_frame_list("frames.csv", b"file;time\na.jpg;6/1/2026 8:00 AM\n")
    read = read_frame_list("frames.csv", b"file;time\na.jpg;Montag\n")
    assert "'Montag'" in read.report.warnings[0]


def test_rows_that_are_left_out_are_counted() -> None:
    text = "file,lon,lat\n1.jpg,1,2\n1.jpg,1,2\n,1,2\n3.jpg,0,0\n4.jpg,200,95\n5.jpg,1\n6.jpg,1,2\n"
    read = read_frame_list("frames.csv", text.encode())
    assert list(read.frames) == ["6.jpg"]
    assert read.report.reasons == {"same-name": 1, "no-name": 1, "null-island": 1, "off-globe": 1, "malformed": 1}


def test_a_position_that_jumps_is_not_used() -> None:
    rows = [f"{k}.jpg,{1777883400 + k},{5 + (0.5 if k == 2 else 0.0001 * k)},6" for k in range(5)]
    read = read_frame_list("frames.csv", "\n".join(["file,time,lon,lat", *rows]).encode())
    assert [frame.has_position for frame in read.frames.values()] == [True, True, False, True, True]
    assert read.report.reasons == {"jump": 1}


@pytest.mark.parametrize(
    ("name", "data", "error"),
    [
        ("frames.csv", b"time,lon,lat\n1,2,3\n", InvalidParameter),
        ("frames.json", b"{", UnreadableUpload),
        ("frames.json", b"[" * 100_000, UnreadableUpload),
        ("frames.json", b'{"frames": 3}', UnreadableUpload),
        ("frames.csv", b"\0\1\2\3" * 100, UnreadableUpload),
        ("frames.csv", b"f" * (MAX_LIST_BYTES + 1), UploadTooLarge),
    ],
)
def test_lists_that_cannot_be_read(name: str, data: bytes, error: type[WaymarkError]) -> None:
    with pytest.raises(error):
        read_frame_list(name, data)


@pytest.mark.parametrize("value", ["1e999", "NaN", '"nan"', "1" * 400, "true", "null", '{"a": 1}', '"\\ud800"'])
def test_odd_values_of_json_give_no_position(value: str) -> None:
    text = f'[{{"file": "1.jpg", "time": {value}, "lon": {value}, "lat": {value}, "accuracy": {value}}}]'
    frame = read_frame_list("frames.json", text.encode()).frames["1.jpg"]
    assert math.isnan(frame.time_s)
    assert not frame.has_position


def test_names_of_files_beside_frames() -> None:
    beside = [is_beside_frames(name) for name in ("a/Frames.CSV", "x.gpx", "poses.csv", "frames.txt", "1.jpg")]
    assert beside == [True, True, True, False, False]


def exif(taken: bytes, offset: bytes = b"", fraction: bytes = b"") -> bytes:
    """A TIFF header with an orientation, and a directory with times."""
    texts = [(tag, text + b"\0") for tag, text in ((0x9003, taken), (0x9011, offset), (0x9291, fraction)) if text]
    at = 8 + 2 + 24 + 4
    own = struct.pack("<H", len(texts))
    data, place = b"", at + 2 + 12 * len(texts) + 4
    for tag, text in texts:
        if len(text) <= 4:
            own += struct.pack("<HHI4s", tag, 2, len(text), text)
        else:
            own += struct.pack("<HHII", tag, 2, len(text), place + len(data))
            data += text
    first = struct.pack("<HHHIHHHHIII", 2, 0x0112, 3, 1, 6, 0, 0x8769, 4, 1, at, 0)
    return b"II*\0" + struct.pack("<I", 8) + first + own + b"\0" * 4 + data


def test_exif_times() -> None:
    read = read_exif(exif(b"2026:05:04 08:30:00", b"+08:00", b"250"))
    assert (read.orientation, read.taken) == (6, "2026-05-04T08:30:00.250+08:00")
    assert read_exif(exif(b"2026:05:04 08:30:00")).taken == "2026-05-04T08:30:00"
    assert read_exif(exif(b"    :  :     :  :  ")).taken is None


@pytest.mark.parametrize("cut", range(0, 120, 7))
def test_exif_that_is_cut_short_counts_as_missing(cut: int) -> None:
    read_exif(exif(b"2026:05:04 08:30:00", b"+08:00", b"250")[:cut])
