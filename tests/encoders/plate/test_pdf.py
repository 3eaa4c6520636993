"""The PDF is measured, its inks are split by Ghostscript, its structure is read by pikepdf."""

from __future__ import annotations

import io
import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pikepdf
import pytest

from app.encoders.plate import ArtworkOptions, Drawing, PlateOrder, encode_plate, encode_sheets, write_pdf
from app.encoders.plate.drawing import Layer, Text
from app.markers.plate import PlateCode, PlateGeometry
from tests.http import WITHIN_S

MM_PER_POINT = 25.4 / 72


def _split(pdf: bytes, folder: Path, ghostscript: str, dpi: int = 72) -> dict[str, np.ndarray]:
    """Coverage of each separation of the first page, 0 to 1."""
    (folder / "plate.pdf").write_bytes(pdf)
    command = [ghostscript, "-q", "-dSAFER", "-dBATCH", "-dNOPAUSE", "-sDEVICE=tiffsep", f"-r{dpi}", "-dLastPage=1"]
    subprocess.run([*command, "-sOutputFile=sep.tif", "plate.pdf"], cwd=folder, check=True, timeout=WITHIN_S)
    inks = {}
    for path in folder.glob("sep*(*).tif"):
        plate = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        inks[path.name.split("(")[1].split(")")[0]] = 1 - plate / 255
    return inks


def _inside(plate: np.ndarray, drawing: Drawing, grow_mm: float = 0.0) -> np.ndarray:
    per_mm = plate.shape[1] / drawing.width_mm
    left, bottom, right, top = drawing.trim_mm[0]
    rows = [round((drawing.height_mm - y) * per_mm) for y in (top + grow_mm, bottom - grow_mm)]
    cols = [round(x * per_mm) for x in (left - grow_mm, right + grow_mm)]
    return plate[rows[0] : rows[1], cols[0] : cols[1]]


@pytest.mark.parametrize("geometry", [PlateGeometry(), PlateGeometry(12, 30, 4)], ids=["n8", "n12"])
def test_boxes_are_the_plate_and_its_bleed(geometry: PlateGeometry, make_order: Callable[..., PlateOrder]) -> None:
    code = PlateCode.from_registry_number(77, n=geometry.n)
    drawing = encode_plate(make_order(code, geometry))
    document = pikepdf.open(io.BytesIO(write_pdf(drawing)))
    page = document.pages[0]
    media, trim, bleed = ([float(v) * MM_PER_POINT for v in page[f"/{k}Box"]] for k in ("Media", "Trim", "Bleed"))
    side = geometry.n * geometry.unit_mm + (geometry.n + 1) * geometry.gap_mm
    assert (trim[2] - trim[0], trim[3] - trim[1]) == pytest.approx((side, side), abs=1e-3)
    assert [b - t for b, t in zip(bleed, trim, strict=True)] == pytest.approx([-5, -5, 5, 5], abs=1e-3)
    assert media[0] < bleed[0]
    assert media[1] < bleed[1]
    assert media[2] > bleed[2]
    assert media[3] > bleed[3]


@pytest.mark.slow
def test_every_ink_is_a_separation_with_its_own_area(
    make_order: Callable[..., PlateOrder], require_tool: Callable[..., str], tmp_path: Path
) -> None:
    drawing = encode_plate(make_order(geometry=PlateGeometry(8, 20, 2)))
    dpi = 254  # Ghostscript paints every pixel that an edge touches: 0.1 mm here
    inks = _split(write_pdf(drawing), tmp_path, require_tool("gs"), dpi)
    spots = {"BASE", "CODE_DARK", "CODE_LIGHT", "MARK_RED", "MARK_GREEN", "ENGRAVE", "NOTE", "CUT"}
    assert spots <= set(inks)
    mm2 = (25.4 / dpi) ** 2
    area = {name: _inside(plate, drawing).sum() * mm2 for name, plate in inks.items()}
    dark = sum(int(d).bit_count() for d in "023792168411")
    expected = {
        "CODE_DARK": dark * 20**2,
        "CODE_LIGHT": (48 - dark) * 20**2,
        "MARK_RED": 42**2 / 2,
        "MARK_GREEN": 3 * 42**2,
        "BASE": 178**2 - 48 * 20**2 - 3.5 * 42**2,
    }
    for name, mm2_expected in expected.items():
        assert area[name] == pytest.approx(mm2_expected, rel=0.015), name
    for name in ("ENGRAVE", "NOTE", "Cyan", "Magenta", "Yellow", "Black"):  # nothing else on the face
        assert area[name] < 1.0, name


