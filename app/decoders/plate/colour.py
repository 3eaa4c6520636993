"""Where a frame is red and where it is green, at half resolution and coarser.

The first signal is how far red stands above green and blue, or green above red and blue: neutral surfaces, sky and
lamps give nothing, a cast gives less than the share of the brightness that is taken off. The second, for where that
finds no plate, is the ratio of red to green against the neighbourhood's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numba as nb
import numpy as np
import numpy.typing as npt

BLOCK = 16  # side of a block of the background grid, in pixels of the signal
# a red marker beside brown soil needs a high threshold to stand alone, a small one far away a low one to be seen at all
VIVID_LEVELS = ((6, 2), (10, 5), (20, 11))
FAINT_LEVELS = ((6, 0), (14, 0))
FAINTEST_LEVELS = ((3, 0), (7, 0))
NOISE_FACTOR = 3.5

Array = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class Planes:
    """Blue, green, red and luma of a frame, scaled down, each of uint8, shape (H // scale, W // scale)."""

    blue: Array
    green: Array
    red: Array
    luma: Array


@dataclass(frozen=True, slots=True)
class MarkerSignal:
    """Where a frame is red (positive) or green (negative).

    Attributes
    ----------
    opponent : ndarray of int16, shape (H // scale, W // scale)
        Strength of the colour.
    planes : Planes
        What it was made of. [grey levels]
    peak : ndarray of int16, shape (H // scale, blocks)
        Strongest signal in every run of `BLOCK` pixels of a row.
    threshold : ndarray of int16, shape (blocks, blocks)
        What stands above the roughness around a block.
    levels : tuple of (int, int)
        Thresholds to look at: strength, and share of the brightness in 32nds.
    scale : int
        Pixels of the frame that make one of the signal, along a side.
    """

    opponent: npt.NDArray[Any]
    planes: Planes
    peak: npt.NDArray[Any]
    threshold: npt.NDArray[Any]
    levels: tuple[tuple[int, int], ...]
    scale: int = 2


def half_planes(image: Array) -> Planes:
    """A BGR frame, shape (H, W, 3), at half resolution."""
    return _planes(cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA))


