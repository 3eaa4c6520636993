"""An independent reader of rendered artwork: samples colours at positions in millimetres that follow from the paper.

Knows nothing of app.encoders, and takes only the numbers n, unit and gap of a plate.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class Rendering:
    """A picture of a sheet, and where the plate's upper left corner lies in it."""

    bgr: npt.NDArray[np.uint8]
    px_per_mm: float
    left_mm: float
    top_mm: float

    def colour(self, x_mm: float, y_mm: float) -> npt.NDArray[np.float64]:
        """Mean colour about a spot of the plate, x right and y down from its upper left corner. [mm]"""
        col = (self.left_mm + x_mm) * self.px_per_mm
        row = (self.top_mm + y_mm) * self.px_per_mm
        reach = max(1, round(2 * self.px_per_mm))
        patch = self.bgr[int(row) - reach : int(row) + reach + 1, int(col) - reach : int(col) + reach + 1]
        return patch.reshape(-1, 3).mean(axis=0)


def rendering(bgr: npt.NDArray[np.uint8], sheet_mm: tuple[float, float], trim_mm: tuple[float, ...]) -> Rendering:
    """A rendering of a whole sheet; `trim_mm` is left, bottom, right, top from the sheet's lower left corner."""
    return Rendering(bgr, bgr.shape[1] / sheet_mm[0], trim_mm[0], sheet_mm[1] - trim_mm[3])


def read_digits(picture: Rendering, n: int, unit_mm: float, gap_mm: float) -> str:
    """Digits of a plate by the paper's rule: four units a cell, left to right, top to bottom, dark = 1."""
    pitch = unit_mm + gap_mm
    digits = ""
    for cell_row in range(n // 2):
        for cell_col in range(n // 2):
            if cell_row in (0, n // 2 - 1) and cell_col in (0, n // 2 - 1):
                continue
            value = 0
            for row, col in ((0, 0), (0, 1), (1, 0), (1, 1)):
                x = gap_mm + (2 * cell_col + col) * pitch + unit_mm / 2
                y = gap_mm + (2 * cell_row + row) * pitch + unit_mm / 2
                value = 2 * value + int(picture.colour(x, y).mean() < 110)
            digits += "0123456789ABCDEF"[value]
    return digits


def marker_colours(picture: Rendering, n: int, unit_mm: float, gap_mm: float) -> list[str]:
    """Names of the colours at the corners, clockwise from the upper left, then that beyond the triangle's long side."""
    side = n * unit_mm + (n + 1) * gap_mm
    marker = 2 * unit_mm + gap_mm
    near, far = gap_mm + marker / 4, side - gap_mm - marker / 4
    beyond = gap_mm + 3 * marker / 4
    spots = ((near, near), (far, near), (far, far), (near, far), (beyond, beyond))
    return [_name(picture.colour(x, y)) for x, y in spots]


def _name(bgr: npt.NDArray[np.float64]) -> str:
    blue, green, red = bgr
    if red > 1.8 * max(blue, green):
        return "red"
    if green > 1.3 * max(blue, red):
        return "green"
    return "grey"


def read_qr(picture: Rendering) -> str:
    """Text of the QR code on a sheet."""
    return qr_text(cv2.cvtColor(picture.bgr, cv2.COLOR_BGR2GRAY))


def qr_text(grey: cv2.typing.MatLike) -> str:
    """Text of the QR code in a picture, "" without one: either of OpenCV's readers misses a code now and then."""
    readers = (cv2.QRCodeDetector(), cv2.QRCodeDetectorAruco())
    return next((text for reader in readers if (text := reader.detectAndDecode(grey)[0])), "")
