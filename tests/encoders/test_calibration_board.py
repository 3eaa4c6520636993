"""The board's artwork, measured in millimetres and read by OpenCV's own detector from other programs' renderings."""

from __future__ import annotations

import io
import re
import subprocess
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pikepdf
import pytest

from app.encoders.calibration_board import encode_board
from app.encoders.plate import ArtworkFormat, write_artwork
from app.errors import InvalidParameter
from app.sensors.camera import CalibrationBoard
from tests.http import WITHIN_S
from tests.machine import require_module, require_tool

BOARDS = (CalibrationBoard(), CalibrationBoard(12, 9, 40.0, 30.0), CalibrationBoard(5, 4, 15.0, 9.0))
Grey = npt.NDArray[np.uint8]


def _read(grey: Grey, board: CalibrationBoard) -> tuple[npt.NDArray[np.float64], list[int]]:
    """Corners and markers, by nothing of ours but the board's figures."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    theirs = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_mm, board.marker_mm, dictionary)
    corners, ids, _markers, numbers = cv2.aruco.CharucoDetector(theirs).detectBoard(grey)
    assert ids is not None
    assert ids.ravel().tolist() == list(range((board.columns - 1) * (board.rows - 1)))
    return np.asarray(corners, float).reshape(-1, 2), sorted(numbers.ravel().tolist())


def _check(grey: Grey, board: CalibrationBoard, width_mm: float) -> None:
    px_per_mm = grey.shape[1] / width_mm
    corners, numbers = _read(grey, board)
    assert numbers == list(range(board.columns * board.rows // 2))
    grid = (corners / px_per_mm).reshape(board.rows - 1, board.columns - 1, 2)
    assert np.diff(grid[..., 0], axis=1) == pytest.approx(board.square_mm, abs=0.15)
    assert np.diff(grid[..., 1], axis=0) == pytest.approx(board.square_mm, abs=0.15)
    assert grid[-1, -1, 0] - grid[0, 0, 0] == pytest.approx((board.columns - 2) * board.square_mm, abs=0.15)
    dark = grey[: int(corners[0, 1]), : int(corners[0, 0])][-5:, -5:]
    assert dark.mean() < 100, "the upper left square is black"


@pytest.mark.parametrize("board", BOARDS, ids=str)
def test_a_svg_is_the_board_in_millimetres(board: CalibrationBoard) -> None:
    drawing = encode_board(board)
    svg = write_artwork(drawing, ArtworkFormat.SVG).content
    head = re.search(rb'width="([\d.]+)mm" height="([\d.]+)mm" viewBox="0 0 ([\d.]+) ([\d.]+)"', svg)
    assert head is not None
    width, height, box_width, box_height = (float(value) for value in head.groups())
    assert (width, height) == (box_width, box_height) == (drawing.width_mm, drawing.height_mm)
    png = require_module("cairosvg", "libcairo").svg2png(svg, output_width=round(width * 6))
    grey = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
    _check(grey, board, width)


@pytest.mark.parametrize("board", BOARDS[:2], ids=str)
def test_a_pdf_is_the_board_in_millimetres(board: CalibrationBoard, tmp_path: Path) -> None:
    program = require_tool("pdftoppm")
    drawing = encode_board(board)
    content = write_artwork(drawing, ArtworkFormat.PDF).content
    with pikepdf.open(io.BytesIO(content)) as document:
        box = [float(v) * 25.4 / 72 for v in document.pages[0].mediabox]
        assert len(document.pages) == 1
    assert box[2:] == pytest.approx([drawing.width_mm, drawing.height_mm], abs=0.01)
    (tmp_path / "board.pdf").write_bytes(content)
    subprocess.run(
        [program, "-r", "150", "-gray", tmp_path / "board.pdf", tmp_path / "page"], check=True, timeout=WITHIN_S
    )
    [page] = tmp_path.glob("page*.pgm")
    grey = cv2.imread(str(page), cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    _check(np.asarray(grey, np.uint8), board, drawing.width_mm)


def test_the_bar_is_a_hundred_millimetres_long() -> None:
    drawing = encode_board(BOARDS[0])
    assert (drawing.width_mm, drawing.height_mm) == (210.0, 297.0)
    png = write_artwork(drawing, ArtworkFormat.PNG, dpi=254).content
    grey = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
    runs = []
    for row in grey[-400:]:  # the legend, 10 px a millimetre
        dark = np.flatnonzero(np.diff(np.concatenate(([0], (row < 128).astype(int), [0]))))
        runs.append(max((int(b - a) for a, b in dark.reshape(-1, 2)), default=0))
    assert max(runs) == pytest.approx(1000, abs=5)


@pytest.mark.parametrize("form", list(ArtworkFormat))
def test_the_same_board_gives_the_same_bytes(form: ArtworkFormat) -> None:
    first, second = (write_artwork(encode_board(CalibrationBoard()), form, dpi=100).content for _ in range(2))
    if form is not ArtworkFormat.DXF:
        assert first == second
    assert len(first) > 1000


@pytest.mark.parametrize(
    ("figures", "field"),
    [
        ({"columns": 3}, "board.columns"),
        ({"rows": 25}, "board.rows"),
        ({"columns": 20, "rows": 20}, "board.rows"),
        ({"square_mm": 7.0}, "board.square_mm"),
        ({"square_mm": float("nan")}, "board.square_mm"),
        ({"marker_mm": 24.0}, "board.marker_mm"),
        ({"marker_mm": float("inf")}, "board.marker_mm"),
        ({"columns": 20, "rows": 10, "square_mm": 200.0, "marker_mm": 150.0}, "board.square_mm"),
    ],
)
def test_a_board_that_cannot_be_is_refused(figures: dict[str, float], field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        CalibrationBoard(**figures)  # type: ignore[arg-type]
    assert caught.value.field == field
    assert caught.value.limit
