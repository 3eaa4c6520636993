"""Marker quadruples of a frame: red and green blobs where a plate has its markers, the likeliest plates first.

Three markers imply an affine map from the plate to the image, and with it the size and the shape of all four markers
and the place of the fourth. Blobs that disagree are no plate. Three green squares are joined where something red is in
the triangle's place, and a red triangle with two or three squares near it. What lies between the markers then ranks the
quadruples: it is grey on a plate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel, ieee_loop, ieee_loop_kernel, step
from app.decoders.plate.detect_blobs import AREA, PEAK, SIGN, X0, X1, XX, XY, Y0, Y1, YY, MarkerSignal, X, Y, find_blobs
from app.values import Floats, Ints

Signal = npt.NDArray[np.int16]
Grey = npt.NDArray[np.uint8]

TRIANGLE, TOP_RIGHT, BOTTOM_RIGHT, BOTTOM_LEFT = range(4)
"""Corners of a plate clockwise, by which the markers of a quadruple are numbered."""
FOUND_ALL = 7
"""Bits of all green squares: 1 for the one at the top right, 2 at the bottom right, 4 at the bottom left."""
MARKER_RATIO = {8: 3.2, 10: 4.267, 12: 5.333}
"""[1] distance between marker centres over the side of a marker, by units along a side: (n - 2) pitches over two units
and a gap, units of 35 mm and gaps of 5 mm."""
TRIANGLE_OFFSET = 0.1667
"""[marker sides] of the triangle's centroid from that of a square in its place: 1 / 2 - 1 / 3."""

# Limits of what may be a plate, in the order of the search. They are chosen, not fitted: tighter ones make a frame
# faster and lose plates that are worn, blurred or small. `python -m benchmarks.plates` counts the plates that are read,
# and measures the time.

MAX_REDS, MAX_GREENS = 150, 160  # blobs of a colour that are tried, strongest first
MAX_NEAR = 6  # green blobs that are tried around a marker
# [extent of a marker, px] around it where others of its plate may be, their sum; 5.3 sides on 12 x 12
SEARCH_SIDES, SEARCH_PX = 7.0, 10.0
MAX_SQUARE_RATIO = 3.67  # [1] of the areas and of the strongest signals of two squares that are alike: e^1.3
MAX_PAIR_AREA_RATIO = 4.06  # [1] of the areas of two squares beside a triangle: e^1.4
SQUARE_OF_RED_AREA = (0.4, 14.0)  # [1] area of a square over that of the triangle; 2 without wear
MIN_SQUARE_OF_RED_PEAK = 0.12  # [1] strongest signal of a square over that of the triangle
MIN_CROSS_PX2 = 12.0  # [px^2 of the signal] area between the marker centres, positive when they are clockwise
# [1] distance between marker centres over the side of a marker: `MARKER_RATIO` halved and half as much again
MIN_SIZE_RATIO, MAX_SIZE_RATIO = 1.6, 7.5
# sixth power of the same, for a test without roots, with room for rounding
MIN_SIZE_RATIO6, MAX_SIZE_RATIO6 = 0.999 * MIN_SIZE_RATIO**6, 1.001 * MAX_SIZE_RATIO**6
# [1] shape ratio of each of three squares, of each of two beside a triangle, of the remaining one: e^1.8, e^2.2, e^2.5
MAX_TRIPLE_SHAPE, MAX_PAIR_SHAPE, MAX_FOURTH_SHAPE = 6.05, 9.03, 12.2
MAX_FOURTH_DISTANCE = 0.3  # [plate sides] of the fourth marker from where the other three place it
PALE_RED = 0.1  # [strongest signal of the squares] red of a triangle below which it is pale, as on worn plates
MAX_PALE_SHAPE, MAX_PALE_AREA_LOG = 2.72, 0.7  # [1, log] shape ratio, and ratio of areas, of squares beside a pale one
BLUR_VARIANCE = 0.3  # [px^2 of the signal] that blur adds to a marker's moments
NO_SHAPE = 1.0e4  # [1] shape ratio where there is no positive covariance: above all limits
# as many as there can be: two squares beside each green one, two beside each red one with any of three corners missing
MAX_QUADS = MAX_GREENS * MAX_NEAR * (MAX_NEAR - 1) + 3 * MAX_REDS * MAX_NEAR * (MAX_NEAR - 1)

