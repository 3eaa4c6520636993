"""Artwork is rendered by programs that are not ours and read back by a reader that knows none of our encoders."""

from __future__ import annotations

import math
import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from app.encoders.plate import ArtworkOptions, PlateOrder, encode_plate, write_pdf, write_png, write_svg
from app.encoders.plate.drawing import Layer, Modules, Text
from app.markers.plate import PlateCode, PlateGeometry
from tests.encoders.plate.artwork_reading import marker_colours, read_digits, read_qr, rendering
from tests.http import WITHIN_S
from tests.machine import require_module

CODES = [
    PlateCode("023792168411"),
    PlateCode.from_position(-77.0365301, -38.8976763, check_digits=1),
    PlateCode.from_position(0.0000004, 51.4778, check_digits=2),
    PlateCode.from_registry_number(0xDEADBEEF),
    PlateCode.from_position(114.1793123, 22.3045678, n=10),
    PlateCode.from_registry_number(0xFEDCBA987654, n=10),
    PlateCode.from_position(-0.1246254, 51.5007292, n=12, check_digits=2),
    PlateCode.from_registry_number(0x0123456789ABCDEF, n=12),
]
GEOMETRIES = {8: PlateGeometry(), 10: PlateGeometry(10, 35, 5), 12: PlateGeometry(12, 30, 4)}
CORNERS = ["red", "green", "green", "green", "grey"]


def _decode(png: bytes) -> npt.NDArray[np.uint8]:
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)


def _from_png(order: PlateOrder, options: ArtworkOptions, folder: Path, tool: Callable[..., str]):
    return _decode(write_png(encode_plate(order, options), dpi=100))


def _from_svg(order: PlateOrder, options: ArtworkOptions, folder: Path, tool: Callable[..., str]):
    return _decode(require_module("cairosvg", "libcairo").svg2png(write_svg(encode_plate(order, options)), dpi=96))


def _from_pdf(order: PlateOrder, options: ArtworkOptions, folder: Path, tool: Callable[..., str]):
    (folder / "plate.pdf").write_bytes(write_pdf(encode_plate(order, options)))
    command = [tool("pdftoppm"), "-r", "150", "-f", "1", "-l", "1", "-singlefile", "-png", "plate.pdf", "page"]
    subprocess.run(command, cwd=folder, check=True, timeout=WITHIN_S)
    return cv2.imread(str(folder / "page.png"))


def _from_chromium(order: PlateOrder, options: ArtworkOptions, folder: Path, tool: Callable[..., str]):
    drawing = encode_plate(order, options)
    (folder / "plate.svg").write_bytes(write_svg(drawing))
    width, height = (math.ceil(mm * 96 / 25.4) for mm in (drawing.width_mm, drawing.height_mm))
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--hide-scrollbars"]
    size = ["--force-device-scale-factor=2", f"--window-size={width},{height}", f"--user-data-dir={folder / 'profile'}"]
    command = [tool("chromium", "chromium-browser", "google-chrome"), *flags, *size, "--screenshot=page.png"]
    subprocess.run([*command, "plate.svg"], cwd=folder, check=True, timeout=WITHIN_S, capture_output=True)
    return cv2.imread(str(folder / "page.png"))


@pytest.mark.slow
@pytest.mark.parametrize("render", [_from_png, _from_svg, _from_pdf])
@pytest.mark.parametrize("code", CODES, ids=lambda c: f"{c.scheme}-{c.n}-{c.check_digits}")
def test_every_scheme_and_size_reads_back(
    code: PlateCode,
    render: Callable[..., npt.NDArray[np.uint8]],
    make_order: Callable[..., PlateOrder],
    require_tool: Callable[..., str],
    tmp_path: Path,
) -> None:
    order = make_order(code, GEOMETRIES[code.n])
    drawing = encode_plate(order)
    image = render(order, ArtworkOptions(), tmp_path, require_tool)
    picture = rendering(image, (drawing.width_mm, drawing.height_mm), drawing.trim_mm[0])
    geometry = (order.geometry.n, order.geometry.unit_mm, order.geometry.gap_mm)
    assert read_digits(picture, *geometry) == code.digits
    assert marker_colours(picture, *geometry) == CORNERS


@pytest.mark.slow
@pytest.mark.parametrize("render", [_from_png, _from_svg, _from_pdf, _from_chromium])
def test_heaters_and_leds_stay_under_the_face_and_the_qr_opens_the_record(
    render: Callable[..., npt.NDArray[np.uint8]],
    make_order: Callable[..., PlateOrder],
    require_tool: Callable[..., str],
    tmp_path: Path,
) -> None:
    order = make_order()
    drawing = encode_plate(order, ArtworkOptions(heaters=True, leds=True))
    image = render(order, ArtworkOptions(heaters=True, leds=True), tmp_path, require_tool)
    picture = rendering(image, (drawing.width_mm, drawing.height_mm), drawing.trim_mm[0])
    assert read_digits(picture, 8, 35.0, 5.0) == "023792168411"
    assert marker_colours(picture, 8, 35.0, 5.0) == CORNERS
    assert read_qr(picture) == order.record_url


@pytest.mark.parametrize("render", [_from_png, _from_svg, _from_pdf])
def test_without_an_address_the_face_is_the_same_and_the_margin_says_that_there_is_no_qr_code(
    render: Callable[..., npt.NDArray[np.uint8]],
    make_order: Callable[..., PlateOrder],
    require_tool: Callable[..., str],
    tmp_path: Path,
) -> None:
    order = make_order(record_url="")
    drawing = encode_plate(order)
    picture = rendering(
        render(order, ArtworkOptions(), tmp_path, require_tool),
        (drawing.width_mm, drawing.height_mm),
        drawing.trim_mm[0],
    )
    assert read_digits(picture, 8, 35.0, 5.0) == "023792168411"
    assert marker_colours(picture, 8, 35.0, 5.0) == CORNERS
    assert read_qr(picture) == ""
    assert not [part for part in drawing.parts if isinstance(part, Modules)]
    notes = [part for part in drawing.parts if isinstance(part, Text) and part.layer is Layer.NOTE]
    assert {"No QR code:", "no public address"} <= {note.text for note in notes}  # a note: it is not engraved
    assert "No QR code:" not in {part.text for part in encode_plate(make_order()).parts if isinstance(part, Text)}
