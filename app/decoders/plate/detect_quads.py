"""Marker quadruples of a frame: red and green blobs where a plate has its markers, the likeliest plates first."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel, ieee_loop, ieee_loop_kernel, step
from app.decoders.plate.detect_blobs import AREA, PEAK, SIGN, X0, X1, XX, XY, Y0, Y1, YY, MarkerSignal, X, Y, find_blobs

# === Blobs joined into quadruples of markers, and how well each quadruple agrees with itself.
#
# Three markers imply an affine map from the plate to the image, and with it the size and the shape of all four markers
# and the place of the fourth. Blobs that disagree are no plate.


Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Signal = npt.NDArray[np.int16]

MAX_REDS = 150
"""[blobs] red ones that are tried, strongest first. Source: chosen by hand, for speed."""
MAX_GREENS = 160
"""[blobs] green ones that are tried, strongest first. Source: chosen by hand, for speed."""
MAX_NEAR = 6
"""[blobs] green ones that are tried around a marker. Source: chosen by hand, for speed."""
MAX_QUADS = MAX_GREENS * MAX_NEAR * (MAX_NEAR - 1) + 3 * MAX_REDS * MAX_NEAR * (MAX_NEAR - 1)
"""[quadruples] as many as there can be: two squares beside each green one, two in three roles beside each red one."""
SEARCH_SIDES, SEARCH_PX = 7.0, 10.0
"""[extent of a marker, px] around it where others of its plate may be, their sum. Source: 5.3 sides on 12 x 12
(`MARKER_RATIO`), the rest chosen by hand."""
MAX_SQUARE_RATIO = 3.67
"""[1] of the areas and of the strongest signals of two squares that are alike. Source: e^1.3; chosen by hand."""
MAX_PAIR_AREA_RATIO = 4.06
"""[1] of the areas of two squares beside a triangle. Source: e^1.4; chosen by hand."""
SQUARE_OF_RED_AREA = (0.4, 14.0)
"""[1] area of a square over that of the triangle; 2 without wear. Source: chosen by hand."""
MIN_SQUARE_OF_RED_PEAK = 0.12
"""[1] strongest signal of a square over that of the triangle. Source: chosen by hand."""
MIN_CROSS_PX2 = 12.0
"""[px^2 of the signal] area of the quadrangle of marker centres, positive when they are clockwise. Source: chosen by
hand."""
SIZE_RATIO_RANGE = (1.6, 7.5)
"""[1] distance between marker centres over the side of a marker. Source: 3.2 to 5.3 (`MARKER_RATIO`), halved and half
as much again for blur and wear."""
SIZE6_RANGE = (0.999 * SIZE_RATIO_RANGE[0] ** 6, 1.001 * SIZE_RATIO_RANGE[1] ** 6)
"""[1] sixth power of the same, for a test without roots, with room for rounding."""
MAX_TRIPLE_SHAPE, MAX_PAIR_SHAPE, MAX_FOURTH_SHAPE = 6.05, 9.03, 12.2
"""[1] shape ratio of each of three squares, of each of two beside a triangle, of the remaining one. Source: e^1.8,
e^2.2, e^2.5; chosen by hand."""
MAX_FOURTH_DISTANCE = 0.3
"""[plate sides] of the fourth marker from where the other three place it. Source: chosen by hand."""
PALE_RED = 0.1
"""[strongest signal of the squares] red of a triangle below which it is pale, as in worn plates. Source: chosen by
hand."""
MAX_PALE_SHAPE, MAX_PALE_AREA_LOG = 2.72, 0.7
"""[1, log] shape ratio and ratio of areas of the squares beside a pale triangle. Source: chosen by hand."""
BLUR_VARIANCE = 0.3
"""[px^2 of the signal] that blur adds to a marker's moments. Source: chosen by hand."""
TRIANGLE_OFFSET = 0.1667
"""[marker sides] of the triangle's centroid from that of a square in its place. Source: 1 / 2 - 1 / 3."""
NO_SHAPE = 1.0e4
"""[1] shape ratio where there is no positive covariance. Source: above all limits."""

FOUND_ALL = 7
CENTROIDS, SCORE, FOUND, SIZE_RATIO, RANK = 0, 8, 9, 10, 11
"""First columns of a quadruple: x and y of four centroids; score; bits of the green squares that were found; distance
between marker centres over the side of a marker; rank."""
QUAD_COLUMNS = 12
TOP_BOTTOM_ROLE, TOP_RIGHT_ROLE, RIGHT_BOTTOM_ROLE = 0, 1, 2
_FOUND_BITS = (5, 3, 6)  # by role: top right 1, bottom right 2, bottom left 4


