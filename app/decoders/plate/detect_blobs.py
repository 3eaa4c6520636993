"""Connected blobs of red and of green in a signal, with their moments: runs of pixels, joined from row to row."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel, ieee_loop, ieee_loop_kernel, kernel, step, trailing_zeros
from app.decoders.plate import Array
from app.values import Floats

# === Signals of red and green in a frame, at half resolution and coarser.
#
# The difference signal is how far red exceeds green and blue, or green exceeds red and blue: neutral surfaces, sky and
# lamps give nothing, a colour cast less than the share of the brightness that the threshold has. The ratio signal, for
# frames where that finds no plate, is the ratio of red to green relative to the neighbourhood.


BLOCK = 16
"""[pixels of the signal] side of a block, for which one threshold holds."""
DIFFERENCE_LEVELS = ((6, 2), (10, 5), (20, 11))
"""[grey levels, 1/32 of the brightness] thresholds of the difference signal. A red marker beside brown soil needs a
high one to stand alone, a small one far away a low one to be seen at all."""
RATIO_LEVELS = ((6, 0), (14, 0))
"""[1/128 of a natural logarithm, none] thresholds of the ratio signal."""
COARSE_RATIO_LEVELS = ((3, 0), (7, 0))
"""The same at a quarter of the resolution, where noise is half. Source: half of `RATIO_LEVELS`."""
NOISE_FACTOR = 3.5
"""[1] threshold over the mean difference of neighbours around a block, which foliage and grass have everywhere."""

LUMA_BITS = np.int32(15)
BLUE_LUMA, GREEN_LUMA, RED_LUMA, HALF_LUMA = np.int32(3735), np.int32(19235), np.int32(9798), np.int32(1 << 14)
"""[1 / 2^15] shares of the colours in the luma, and half a grey level. Source: ITU-R BT.601, rounded as OpenCV does."""

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
    """Where a frame is red (positive) or green (negative)."""

    opponent: Array  # int16, shape (H // scale, W // scale): strength of the colour
    planes: Planes  # [grey levels] the scaled frame
    # int16, shape (H // scale, blocks): strongest signal in every run of `BLOCK` pixels of a row
    peak: Array
    threshold: Array  # int16, shape (blocks, blocks): signal that exceeds the roughness around a block
    # thresholds at which blobs are cut out: strength, and share of the brightness in 32nds
    levels: tuple[tuple[int, int], ...]
    scale: int = 2  # pixels of the frame that make one of the signal, along a side


def half_planes(image: Array) -> Planes:
    """A BGR frame, shape (H, W, 3), at half resolution; the last row or column of an odd number is left out."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    planes = Planes(*(np.empty((height, width), np.uint8) for _ in range(4)))
    _halve(np.ascontiguousarray(image).reshape(len(image), -1), planes.blue, planes.green, planes.red, planes.luma)
    return planes


