"""Connected blobs of red and of green in a signal, with their moments: runs of pixels, joined from row to row."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.decoders.compiled import ieee_kernel, step
from app.decoders.plate.colour import BLOCK, MarkerSignal

Floats = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]
Signal = npt.NDArray[np.int16]

MAX_BLOBS = 6000
"""[blobs] of all levels; more are left out. Source: chosen by hand, for speed."""
MAX_RUNS = 60_000
"""[runs] of one level; more are left out. Source: chosen by hand, for speed."""
MIN_AREA = 2
"""[pixels of the signal] of a blob. Source: chosen by hand."""
PIXEL_VARIANCE = 1.0 / 12
"""[px^2] variance of a pixel's own square. Source: that of the uniform distribution."""

SIGN, WEIGHT, X, Y, XX, XY, YY, AREA, X0, X1, Y0, Y1, PEAK = range(13)
"""Columns of a blob: +1 red or -1 green; weight, centroid, central moments; area; extent; strongest signal."""
COLUMNS = 13
_W, _WX, _WY, _WXX, _WXY, _WYY, _AREA, _X0, _X1, _Y0, _Y1, _PEAK = range(12)  # columns of a run's sums


class _Level(NamedTuple):
    """A signal and the level at which blobs are cut out of it: attributes of `MarkerSignal`, one of its `levels`."""

    opponent: Signal
    luma: Grey
    peak: Signal
    threshold: Signal
    floor: int
    slack: int


class _Runs(NamedTuple):
    """Runs found so far.

    Attributes
    ----------
    parent : ndarray of int32, shape (MAX_RUNS,)
        Another run of the same blob, itself for the blob's first run.
    sums : ndarray, shape (MAX_RUNS, 12)
        Weighted sums of a blob's runs at its first run: w, wx, wy, wxx, wxy, wyy, area, x0, x1, y0, y1, peak.
    sign : ndarray of int8; first, last : ndarray of int32, shape (MAX_RUNS,)
        Colour; first and last column.
    """

    parent: npt.NDArray[np.int32]
    sums: Floats
    sign: npt.NDArray[np.int8]
    first: npt.NDArray[np.int32]
    last: npt.NDArray[np.int32]


def find_blobs(signal: MarkerSignal) -> Floats:
    """Blobs at all the signal's levels, shape (B, 13), columns `SIGN` to `PEAK`."""
    blobs, count = np.empty((MAX_BLOBS, COLUMNS)), 0
    for floor, slack in signal.levels:
        level = _Level(signal.opponent, signal.planes.luma, signal.peak, signal.threshold, floor, slack)
        count = _add_blobs(level, blobs, count)
    return blobs[:count]


@step
def _run_start(level: _Level, y: int, x: int) -> int:
    """First column from x on whose signal exceeds the level; the width where there is none."""
    width: int = level.opponent.shape[1]
    while x < width:
        block = x // BLOCK
        stop = min(width, (block + 1) * BLOCK)
        high = max(int(level.threshold[y // BLOCK, block]), level.floor)
        if level.peak[y, block] <= high:  # nothing in this block of the row
            x = stop
            continue
        while x < stop:
            v = abs(int(level.opponent[y, x]))
            if v > high and (v << 5) > level.slack * int(level.luma[y, x]):
                return x
            x += 1
    return width


@step
def _measure_run(level: _Level, y: int, start: int, sign: int, sums: Floats) -> int:
    """Set the sums of the run of one colour that starts here; returns the column after its last one."""
    width: int = level.opponent.shape[1]
    w = 0.0
    wx = 0.0
    wxx = 0.0
    top = 0.0
    x = start
    while x < width:
        v = sign * int(level.opponent[y, x])
        high = max(int(level.threshold[y // BLOCK, x // BLOCK]), level.floor)
        if v <= high or (v << 5) <= level.slack * int(level.luma[y, x]):
            break
        d = np.float64(v)
        w += d
        wx += d * x
        wxx += d * x * x
        top = max(top, d)
        x += 1
    sums[_W] = w
    sums[_WX] = wx
    sums[_WY] = w * y
    sums[_WXX] = wxx
    sums[_WXY] = wx * y
    sums[_WYY] = w * y * y
    sums[_AREA] = x - start
    sums[_X0] = start
    sums[_X1] = x - 1
    sums[_Y0] = y
    sums[_Y1] = y
    sums[_PEAK] = top
    return x


@step
def _first_run(parent: npt.NDArray[np.int32], run: int) -> int:
    """First run of the blob that a run belongs to; shortens the way to it."""
    while parent[run] != run:
        parent[run] = parent[parent[run]]
        run = parent[run]
    return run


@step
def _join(runs: _Runs, a: int, b: int) -> None:
    """Make one blob of the two that these runs belong to."""
    first = _first_run(runs.parent, a)
    second = _first_run(runs.parent, b)
    if first != second:
        into = min(first, second)
        other = max(first, second)
        runs.parent[other] = into
        for m in range(_AREA + 1):
            runs.sums[into, m] += runs.sums[other, m]
        for m in (_X0, _Y0):
            runs.sums[into, m] = min(runs.sums[into, m], runs.sums[other, m])
        for m in (_X1, _Y1, _PEAK):
            runs.sums[into, m] = max(runs.sums[into, m], runs.sums[other, m])


@step
def _write_blob(sums: Floats, sign: float, blob: Floats) -> None:
    """Centroid and central moments from sums; the variance of a pixel's own square is added to the moments."""
    mean_x = sums[_WX] / sums[_W]
    mean_y = sums[_WY] / sums[_W]
    blob[SIGN] = sign
    blob[WEIGHT] = sums[_W]
    blob[X] = mean_x
    blob[Y] = mean_y
    blob[XX] = sums[_WXX] / sums[_W] - mean_x * mean_x + PIXEL_VARIANCE
    blob[XY] = sums[_WXY] / sums[_W] - mean_x * mean_y
    blob[YY] = sums[_WYY] / sums[_W] - mean_y * mean_y + PIXEL_VARIANCE
    for m in range(AREA, COLUMNS):
        blob[m] = sums[m - 1]


@ieee_kernel
def _add_blobs(level: _Level, blobs: Floats, count: int) -> int:
    """Add the blobs at one level, moments weighted by the signal; returns how many there are then."""
    height, width = level.opponent.shape
    runs = _Runs(
        np.empty(MAX_RUNS, np.int32), np.empty((MAX_RUNS, 12)), np.empty(MAX_RUNS, np.int8),
        np.empty(MAX_RUNS, np.int32), np.empty(MAX_RUNS, np.int32),
    )  # fmt: skip
    found = 0
    above = 0  # first run of the row above
    for y in range(height):
        begin = found
        x = 0
        while found < MAX_RUNS:
            x = _run_start(level, y, x)
            if x >= width:
                break
            start = x
            sign = 1 if level.opponent[y, x] > 0 else -1
            x = _measure_run(level, y, start, sign, runs.sums[found])
            runs.parent[found] = found
            runs.sign[found] = sign
            runs.first[found] = start
            runs.last[found] = x - 1
            # runs of the row above that touch this one, diagonals included
            while above < begin and runs.last[above] < start - 1:
                above += 1
            k = above
            while k < begin and runs.first[k] <= x:
                if runs.sign[k] == sign:
                    _join(runs, k, found)
                k += 1
            found += 1
        above = begin
    for i in range(found):
        if runs.parent[i] == i and runs.sums[i, _AREA] >= MIN_AREA and count < MAX_BLOBS:
            _write_blob(runs.sums[i], runs.sign[i], blobs[count])
            count += 1
    return count
