"""Signals of red and green in a frame, at half resolution and coarser.

The difference signal is how far red exceeds green and blue, or green exceeds red and blue: neutral surfaces, sky and
lamps give nothing, a colour cast less than the share of the brightness that the threshold has. The ratio signal, for
frames where that finds no plate, is the ratio of red to green relative to the neighbourhood.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel, kernel

BLOCK = 16
"""[pixels of the signal] side of a block, for which one threshold holds. Source: chosen by hand."""
DIFFERENCE_LEVELS = ((6, 2), (10, 5), (20, 11))
"""[grey levels, 1/32 of the brightness] thresholds of the difference signal. Source: chosen by hand: a red marker
beside brown soil needs a high one to stand alone, a small one far away a low one to be seen at all."""
RATIO_LEVELS = ((6, 0), (14, 0))
"""[1/128 of a natural logarithm, none] thresholds of the ratio signal. Source: chosen by hand."""
COARSE_RATIO_LEVELS = ((3, 0), (7, 0))
"""The same at a quarter of the resolution, where noise is half. Source: half of `RATIO_LEVELS`."""
NOISE_FACTOR = 3.5
"""[1] threshold over the mean difference of neighbours around a block, which foliage and grass have everywhere. Source:
chosen by hand."""

Array = npt.NDArray[Any]
Grey = npt.NDArray[np.uint8]
Signal = npt.NDArray[np.int16]


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
        The scaled frame. [grey levels]
    peak : ndarray of int16, shape (H // scale, blocks)
        Strongest signal in every run of `BLOCK` pixels of a row.
    threshold : ndarray of int16, shape (blocks, blocks)
        Signal that exceeds the roughness around a block.
    levels : tuple of (int, int)
        Thresholds at which blobs are cut out: strength, and share of the brightness in 32nds.
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
    return planes_of(cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA))


def planes_of(image: Array) -> Planes:
    """A BGR frame that is scaled down already, shape (H, W, 3)."""
    blue, green, red = cv2.split(image)
    return Planes(blue, green, red, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def difference_signal(planes: Planes) -> MarkerSignal:
    """How far red exceeds green and blue, or green exceeds red and blue: saturated colours."""
    opponent: Array = np.empty(planes.red.shape, np.int16)
    _difference(planes.blue.reshape(-1), planes.green.reshape(-1), planes.red.reshape(-1), opponent.reshape(-1))
    return _signal(opponent, planes, DIFFERENCE_LEVELS)


def ratio_signal(planes: Planes) -> MarkerSignal:
    """The ratio of red to green relative to the neighbourhood: weak colours in haze, glare or a colour cast.

    About 128 times the ratio's logarithm, less in the dark.
    """
    opponent: Array = np.empty(planes.red.shape, np.int16)
    _ratio(planes.green.reshape(-1), planes.red.reshape(-1), opponent.reshape(-1))
    height, width = opponent.shape
    means = np.empty((max(height // BLOCK, 1), max(width // BLOCK, 1)), np.int16)
    _block_means(opponent, means)  # cv2.resize by area takes ten times as long where the sides are no multiples
    level = cv2.medianBlur(means, 5)
    opponent = cv2.subtract(opponent, cv2.resize(level, (width, height), interpolation=cv2.INTER_LINEAR))
    return _signal(opponent, planes, RATIO_LEVELS)


def coarse_ratio_signal(planes: Planes) -> MarkerSignal:
    """The ratio signal at half the planes' resolution, where noise is less: large plates in thick haze."""
    height, width = planes.red.shape
    half = (width // 2, height // 2)
    coarse = Planes(
        *(
            cv2.resize(plane, half, interpolation=cv2.INTER_AREA)
            for plane in (planes.blue, planes.green, planes.red, planes.luma)
        )
    )
    return replace(ratio_signal(coarse), levels=COARSE_RATIO_LEVELS, scale=4)


def _signal(opponent: Array, planes: Planes, levels: tuple[tuple[int, int], ...]) -> MarkerSignal:
    rows, columns = ((side + BLOCK - 1) // BLOCK for side in opponent.shape)
    peak = np.zeros((opponent.shape[0], columns), np.int16)
    rough = np.zeros((rows, columns), np.int32)
    _block_statistics(opponent, peak, rough)
    return MarkerSignal(opponent, planes, peak, _thresholds(rough), levels)


@ieee_kernel
def _difference(blue: Grey, green: Grey, red: Grey, opponent: Signal) -> None:
    """Set how far red exceeds both others, or minus how far green does; shape (pixels,) each."""
    zero = np.int16(0)
    for k in range(opponent.shape[0]):
        b = np.int16(blue[k])
        g = np.int16(green[k])
        r = np.int16(red[k])
        opponent[k] = max(r - max(g, b), zero) - max(g - max(r, b), zero)


@kernel
def _ratio(green: Grey, red: Grey, opponent: Signal) -> None:
    """Set 256 (r - g) / (r + g + 24), the ratio's logarithm times 128 where both are bright; shape (pixels,) each."""
    for k in range(opponent.shape[0]):
        r = np.float32(red[k])
        g = np.float32(green[k])
        opponent[k] = np.int16(np.int32(np.float32(256.0) * (r - g) / (r + g + np.float32(24.0))))


@ieee_kernel
def _block_means(signal: Signal, means: Signal) -> None:
    """Set the means of about equal blocks of a signal: sums of columns first, which are compiled to vectors."""
    height, width = signal.shape
    rows, columns = means.shape
    total = np.empty(width, np.int32)
    for r in range(rows):
        y0 = r * height // rows
        y1 = (r + 1) * height // rows
        total[:] = 0
        for y in range(y0, y1):
            for x in range(width):
                total[x] += signal[y, x]
        for c in range(columns):
            x0 = c * width // columns
            x1 = (c + 1) * width // columns
            area = (y1 - y0) * (x1 - x0)
            block = np.int64(0)
            for x in range(x0, x1):
                block += total[x]
            means[r, c] = np.int16(np.rint(block / area))


@ieee_kernel
def _block_statistics(opponent: Signal, peak: Signal, rough: npt.NDArray[np.int32]) -> None:
    """Set the strongest signal of each run of `BLOCK` pixels in a row, and add up neighbours' differences by block."""
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


@ieee_kernel
def _thresholds(rough: npt.NDArray[np.int32]) -> Signal:
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
