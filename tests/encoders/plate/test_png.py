"""The PNG carries its resolution, and its edges lie at rounded cumulative positions."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from app.encoders.plate import PlateOrder, encode_plate, encode_sheets, write_png
from app.errors import InvalidParameter
from app.markers.plate import PlateCode, PlateGeometry


def _chunks(png: bytes) -> dict[str, bytes]:
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    chunks, at = {}, 8
    while at < len(png):
        length, kind = struct.unpack(">I4s", png[at : at + 8])
        body = png[at + 8 : at + 8 + length]
        assert struct.unpack(">I", png[at + 8 + length : at + 12 + length])[0] == zlib.crc32(kind + body)
        chunks.setdefault(kind.decode(), body)
        at += 12 + length
    return chunks


@pytest.mark.parametrize(("dpi", "per_metre"), [(72, 2835), (150, 5906), (300, 11811)])
def test_resolution_is_written_and_the_size_is_true(
    dpi: float, per_metre: int, make_order: Callable[..., PlateOrder]
) -> None:
    drawing = encode_plate(make_order())
    chunks = _chunks(write_png(drawing, dpi=dpi))
    assert struct.unpack(">IIB", chunks["pHYs"]) == (per_metre, per_metre, 1)
    width, height = struct.unpack(">II", chunks["IHDR"][:8])
    assert list(chunks).index("pHYs") < list(chunks).index("IDAT")
    assert (width, height) == (round(drawing.width_mm * per_metre / 1000), round(drawing.height_mm * per_metre / 1000))


@pytest.mark.parametrize("dpi", [63.0, 90.0, 110.0])
def test_unit_edges_never_drift(dpi: float, make_order: Callable[..., PlateOrder]) -> None:
    geometry = PlateGeometry(12, 20.3, 2.7)
    code = PlateCode("9" * 18 + "0" * 14, n=12)
    drawing = encode_plate(make_order(code, geometry))
    image = cv2.imdecode(np.frombuffer(write_png(drawing, dpi=dpi), np.uint8), cv2.IMREAD_GRAYSCALE).astype(int)
    per_mm = round(dpi / 25.4 * 1000) / 1000
    left, top = drawing.trim_mm[0][0], drawing.height_mm - drawing.trim_mm[0][3]
    row = int((top + 2.7 + 2 * 23.0 + 20.3 / 2) * per_mm)  # through the third row of units: code from end to end
    edges = np.flatnonzero(np.abs(np.diff(image[row])) > 20) + 1
    wanted = {int(np.floor((left + 2.7 + k * 23.0 + part) * per_mm + 0.5)) for k in range(12) for part in (0.0, 20.3)}
    assert wanted <= set(edges.tolist())


@pytest.mark.parametrize("dpi", [35.0, 1201.0, float("nan")])
def test_resolutions_outside_the_limits_are_refused(dpi: float, make_order: Callable[..., PlateOrder]) -> None:
    with pytest.raises(InvalidParameter, match="dpi") as caught:
        write_png(encode_plate(make_order()), dpi=dpi)
    assert caught.value.field == "dpi"
    assert caught.value.limit == "36 to 1200 dpi"


def test_pictures_too_large_for_memory_are_refused(make_order: Callable[..., PlateOrder]) -> None:
    (sheet,) = encode_sheets([make_order()], width_mm=3000, height_mm=3000)
    with pytest.raises(InvalidParameter, match="pixels"):
        write_png(sheet, dpi=300)