# [log] colour margin of the best plates, 40 standard deviations: a quadruple that needs more for even odds is left out
MAX_MARGIN_LOG = 3.7
MAX_RANKED = 400  # quadruples whose colours are measured, those that need the least margin
# [log odds] by which a rank rises with the logarithm of the margin: with all squares seen (`_wanted_margins`), with one
# missing
MARGIN_WEIGHT_COMPLETE, MARGIN_WEIGHT = 1.86, 2.0
MIN_SAMPLES, MIN_RANGE = 12, 8  # [points, grey levels] between the markers: inside the frame, and range of their luma
MIN_INTERIOR = 1.0  # [standard deviations] colour margin of the weakest markers
NO_PLATE = -100.0  # rank and colour margin of what is no plate: below all limits
MIN_RANK = -3.0  # [log odds] of a candidate; the grid between its markers decides (`find_candidates`)
MAX_CANDIDATES = 40  # of one signal
SAME_PLACE = 0.25  # [extent of a quadruple] between the centres of two that overlap


@dataclass(frozen=True, slots=True)
class MarkerQuad:
    """Centroids of a plate's four markers."""

    centroids_px: Floats  # (4, 2) triangle, then squares clockwise, in full-resolution pixels
    found: int  # bits of the green squares that were seen (`FOUND_ALL`); the others are implied by the affine map
    rank: float  # [log odds] that it is a plate, by its markers alone
    size_ratio: float  # distance between marker centres over the side of a marker; distinguishes 8, 10 and 12 units


class Quads(NamedTuple):
    """Quadruples as arrays of Q."""

    centroids: Floats  # (Q, 4, 2) [px of the signal]
    found: Ints  # as of `MarkerQuad`
    size_ratio: Floats  # as of `MarkerQuad`
    score: Floats  # how well the markers agree with each other

    @classmethod
    def empty(cls, count: int) -> Quads:
        """Memory for so many."""
        return cls(np.empty((count, 4, 2)), np.empty(count, np.int64), np.empty(count), np.empty(count))

    def part(self, which: slice | Ints) -> Quads:
        """Some of them."""
        return Quads(self.centroids[which], self.found[which], self.size_ratio[which], self.score[which])


class Nearest(NamedTuple):
    """Memory for the blobs around one, lowest misfit first."""

    blobs: Ints  # (MAX_NEAR,)
    misfits: Floats  # (MAX_NEAR,)

    @classmethod
    def empty(cls) -> Nearest:
        """Memory for the blobs around one."""
        return cls(np.empty(MAX_NEAR, np.int64), np.empty(MAX_NEAR))


def detect_marker_quads(signal: MarkerSignal) -> list[MarkerQuad]:
    """Marker quadruples of a frame, best first, overlapping ones suppressed."""
    blobs = find_blobs(signal)
    strength = blobs[:, SIGN] * blobs[:, PEAK] * np.sqrt(blobs[:, AREA])
    reds, greens = _strongest(strength, MAX_REDS), _strongest(-strength, MAX_GREENS)
    quads, nearest = Quads.empty(MAX_QUADS), Nearest.empty()
    count = join_green_triples(blobs, greens, signal.opponent, nearest, quads)
    count = join_red_quads(blobs, reds, greens, nearest, quads, count)
    quads = quads.part(slice(count))
    # the colours between the markers are measured only where they can make a quadruple likely
    wanted = _wanted_margins(quads, signal.scale)
    possible = np.flatnonzero(wanted < MAX_MARGIN_LOG)
    if len(possible) > MAX_RANKED:
        possible = np.sort(possible[np.argpartition(wanted[possible], MAX_RANKED)[:MAX_RANKED]])
    quads = quads.part(possible)
    ranks = _rank(quads, wanted[possible], signal.opponent, signal.planes.luma)
    kept = _suppress(quads.centroids, ranks, np.argsort(-ranks, kind="stable"), MAX_CANDIDATES)
    # pixel centres are at integers in the frame and in the signal
    centroids_px = signal.scale * quads.centroids[kept] + (signal.scale - 1) / 2
    founds, size_ratios = quads.found[kept].tolist(), quads.size_ratio[kept].tolist()
    return [MarkerQuad(*values) for values in zip(centroids_px, founds, ranks[kept].tolist(), size_ratios, strict=True)]


