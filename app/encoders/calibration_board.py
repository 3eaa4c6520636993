"""Calibration board to a drawing at true size, written by the writers of plate artwork."""

from __future__ import annotations

import numpy as np

from app.encoders.plate.drawing import Boxes, Drawing, Layer, Modules, Part, Text, fitted_height_mm
from app.sensors.camera import MODULES, CalibrationBoard, marker_is_dark

A_SIZES_MM = ((210.0, 297.0), (297.0, 420.0), (420.0, 594.0), (594.0, 841.0), (841.0, 1189.0))
MARGIN_MM = 10.0
LEGEND_MM = 24.0
"""Height below the board for the scale bar and the legend. [mm]"""
BAR_MM = 100.0
_LINE_MM = 0.3


def encode_board(board: CalibrationBoard) -> Drawing:
    """Draw a calibration board.

    Returns
    -------
    Drawing
        On the smallest ISO A sheet that holds it, upright or across, or on a sheet of its own size: black squares and
        markers in `CODE_DARK` on the bare sheet; below them a bar of 100 mm (half of it on boards under 120 mm) to
        measure the print by, and the board's figures.
    """
    width, height = board.columns * board.square_mm, board.rows * board.square_mm
    sheet_width, sheet_height = _sheet_mm(width + 2 * MARGIN_MM, height + 2 * MARGIN_MM + LEGEND_MM)
    left = (sheet_width - width) / 2
    top = sheet_height - MARGIN_MM - (sheet_height - height - 2 * MARGIN_MM - LEGEND_MM) / 2
    square = board.square_mm
    dark = np.array([(c, -r - 1, c + 1, -r) for c, r in board.dark_squares], float) * square
    parts: list[Part] = [Boxes(Layer.CODE_DARK, dark + np.array([left, top, left, top]))]
    for number in range(len(board.marker_squares)):
        x_mm, y_mm = board.marker_corners_mm(number)[0]
        module_mm = board.marker_mm / MODULES
        parts.append(Modules(Layer.CODE_DARK, _runs(number), module_mm, left + float(x_mm), top - float(y_mm)))
    parts += _legend(board, left, top - height, width)
    return Drawing(board.title, sheet_width, sheet_height, tuple(parts))


def _sheet_mm(width_mm: float, height_mm: float) -> tuple[float, float]:
    for short, long in A_SIZES_MM:
        for sheet in ((short, long), (long, short)):
            if width_mm <= sheet[0] and height_mm <= sheet[1]:
                return sheet
    return width_mm, height_mm


def _runs(number: int) -> tuple[tuple[int, int, int], ...]:
    """Black modules of a marker as (row, first column, number of modules)."""
    runs = []
    for row, cells in enumerate(marker_is_dark(number)):
        edges = np.flatnonzero(np.diff(np.concatenate(([0], cells.astype(np.int8), [0]))))
        runs += [(row, int(start), int(end - start)) for start, end in edges.reshape(-1, 2)]
    return tuple(runs)


def _legend(board: CalibrationBoard, left: float, bottom: float, width: float) -> list[Part]:
    bar_mm = BAR_MM if width >= BAR_MM * 1.2 else BAR_MM / 2
    y = bottom - 9.0
    boxes = [(0.0, 0.0, bar_mm, _LINE_MM)]
    for k in range(11):  # the bar's ends are those of its first and last tick
        x = (bar_mm - _LINE_MM) * k / 10
        boxes.append((x, 0.0, x + _LINE_MM, 3.0 if k % 5 == 0 else 1.5))
    bar = Boxes(Layer.NOTE, np.array(boxes) + np.array([left, y, left, y]))
    texts = (
        f"Print at 100 %, flat and matt. This bar is {bar_mm:g} mm long: measure it, and a square.",
        board.title,
    )
    lines: list[Part] = [
        Text(Layer.NOTE, text, left, y - 5.0 - 5.0 * k, fitted_height_mm(text, 2.6, width))
        for k, text in enumerate(texts)
    ]
    return [bar, *lines]