class Nearest(NamedTuple):
    """Memory for the blobs around one, shape (MAX_NEAR,): their numbers, and how much they differ from its like."""

    near: Ints
    misfits: Floats


def new_nearest() -> Nearest:
    """Memory for the blobs around one."""
    return Nearest(np.empty(MAX_NEAR, np.int64), np.empty(MAX_NEAR))


class _Sides(NamedTuple):
    """Vectors between marker centres along the plate's rows, to the right (p), and along its columns, down (q). [px]"""

    px: float
    py: float
    qx: float
    qy: float


class _Moments(NamedTuple):
    """Central moments that a marker of a plate with given sides has in the image. [px^2]"""

    xx: float
    xy: float
    yy: float


class _Fourth(NamedTuple):
    """The fourth marker: its place among the blobs nearby (-1 for none), distance from the expected place [sides]."""

    near: int
    distance: float


@ieee_loop
def _square_moments(sides: _Sides, size_ratio: float) -> _Moments:
    """Moments of a square: a twelfth of the squared side in each direction, and the blur of the image."""
    scale = 1.0 / (12.0 * size_ratio * size_ratio)
    return _Moments(
        (sides.px * sides.px + sides.qx * sides.qx) * scale + BLUR_VARIANCE,
        (sides.px * sides.py + sides.qx * sides.qy) * scale,
        (sides.py * sides.py + sides.qy * sides.qy) * scale + BLUR_VARIANCE,
    )


@ieee_loop
def _shape_ratio(blobs: Floats, k: int, expected: _Moments) -> float:
    """Largest eigenvalue of inv(expected) measured, or of its inverse: 1 where both shapes agree."""
    xx = blobs[k, XX] + BLUR_VARIANCE
    yy = blobs[k, YY] + BLUR_VARIANCE
    xy = blobs[k, XY]
    det = expected.xx * expected.yy - expected.xy * expected.xy
    if det <= 0:
        return NO_SHAPE
    trace = (expected.yy * xx - 2 * expected.xy * xy + expected.xx * yy) / det
    d = (xx * yy - xy * xy) / det
    if d <= 0:
        return NO_SHAPE
    root = math.sqrt(max(trace * trace / 4 - d, 0.0))
    low = trace / 2 - root
    high = trace / 2 + root
    if low <= 0:
        return NO_SHAPE
    ratio: float = max(high, 1.0 / low)
    return ratio


@ieee_loop
def _reach_px(blobs: Floats, k: int) -> float:
    """How far from a marker another one of its plate may be."""
    extent: float = max(blobs[k, X1] - blobs[k, X0], blobs[k, Y1] - blobs[k, Y0])
    return SEARCH_SIDES * extent + SEARCH_PX


@ieee_loop
def _keep_nearest(near: Ints, misfits: Floats, count: int, blob: int, misfit: float) -> int:
    """Insert a blob into the list of the best, lowest misfit first; returns how many it holds."""
    j = min(count, MAX_NEAR - 1)
    if count >= MAX_NEAR and misfit >= misfits[j]:
        return count
    while j > 0 and misfits[j - 1] > misfit:
        misfits[j] = misfits[j - 1]
        near[j] = near[j - 1]
        j -= 1
    misfits[j] = misfit
    near[j] = blob
    return min(count + 1, MAX_NEAR)


# --- three green squares ------------------------------------------------------------------------------------------


@step
def _squares_near(blobs: Floats, greens: Ints, a: int, near: Ints, misfits: Floats) -> int:
    """The green blobs around a green one that may be squares of its plate, the most alike first; how many."""
    corner = greens[a]
    x, y, area, peak = blobs[corner, X], blobs[corner, Y], blobs[corner, AREA], blobs[corner, PEAK]
    reach = _reach_px(blobs, corner)
    count = 0
    for b in range(greens.shape[0]):
        other = greens[b]
        if b == a or abs(blobs[other, X] - x) > reach or abs(blobs[other, Y] - y) > reach:
            continue
        ratio = max(blobs[other, AREA] / area, area / blobs[other, AREA])
        if ratio > MAX_SQUARE_RATIO or max(blobs[other, PEAK], peak) > MAX_SQUARE_RATIO * min(blobs[other, PEAK], peak):
            continue
        count = _keep_nearest(near, misfits, count, other, ratio)
    return count


