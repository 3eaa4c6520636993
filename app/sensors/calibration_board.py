"""The board that cameras are calibrated with: a chessboard whose white squares hold ArUco markers (ChArUco)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter

Floats = npt.NDArray[np.float64]

DICTIONARY = "DICT_5X5_100"
MODULES = 7
"""Of a marker along a side: five of its code and a black border."""
SIDES = (4, 24)
SQUARE_MM = (8.0, 250.0)
RATIO = (0.5, 0.85)
"""Side of a marker over that of its square."""
MAX_SIDE_MM = 3000.0
_MARKERS = 100


@dataclass(frozen=True, slots=True)
class CalibrationBoard:
    """A board, seen from the front. Board frame: millimetres from its upper left corner, x right, y down.

    Parameters
    ----------
    columns, rows : int
        Squares, 4 to 24 each, at most 200 together: half of them hold a marker. The upper left one is black.
    square_mm, marker_mm : float
        Side of a square, 8 to 250 mm, and of a marker, 0.5 to 0.85 of that. As measured on the print; intrinsics do
        not depend on the scale. [mm]

    Raises
    ------
    InvalidParameter
        A figure is out of its limits.
    """

    columns: int = 7
    rows: int = 10
    square_mm: float = 25.0
    marker_mm: float = 18.0

    def __post_init__(self) -> None:
        for name in ("columns", "rows"):
            if not SIDES[0] <= getattr(self, name) <= SIDES[1]:
                raise InvalidParameter(
                    f"the board has {getattr(self, name)} {name}",
                    field=f"board.{name}",
                    limit=f"{SIDES[0]} to {SIDES[1]}",
                    cure="7 x 10 fits an A4 sheet",
                )
        if self.columns * self.rows > 2 * _MARKERS:
            raise InvalidParameter(
                f"the board has {self.columns * self.rows} squares",
                field="board.rows",
                limit=f"at most {2 * _MARKERS} squares: {DICTIONARY} has {_MARKERS} markers",
            )
        if not SQUARE_MM[0] <= self.square_mm <= SQUARE_MM[1]:
            raise InvalidParameter(
                f"square_mm is {self.square_mm:g}",
                field="board.square_mm",
                limit=f"{SQUARE_MM[0]:g} to {SQUARE_MM[1]:g} mm",
            )
        if not RATIO[0] <= self.marker_mm / self.square_mm <= RATIO[1]:
            raise InvalidParameter(
                f"marker_mm is {self.marker_mm:g}, {self.marker_mm / self.square_mm:.3g} of a square",
                field="board.marker_mm",
                limit=f"{RATIO[0]:g} to {RATIO[1]:g} of square_mm",
                cure="0.72 of a square is usual",
            )
        if max(self.columns, self.rows) * self.square_mm > MAX_SIDE_MM:
            raise InvalidParameter(
                f"the board is {self.columns * self.square_mm:g} x {self.rows * self.square_mm:g} mm",
                field="board.square_mm",
                limit=f"{MAX_SIDE_MM:g} mm a side",
            )

    @property
    def title(self) -> str:
        """The board in words."""
        return (
            f"Calibration board {self.columns} x {self.rows}, squares {self.square_mm:g} mm, "
            f"markers {self.marker_mm:g} mm, ArUco {DICTIONARY[5:].replace('_', ' ').lower()}"
        )

    @property
    def dark_squares(self) -> list[tuple[int, int]]:
        """Column and row of each black square."""
        return [(c, r) for r in range(self.rows) for c in range(self.columns) if (c + r) % 2 == 0]

    @property
    def marker_squares(self) -> list[tuple[int, int]]:
        """Column and row of the square of each marker, in the order of their numbers from 0."""
        return [(c, r) for r in range(self.rows) for c in range(self.columns) if (c + r) % 2 == 1]

    @property
    def corner_count(self) -> int:
        """Inner corners: where four squares meet."""
        return (self.columns - 1) * (self.rows - 1)

    @property
    def corners_mm(self) -> Floats:
        """Inner corners, row by row, shape (corner_count, 2). [mm]"""
        column, row = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        corners: Floats = np.stack([column.ravel(), row.ravel()], axis=1).astype(float) * self.square_mm
        return corners

    def marker_corners_mm(self, number: int) -> Floats:
        """Corners of a marker, clockwise from its upper left, shape (4, 2). [mm]"""
        column, row = self.marker_squares[number]
        edge = (self.square_mm - self.marker_mm) / 2
        left, top = column * self.square_mm + edge, row * self.square_mm + edge
        side = self.marker_mm
        return np.array([(left, top), (left + side, top), (left + side, top + side), (left, top + side)])


def marker_is_dark(number: int) -> npt.NDArray[np.bool_]:
    """Modules of a marker with its border, True where black, shape (7, 7)."""
    dark = np.ones((MODULES, MODULES), bool)
    code = board_dictionary().bytesList[number : number + 1]
    dark[1:-1, 1:-1] = np.asarray(cv2.aruco.Dictionary.getBitsFromByteList(code, MODULES - 2)) == 0
    return dark


def board_dictionary() -> Any:
    """OpenCV's dictionary of the markers."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