def _strongest(strength: Floats, most: int) -> Ints:
    """Numbers of the blobs with the greatest positive strengths, the greatest first."""
    found = np.flatnonzero(strength > 0)
    if len(found) > most:
        found = np.sort(found[np.argpartition(-strength[found], most)[:most]])
    order: Ints = found[np.argsort(-strength[found], kind="stable")]
    return order


# === Joining of blobs: what three markers imply of the others.


class _Sides(NamedTuple):
    """Vectors between marker centres along the plate's rows, to the right (p), and along its columns, down (q). [px]"""

    px: float
    py: float
    qx: float
    qy: float


class _Moments(NamedTuple):
    """Central moments that a square of a plate with given sides has in the image. [px^2]"""

    xx: float
    xy: float
    yy: float


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
def _keep_nearest(nearest: Nearest, count: int, blob: int, misfit: float) -> int:
    """Insert a blob into the list of the best; returns how many it holds."""
    j = min(count, MAX_NEAR - 1)
    if count >= MAX_NEAR and misfit >= nearest.misfits[j]:
        return count
    while j > 0 and nearest.misfits[j - 1] > misfit:
        nearest.misfits[j] = nearest.misfits[j - 1]
        nearest.blobs[j] = nearest.blobs[j - 1]
        j -= 1
    nearest.misfits[j] = misfit
    nearest.blobs[j] = blob
    return min(count + 1, MAX_NEAR)


@ieee_loop
def _set_centroid(quads: Quads, k: int, corner: int, x: float, y: float) -> None:
    quads.centroids[k, corner, 0] = x
    quads.centroids[k, corner, 1] = y


# --- three green squares ------------------------------------------------------------------------------------------


@ieee_loop_kernel
def join_green_triples(blobs: Floats, greens: Ints, opponent: Signal, nearest: Nearest, quads: Quads) -> int:
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
    quads : Quads
        Set, with `MAX_QUADS` rows.
    """
    found = 0
    for corner in greens:
        count = _squares_near(blobs, greens, corner, nearest)
        for i in range(count):
            for j in range(count):
                if i != j:
                    triple = _Triple(corner, nearest.blobs[i], nearest.blobs[j])
                    found = _add_triple(blobs, triple, opponent, quads, found)
    return found


@step
def _squares_near(blobs: Floats, greens: Ints, corner: int, nearest: Nearest) -> int:
    """Keep the green blobs around a green one that may be squares of its plate, the most alike first; how many."""
    x, y, area, peak = blobs[corner, X], blobs[corner, Y], blobs[corner, AREA], blobs[corner, PEAK]
    reach = _reach_px(blobs, corner)
    count = 0
    for other in greens:
        if other == corner or abs(blobs[other, X] - x) > reach or abs(blobs[other, Y] - y) > reach:
            continue
        ratio = max(blobs[other, AREA] / area, area / blobs[other, AREA])
        if ratio > MAX_SQUARE_RATIO or max(blobs[other, PEAK], peak) > MAX_SQUARE_RATIO * min(blobs[other, PEAK], peak):
            continue
        count = _keep_nearest(nearest, count, other, ratio)
    return count


class _Triple(NamedTuple):
    """Three green squares, by their blobs."""

    corner: int  # opposite the triangle
    right: int  # above it, at the top right
    below: int  # to its left, at the bottom left


@step
def _add_triple(blobs: Floats, triple: _Triple, opponent: Signal, quads: Quads, found: int) -> int:
    """Add the quadruple of three green squares, where there is something red in the triangle's place."""
    corner, right, below = triple
    xc, yc = blobs[corner, X], blobs[corner, Y]
    xr, yr = blobs[right, X], blobs[right, Y]
    xb, yb = blobs[below, X], blobs[below, Y]
    sides = _Sides(xc - xb, yc - yb, xc - xr, yc - yr)
    # the markers' distances suit their sizes, and their shapes the affine map
    cross = sides.px * sides.qy - sides.py * sides.qx
    if cross < MIN_CROSS_PX2:
        return found
    area_right, area_below = blobs[right, AREA], blobs[below, AREA]
    areas = area_right * area_below * blobs[corner, AREA]
    if not MIN_SIZE_RATIO6 * areas < cross * cross * cross < MAX_SIZE_RATIO6 * areas:
        return found
    size_ratio = math.sqrt(cross / areas ** (1.0 / 3.0))
    if size_ratio < MIN_SIZE_RATIO or size_ratio > MAX_SIZE_RATIO:
        return found
    shape = _triple_shape_ratio(blobs, triple, _square_moments(sides, size_ratio))
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
    quads.score[found] = (
        4.0
        - 0.7 * math.log(shape)
        - 0.5 * area_log
        - abs(math.log(blobs[right, PEAK] / blobs[below, PEAK]))
        + 0.5 * math.log(max(red, PALE_RED * amplitude) * amplitude)
        - (3.5 if pale else 0.5)
    )
    _set_centroid(quads, found, TRIANGLE, x, y)
    _set_centroid(quads, found, TOP_RIGHT, xr, yr)
    _set_centroid(quads, found, BOTTOM_RIGHT, xc, yc)
    _set_centroid(quads, found, BOTTOM_LEFT, xb, yb)
    quads.found[found] = FOUND_ALL
    quads.size_ratio[found] = size_ratio
    return found + 1


