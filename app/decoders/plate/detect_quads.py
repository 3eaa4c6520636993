"""Marker quadruples of a frame: red and green blobs where a plate has its markers, the likeliest plates first."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel, step
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
    new_nearest,
)

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Grey = npt.NDArray[np.uint8]
Signal = npt.NDArray[np.int16]

MAX_CANDIDATES = 40
"""[candidates] of one signal. Source: chosen by hand, for speed."""
MIN_RANK = -3.0
"""[log odds] rank below which a quadruple is no candidate. Source: chosen by hand: the grid between the markers decides
(`filter_candidates`)."""
MIN_INTERIOR = 1.0
"""[standard deviations] colour margin of the weakest markers. Source: chosen by hand."""
MAX_MARGIN_LOG = 3.7
"""[log] colour margin of the best plates: a quadruple that needs more for a rank of 0 is left out. Source: chosen by
hand, for speed: 40 standard deviations."""
MAX_RANKED = 400
"""[quadruples] whose colours are measured, those that need the least margin. Source: chosen by hand, for speed."""
MARGIN_WEIGHT_COMPLETE, MARGIN_WEIGHT = 1.86, 2.0
"""[log odds] by which a rank rises with the logarithm of the margin: with all squares seen, with one missing. Source:
as of `_wanted_margins`."""
MIN_SAMPLES, MIN_RANGE = 12, 8
"""[points, grey levels] between the markers: inside the frame, and range of their luma. Source: chosen by hand."""
NO_PLATE = -100.0
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
        How likely it is a plate by its markers alone, 0 for even odds.
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
    quads, nearest = np.empty((MAX_QUADS, QUAD_COLUMNS)), new_nearest()
    found = join_green_triples(blobs, greens, signal.opponent, nearest, quads)
    found = join_red_quads(blobs, reds, greens, nearest, quads, found)
    wanted = _wanted_margins(quads[:found], signal.scale)
    possible = np.flatnonzero(wanted < MAX_MARGIN_LOG)
    if len(possible) > MAX_RANKED:
        possible = np.sort(possible[np.argpartition(wanted[possible], MAX_RANKED)[:MAX_RANKED]])
    likely = quads[possible]
    _rank(likely, wanted[possible], signal.opponent, signal.planes.luma)
    order = np.argsort(-likely[:, RANK], kind="stable")
    kept = likely[_suppress(likely, order, MAX_CANDIDATES)]
    centroids_px = _full_px(kept[:, :8].reshape(-1, 4, 2), signal.scale)
    return [
        MarkerQuad(*row)
        for row in zip(centroids_px, kept[:, FOUND].astype(int).tolist(), kept[:, RANK].tolist(),
                       kept[:, SIZE_RATIO].tolist(), strict=True)
    ]  # fmt: skip


def _full_px(points: Floats, scale: int) -> Floats:
    """Pixels of the frame from those of a signal; pixel centres are at integers in both."""
    return scale * points + (scale - 1) / 2


@ieee_kernel
def _wanted_margins(quads: Floats, scale: int) -> Floats:
    """Logarithm of the colour margin with which each quadruple's rank is 0.

    With all squares seen the rank is the logarithm of the odds that it is a plate, by logistic regression over 3,600
    candidates in simulated frames, and 2.6; with one missing, hardly any is a plate, and only a strong one counts.
    """
    wanted = np.empty(quads.shape[0])
    for k in range(quads.shape[0]):
        quad = quads[k]
        area = abs((quad[2] - quad[0]) * (quad[7] - quad[1]) - (quad[3] - quad[1]) * (quad[6] - quad[0]))
        size = np.log10(max(area * scale * scale, 1.0))
        if quad[FOUND] == FOUND_ALL:
            wanted[k] = (9.4 - 1.14 * quad[SCORE] - 1.99 * size + 0.51 * size**2) / MARGIN_WEIGHT_COMPLETE
        else:
            wanted[k] = (min(max(4.5 * size - 5.8, 5.0), 8.7 + max(size - 3.5, 0.0)) - quad[SCORE]) / MARGIN_WEIGHT
    return wanted


@ieee_kernel
def _rank(quads: Floats, wanted: Floats, opponent: Signal, luma: Grey) -> None:
    """Set the rank: how likely each quadruple is a plate, by how far its colour margin exceeds the wanted one."""
    for k in range(quads.shape[0]):
        quad = quads[k]
        margin = _colour_margin(opponent, luma, quad)
        weight = MARGIN_WEIGHT_COMPLETE if quad[FOUND] == FOUND_ALL else MARGIN_WEIGHT
        quad[RANK] = weight * (np.log(margin) - wanted[k]) if margin >= MIN_INTERIOR else NO_PLATE


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

    Between the markers a plate is neutral and has contrast; foliage has colour all over; `NO_PLATE` without contrast.
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
        if q[RANK] <= MIN_RANK or count == max_kept:
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
