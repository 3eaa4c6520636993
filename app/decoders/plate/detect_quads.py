"""Marker quadruples of a frame: red and green blobs where a plate has its markers, the likeliest plates first."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.decoders.compiled import ieee_kernel, step
from app.decoders.plate.colour import MarkerSignal
from app.decoders.plate.detect_blobs import AREA, PEAK, SIGN, find_blobs
from app.decoders.plate.join_quads import (
    FOUND,
    FOUND_ALL,
    MAX_GREENS,
    MAX_QUADS,
    MAX_REDS,
    QUAD_COLUMNS,
    RANK,
    SCORE,
    SIZE_RATIO,
    join_green_triples,
    join_red_quads,
)

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Grey = npt.NDArray[np.uint8]
Signal = npt.NDArray[np.int16]

MAX_CANDIDATES = 12
"""[candidates] of one signal. Source: chosen by hand, for speed."""
MIN_INTERIOR = 2.5
"""[standard deviations] colour margin of the weakest markers. Source: chosen by hand."""
MIN_BEST_RANK = -1.0
"""[log odds] rank that a quadruple could reach at best. Source: chosen by hand, for speed."""
MIN_SAMPLES, MIN_RANGE = 12, 8
"""[points, grey levels] between the markers: inside the frame, and range of their luma. Source: chosen by hand."""
NO_PLATE = -1.0
"""Rank and colour margin of what is no plate. Source: below all limits."""
SAME_PLACE = 0.25
"""[extent of a quadruple] between the centres of two that overlap. Source: chosen by hand."""
MARKER_RATIO = {8: 3.2, 10: 4.267, 12: 5.333}
"""[1] distance between marker centres over the side of a marker, by units along a side. Source: (n - 2) pitches over
two units and a gap, units of 35 mm and gaps of 5 mm."""


@dataclass(frozen=True, slots=True)
class MarkerQuad:
    """Centroids of a plate's four markers.

    Attributes
    ----------
    centroids_px : ndarray, shape (4, 2)
        Red triangle, then the green squares clockwise; full-resolution pixels.
    found : int
        Bits 1, 2, 4: which of the three green squares were seen; the others are implied by the affine map.
    rank : float
        How likely it is a plate: above 0 worth a fit.
    size_ratio : float
        Distance between marker centres over the side of a marker; distinguishes 8, 10 and 12 units.
    """

    centroids_px: Floats
    found: int
    rank: float
    size_ratio: float


def detect_marker_quads(signal: MarkerSignal) -> list[MarkerQuad]:
    """Marker quadruples of a frame, best first, overlapping ones suppressed."""
    blobs = find_blobs(signal)
    by_strength = np.argsort(-blobs[:, PEAK] * np.sqrt(blobs[:, AREA]), kind="stable")
    reds = by_strength[blobs[by_strength, SIGN] > 0][:MAX_REDS]
    greens = by_strength[blobs[by_strength, SIGN] < 0][:MAX_GREENS]
    quads = np.empty((MAX_QUADS, QUAD_COLUMNS))
    found = join_green_triples(blobs, greens, signal.opponent, quads)
    found = join_red_quads(blobs, reds, greens, quads, found)
    _rank(quads[:found], signal.opponent, signal.planes.luma, signal.scale)
    order = np.argsort(-quads[:found, RANK], kind="stable")
    return [
        MarkerQuad(
            _full_px(row[:8].reshape(4, 2), signal.scale), int(row[FOUND]), float(row[RANK]), float(row[SIZE_RATIO])
        )
        for row in quads[_suppress(quads, order, MAX_CANDIDATES)]
    ]


def _full_px(points: Floats, scale: int) -> Floats:
    """Pixels of the frame from those of a signal; pixel centres are at integers in both."""
    return scale * points + (scale - 1) / 2


@ieee_kernel
def _rank(quads: Floats, opponent: Signal, luma: Grey, scale: int) -> None:
    """Set the rank: how likely each quadruple is a plate.

    With all squares seen it is the logarithm of the odds, by logistic regression over 3,600 candidates in simulated
    frames, and 2.6; with one missing, hardly any candidate is a plate, and only a strong one counts.
    """
    for quad in quads:
        # the rank with a colour margin and a size of the best plates
        best = 1.14 * quad[SCORE] - 5.0 if quad[FOUND] == FOUND_ALL else quad[SCORE]
        quad[RANK] = NO_PLATE
        if best < MIN_BEST_RANK:
            continue
        margin = _colour_margin(opponent, luma, quad)
        if margin < MIN_INTERIOR:
            continue
        area = abs((quad[2] - quad[0]) * (quad[7] - quad[1]) - (quad[3] - quad[1]) * (quad[6] - quad[0]))
        size = np.log10(max(area * scale * scale, 1.0))
        if quad[FOUND] == FOUND_ALL:
            quad[RANK] = 1.14 * quad[SCORE] + 1.86 * np.log(margin) + 1.99 * size - 0.51 * size**2 - 9.4
        else:
            wanted = min(max(4.5 * size - 5.8, 5.0), 8.7 + max(size - 3.5, 0.0))
            quad[RANK] = quad[SCORE] + 2.0 * np.log(margin) - wanted


class _Interior(NamedTuple):
    """Between the markers: samples, range of the luma [grey levels], mean and spread of the colour signal."""

    samples: int
    luma_range: int
    mean: float
    spread: float


@step
def _sample_interior(opponent: Signal, luma: Grey, quad: Floats) -> _Interior:
    """Sample a grid of 7 x 7 points between the markers, without the corners where the markers are."""
    height, width = opponent.shape
    low = 255
    high = 0
    total = 0
    mean = 0.0
    square = 0.0
    for i in range(7):
        for j in range(7):
            if (i < 2 or i > 4) and (j < 2 or j > 4):
                continue
            u = i / 6.0
            v = j / 6.0
            x = (1 - u) * (1 - v) * quad[0] + u * (1 - v) * quad[2] + u * v * quad[4] + (1 - u) * v * quad[6]
            y = (1 - u) * (1 - v) * quad[1] + u * (1 - v) * quad[3] + u * v * quad[5] + (1 - u) * v * quad[7]
            column = int(x + 0.5)
            row = int(y + 0.5)
            if column < 0 or row < 0 or column >= width or row >= height:
                continue
            total += 1
            low = min(low, luma[row, column])
            high = max(high, luma[row, column])
            o = float(opponent[row, column])
            mean += o
            square += o * o
    mean /= max(total, 1)
    spread = np.sqrt(max(square / max(total, 1) - mean * mean, 0.0)) + 1.0
    return _Interior(total, high - low, mean, spread)


@step
def _colour_margin(opponent: Signal, luma: Grey, quad: Floats) -> float:
    """How far the weakest markers' colours stand out of what lies between the markers, in its standard deviations.

    Between the markers a plate is neutral and has contrast; foliage has colour all over, a road has no contrast: -1.
    The second weakest marker counts with a fifth of the weakest: one marker may be worn.
    """
    height, width = opponent.shape
    interior = _sample_interior(opponent, luma, quad)
    if interior.samples < MIN_SAMPLES or interior.luma_range < MIN_RANGE:
        return NO_PLATE
    weakest = 1.0e9
    second = 1.0e9
    for k in range(4):
        column = int(min(max(quad[2 * k] + 0.5, 0), width - 1))
        row = int(min(max(quad[2 * k + 1] + 0.5, 0), height - 1))
        margin = (opponent[row, column] - interior.mean) / interior.spread
        if k > 0:  # green is negative
            margin = -margin
        if margin < weakest:
            second = weakest
            weakest = margin
        elif margin < second:
            second = margin
    return second + 0.2 * weakest


@ieee_kernel
def _suppress(quads: Floats, order: Ints, max_kept: int) -> Ints:
    """The best that are worth a fit, and of those in about one place the best only."""
    kept = np.empty(max_kept, np.int64)
    count = 0
    for k in order:
        q = quads[k]
        if q[RANK] <= 0.0 or count == max_kept:
            break
        x = (q[0] + q[2] + q[4] + q[6]) / 4
        y = (q[1] + q[3] + q[5] + q[7]) / 4
        size = 0.0
        for i in range(4):
            size = max(size, 2 * abs(q[2 * i] - x), 2 * abs(q[2 * i + 1] - y))
        is_new = True
        for m in range(count):
            p = quads[kept[m]]
            apart_x = abs((p[0] + p[2] + p[4] + p[6]) / 4 - x)
            apart_y = abs((p[1] + p[3] + p[5] + p[7]) / 4 - y)
            if max(apart_x, apart_y) < SAME_PLACE * size:
                is_new = False
                break
        if is_new:
            kept[count] = k
            count += 1
    return kept[:count]