@step
def _triple_shape_ratio(blobs: Floats, triple: _Triple, moments: _Moments) -> float:
    """Largest shape ratio of three squares; the first above the limit ends the search."""
    shape = _shape_ratio(blobs, triple.corner, moments)
    if shape <= MAX_TRIPLE_SHAPE:
        shape = max(shape, _shape_ratio(blobs, triple.right, moments))
    if shape <= MAX_TRIPLE_SHAPE:
        shape = max(shape, _shape_ratio(blobs, triple.below, moments))
    return shape


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


# --- a red triangle and two or three green squares ----------------------------------------------------------------


@ieee_loop_kernel
def join_red_quads(blobs: Floats, reds: Ints, greens: Ints, nearest: Nearest, quads: Quads, found: int) -> int:
    """Add quadruples of a red triangle and two or three of the green squares near it; returns how many there are then.

    Parameters as of `join_green_triples`; `reds` are the red blobs, strongest first.
    """
    for red in reds:
        count = _greens_near(blobs, greens, red, nearest)
        complete_seen = False
        for i in range(count):
            for j in range(count):
                first, second = nearest.blobs[i], nearest.blobs[j]
                area_i, area_j = blobs[first, AREA], blobs[second, AREA]
                if i == j or max(area_i, area_j) > MAX_PAIR_AREA_RATIO * min(area_i, area_j):
                    continue
                for missing in (BOTTOM_RIGHT, BOTTOM_LEFT, TOP_RIGHT):
                    pair = _Pair(red, first, second, missing)
                    found, complete_seen = _add_pair(blobs, pair, nearest, count, complete_seen, quads, found)
    return found


@step
def _greens_near(blobs: Floats, greens: Ints, red: int, nearest: Nearest) -> int:
    """Keep the green blobs around a red one that may be squares of its plate, the likeliest first; how many."""
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
        count = _keep_nearest(nearest, count, g, misfit)
    return count


class _Pair(NamedTuple):
    """A red triangle and two green squares, by their blobs, and the corner without a blob yet."""

    red: int
    first: int  # at the top right, or at the bottom right where that corner is missing
    second: int  # at the bottom left, or at the bottom right where that corner is missing
    missing: int


