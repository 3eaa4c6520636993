"""Connected blobs of red and of green in a signal, by runs of pixels, with their moments."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
import numpy.typing as npt

from app.decoders.plate.colour import BLOCK, MarkerSignal

MAX_BLOBS = 6000
MAX_RUNS = 60_000
COLUMNS = 13


def find_blobs(signal: MarkerSignal) -> npt.NDArray[Any]:
    """Blobs at all the signal's levels, shape (B, 13).

    Columns: sign (+1 red, -1 green), weight, x, y, xx, xy, yy (central moments), area, x0, x1, y0, y1, peak.
    """
    blobs, count = np.empty((MAX_BLOBS, COLUMNS)), 0
    for floor, slack in signal.levels:
        count = _add_blobs(
            signal.opponent, signal.planes.luma, signal.peak, signal.threshold, floor, slack, blobs, count
        )
    return blobs[:count]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _find(parent, i):  # type: ignore[no-untyped-def]
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _join(parent, stats, a, b):  # type: ignore[no-untyped-def]
    """Make one blob of the two that these runs belong to."""
    a = _find(parent, a)
    b = _find(parent, b)
    if a == b:
        return
    if a > b:
        a, b = b, a
    parent[b] = a
    into = stats[a]
    other = stats[b]
    for m in range(7):
        into[m] += other[m]
    into[7] = min(into[7], other[7])
    into[8] = max(into[8], other[8])
    into[9] = min(into[9], other[9])
    into[10] = max(into[10], other[10])
    into[11] = max(into[11], other[11])


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _add_blobs(opponent, luma, peak, threshold, floor, slack, blobs, count):  # type: ignore[no-untyped-def]
    """Add the blobs at one level, moments weighted by the signal; returns how many there are then."""
    height, width = opponent.shape
    parent = np.empty(MAX_RUNS, np.int32)
    stats = np.empty((MAX_RUNS, 12), np.float64)  # w, wx, wy, wxx, wxy, wyy, area, x0, x1, y0, y1, peak
    sign = np.empty(MAX_RUNS, np.int8)
    run_x0 = np.empty(MAX_RUNS, np.int32)
    run_x1 = np.empty(MAX_RUNS, np.int32)
    runs = 0
    above0 = 0  # the runs of the row above
    above1 = 0
    for y in range(height):
        start = runs
        scan = above0
        block_row = y // BLOCK
        x = 0
        while x < width and runs < MAX_RUNS:
            block = x // BLOCK
            stop = min(width, (block + 1) * BLOCK)
            high = max(np.int32(threshold[block_row, block]), floor)
            if peak[y, block] <= high:
                x = stop
                continue
            while x < stop and runs < MAX_RUNS:
                v = np.int32(opponent[y, x])
                if abs(v) <= high or (abs(v) << 5) <= slack * np.int32(luma[y, x]):
                    x += 1
                    continue
                s = 1 if v > 0 else -1
                w = 0.0
                wx = 0.0
                wxx = 0.0
                top = 0.0
                x0 = x
                while x < width:
                    v = np.int32(s * opponent[y, x])
                    least = max(np.int32(threshold[block_row, x // BLOCK]), floor)
                    if v <= least or (v << 5) <= slack * np.int32(luma[y, x]):
                        break
                    d = np.float64(v)
                    w += d
                    wx += d * x
                    wxx += d * x * x
                    top = max(top, d)
                    x += 1
                parent[runs] = runs
                sign[runs] = s
                run_x0[runs] = x0
                run_x1[runs] = x - 1
                row = (w, wx, w * y, wxx, wx * y, w * y * y, x - x0 + 0.0, x0 + 0.0, x - 1.0, y + 0.0, y + 0.0, top)
                for m in range(12):
                    stats[runs, m] = row[m]
                while scan < above1 and run_x1[scan] < x0 - 1:
                    scan += 1
                k = scan
                while k < above1 and run_x0[k] <= x:
                    if sign[k] == s:
                        _join(parent, stats, k, runs)
                    k += 1
                runs += 1
        above0 = start
        above1 = runs
    for i in range(runs):
        if parent[i] != i or count >= MAX_BLOBS:
            continue
        q = stats[i]
        if q[6] < 2:
            continue
        o = blobs[count]
        mx = q[1] / q[0]
        my = q[2] / q[0]
        o[0] = sign[i]
        o[1] = q[0]
        o[2] = mx
        o[3] = my
        o[4] = q[3] / q[0] - mx * mx + 1.0 / 12
        o[5] = q[4] / q[0] - mx * my
        o[6] = q[5] / q[0] - my * my + 1.0 / 12
        for m in range(7, 13):
            o[m] = q[m - 1]
        count += 1
    return count
