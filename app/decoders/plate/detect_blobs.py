"""Connected blobs of red and of green in a signal, with their moments: runs of pixels, joined from row to row."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import ieee_loop, ieee_loop_kernel, step, trailing_zeros
from app.decoders.plate.colour import BLOCK, MarkerSignal

Floats = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]
Signal = npt.NDArray[np.int16]
Runs = npt.NDArray[np.int16]
Ints = npt.NDArray[np.int32]
Sums = npt.NDArray[np.int64]
Marks = npt.NDArray[np.int8]
Words = npt.NDArray[np.uint64]

MAX_BLOBS = 6000
"""[blobs] of all levels; more are left out. Source: chosen by hand, for speed."""
MAX_RUNS = 60_000
"""[runs] of one level; more are left out. Source: chosen by hand, for speed."""
WORD = 8
"""[pixels] that are looked at in one step where they are all alike: bytes of an unsigned 64-bit word."""
MIN_AREA = 2
"""[pixels of the signal] of a blob. Source: chosen by hand."""
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
    level : _Level
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