@step
def _add_pair(
    blobs: Floats, pair: _Pair, nearest: Nearest, count: int, complete_seen: bool, quads: Quads, found: int
) -> tuple[int, bool]:
    """Add the quadruple of a red triangle and two squares, with the third where it is among the nearest blobs.

    Returns how many quadruples there are then, and whether a complete one was seen: after one, incomplete ones of the
    same triangle are left out. Complete ones come once, as those whose bottom right is missing.
    """
    red, first, second, missing = pair
    sides = _sides_of(blobs, pair)
    cross = sides.px * sides.qy - sides.py * sides.qx
    if cross < MIN_CROSS_PX2:
        return found, complete_seen
    # from the areas in pixels; blur makes small blobs larger
    size_ratio = math.sqrt(cross / math.sqrt(blobs[first, AREA] * blobs[second, AREA]))
    if size_ratio < MIN_SIZE_RATIO or size_ratio > MAX_SIZE_RATIO:
        return found, complete_seen
    moments = _square_moments(sides, size_ratio)
    shape = _shape_ratio(blobs, first, moments)
    if shape <= MAX_PAIR_SHAPE:
        shape = max(shape, _shape_ratio(blobs, second, moments))
    if shape > MAX_PAIR_SHAPE:
        return found, complete_seen
    x = blobs[red, X] + (sides.px if missing != BOTTOM_LEFT else 0.0) + (sides.qx if missing != TOP_RIGHT else 0.0)
    y = blobs[red, Y] + (sides.py if missing != BOTTOM_LEFT else 0.0) + (sides.qy if missing != TOP_RIGHT else 0.0)
    fourth = _find_fourth(blobs, pair, nearest, count, x, y, sides, moments)
    is_complete = fourth.blob >= 0
    if (is_complete and missing != BOTTOM_RIGHT) or (not is_complete and complete_seen):
        return found, complete_seen
    quads.score[found] = (
        (5.5 - 6.0 * fourth.distance if is_complete else 0.0)
        - 0.7 * math.log(shape)
        - 0.3 * math.log(_shape_ratio(blobs, red, moments))
        - 0.5 * abs(math.log(blobs[first, AREA] / blobs[second, AREA]))
        + 0.5 * math.log(blobs[red, PEAK] * math.sqrt(blobs[first, PEAK] * blobs[second, PEAK]))
    )
    if is_complete:
        x = blobs[fourth.blob, X]
        y = blobs[fourth.blob, Y]
    first_corner = TOP_RIGHT if missing != TOP_RIGHT else BOTTOM_RIGHT
    second_corner = BOTTOM_LEFT if missing != BOTTOM_LEFT else BOTTOM_RIGHT
    _set_centroid(quads, found, TRIANGLE, blobs[red, X], blobs[red, Y])
    _set_centroid(quads, found, first_corner, blobs[first, X], blobs[first, Y])
    _set_centroid(quads, found, second_corner, blobs[second, X], blobs[second, Y])
    _set_centroid(quads, found, missing, x, y)
    quads.found[found] = FOUND_ALL if is_complete else FOUND_ALL - (1 << (missing - 1))
    quads.size_ratio[found] = size_ratio
    return found + 1, complete_seen or is_complete


@step
def _sides_of(blobs: Floats, pair: _Pair) -> _Sides:
    """Sides that a triangle and two squares imply."""
    x0, y0 = blobs[pair.red, X], blobs[pair.red, Y]
    x1, y1 = blobs[pair.first, X], blobs[pair.first, Y]
    x2, y2 = blobs[pair.second, X], blobs[pair.second, Y]
    if pair.missing == BOTTOM_RIGHT:
        return _Sides(x1 - x0, y1 - y0, x2 - x0, y2 - y0)
    if pair.missing == BOTTOM_LEFT:
        return _Sides(x1 - x0, y1 - y0, x2 - x1, y2 - y1)
    return _Sides(x1 - x2, y1 - y2, x2 - x0, y2 - y0)


class _Fourth(NamedTuple):
    """The fourth marker: its blob (-1 for none), and its distance from the expected place [plate sides]."""

    blob: int
    distance: float


@step
def _find_fourth(
    blobs: Floats, pair: _Pair, nearest: Nearest, count: int, x: float, y: float, sides: _Sides, moments: _Moments
) -> _Fourth:
    """The blob of the missing square among the nearest, expected at x, y."""
    cross = sides.px * sides.qy - sides.py * sides.qx
    best = MAX_FOURTH_DISTANCE
    fourth = -1
    for m in range(count):
        blob = nearest.blobs[m]
        if blob in (pair.first, pair.second):
            continue
        ex = blobs[blob, X] - x
        ey = blobs[blob, Y] - y
        off = max(abs(ex * sides.qy - ey * sides.qx), abs(sides.px * ey - sides.py * ex)) / cross
        if off < best and _shape_ratio(blobs, blob, moments) < MAX_FOURTH_SHAPE:
            best = off
            fourth = blob
    return _Fourth(fourth, best)


# === Ranking: how far the markers' colours stand out of what lies between them.