def planes_of(image: Array) -> Planes:
    """A BGR frame that is scaled down already, shape (H, W, 3)."""
    blue, green, red = (
        cv2.extractChannel(image, channel) for channel in range(3)
    )  # cv2.split takes four times as long
    return Planes(blue, green, red, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def difference_signal(planes: Planes) -> MarkerSignal:
    """How far red exceeds green and blue, or green exceeds red and blue: saturated colours."""
    opponent: Array = np.empty(planes.red.shape, np.int16)
    _difference(planes.blue.reshape(-1), planes.green.reshape(-1), planes.red.reshape(-1), opponent.reshape(-1))
    return _signal(opponent, planes, DIFFERENCE_LEVELS)


def ratio_signal(planes: Planes) -> MarkerSignal:
    """The ratio of red to green relative to the neighbourhood: weak colours in haze, glare or a colour cast.

    About 128 times the ratio's logarithm, less in the dark. The neighbourhood lies above and below: what a wet road
    mirrors is an upright streak in the image.
    """
    opponent: Array = np.empty(planes.red.shape, np.int16)
    _ratio(planes.green.reshape(-1), planes.red.reshape(-1), opponent.reshape(-1))
    height, width = opponent.shape
    means = np.empty((max(height // BLOCK, 1), max(width // BLOCK, 1)), np.int16)
    _block_means(opponent, means)  # cv2.resize by area takes ten times as long where the sides are no multiples
    level = _median_along_columns(means)
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


@ieee_loop_kernel
def _halve(rows: Grey, blue: Grey, green: Grey, red: Grey, luma: Grey) -> None:
    """Set the means of two by two pixels, and their luma by ITU-R BT.601, in one pass over the frame.

    Parameters
    ----------
    rows : ndarray of uint8, shape (H, 3 W)
        Blue, green and red of one pixel after the other.
    """
    for y in range(blue.shape[0]):
        upper, lower = rows[2 * y], rows[2 * y + 1]
        for x in range(blue.shape[1]):
            i = np.uint64(6 * x)
            b = _mean_of_four(upper, lower, i)
            g = _mean_of_four(upper, lower, i + np.uint64(1))
            r = _mean_of_four(upper, lower, i + np.uint64(2))
            blue[y, x] = b
            green[y, x] = g
            red[y, x] = r
            light = np.int32(b) * BLUE_LUMA + np.int32(g) * GREEN_LUMA + np.int32(r) * RED_LUMA
            luma[y, x] = np.uint8((light + HALF_LUMA) >> LUMA_BITS)


@step
def _mean_of_four(upper: Grey, lower: Grey, i: np.uint64) -> np.uint8:
    """Rounded mean of a channel over two by two pixels of two rows, of which the first is at column i."""
    right = i + np.uint64(3)
    return np.uint8((np.int32(upper[i]) + upper[right] + lower[i] + lower[right] + 2) >> 2)


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


def _median_along_columns(means: Signal) -> Signal:
    """Median of each block and the two above and below, by comparing whole rows, which is faster than sorting."""
    padded = np.pad(means, ((2, 2), (0, 0)), mode="edge")
    a, b, c, d, e = (padded[k : k + len(means)] for k in range(5))
    low = np.maximum(np.minimum(a, b), np.minimum(c, d))
    high = np.minimum(np.maximum(a, b), np.maximum(c, d))
    return np.asarray(np.maximum(np.minimum(low, high), np.minimum(e, np.maximum(low, high))), np.int16)


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


# === Connected blobs of red and of green in a signal, with their moments.


Runs = npt.NDArray[np.int16]
Ints = npt.NDArray[np.int32]
Sums = npt.NDArray[np.int64]
Marks = npt.NDArray[np.int8]
Words = npt.NDArray[np.uint64]

MAX_BLOBS = 6000
"""[blobs] of all levels; more are left out. For speed."""
MAX_RUNS = 60_000
"""[runs] of one level; more are left out. For speed."""
WORD = 8
"""[pixels] that are looked at in one step where they are all alike: bytes of an unsigned 64-bit word."""
MIN_AREA = 2
"""[pixels of the signal] of a blob."""
PIXEL_VARIANCE = 1.0 / 12
"""[px^2] variance of a pixel's own square. Source: that of the uniform distribution."""

SIGN, WEIGHT, X, Y, XX, XY, YY, AREA, X0, X1, Y0, Y1, PEAK = range(13)
"""Columns of a blob: +1 red or -1 green; weight, centroid, central moments; area; extent; strongest signal."""
COLUMNS = 13
_W, _WX, _WY, _WXX, _WXY, _WYY, _AREA, _X0, _X1, _Y0, _Y1, _PEAK = range(12)  # columns of a part's sums
BYTE = np.uint64(8)
"""[bits] of a mark."""


class _Level(NamedTuple):
    """A signal and the level at which blobs are cut out of it: attributes of `MarkerSignal`, one of its `levels`."""

    opponent: Signal
    luma: Grey
    peak: Signal
    threshold: Signal
    floor: int
    slack: int


def find_blobs(signal: MarkerSignal) -> Floats:
    """Blobs at all the signal's levels, moments weighted by the signal, shape (B, 13), columns `SIGN` to `PEAK`."""
    blobs, count = np.empty((MAX_BLOBS, COLUMNS)), 0
    blocks = signal.peak.shape[1]
    words, high = np.zeros(blocks * BLOCK // WORD, np.uint64), np.empty(blocks, np.int16)
    runs, part_of = np.empty((MAX_RUNS, 4), np.int16), np.empty(MAX_RUNS, np.int32)
    parent, sums, sign = np.empty(MAX_RUNS, np.int32), np.empty((MAX_RUNS, 12), np.int64), np.empty(MAX_RUNS, np.int8)
    for floor, slack in signal.levels:
        level = _Level(signal.opponent, signal.planes.luma, signal.peak, signal.threshold, floor, slack)
        found = _find_runs(level, words, words.view(np.int8), high, runs)
        parts = _join_runs(signal.opponent, runs[:found], part_of, parent, sums, sign)
        count = _write_blobs(parent[:parts], sums[:parts], sign, blobs, count)
    return blobs[:count]


@step
def _mark(v: np.int32, luma: np.int32, high: np.int32, slack: np.int32) -> np.int8:
    """+1, -1 or 0 for red, green or neither."""
    strength = abs(v)
    exceeds = (strength > high) & ((strength << 5) > slack * luma)
    return np.int8((1 if v > 0 else -1) if exceeds else 0)


@step
def _mark_row(level: _Level, y: int, high: Signal, marks: Marks) -> None:
    """Mark red and green in the blocks of a row that have a signal above their threshold, `high`.

    Indices are unsigned: those that may be negative keep a loop from being compiled to vector instructions.
    """
    width = level.opponent.shape[1]
    slack = np.int32(level.slack)
    for block in range(high.size):
        if level.peak[y, block] <= high[block]:
            continue
        at_least = np.int32(high[block])
        if BLOCK * block + BLOCK <= width:
            for k in range(BLOCK):
                x = np.uint64(BLOCK * block) + np.uint64(k)
                marks[x] = _mark(np.int32(level.opponent[y, x]), np.int32(level.luma[y, x]), at_least, slack)
        else:
            for column in range(BLOCK * block, width):
                v, luma = np.int32(level.opponent[y, column]), np.int32(level.luma[y, column])
                marks[column] = _mark(v, luma, at_least, slack)


@ieee_loop_kernel
def _find_runs(level: _Level, words: Words, marks: Marks, high: Signal, runs: Runs) -> int:
    """List runs of one colour, row by row: row, first column, column after the last one, sign; returns their number.

    The bytes of a word in which a run begins or ends differ from the byte before: the rest is not looked at. Every
    such place writes a run, which counts only where one ends, so that there is no branch to mispredict.

    Parameters
    ----------
    words, marks : ndarray of uint64 and of int8
        One memory for the marks of a row, all zero: those beyond the frame stay so.
    high : ndarray of int16, shape (blocks,)
        Memory for the thresholds of a row of blocks.
    runs : ndarray of int16, shape (MAX_RUNS, 4)
        Set.
    """
    blocks = level.peak.shape[1]
    count = 0
    for y in range(level.opponent.shape[0]):
        if count + BLOCK * blocks >= runs.shape[0]:
            break
        if y % BLOCK == 0:
            for block in range(blocks):
                high[block] = max(level.threshold[y // BLOCK, block], level.floor)
        _mark_row(level, y, high, marks)
        sign = np.int64(0)
        start = np.int64(0)
        for block in range(blocks):
            if level.peak[y, block] <= high[block]:  # a run ends with the last block
                runs[count, 0], runs[count, 1], runs[count, 2], runs[count, 3] = y, start, BLOCK * block, sign
                count += sign != 0
                sign = np.int64(0)
                continue
            for w in range(BLOCK // WORD * block, BLOCK // WORD * (block + 1)):
                word = words[w]
                changes = word ^ ((word << BYTE) | np.uint64(sign & 0xFF))
                while changes != 0:
                    shift = np.uint64(trailing_zeros(changes)) & ~np.uint64(7)
                    x = WORD * w + np.int64(shift >> np.uint64(3))
                    runs[count, 0], runs[count, 1], runs[count, 2], runs[count, 3] = y, start, x, sign
                    count += sign != 0
                    sign = np.int64(marks[x])
                    start = x
                    changes &= ~(np.uint64(0xFF) << shift)
        if sign != 0:
            runs[count, 0], runs[count, 1], runs[count, 2], runs[count, 3] = y, start, level.opponent.shape[1], sign
            count += 1
    return count


@ieee_loop
def _first_part(parent: Ints, part: int) -> int:
    """First part of the blob that a part belongs to; shortens the way to it."""
    while parent[part] != part:
        parent[part] = parent[parent[part]]
        part = parent[part]
    return part


@ieee_loop
def _join(parent: Ints, sums: Sums, first: int, second: int) -> int:
    """Make one blob of two, given by their first parts; returns its first part."""
    into = min(first, second)
    other = max(first, second)
    parent[other] = into
    for m in range(_AREA + 1):
        sums[into, m] += sums[other, m]
    for m in (_X0, _Y0):
        sums[into, m] = min(sums[into, m], sums[other, m])
    for m in (_X1, _Y1, _PEAK):
        sums[into, m] = max(sums[into, m], sums[other, m])
    return into


@ieee_loop
def _add_run(opponent: Signal, y: int, start: int, size: int, at: int, is_new: bool, sums: Sums) -> None:
    """Add a run to the sums of its part. Sums of integers are exact in any order."""
    w = np.int64(0)
    wx = np.int64(0)
    wxx = np.int64(0)
    top = np.int64(0)
    for k in range(size):
        v = abs(np.int64(opponent[y, np.uint64(start) + np.uint64(k)]))
        w += v
        wx += v * k
        wxx += v * k * k
        top = max(top, v)
    wxx += start * (2 * wx + start * w)
    wx += start * w
    if is_new:
        sums[at, _W], sums[at, _WX], sums[at, _WY] = w, wx, w * y
        sums[at, _WXX], sums[at, _WXY], sums[at, _WYY] = wxx, wx * y, w * y * y
        sums[at, _AREA], sums[at, _PEAK] = size, top
        sums[at, _X0], sums[at, _X1], sums[at, _Y0], sums[at, _Y1] = start, start + size - 1, y, y
    else:
        sums[at, _W] += w
        sums[at, _WX] += wx
        sums[at, _WY] += w * y
        sums[at, _WXX] += wxx
        sums[at, _WXY] += wx * y
        sums[at, _WYY] += w * y * y
        sums[at, _AREA] += size
        sums[at, _X0] = min(sums[at, _X0], start)
        sums[at, _X1] = max(sums[at, _X1], start + size - 1)
        sums[at, _Y1] = y
        sums[at, _PEAK] = max(sums[at, _PEAK], top)


@ieee_loop_kernel
def _join_runs(opponent: Signal, runs: Runs, part_of: Ints, parent: Ints, sums: Sums, sign: Marks) -> int:
    """Join runs that touch, diagonals included, to parts of blobs; returns the number of parts.

    Parameters
    ----------
    opponent : ndarray of int16, shape (H, W)
        The signal, whose strength is the weight.
    runs : ndarray of int16, shape (R, 4)
        Of `_find_runs`.
    part_of : ndarray of int32, shape (R,)
        Set to the part of each run.
    parent : ndarray of int32, shape (R,)
        Set to another part of the same blob, itself for the blob's first part.
    sums : ndarray of int64, shape (R, 12)
        Set to weighted sums of a blob's runs at its first part: w, wx, wy, wxx, wxy, wyy, area, x0, x1, y0, y1, peak.
    sign : ndarray of int8, shape (R,)
        Set to the colour of each part.
    """
    parts = 0
    begin = 0  # first run of the row
    above = 0  # first run of the row above that may touch this one or a later one
    row = -2
    for r in range(runs.shape[0]):
        y, start, stop, colour = int(runs[r, 0]), int(runs[r, 1]), int(runs[r, 2]), runs[r, 3]
        if y != row:
            above = begin if y == row + 1 else r
            begin = r
            row = y
        while above < begin and runs[above, 2] < start:
            above += 1
        part = -1
        k = above
        while k < begin and runs[k, 1] <= stop:
            if runs[k, 3] == colour:
                touched = _first_part(parent, part_of[k])
                if part < 0:
                    part = touched
                elif part != touched:
                    part = _join(parent, sums, part, touched)
            k += 1
        is_new = part < 0
        if is_new:
            part = parts
            parent[part] = part
            sign[part] = colour
            parts += 1
        _add_run(opponent, y, start, stop - start, part, is_new, sums)
        part_of[r] = part
    return parts


@step
def _write_blob(sums: Sums, sign: Marks, part: int, blobs: Floats, k: int) -> None:
    """Centroid and central moments from sums; the variance of a pixel's own square is added to the moments."""
    weight = np.float64(sums[part, _W])
    mean_x = sums[part, _WX] / weight
    mean_y = sums[part, _WY] / weight
    blobs[k, SIGN] = sign[part]
    blobs[k, WEIGHT] = weight
    blobs[k, X] = mean_x
    blobs[k, Y] = mean_y
    blobs[k, XX] = sums[part, _WXX] / weight - mean_x * mean_x + PIXEL_VARIANCE
    blobs[k, XY] = sums[part, _WXY] / weight - mean_x * mean_y
    blobs[k, YY] = sums[part, _WYY] / weight - mean_y * mean_y + PIXEL_VARIANCE
    for m in range(AREA, COLUMNS):
        blobs[k, m] = sums[part, m - 1]


@ieee_loop_kernel
def _write_blobs(parent: Ints, sums: Sums, sign: Marks, blobs: Floats, count: int) -> int:
    """Add the blobs that parts make; returns how many there are then."""
    for i in range(parent.size):
        if parent[i] == i and sums[i, _AREA] >= MIN_AREA and count < MAX_BLOBS:
            _write_blob(sums, sign, i, blobs, count)
            count += 1
    return count