@step
def _red_at(opponent: Signal, x: float, y: float, sides: _Sides, size_ratio: float) -> int:
    """Strongest red within a marker's triangle around a point where one should be. [grey levels]"""
    best = 0
    pitch = 0.25 / size_ratio
    for i in range(-2, 3):
        for j in range(-2, 3):
            xi = int(x + pitch * (i * sides.px + j * sides.qx) + 0.5)
            yi = int(y + pitch * (i * sides.py + j * sides.qy) + 0.5)
            if 0 <= xi < opponent.shape[1] and 0 <= yi < opponent.shape[0]:
                best = max(best, opponent[yi, xi])
    return best


@step
def _triple_shape_ratio(blobs: Floats, corner: int, right: int, below: int, moments: _Moments) -> float:
    """Largest shape ratio of three squares; the first above the limit ends the search."""
    shape = _shape_ratio(blobs, corner, moments)
    if shape <= MAX_TRIPLE_SHAPE:
        shape = max(shape, _shape_ratio(blobs, right, moments))
    if shape <= MAX_TRIPLE_SHAPE:
        shape = max(shape, _shape_ratio(blobs, below, moments))
    return shape


@step
def _add_triple(blobs: Floats, corner: int, right: int, below: int, opponent: Signal, quads: Floats, found: int) -> int:
    """Add the quadruple of three green squares, where there is something red in the triangle's place.

    `corner` is the square opposite the triangle, `right` the one above it and `below` the one to its left.
    """
    xc, yc, xr, yr, xb, yb = (
        blobs[corner, X], blobs[corner, Y], blobs[right, X], blobs[right, Y], blobs[below, X], blobs[below, Y]
    )  # fmt: skip
    sides = _Sides(xc - xb, yc - yb, xc - xr, yc - yr)
    cross = sides.px * sides.qy - sides.py * sides.qx
    if cross < MIN_CROSS_PX2:
        return found
    area_right, area_below = blobs[right, AREA], blobs[below, AREA]
    areas = area_right * area_below * blobs[corner, AREA]
    if not SIZE6_RANGE[0] * areas < cross * cross * cross < SIZE6_RANGE[1] * areas:
        return found
    size_ratio = math.sqrt(cross / areas ** (1.0 / 3.0))
    if size_ratio < SIZE_RATIO_RANGE[0] or size_ratio > SIZE_RATIO_RANGE[1]:
        return found
    shape = _triple_shape_ratio(blobs, corner, right, below, _square_moments(sides, size_ratio))
    if shape > MAX_TRIPLE_SHAPE:
        return found
    # the triangle's centroid is nearer to the plate's corner than a square's: a third of its side, not a half
    x = xr + xb - xc - (sides.px + sides.qx) * (TRIANGLE_OFFSET / size_ratio)
    y = yr + yb - yc - (sides.py + sides.qy) * (TRIANGLE_OFFSET / size_ratio)
    red = _red_at(opponent, x, y, sides, size_ratio)
    amplitude = (blobs[right, PEAK] * blobs[below, PEAK] * blobs[corner, PEAK]) ** (1.0 / 3.0)
    pale = red < PALE_RED * amplitude
    area_log = abs(math.log(area_right / area_below))
    if pale and (shape > MAX_PALE_SHAPE or area_log > MAX_PALE_AREA_LOG):
        return found
    quads[found, SCORE] = (
        4.0
        - 0.7 * math.log(shape)
        - 0.5 * area_log
        - abs(math.log(blobs[right, PEAK] / blobs[below, PEAK]))
        + 0.5 * math.log(max(red, PALE_RED * amplitude) * amplitude)
        - (3.5 if pale else 0.5)
    )
    _set_centroids(quads, found, x, y, xr, yr, xc, yc, xb, yb)
    quads[found, FOUND] = FOUND_ALL
    quads[found, SIZE_RATIO] = size_ratio
    return found + 1


@ieee_loop
def _set_centroids(
    quads: Floats, k: int, x0: float, y0: float, x1: float, y1: float, x2: float, y2: float, x3: float, y3: float
) -> None:
    quads[k, 0], quads[k, 1], quads[k, 2], quads[k, 3] = x0, y0, x1, y1
    quads[k, 4], quads[k, 5], quads[k, 6], quads[k, 7] = x2, y2, x3, y3


