"""What an upload is, by its content, and the list of formats."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from app.errors import WaymarkError
from app.formats.format import SpooledFile, Use
from app.formats.kinds import FORMATS, UploadKind, detect_drive_file, guess_kind

JPEG, PNG = b"\xff\xd8\xff\xe0" + bytes(40), b"\x89PNG\r\n\x1a\n" + bytes(40)
RAW_DATA = b"Time Stamp,Sensor 1 X,Sensor 1 Y\n0.1,2,3\n"
POSES = b"time,longitude,latitude\n2026-03-16T13:39:32Z,10,50\n"
LOG = b"id,latitude,longitude,rssi,timestamp\n1,50,10,-80,2026-03-16T13:39:32Z\n"
PAYLOADS = bytes([0x10, *range(23)]) * 9
STREAM = np.random.default_rng(1).normal(40, 9, 43 * 40).astype("<f4").tobytes()


def _zip(**files: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("data", "kind"),
    [
        (JPEG, UploadKind.FRAME),
        (PNG, UploadKind.FRAME),
        (_zip(a=JPEG, b=PNG), UploadKind.FRAME),
        (_zip(**{f"f{k}": JPEG for k in range(40)}), UploadKind.FRAME),
        (RAW_DATA, UploadKind.TRACE),
        (b"t_s,s1_x,s1_y,s1_z,speed_m_s,lon,lat\n0,1,2,3,4,5,6\n", UploadKind.TRACE),
        (b"PAR1" + bytes(40), UploadKind.TRACE),
        (b"LOGG" + bytes(40), UploadKind.TRACE),
        (STREAM, UploadKind.TRACE),
        (_zip(a=RAW_DATA, b=b"Time Stamp,Speed\n0,1\n"), UploadKind.TRACE),
        (LOG, UploadKind.PACKETS),
        (b"timestamp;payload\n0;10ff\n", UploadKind.PACKETS),
        (b'{"deduplicationId": 1}\n', UploadKind.PACKETS),
        (PAYLOADS, UploadKind.PACKETS),
        (PAYLOADS[:24].hex().encode() + b"\n", UploadKind.PACKETS),
        (_zip(log=LOG, poses=POSES, frame=JPEG), UploadKind.PACKETS),
        (_zip(poses=POSES), UploadKind.PACKETS),
        (b"", None),
        (b"1,2,3\n", None),
    ],
    ids=lambda value: "upload" if isinstance(value, bytes) else str(value),
)
def test_an_upload_is_recognized_by_its_content(data: bytes, kind: UploadKind | None) -> None:
    assert guess_kind("upload", SpooledFile.of(data)) is kind


def test_any_bytes_have_a_kind_none_or_a_problem() -> None:
    rng = np.random.default_rng(5)
    good = [JPEG, RAW_DATA, LOG, PAYLOADS, _zip(log=LOG, poses=POSES), b"\xff\xfe" + "a,b\n".encode("utf-16-le")]
    for k in range(600):
        data = bytearray(good[k % len(good)])
        for at in rng.integers(0, len(data), 4):
            data[at] = rng.integers(256)
        try:
            guess_kind("upload", SpooledFile.of(bytes(data[: rng.integers(0, len(data) + 1)])))
        except WaymarkError:
            continue


@pytest.mark.parametrize(
    ("name", "data", "use"),
    [
        ("frame", JPEG, Use.FRAME),
        ("frame.gpx", PNG, Use.FRAME),
        ("log.csv", LOG, Use.PACKETS),
        ("log.bin", PAYLOADS, Use.PACKETS),
        ("notes.txt", b"hello\nworld\n", Use.PACKETS),
        ("track.csv", POSES, Use.POSES),
        ("track", b"<gpx></gpx>", Use.POSES),
        ("track.nmea", b"t,x,y\n", Use.POSES),
    ],
)
def test_files_of_a_drive(name: str, data: bytes, use: Use) -> None:
    assert detect_drive_file(name, data) is use


def test_every_format_stands_in_the_list_once() -> None:
    assert len({(found.use, found.name) for found in FORMATS}) == len(FORMATS)
    assert {found.use for found in FORMATS} == set(Use)


def test_the_documentation_names_every_format_of_surveys() -> None:
    text = (Path(__file__).parents[2] / "docs/imports.md").read_text().lower()
    names = {found.name for found in FORMATS if found.use is Use.SURVEY} - {"gpkg"} | {"geopackage"}
    assert [name for name in sorted(names) if name not in text] == []