def _planes(image: Array) -> Planes:
    blue, green, red = cv2.split(image)
    return Planes(blue, green, red, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def vivid_signal(planes: Planes) -> MarkerSignal:
    """How far red stands above green and blue, or green above red and blue: strong colours, whatever is around."""
    red_above = cv2.subtract(planes.red, cv2.max(planes.green, planes.blue))
    green_above = cv2.subtract(planes.green, cv2.max(planes.red, planes.blue))
    return _signal(cv2.subtract(red_above, green_above, dtype=cv2.CV_16S), planes, VIVID_LEVELS)


def faint_signal(planes: Planes) -> MarkerSignal:
    """The ratio of red to green against the neighbourhood's: weak colours in haze, glare or a colour cast.

    About 128 times the ratio's logarithm, less in the dark.
    """
    opponent: Array = np.empty(planes.red.shape, np.int16)
    _ratio(planes.green.reshape(-1), planes.red.reshape(-1), opponent.reshape(-1))
    height, width = opponent.shape
    means = np.empty((max(height // BLOCK, 1), max(width // BLOCK, 1)), np.int16)
    _block_means(opponent, means)  # cv2.resize by area takes ten times as long where the sides are no multiples
    level = cv2.medianBlur(means, 5)
    opponent = cv2.subtract(opponent, cv2.resize(level, (width, height), interpolation=cv2.INTER_LINEAR))
    return _signal(opponent, planes, FAINT_LEVELS)


def faintest_signal(planes: Planes) -> MarkerSignal:
    """The same at half the planes' resolution, where noise is less: large plates in thick haze."""
    height, width = planes.red.shape
    half = (width // 2, height // 2)
    coarse = Planes(
        *(
            cv2.resize(plane, half, interpolation=cv2.INTER_AREA)
            for plane in (planes.blue, planes.green, planes.red, planes.luma)
        )
    )
    return replace(faint_signal(coarse), levels=FAINTEST_LEVELS, scale=4)


def _signal(opponent: Array, planes: Planes, levels: tuple[tuple[int, int], ...]) -> MarkerSignal:
    rows, columns = ((side + BLOCK - 1) // BLOCK for side in opponent.shape)
    peak = np.zeros((opponent.shape[0], columns), np.int16)
    rough = np.zeros((rows, columns), np.int32)
    _block_statistics(opponent, peak, rough)
    return MarkerSignal(opponent, planes, peak, _thresholds(rough), levels)


_SPOTS = np.array([(x, y) for x in (-0.03, 0.0, 0.03) for y in (-0.03, 0.0, 0.03)])


@dataclass(frozen=True, slots=True)
class MarkerColours:
    """How red the triangle of a fitted plate is, and how green its squares are.

    Attributes
    ----------
    margins : ndarray, shape (4,)
        How far the signal of the triangle and the squares stands out of the units', in their spreads.
    tints : ndarray, shape (4,)
        Red of the triangle, green of the squares above their other colours, as shares of the median square's; grey
        being what the units are. A black square in the dark has none, whatever the ratio of its few grey levels says.
    cast : ndarray, shape (2,)
        Blue and red of the units as shares of their green.
    """

    margins: Array
    tints: Array
    cast: Array


def marker_colours(signal: MarkerSignal, plate_from_image: Array, centroids: Array, units: Array) -> MarkerColours:
    """Colours of a fitted plate's markers.

    Parameters
    ----------
    signal : MarkerSignal
    plate_from_image : ndarray, shape (3, 3)
        Full-resolution pixels to plate coordinates.
    centroids : ndarray, shape (4, 2)
        Of the markers, in plate coordinates.
    units : ndarray, shape (U, 2)
        Centres of the units, in plate coordinates.
    """
    points = np.concatenate([(centroids[:, None] + _SPOTS[None]).reshape(-1, 2), units])
    planes = signal.planes
    seen = np.empty((4, len(points)))
    _look_up(np.linalg.inv(plate_from_image), points, signal.scale, signal.opponent,
             planes.blue, planes.green, planes.red, seen)  # fmt: skip
    strength, blue, green, red = seen
    spots = 4 * len(_SPOTS)
    cast = np.array([plane[spots:].sum() for plane in (blue, green, red)])
    cast = np.maximum(cast, 1.0) / max(cast[1], 1.0)
    sign = np.array([1, -1, -1, -1])
    inside = strength[:spots].reshape(4, -1).mean(axis=1)
    between = strength[spots:]
    # as grey units would look in the same light
    blue, green, red = (
        plane[:spots].reshape(4, -1).mean(axis=1) / c for plane, c in zip((blue, green, red), cast, strict=True)
    )
    tints = np.where(sign > 0, red - np.maximum(green, blue), green - np.maximum(red, blue))
    return MarkerColours(sign * (inside - between.mean()) / (between.std() + 1.0),
                         tints / max(float(np.median(tints[1:])), 1.0), cast[[0, 2]])  # fmt: skip


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _look_up(image_from_plate, points, scale, opponent, blue, green, red, seen):  # type: ignore[no-untyped-def]
    """Signal and colours at points of the plate."""
    height, width = opponent.shape
    m = image_from_plate
    for k in range(points.shape[0]):
        u = points[k, 0]
        v = points[k, 1]
        w = m[2, 0] * u + m[2, 1] * v + m[2, 2]
        x = ((m[0, 0] * u + m[0, 1] * v + m[0, 2]) / w - (scale - 1) / 2) / scale
        y = ((m[1, 0] * u + m[1, 1] * v + m[1, 2]) / w - (scale - 1) / 2) / scale
        column = int(np.rint(min(max(x, 0.0), width - 1.0)))
        row = int(np.rint(min(max(y, 0.0), height - 1.0)))
        seen[0, k] = opponent[row, column]
        seen[1, k] = blue[row, column]
        seen[2, k] = green[row, column]
        seen[3, k] = red[row, column]


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _ratio(green, red, opponent):  # type: ignore[no-untyped-def]
    for k in range(opponent.shape[0]):
        r = np.float32(red[k])
        g = np.float32(green[k])
        opponent[k] = np.int16(np.int32(np.float32(256.0) * (r - g) / (r + g + np.float32(24.0))))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _block_means(signal, means):  # type: ignore[no-untyped-def]
    """Means of about equal blocks of a signal."""
    height, width = signal.shape
    rows, columns = means.shape
    total = np.empty(columns, np.int32)
    for r in range(rows):
        y0 = r * height // rows
        y1 = (r + 1) * height // rows
        total[:] = 0
        for y in range(y0, y1):
            for c in range(columns):
                row = np.int32(0)
                for x in range(c * width // columns, (c + 1) * width // columns):
                    row += signal[y, x]
                total[c] += row
        for c in range(columns):
            area = (y1 - y0) * ((c + 1) * width // columns - c * width // columns)
            means[r, c] = np.int16(np.rint(total[c] / area))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _block_statistics(opponent, peak, rough):  # type: ignore[no-untyped-def]
    height, width = opponent.shape
    whole = width // BLOCK
    for y in range(height):
        for c in range(whole):
            top = np.int16(0)
            total = np.int16(0)
            x0 = c * BLOCK
            for k in range(BLOCK):
                top = max(top, abs(opponent[y, x0 + k]))
            for k in range(1, BLOCK):
                total += min(abs(opponent[y, x0 + k] - opponent[y, x0 + k - 1]), np.int16(255))
            peak[y, c] = top
            rough[y // BLOCK, c] += total
        for x in range(whole * BLOCK, width):
            peak[y, whole] = max(peak[y, whole], abs(opponent[y, x]))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _thresholds(rough):  # type: ignore[no-untyped-def]
    """Threshold per block against the roughness around, which foliage and grass have everywhere."""
    rows, cols = rough.shape
    threshold = np.empty((rows, cols), np.int16)
    for r in range(rows):
        for c in range(cols):
            lowest = 1.0e9
            for i in (-2, 2):
                rr = min(max(r + i, 0), rows - 1)
                cc = min(max(c + i, 0), cols - 1)
                lowest = min(lowest, max(rough[rr, c], rough[r, cc]))
            threshold[r, c] = np.int16(NOISE_FACTOR * lowest / (BLOCK * BLOCK))
    return threshold
