"""Readings and lanes drawn over their frame, for people to look at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from app.lanes.overlay import LaneInFrame

Pixels = npt.NDArray[np.uint8]
_UNSURE_BGR = (40, 190, 250)
_BGR = {"read": (80, 220, 60)} | dict.fromkeys(("unchecked", "unsure", "not-in-registry"), _UNSURE_BGR)
_REFUSED_BGR = (90, 90, 240)
_DARK_BGR = (25, 25, 25)
_LANE_BGR, _LANE_SHARE = (90, 200, 70), 0.32
_LEFT_BGR, _RIGHT_BGR, _CENTRE_BGR = (235, 160, 60), (60, 170, 245), (245, 245, 245)
_MARKER_BGR = (60, 230, 250)


@dataclass(frozen=True, slots=True)
class Outline:
    """One reading to draw over its frame."""

    corners_px: tuple[tuple[float, float], ...]  # clockwise from the triangle's corner; may be empty
    outcome: str
    label: str


def draw_outlines(pixels: Pixels, outlines: Sequence[Outline]) -> Pixels:
    """Plate outlines with their label: green what was read, amber what was unsure, red what was refused.

    Parameters
    ----------
    pixels : ndarray of uint8, shape (H, W, 3) BGR or (H, W) grey
    outlines : sequence of Outline
        Corners in pixels of the upright frame.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        A copy. BGR.
    """
    canvas = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR) if pixels.ndim == 2 else pixels.copy(), np.uint8)
    scale = max(min(canvas.shape[:2]) / 1080, 0.4)
    for row, outline in enumerate(outlines):
        colour = _BGR.get(outline.outcome, _REFUSED_BGR)
        if outline.corners_px:
            _draw_corners(canvas, outline.corners_px, colour, scale)
        _draw_label(canvas, outline, colour, scale, row)
    return canvas


def draw_lane(pixels: Pixels, lane: LaneInFrame) -> Pixels:
    """A frame with the lane over it: its area green, left boundary blue, right boundary orange, centre line white.

    Parameters
    ----------
    pixels : ndarray of uint8, shape (H, W, 3) BGR or (H, W) grey
    lane : LaneInFrame
        Of a camera with this frame's size.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        A copy. BGR.
    """
    canvas = np.array(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR) if pixels.ndim == 2 else pixels, dtype=np.uint8)
    scale = max(min(canvas.shape[:2]) / 1080, 0.4)
    if lane["area_px"]:
        filled = canvas.copy()
        for polygon in lane["area_px"]:
            cv2.fillPoly(filled, [_fixed(polygon)], _LANE_BGR, cv2.LINE_AA, 4)
        cv2.addWeighted(filled, _LANE_SHARE, canvas, 1 - _LANE_SHARE, 0, dst=canvas)
    for line, colour, thick in (
        (lane["centre_px"], _CENTRE_BGR, 2),
        (lane["left_px"], _LEFT_BGR, 4),
        (lane["right_px"], _RIGHT_BGR, 4),
    ):
        pieces = [_fixed(piece) for piece in line]
        cv2.polylines(canvas, pieces, False, _DARK_BGR, max(4, round((thick + 3) * scale)), cv2.LINE_AA, 4)
        cv2.polylines(canvas, pieces, False, colour, max(2, round(thick * scale)), cv2.LINE_AA, 4)
    for u, v in _fixed(lane["markers_px"]).reshape(-1, 2).tolist():
        cv2.circle(canvas, (u, v), round(8 * scale) * 16, _DARK_BGR, cv2.FILLED, cv2.LINE_AA, 4)
        cv2.circle(canvas, (u, v), round(5 * scale) * 16, _MARKER_BGR, cv2.FILLED, cv2.LINE_AA, 4)
    return canvas


def _fixed(points_px: list[list[float]]) -> npt.NDArray[np.int32]:
    """OpenCV's points in sixteenths of a pixel."""
    return np.asarray(np.round(np.asarray(points_px) * 16), np.int32).reshape(-1, 1, 2)


def encode_picture(pixels: Pixels, suffix: str) -> bytes:
    """A picture as ``png`` or ``jpg``."""
    options = [cv2.IMWRITE_JPEG_QUALITY, 90] if suffix == "jpg" else [cv2.IMWRITE_PNG_COMPRESSION, 3]
    _ok, encoded = cv2.imencode(f".{suffix}", pixels, options)
    return bytes(encoded)


def _draw_corners(
    canvas: Pixels, corners_px: Sequence[tuple[float, float]], colour: tuple[int, int, int], scale: float
) -> None:
    bound = 4 * max(canvas.shape[:2])  # corners of a plate half out of view lie outside, but not without end
    points = np.clip(np.array(corners_px, dtype=float), -bound, bound)
    fixed = np.round(points * 16).astype(np.int32)
    cv2.polylines(canvas, [fixed.reshape(-1, 1, 2)], True, _DARK_BGR, max(3, round(5 * scale)), cv2.LINE_AA, 4)
    cv2.polylines(canvas, [fixed.reshape(-1, 1, 2)], True, colour, max(1, round(2 * scale)), cv2.LINE_AA, 4)
    centre = (int(fixed[0, 0]), int(fixed[0, 1]))
    cv2.circle(canvas, centre, max(3, round(5 * scale)) * 16, colour, cv2.FILLED, cv2.LINE_AA, 4)


def _draw_label(canvas: Pixels, outline: Outline, colour: tuple[int, int, int], scale: float, row: int) -> None:
    height, width = canvas.shape[:2]
    font, size, thick = cv2.FONT_HERSHEY_SIMPLEX, 0.8 * scale, max(1, round(2 * scale))
    (text_width, text_height), _base = cv2.getTextSize(outline.label, font, size, thick)
    if outline.corners_px:
        points = np.array(outline.corners_px, dtype=float)
        x, y = float(points[:, 0].min()), float(points[:, 1].min()) - 8 * scale
    else:
        x, y = 8.0, 8 + (row + 1) * (text_height + 12 * scale)
    at = (int(np.clip(x, 4, max(width - text_width - 4, 4))), int(np.clip(y, text_height + 4, height - 6)))
    cv2.putText(canvas, outline.label, at, font, size, _DARK_BGR, thick + 2, cv2.LINE_AA)
    cv2.putText(canvas, outline.label, at, font, size, colour, thick, cv2.LINE_AA)