@pytest.mark.slow
def test_the_base_bleeds_and_crop_marks_are_on_every_separation(
    make_order: Callable[..., PlateOrder], require_tool: Callable[..., str], tmp_path: Path
) -> None:
    drawing = encode_plate(make_order())
    inks = _split(write_pdf(drawing), tmp_path, require_tool("gs"), dpi=144)
    mm2 = (25.4 / 144) ** 2
    bled = _inside(inks["BASE"], drawing, 5.0).sum() - _inside(inks["BASE"], drawing).sum()
    assert bled * mm2 == pytest.approx(335**2 - 325**2, rel=0.03)
    per_mm = inks["BASE"].shape[1] / drawing.width_mm
    row = round((drawing.height_mm - drawing.trim_mm[0][3]) * per_mm)
    mark = np.s_[row - 2 : row + 3, round(6 * per_mm) : round(12 * per_mm)]
    for name in ("BASE", "CODE_DARK", "MARK_RED", "MARK_GREEN", "CUT"):
        assert inks[name][mark].sum(axis=0).min() > 0.3, name


def test_there_is_no_font_and_no_live_text(make_order: Callable[..., PlateOrder]) -> None:
    sheets = encode_sheets([make_order()] * 4, width_mm=900, height_mm=900)
    for content in (write_pdf(encode_plate(make_order()), compress=False), write_pdf(sheets, compress=False)):
        assert b"/Font" not in content
        assert b"\nBT" not in content
        with pikepdf.open(io.BytesIO(content)) as document:
            assert not document.check_pdf_syntax()


def test_heaters_and_leds_have_a_page_of_their_own(
    make_order: Callable[..., PlateOrder], require_tool: Callable[..., str], tmp_path: Path
) -> None:
    drawing = encode_plate(make_order(), ArtworkOptions(heaters=True, leds=True))
    pdf = write_pdf(drawing)
    with pikepdf.open(io.BytesIO(pdf)) as document:
        assert len(document.pages) == 2
    inks = _split(pdf, tmp_path, require_tool("gs"))
    assert inks.get("HEATER", np.zeros(1)).sum() < 1  # not on the page of the face


def test_texts_that_repeat_are_written_once_and_look_the_same(
    make_order: Callable[..., PlateOrder], require_tool: Callable[..., str], tmp_path: Path
) -> None:
    drawing = encode_plate(make_order())
    once, thrice = write_pdf(drawing, compress=False), write_pdf([drawing] * 3, compress=False)
    texts = sum(isinstance(part, Text) for part in drawing.parts)
    assert texts > 10
    assert len(thrice) < 2 * len(once)
    pictures = []
    for name, pdf in (("once", once), ("thrice", thrice)):
        (tmp_path / name).write_bytes(pdf)
        command = [require_tool("pdftoppm"), "-r", "60", "-singlefile", "-png", name, f"{name}-page"]
        subprocess.run(command, cwd=tmp_path, check=True, timeout=WITHIN_S)
        pictures.append(cv2.imread(str(tmp_path / f"{name}-page.png")))
    assert np.array_equal(*pictures)


def test_properties_take_any_text_and_bytes_are_stable(make_order: Callable[..., PlateOrder]) -> None:
    order = make_order(plate_id="路标) << (é")
    pdf = write_pdf(encode_plate(order))
    with pikepdf.open(io.BytesIO(pdf)) as document:
        assert str(document.docinfo["/Title"]).startswith("路标) << (é r2")
    assert pdf == write_pdf(encode_plate(order))


def test_a_spot_ink_is_named_after_its_layer(make_order: Callable[..., PlateOrder]) -> None:
    document = pikepdf.open(io.BytesIO(write_pdf(encode_plate(make_order()))))
    page = document.pages[0]
    for name, space in page["/Resources"]["/ColorSpace"].items():
        assert space[0] == "/Separation"
        layer = Layer(name[1:])
        named = {Layer.BLEED: "/BASE", Layer.CROP: "/All"}.get(layer, f"/{layer}")
        assert space[1] == named
