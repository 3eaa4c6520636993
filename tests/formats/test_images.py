"""The one loader of pictures: what it reads, what it refuses, and how it says so."""

from __future__ import annotations

import io
import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge, WaymarkError
from app.formats.images import ImageKind, ImageLimits, inspect_image, load_image
from tests.formats.pictures import chunk, corner_frame, huge_png, jpeg, lying_png, png, raw_png


def colours_of(pixels: np.ndarray) -> list[str]:
    """Names of the four quarters of a BGR frame, row by row."""
    h, w = pixels.shape[:2]
    names = {(0, 0, 1): "red", (0, 1, 0): "green", (1, 0, 0): "blue", (1, 1, 1): "white"}
    return [names[tuple(pixels[y, x] // 128)] for y in (h // 4, 3 * h // 4) for x in (w // 4, 3 * w // 4)]


UPRIGHT = ["red", "green", "blue", "white"]


def test_jpeg_and_png_are_read_as_bgr() -> None:
    for data, kind in ((jpeg(), ImageKind.JPEG), (png(), ImageKind.PNG)):
        frame = load_image(data)
        assert frame.header.kind is kind
        assert frame.pixels.shape == (240, 320, 3)
        assert frame.pixels.dtype == np.uint8
        assert colours_of(frame.pixels) == UPRIGHT


@pytest.mark.parametrize("options", [{"progressive": True}, {"subsampling": 0}, {"optimize": True}])
def test_jpeg_varieties_that_cameras_write(options: dict[str, object]) -> None:
    assert colours_of(load_image(jpeg(**options)).pixels) == UPRIGHT


def test_restart_markers_are_no_end() -> None:
    ok, data = cv2.imencode(".jpg", corner_frame()[..., ::-1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 3])
    assert ok
    assert b"\xff\xd3" in data.tobytes()
    assert colours_of(load_image(data.tobytes()).pixels) == UPRIGHT


@pytest.mark.parametrize("mode", ["RGBA", "P", "L", "LA"])
def test_png_varieties(mode: str) -> None:
    image = Image.fromarray(corner_frame()).convert(mode)
    out = io.BytesIO()
    image.save(out, "PNG")
    pixels = load_image(out.getvalue()).pixels
    assert pixels.shape == (240, 320, 3)
    if mode in ("RGBA", "P"):
        assert colours_of(pixels) == UPRIGHT


# The stored pixels are the upright frame turned the other way (CIPA DC-008, tag 0x0112).
@pytest.mark.parametrize(("orientation", "quarter_turns_ccw"), [(1, 0), (3, 2), (6, 1), (8, 3)])
def test_orientation_is_applied_once(orientation: int, quarter_turns_ccw: int) -> None:
    stored = np.ascontiguousarray(np.rot90(corner_frame(), quarter_turns_ccw))
    frame = load_image(jpeg(stored, orientation=orientation))
    assert frame.pixels.shape == (240, 320, 3)
    assert (frame.header.width_px, frame.header.height_px) == (320, 240)
    assert colours_of(frame.pixels) == UPRIGHT


def test_orientation_of_a_png_is_applied_too() -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    stored = np.ascontiguousarray(np.rot90(corner_frame(), 1))
    assert colours_of(load_image(png(stored, exif=exif)).pixels) == UPRIGHT


@pytest.mark.parametrize("orientation", [2, 4, 5, 7])
def test_mirrored_orientations_are_refused(orientation: int) -> None:
    for data in (jpeg(orientation=orientation),):
        with pytest.raises(UnsupportedUpload, match="mirrors") as caught:
            inspect_image(data)
        assert caught.value.field == "file"
        assert caught.value.limit
        assert caught.value.cure


@pytest.mark.parametrize("orientation", [0, 9, 65535])
def test_orientations_that_do_not_exist_are_upright(orientation: int) -> None:
    assert load_image(jpeg(orientation=orientation)).header.orientation == 1


# --- thermal ------------------------------------------------------------------------------------------------------


def thermal_png() -> tuple[bytes, np.ndarray]:
    counts = np.full((64, 80), 29_000, np.uint16)
    counts[:, 40:] = 29_500
    counts[0, 0] = 65_535  # a dead pixel must not set the scale
    ok, data = cv2.imencode(".png", counts)
    assert ok
    return data.tobytes(), counts


def test_sixteen_bit_thermal_is_scaled_by_its_percentiles() -> None:
    frame = load_image(thermal_png()[0], thermal=True)
    assert frame.pixels.shape == (64, 80)
    assert frame.pixels.dtype == np.uint8
    assert frame.pixels[30, 10] == 0
    assert frame.pixels[30, 60] == 255


def test_sixteen_bit_thermal_is_scaled_by_the_declared_range() -> None:
    frame = load_image(thermal_png()[0], thermal=True, thermal_range=(28_500, 29_500))
    assert abs(int(frame.pixels[30, 10]) - 128) <= 1
    assert frame.pixels[30, 60] == 255


@pytest.mark.parametrize("bounds", [(2.0, 1.0), (1.0, 1.0), (float("nan"), 1.0), (0.0, float("inf"))])
def test_senseless_thermal_ranges(bounds: tuple[float, float]) -> None:
    with pytest.raises(InvalidParameter) as caught:
        load_image(thermal_png()[0], thermal=True, thermal_range=bounds)
    assert caught.value.field == "thermal_range"


def test_sixteen_bits_without_thermal_are_refused() -> None:
    with pytest.raises(UnsupportedUpload, match="thermal"):
        load_image(thermal_png()[0])


def test_a_constant_thermal_frame_is_a_frame() -> None:
    ok, data = cv2.imencode(".png", np.full((64, 64), 1234, np.uint16))
    assert ok
    assert load_image(data.tobytes(), thermal=True).pixels.max() == 0


# --- refusals -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "names"),
    [
        (b"GIF89a" + bytes(50), "GIF"),
        (b"BM" + bytes(50), "BMP"),
        (b"II*\x00" + bytes(50), "TIFF"),
        (b"RIFF\x00\x00\x00\x00WEBP" + bytes(50), "WebP"),
        (b"\x00\x00\x00\x18ftypmp42" + bytes(50), "video"),
        (b"%PDF-1.7" + bytes(50), "PDF"),
        (b"PK\x03\x04" + bytes(50), "ZIP"),
        (b"ffconcat version 1.0\nfile other.avi", "playlist"),
        (b"#EXTM3U\nfile:///etc/passwd", "playlist"),
        (b"<svg xmlns='http://www.w3.org/2000/svg'/>", "SVG"),
        (b"hello", "not a JPEG"),
        (b"\x00\x00\x00\x01\x67\x64\x00\x1f", "a raw H.264 or H.265 stream"),
        (b"\x28\xb5\x2f\xfd\x04\x00", "compressed by zstd"),
        (b"#ROSBAG V1.2\n", "a ROS bag of an old version"),
        (b"\xff\xd8", "not a JPEG"),
    ],
)
def test_other_kinds_are_named_and_refused(data: bytes, names: str) -> None:
    with pytest.raises(UnsupportedUpload, match=names) as caught:
        load_image(data)
    assert (caught.value.field, bool(caught.value.limit), bool(caught.value.cure)) == ("file", True, True)


def test_empty() -> None:
    with pytest.raises(UnreadableUpload, match="empty"):
        load_image(b"")


def test_cmyk_is_refused() -> None:
    with pytest.raises(UnsupportedUpload, match="CMYK"):
        load_image(jpeg(cmyk=True))


@pytest.mark.parametrize("make", [jpeg, png])
@pytest.mark.parametrize("share", [0.001, 0.02, 0.3, 0.7, 0.999])
def test_truncated_files_are_refused(make: object, share: float) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (120, 160, 3), dtype=np.uint8)
    data = make(noise)  # type: ignore[operator]
    with pytest.raises(UnreadableUpload):
        load_image(data[: max(9, int(len(data) * share))])


def test_truncated_between_the_scans_of_a_progressive_jpeg() -> None:
    data = jpeg(progressive=True)
    last_scan = data.rfind(b"\xff\xda")
    with pytest.raises(UnreadableUpload):
        load_image(data[:last_scan])


def test_one_flipped_bit_in_a_png_is_found() -> None:
    data = bytearray(png())
    data[len(data) // 2] ^= 1
    with pytest.raises(UnreadableUpload, match="checksum"):
        load_image(bytes(data))


def test_png_with_too_few_rows() -> None:
    with pytest.raises(UnreadableUpload, match="damaged"):
        load_image(raw_png(100, 100, bytes(301 * 50)))


@pytest.mark.parametrize(("depth", "colour"), [(1, 0), (2, 3), (4, 0), (16, 2), (16, 6), (8, 1), (8, 5)])
def test_png_depths_no_camera_writes(depth: int, colour: int) -> None:
    with pytest.raises(UnsupportedUpload, match="bits a channel"):
        load_image(raw_png(64, 64, bytes(64 * 1000), depth=depth, colour=colour), thermal=True)


def test_animated_png_is_refused() -> None:
    with pytest.raises(UnsupportedUpload, match="animated"):
        load_image(raw_png(64, 64, bytes(193 * 64), extra=chunk(b"acTL", struct.pack(">II", 2, 0))))


def test_two_headers_are_refused() -> None:
    second = chunk(b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0))
    with pytest.raises(UnreadableUpload, match="header"):
        load_image(raw_png(64, 64, bytes(193 * 64), extra=second))


@pytest.mark.parametrize(("width", "height"), [(31, 400), (400, 31), (1, 1)])
def test_too_small(width: int, height: int) -> None:
    for make in (jpeg, png):
        with pytest.raises(UnreadableUpload, match="too small") as caught:
            load_image(make(corner_frame(width, height)))
        assert caught.value.limit == "at least 32 px a side"


def test_zero_size() -> None:
    with pytest.raises(UnreadableUpload, match="too small"):
        load_image(raw_png(0, 64, b""))


def test_pixel_limit_is_read_from_the_header() -> None:
    for data in (jpeg(), png()):
        with pytest.raises(UploadTooLarge, match="320 x 240"):
            inspect_image(data, ImageLimits(pixels=320 * 240 - 1))
        assert inspect_image(data, ImageLimits(pixels=320 * 240)).width_px == 320


def test_compressed_text_is_never_expanded() -> None:
    bomb = chunk(b"zTXt", b"note\x00\x00" + zlib.compress(bytes(200_000_000), 9))
    profile = chunk(b"iCCP", b"icc\x00\x00" + zlib.compress(bytes(50_000_000), 9))
    frame = load_image(raw_png(64, 64, bytes(193 * 64), extra=profile + bomb))
    assert frame.pixels.shape == (64, 64, 3)


@pytest.mark.parametrize("tail", [b"PK\x03\x04 an archive", b"\xff\xd8\xff a second picture", b"<script>"])
def test_what_follows_the_picture_is_ignored_and_counted(tail: bytes) -> None:
    for data in (jpeg(), png()):
        frame = load_image(data + tail)
        assert frame.header.trailing_bytes == len(tail)
        assert colours_of(frame.pixels) == UPRIGHT


_MEASURE = """
import resource, sys
from app.formats.images import load_image
from app.errors import UnreadableUpload
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    load_image(sys.stdin.buffer.read())
except UnreadableUpload as error:
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(grown // 1024, error.message)
"""


@pytest.mark.parametrize(("data", "message"), [(lying_png(), "declares"), (huge_png(), "30000 x 30000")])
def test_bombs_cost_no_memory(data: bytes, message: str) -> None:
    assert len(data) < 200_000
    done = subprocess.run([sys.executable, "-c", _MEASURE], input=data, capture_output=True, check=True)
    grown_mib, said = done.stdout.decode().split(" ", 1)
    assert int(grown_mib) < 32
    assert message in said


def test_a_lying_length_within_a_signed_integer() -> None:
    with pytest.raises(UnreadableUpload, match="declares 2147483647 bytes"):
        load_image(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", bytes(13), length=2**31 - 1))


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_mutilated_files_raise_only_our_errors(data: st.DataObject) -> None:
    original = data.draw(st.sampled_from([jpeg(corner_frame(64, 48)), png(corner_frame(64, 48))]))
    mutant = bytearray(original)
    for _ in range(data.draw(st.integers(1, 6))):
        mutant[data.draw(st.integers(0, len(mutant) - 1))] = data.draw(st.integers(0, 255))
    try:
        frame = load_image(bytes(mutant), ImageLimits(pixels=1_000_000))
    except WaymarkError:
        return
    assert frame.pixels.shape[:2] == (frame.header.height_px, frame.header.width_px)