@ieee_loop_kernel
def join_green_triples(blobs: Floats, greens: Ints, opponent: Signal, nearest: Nearest, quads: Floats) -> int:
    """Fill quadruples from three green squares with something red where the triangle should be; how many.

    Parameters
    ----------
    blobs : ndarray, shape (B, 13)
        Of `find_blobs`.
    greens : ndarray of int, shape (G,)
        The green ones among them, strongest first.
    opponent : ndarray of int16, shape (H, W)
        The signal that they were found in.
    nearest : Nearest
        Memory.
    quads : ndarray, shape (MAX_QUADS, 12)
        Set: columns as named by `CENTROIDS` to `RANK`.
    """
    found = 0
    near, misfits = nearest
    for a in range(greens.shape[0]):
        count = _squares_near(blobs, greens, a, near, misfits)
        for i in range(count):
            for j in range(count):
                if i != j:
                    found = _add_triple(blobs, greens[a], near[i], near[j], opponent, quads, found)
    return found


# --- a red triangle and two or three green squares ----------------------------------------------------------------


@step
def _near_greens(blobs: Floats, greens: Ints, red: int, near: Ints, misfits: Floats) -> int:
    """The green blobs around a red one that may be squares of its plate, the likeliest first; how many."""
    x, y, area, peak = blobs[red, X], blobs[red, Y], blobs[red, AREA], blobs[red, PEAK]
    reach = _reach_px(blobs, red)
    count = 0
    for g in greens:
        if abs(blobs[g, X] - x) > reach or abs(blobs[g, Y] - y) > reach:
            continue
        ratio = blobs[g, AREA] / area
        if ratio < SQUARE_OF_RED_AREA[0] or ratio > SQUARE_OF_RED_AREA[1]:
            continue
        if blobs[g, PEAK] < MIN_SQUARE_OF_RED_PEAK * peak:
            continue
        misfit = abs(math.log(ratio / 2.0)) - 0.5 * math.log(blobs[g, PEAK])  # a square has twice the triangle's area
        count = _keep_nearest(near, misfits, count, g, misfit)
    return count


@step
def _sides_of(role: int, blobs: Floats, red: int, first: int, second: int) -> _Sides:
    """Sides that a triangle and two squares imply, by the squares that these are."""
    x0, y0, x1, y1, x2, y2 = (
        blobs[red, X], blobs[red, Y], blobs[first, X], blobs[first, Y], blobs[second, X], blobs[second, Y]
    )  # fmt: skip
    if role == TOP_BOTTOM_ROLE:  # top right and bottom left
        return _Sides(x1 - x0, y1 - y0, x2 - x0, y2 - y0)
    if role == TOP_RIGHT_ROLE:  # top right and bottom right
        return _Sides(x1 - x0, y1 - y0, x2 - x1, y2 - y1)
    return _Sides(x1 - x2, y1 - y2, x2 - x0, y2 - y0)  # bottom right and bottom left


@step
def _find_fourth(
    blobs: Floats, near: Ints, count: int, i: int, j: int, x: float, y: float, sides: _Sides, moments: _Moments
) -> _Fourth:
    """The blob of the remaining square, expected at x, y."""
    cross = sides.px * sides.qy - sides.py * sides.qx
    best = MAX_FOURTH_DISTANCE
    fourth = -1
    for m in range(count):
        if m in (i, j):
            continue
        ex = blobs[near[m], X] - x
        ey = blobs[near[m], Y] - y
        off = max(abs(ex * sides.qy - ey * sides.qx), abs(sides.px * ey - sides.py * ex)) / cross
        if off < best and _shape_ratio(blobs, near[m], moments) < MAX_FOURTH_SHAPE:
            best = off
            fourth = m
    return _Fourth(fourth, best)


@step
def _write_quad(
    role: int, blobs: Floats, red: int, first: int, second: int, x: float, y: float, is_complete: bool, quads: Floats,
    k: int,
) -> None:  # fmt: skip
    """Set the centroids and what was found; the remaining square is at x, y."""
    x0, y0, x1, y1, x2, y2 = (
        blobs[red, X], blobs[red, Y], blobs[first, X], blobs[first, Y], blobs[second, X], blobs[second, Y]
    )  # fmt: skip
    if role == TOP_BOTTOM_ROLE:
        _set_centroids(quads, k, x0, y0, x1, y1, x, y, x2, y2)
    elif role == TOP_RIGHT_ROLE:
        _set_centroids(quads, k, x0, y0, x1, y1, x2, y2, x, y)
    else:
        _set_centroids(quads, k, x0, y0, x, y, x1, y1, x2, y2)
    quads[k, FOUND] = FOUND_ALL if is_complete else _FOUND_BITS[role]


