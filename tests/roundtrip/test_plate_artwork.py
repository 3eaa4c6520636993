"""What the encoder writes the decoder reads: the proof with the real reader, and files through other renderers."""

from __future__ import annotations

import io
import json
import subprocess
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from app.decoders.plate.reader import decode_plates
from app.encoders.plate import (
    ArtworkOptions,
    PlateOrder,
    encode_plate,
    prove_plate,
    write_bundle,
    write_pdf,
    write_png,
    write_svg,
)
from app.encoders.plate.drawing import Boxes, Layer
from app.errors import ProofFailed
from app.markers.plate import PlateCode, PlateGeometry
from app.markers.reading import PlateOutcome, PlateReading
from tests.http import WITHIN_S
from tests.machine import require_module, require_tool

URL = "https://waymark.example/v1/markers/3f0c8a52-6a0c-7d1e-9f52-0123456789ab"
CAMERA_PX_PER_MM = 1.0  # a plate some 1.5 m in front of a 1080p camera
CASES = [
    (PlateCode("023792168411"), PlateGeometry()),
    (PlateCode("000000000001"), PlateGeometry()),
    (PlateCode.from_position(-77.0365301, -38.8976763, check_digits=1), PlateGeometry(8, 20, 2)),
    (PlateCode.from_position(0.0000004, 51.4778, check_digits=2), PlateGeometry(8, 50, 10)),
    (PlateCode.from_registry_number(0xDEADBEEF), PlateGeometry(8, 40, 3)),
    (PlateCode.from_registry_number(0xFFFFFFFF), PlateGeometry()),
    (PlateCode.from_registry_number(0xFEDCBA987654, n=10), PlateGeometry(10)),
    (PlateCode.from_position(114.1793123, 22.3045678, n=12), PlateGeometry(12, 30, 4)),
]


def read(image: npt.NDArray[np.uint8], geometry: PlateGeometry) -> Sequence[PlateReading]:
    return decode_plates(image, geometries=[geometry])


def _digits(image: npt.NDArray[np.uint8], geometry: PlateGeometry) -> list[str | None]:
    return [r.digits for r in read(image, geometry) if r.outcome is PlateOutcome.READ]


@pytest.mark.parametrize(("code", "geometry"), CASES, ids=lambda v: getattr(v, "digits", None) or f"n{v.n}-{v.unit_mm}")
def test_every_drawing_proves_itself(code: PlateCode, geometry: PlateGeometry) -> None:
    drawing = encode_plate(PlateOrder("P", code, geometry, URL), ArtworkOptions(heaters=True, leds=True))
    proof = prove_plate(drawing, code, geometry, read)
    assert proof.digits == code.digits
    assert proof.corner_error_px < 1.0


def test_a_drawing_of_another_code_fails_its_proof() -> None:
    drawing = encode_plate(PlateOrder("P", PlateCode("023792168411")))
    with pytest.raises(ProofFailed, match="reads 023792168411"):
        prove_plate(drawing, PlateCode("023792168412"), PlateGeometry(), read)


def test_a_drawing_without_its_triangle_fails_its_proof() -> None:
    drawing = encode_plate(PlateOrder("P", PlateCode("023792168411")))
    bare = replace(drawing, parts=tuple(part for part in drawing.parts if part.layer is not Layer.MARK_RED))
    with pytest.raises(ProofFailed):
        prove_plate(bare, PlateCode("023792168411"), PlateGeometry(), read)
    swapped = [
        Boxes({Layer.CODE_DARK: Layer.CODE_LIGHT, Layer.CODE_LIGHT: Layer.CODE_DARK}.get(p.layer, p.layer), p.boxes_mm)
        if isinstance(p, Boxes)
        else p
        for p in drawing.parts
    ]
    with pytest.raises(ProofFailed):
        prove_plate(replace(drawing, parts=tuple(swapped)), PlateCode("023792168411"), PlateGeometry(), read)


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_files_are_read_by_the_decoder_through_other_renderers(kind: str, tmp_path: Path) -> None:
    code = PlateCode.from_position(114.1793123, 22.3045678)
    drawing = encode_plate(PlateOrder("HK-000123", code, PlateGeometry(), URL))
    if kind == "png":
        picture = write_png(drawing, dpi=150)
    elif kind == "svg":
        picture = require_module("cairosvg", "libcairo").svg2png(write_svg(drawing), dpi=96)
    else:
        pdftoppm = require_tool("pdftoppm")
        (tmp_path / "plate.pdf").write_bytes(write_pdf(drawing))
        command = [pdftoppm, "-r", "150", "-singlefile", "-png", "plate.pdf", "page"]
        subprocess.run(command, cwd=tmp_path, check=True, timeout=WITHIN_S)
        picture = (tmp_path / "page.png").read_bytes()
    sheet = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    size = (round(drawing.width_mm * CAMERA_PX_PER_MM), round(drawing.height_mm * CAMERA_PX_PER_MM))
    image = cv2.resize(sheet, size, interpolation=cv2.INTER_AREA)
    assert _digits(image, PlateGeometry()) == [code.digits]


def test_a_bundle_is_proved_with_the_decoder() -> None:
    orders = [PlateOrder(f"P{k}", PlateCode(f"{(k + 1) * 104729:012d}"), record_url=URL) for k in range(12)]
    buffer = io.BytesIO()
    write_bundle(orders, buffer, read=read)
    manifest = json.loads(zipfile.ZipFile(buffer).read("manifest.json"))
    assert [p["proof"]["read_back"] for p in manifest["plates"]] == [order.code.digits for order in orders]