@ieee_kernel
def _wanted_margins(quads: Quads, scale: int) -> Floats:
    """Logarithm of the colour margin with which each quadruple's rank is 0.

    With all squares seen the rank is the logarithm of the odds that it is a plate, by logistic regression over 3,600
    candidates in simulated frames, and 2.6; with one missing, hardly any is a plate, and only a strong one counts.
    """
    wanted = np.empty(quads.score.size)
    for k in range(quads.score.size):
        quad = quads.centroids[k]
        right_x, right_y = quad[TOP_RIGHT, 0] - quad[TRIANGLE, 0], quad[TOP_RIGHT, 1] - quad[TRIANGLE, 1]
        down_x, down_y = quad[BOTTOM_LEFT, 0] - quad[TRIANGLE, 0], quad[BOTTOM_LEFT, 1] - quad[TRIANGLE, 1]
        area = abs(right_x * down_y - right_y * down_x)
        size = np.log10(max(area * scale * scale, 1.0))
        if quads.found[k] == FOUND_ALL:
            wanted[k] = (9.4 - 1.14 * quads.score[k] - 1.99 * size + 0.51 * size**2) / MARGIN_WEIGHT_COMPLETE
        else:
            needed = min(max(4.5 * size - 5.8, 5.0), 8.7 + max(size - 3.5, 0.0))
            wanted[k] = (needed - quads.score[k]) / MARGIN_WEIGHT
    return wanted


@ieee_kernel
def _rank(quads: Quads, wanted: Floats, opponent: Signal, luma: Grey) -> Floats:
    """How likely each quadruple is a plate [log odds], by how far its colour margin exceeds the wanted one."""
    ranks = np.empty(wanted.size)
    for k in range(wanted.size):
        margin = _colour_margin(opponent, luma, quads.centroids[k])
        weight = MARGIN_WEIGHT_COMPLETE if quads.found[k] == FOUND_ALL else MARGIN_WEIGHT
        ranks[k] = weight * (np.log(margin) - wanted[k]) if margin >= MIN_INTERIOR else NO_PLATE
    return ranks


@step
def _colour_margin(opponent: Signal, luma: Grey, centroids: Floats) -> float:
    """How far the weakest markers' colours stand out of what lies between the markers, in its standard deviations.

    Between the markers a plate is neutral and has contrast; foliage has colour all over; `NO_PLATE` without contrast.
    The second weakest marker counts with a fifth of the weakest: one marker may be worn.
    """
    height, width = opponent.shape
    interior = _sample_interior(opponent, luma, centroids)
    if interior.samples < MIN_SAMPLES or interior.luma_range < MIN_RANGE:
        return NO_PLATE
    weakest = 1.0e9
    second = 1.0e9
    for k in range(4):
        column = int(min(max(centroids[k, 0] + 0.5, 0), width - 1))
        row = int(min(max(centroids[k, 1] + 0.5, 0), height - 1))
        margin = (opponent[row, column] - interior.mean) / interior.spread
        if k != TRIANGLE:  # green is negative
            margin = -margin
        if margin < weakest:
            second = weakest
            weakest = margin
        elif margin < second:
            second = margin
    return second + 0.2 * weakest


class _Interior(NamedTuple):
    """Between the markers: samples, range of the luma [grey levels], mean and spread of the colour signal."""

    samples: int
    luma_range: int
    mean: float
    spread: float


@step
def _sample_interior(opponent: Signal, luma: Grey, centroids: Floats) -> _Interior:
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
            at = (1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v
            x = at[0] * centroids[0, 0] + at[1] * centroids[1, 0] + at[2] * centroids[2, 0] + at[3] * centroids[3, 0]
            y = at[0] * centroids[0, 1] + at[1] * centroids[1, 1] + at[2] * centroids[2, 1] + at[3] * centroids[3, 1]
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


@ieee_kernel
def _suppress(centroids: Floats, ranks: Floats, order: Ints, max_kept: int) -> Ints:
    """The best that are worth a fit, and of those in about one place the best only."""
    kept = np.empty(max_kept, np.int64)
    middles = np.empty((max_kept, 2))
    count = 0
    for k in order:
        if ranks[k] <= MIN_RANK or count == max_kept:
            break
        quad = centroids[k]
        x = (quad[0, 0] + quad[1, 0] + quad[2, 0] + quad[3, 0]) / 4
        y = (quad[0, 1] + quad[1, 1] + quad[2, 1] + quad[3, 1]) / 4
        size = 0.0
        for i in range(4):
            size = max(size, 2 * abs(quad[i, 0] - x), 2 * abs(quad[i, 1] - y))
        is_new = True
        for m in range(count):
            if max(abs(middles[m, 0] - x), abs(middles[m, 1] - y)) < SAME_PLACE * size:
                is_new = False
                break
        if is_new:
            kept[count] = k
            middles[count, 0] = x
            middles[count, 1] = y
            count += 1
    return kept[:count]