@step
def _add_pair(
    blobs: Floats,
    red: int,
    near: Ints,
    count: int,
    i: int,
    j: int,
    role: int,
    complete_seen: bool,
    quads: Floats,
    found: int,
) -> tuple[int, bool]:
    """Add the quadruple of a red triangle and two squares, with the third where it is found.

    Returns how many quadruples there are then, and whether a complete one was seen: after one, incomplete ones of the
    same triangle are left out. Complete ones come once, in the first role.
    """
    first = near[i]
    second = near[j]
    sides = _sides_of(role, blobs, red, first, second)
    cross = sides.px * sides.qy - sides.py * sides.qx
    if cross < MIN_CROSS_PX2:
        return found, complete_seen
    # from the areas in pixels; blur makes small blobs larger
    size_ratio = math.sqrt(cross / math.sqrt(blobs[first, AREA] * blobs[second, AREA]))
    if size_ratio < SIZE_RATIO_RANGE[0] or size_ratio > SIZE_RATIO_RANGE[1]:
        return found, complete_seen
    moments = _square_moments(sides, size_ratio)
    shape = _shape_ratio(blobs, first, moments)
    if shape <= MAX_PAIR_SHAPE:
        shape = max(shape, _shape_ratio(blobs, second, moments))
    if shape > MAX_PAIR_SHAPE:
        return found, complete_seen
    x = blobs[red, X] + (sides.px if role != TOP_RIGHT_ROLE else 0.0) + (sides.qx if role != RIGHT_BOTTOM_ROLE else 0.0)
    y = blobs[red, Y] + (sides.py if role != TOP_RIGHT_ROLE else 0.0) + (sides.qy if role != RIGHT_BOTTOM_ROLE else 0.0)
    fourth = _find_fourth(blobs, near, count, i, j, x, y, sides, moments)
    is_complete = fourth.near >= 0
    if (is_complete and role != TOP_BOTTOM_ROLE) or (not is_complete and complete_seen):
        return found, complete_seen
    quads[found, SCORE] = (
        (5.5 - 6.0 * fourth.distance if is_complete else 0.0)
        - 0.7 * math.log(shape)
        - 0.3 * math.log(_shape_ratio(blobs, red, moments))
        - 0.5 * abs(math.log(blobs[first, AREA] / blobs[second, AREA]))
        + 0.5 * math.log(blobs[red, PEAK] * math.sqrt(blobs[first, PEAK] * blobs[second, PEAK]))
    )
    quads[found, SIZE_RATIO] = size_ratio
    if is_complete:
        x = blobs[near[fourth.near], X]
        y = blobs[near[fourth.near], Y]
    _write_quad(role, blobs, red, first, second, x, y, is_complete, quads, found)
    return found + 1, complete_seen or is_complete


@ieee_loop_kernel
def join_red_quads(blobs: Floats, reds: Ints, greens: Ints, nearest: Nearest, quads: Floats, found: int) -> int:
    """Add quadruples of a red triangle and two or three of the green squares near it; returns how many there are then.

    Parameters as of `join_green_triples`; `reds` are the red blobs, strongest first.
    """
    near, misfits = nearest
    for red in reds:
        count = _near_greens(blobs, greens, red, near, misfits)
        complete_seen = False
        for i in range(count):
            for j in range(count):
                area_i = blobs[near[i], AREA]
                area_j = blobs[near[j], AREA]
                if i == j or max(area_i, area_j) > MAX_PAIR_AREA_RATIO * min(area_i, area_j):
                    continue
                for role in range(3):
                    found, complete_seen = _add_pair(
                        blobs, red, near, count, i, j, role, complete_seen, quads, found
                    )  # fmt: skip
    return found


# === Marker quadruples of a frame.


Grey = npt.NDArray[np.uint8]

MAX_CANDIDATES = 40
"""[candidates] of one signal. Source: chosen by hand, for speed."""
MIN_RANK = -3.0
"""[log odds] rank below which a quadruple is no candidate. Source: chosen by hand: the grid between the markers decides
(`find_candidates`)."""
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
    """Centroids of a plate's four markers."""

    centroids_px: Floats  # shape (4, 2): red triangle, then the green squares clockwise; full-resolution pixels
    found: int  # bits 1, 2, 4: which of the three green squares were seen; the others are implied by the affine map
    rank: float  # how likely it is a plate by its markers alone, 0 for even odds
    size_ratio: float  # distance between marker centres over the side of a marker; distinguishes 8, 10 and 12 units


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
