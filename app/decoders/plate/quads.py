"""Red and green blobs joined into marker quadruples.

A candidate is a red triangle with at least two green squares in the places where a plate has them; size and shape of
the blobs must agree with the affine map that their centres imply.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba as nb
import numpy as np
import numpy.typing as npt

from app.decoders.plate.blobs import find_blobs
from app.decoders.plate.colour import MarkerSignal

MAX_REDS = 150
MAX_GREENS = 160
MAX_NEAR = 8
MAX_QUADS = 1000
MAX_CANDIDATES = 12
LEAST_INTERIOR = 2.5
ALL_SQUARES = 7
# distance between marker centres over the side of a marker: 3.2, 4.27, 5.33 for 8, 10, 12 units of 35 / 5 mm
MARKER_RATIO = {8: 3.2, 10: 4.267, 12: 5.333}


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
        Distance between marker centres over the side of a marker; tells 8 from 10 from 12 units.
    """

    centroids_px: npt.NDArray[Any]
    found: int
    rank: float
    size_ratio: float


def detect_marker_quads(signal: MarkerSignal) -> list[MarkerQuad]:
    """Marker quadruples of a frame, best first, overlapping ones suppressed."""
    quads = np.empty((MAX_QUADS, 12))
    found = _join_quads(find_blobs(signal), signal.opponent, quads)
    _rank(quads[:found], signal.opponent, signal.planes.luma, signal.scale)
    order = np.argsort(-quads[:found, 11], kind="stable")
    return [
        MarkerQuad(_full_px(row[:8].reshape(4, 2), signal.scale), int(row[9]), float(row[11]), float(row[10]))
        for row in quads[_suppress(quads, order, MAX_CANDIDATES)]
    ]


def _full_px(points: npt.NDArray[Any], scale: int) -> npt.NDArray[Any]:
    """Pixels of the frame from those of a signal; pixel centres are at integers in both."""
    return scale * points + (scale - 1) / 2


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _rank(quads, opponent, luma, scale):  # type: ignore[no-untyped-def]
    """Set the last column: how likely each is a plate.

    With all squares seen it is the logarithm of the odds, by regression over 3,600 candidates in simulated frames, and
    2.6; with one missing, hardly any candidate is a plate, and only a strong one counts.
    """
    for q in quads:
        most = 1.14 * q[8] - 5.0 if q[9] == ALL_SQUARES else q[8]  # with a colour margin and a size of the best
        q[11] = -1.0
        if most < -1.0:
            continue
        margin = _interior_score(opponent, luma, q)
        if margin < LEAST_INTERIOR:
            continue
        area = abs((q[2] - q[0]) * (q[7] - q[1]) - (q[3] - q[1]) * (q[6] - q[0]))
        size = np.log10(max(area * scale * scale, 1.0))
        if q[9] == ALL_SQUARES:
            q[11] = 1.14 * q[8] + 1.86 * np.log(margin) + 1.99 * size - 0.51 * size**2 - 9.4
        else:
            wanted = min(max(4.5 * size - 5.8, 5.0), 8.7 + max(size - 3.5, 0.0))
            q[11] = q[8] + 2.0 * np.log(margin) - wanted


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _suppress(quads, order, most):  # type: ignore[no-untyped-def]
    """The best that are worth a fit, and of those in about one place the best only."""
    kept = np.empty(most, np.int64)
    count = 0
    for k in order:
        q = quads[k]
        if q[11] <= 0.0 or count == most:
            break
        cx = (q[0] + q[2] + q[4] + q[6]) / 4
        cy = (q[1] + q[3] + q[5] + q[7]) / 4
        size = 0.0
        for i in range(4):
            size = max(size, 2 * abs(q[2 * i] - cx), 2 * abs(q[2 * i + 1] - cy))
        fresh = True
        for m in kept[:count]:
            p = quads[m]
            px = (p[0] + p[2] + p[4] + p[6]) / 4
            py = (p[1] + p[3] + p[5] + p[7]) / 4
            if max(abs(px - cx), abs(py - cy)) < 0.25 * size:
                fresh = False
                break
        if fresh:
            kept[count] = k
            count += 1
    return kept[:count]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _shape_error(b, pxx, pxy, pyy):  # type: ignore[no-untyped-def]
    """How far a blob's covariance is from the predicted one: the log generalised eigenvalues, largest magnitude."""
    axx = b[4] + 0.3
    ayy = b[6] + 0.3
    axy = b[5]
    det = pxx * pyy - pxy * pxy
    if det <= 0:
        return 9.0
    # eigenvalues of inv(P) A
    t = (pyy * axx - 2 * pxy * axy + pxx * ayy) / det
    d = (axx * ayy - axy * axy) / det
    if d <= 0:
        return 9.0
    root = np.sqrt(max(t * t / 4 - d, 0.0))
    low = t / 2 - root
    high = t / 2 + root
    if low <= 0:
        return 9.0
    return np.log(max(high, 1.0 / low))  # one logarithm is the larger magnitude, on whichever side of 1 they are


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _red_at(opponent, x, y, px, py, qx, qy, ratio):  # type: ignore[no-untyped-def]
    """Strongest red within a marker's triangle around a point where one should be. [grey levels]"""
    best = 0
    step = 0.25 / ratio
    for i in range(-2, 3):
        for j in range(-2, 3):
            xi = int(x + step * (i * px + j * qx) + 0.5)
            yi = int(y + step * (i * py + j * qy) + 0.5)
            if 0 <= xi < opponent.shape[1] and 0 <= yi < opponent.shape[0]:
                best = max(best, opponent[yi, xi])
    return best


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _keep_nearest(near, merit, count, blob, misfit):  # type: ignore[no-untyped-def]
    """Insert a blob into the list of the best, lowest misfit first; returns how many it holds."""
    j = min(count, MAX_NEAR - 1)
    if count >= MAX_NEAR and misfit >= merit[j]:
        return count
    while j > 0 and merit[j - 1] > misfit:
        merit[j] = merit[j - 1]
        near[j] = near[j - 1]
        j -= 1
    merit[j] = misfit
    near[j] = blob
    return min(count + 1, MAX_NEAR)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _green_triples(blobs, greens, opponent, quads):  # type: ignore[no-untyped-def]
    """Quadruples from three green squares with something red where the triangle should be."""
    found = 0
    n = greens.shape[0]
    near = np.empty(MAX_NEAR, np.int32)
    merit = np.empty(MAX_NEAR)
    for a in range(n):
        corner = blobs[greens[a]]
        reach = 7.0 * max(corner[9] - corner[8], corner[11] - corner[10]) + 10.0
        k = 0
        for b in range(n):
            if b == a:
                continue
            other = blobs[greens[b]]
            if abs(other[2] - corner[2]) > reach or abs(other[3] - corner[3]) > reach:
                continue
            larger = max(other[7] / corner[7], corner[7] / other[7])
            if larger > 3.67 or other[12] > 3.67 * corner[12] or corner[12] > 3.67 * other[12]:
                continue
            k = _keep_nearest(near, merit, k, greens[b], larger)
        for i in range(k):
            for j in range(k):
                if i == j:
                    continue
                g1 = blobs[near[i]]  # top-right
                g2 = blobs[near[j]]  # bottom-left
                px = corner[2] - g2[2]
                py = corner[3] - g2[3]
                qx = corner[2] - g1[2]
                qy = corner[3] - g1[3]
                cross = px * qy - py * qx
                if cross < 12.0:
                    continue
                area = (g1[7] * g2[7] * corner[7]) ** (1.0 / 3.0)
                ratio = np.sqrt(cross / area)
                if ratio < 1.6 or ratio > 7.5:
                    continue
                pxx, pxy, pyy = _square_moments(px, py, qx, qy, ratio)
                shape = 0.0
                for square in (corner, g1, g2):
                    shape = max(shape, _shape_error(square, pxx, pxy, pyy))
                    if shape > 1.8:
                        break
                if shape > 1.8:
                    continue
                # the triangle's centroid is nearer to the plate's corner than a square's
                x = g1[2] + g2[2] - corner[2] - (px + qx) * (0.1667 / ratio)
                y = g1[3] + g2[3] - corner[3] - (py + qy) * (0.1667 / ratio)
                red = _red_at(opponent, x, y, px, py, qx, qy, ratio)
                amplitude = (g1[12] * g2[12] * corner[12]) ** (1.0 / 3.0)
                pale = red < 0.1 * amplitude
                if found >= MAX_QUADS // 2 or (pale and (shape > 1.0 or abs(np.log(g1[7] / g2[7])) > 0.7)):
                    continue
                score = (
                    4.0
                    - 0.7 * shape
                    - 0.5 * abs(np.log(g1[7] / g2[7]))
                    - abs(np.log(g1[12] / g2[12]))
                    + 0.5 * np.log(max(red, 0.1 * amplitude) * amplitude)
                    - (3.5 if pale else 0.5)
                )
                row = (x, y, g1[2], g1[3], corner[2], corner[3], g2[2], g2[3], score, 7.0, ratio)
                for m in range(11):
                    quads[found, m] = row[m]
                found += 1
    return found


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _square_moments(px, py, qx, qy, ratio):  # type: ignore[no-untyped-def]
    """Central moments of a green square whose plate has these sides between marker centres."""
    scale = 1.0 / (12.0 * ratio * ratio)
    return (px * px + qx * qx) * scale + 0.3, (px * py + qx * qy) * scale, (py * py + qy * qy) * scale + 0.3


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _near_greens(blobs, greens, red, near, merit):  # type: ignore[no-untyped-def]
    """The green blobs around a red one that may be squares of its plate, the likeliest first; how many."""
    reach = 7.0 * max(red[9] - red[8], red[11] - red[10]) + 10.0
    count = 0
    for g in greens:
        green = blobs[g]
        if abs(green[2] - red[2]) > reach or abs(green[3] - red[3]) > reach:
            continue
        ratio = green[7] / red[7]
        if ratio < 0.4 or ratio > 14.0 or green[12] < 0.12 * red[12]:
            continue
        misfit = abs(np.log(ratio / 2.0)) - 0.5 * np.log(green[12])
        count = _keep_nearest(near, merit, count, g, misfit)
    return count


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _fourth(blobs, near, i, j, x, y, px, py, qx, qy, moments):  # type: ignore[no-untyped-def]
    """The blob that is the remaining square, expected at x, y: its place in `near` or -1, and how far off it is."""
    cross = px * qy - py * qx
    best = 0.3  # of a side
    fourth = -1
    for m in range(near.shape[0]):
        if m in (i, j):
            continue
        blob = blobs[near[m]]
        ex = blob[2] - x
        ey = blob[3] - y
        off = max(abs(ex * qy - ey * qx), abs(px * ey - py * ex)) / cross
        if off < best and _shape_error(blob, moments[0], moments[1], moments[2]) < 2.5:
            best = off
            fourth = m
    return fourth, best


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _quads_of_red(blobs, red, near, quads, found):  # type: ignore[no-untyped-def]
    """Quadruples of a red triangle and two or three of the green blobs near it; returns how many there are then."""
    complete_seen = False
    for i in range(near.shape[0]):
        for j in range(near.shape[0]):
            g1 = blobs[near[i]]
            g2 = blobs[near[j]]
            if i == j or g1[7] > 4.06 * g2[7] or g2[7] > 4.06 * g1[7]:
                continue
            similar = abs(np.log(g1[7] / g2[7]))
            for role in range(3):  # which two green squares: 0 = TR, BL; 1 = TR, BR; 2 = BR, BL
                if role == 0:
                    px, py, qx, qy = g1[2] - red[2], g1[3] - red[3], g2[2] - red[2], g2[3] - red[3]
                elif role == 1:
                    px, py, qx, qy = g1[2] - red[2], g1[3] - red[3], g2[2] - g1[2], g2[3] - g1[3]
                else:
                    px, py, qx, qy = g1[2] - g2[2], g1[3] - g2[3], g2[2] - red[2], g2[3] - red[3]
                cross = px * qy - py * qx
                if cross < 12.0:
                    continue
                # ratio of centre distance to marker side from the areas in pixels (blur widens small blobs)
                size_ratio = np.sqrt(cross / np.sqrt(g1[7] * g2[7]))
                if size_ratio < 1.6 or size_ratio > 7.5:
                    continue
                moments = _square_moments(px, py, qx, qy, size_ratio)
                shape = _shape_error(g1, moments[0], moments[1], moments[2])
                if shape > 2.2:
                    continue
                shape = max(shape, _shape_error(g2, moments[0], moments[1], moments[2]))
                if shape > 2.2:
                    continue
                x = red[2] + (px if role != 1 else 0.0) + (qx if role != 2 else 0.0)
                y = red[3] + (py if role != 1 else 0.0) + (qy if role != 2 else 0.0)
                fourth, off = _fourth(blobs, near, i, j, x, y, px, py, qx, qy, moments)
                complete = fourth >= 0
                if (complete and role != 0) or (not complete and complete_seen):
                    continue  # the same quadruple comes with role 0
                if found >= MAX_QUADS:
                    return found
                score = (
                    (5.5 - 6.0 * off if complete else 0.0)
                    - 0.7 * shape
                    - 0.3 * _shape_error(red, moments[0], moments[1], moments[2])
                    - 0.5 * similar
                    + 0.5 * np.log(red[12] * np.sqrt(g1[12] * g2[12]))
                )
                if complete:
                    complete_seen = True
                    x, y = blobs[near[fourth], 2], blobs[near[fourth], 3]
                if role == 0:
                    corners = (red[2], red[3], g1[2], g1[3], x, y, g2[2], g2[3])
                elif role == 1:
                    corners = (red[2], red[3], g1[2], g1[3], g2[2], g2[3], x, y)
                else:
                    corners = (red[2], red[3], x, y, g1[2], g1[3], g2[2], g2[3])
                for m in range(8):
                    quads[found, m] = corners[m]
                quads[found, 8] = score
                quads[found, 9] = 7 if complete else (5 if role == 0 else (3 if role == 1 else 6))
                quads[found, 10] = size_ratio
                found += 1
    return found


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _join_quads(blobs, opponent, quads):  # type: ignore[no-untyped-def]
    """Fill rows: four centroids (x, y), score, bits of the green squares found, size ratio, rank; how many."""
    n = blobs.shape[0]
    strength = np.empty(n)
    for i in range(n):
        strength[i] = -blobs[i, 12] * np.sqrt(blobs[i, 7])
    reds = np.empty(MAX_REDS, np.int32)
    greens = np.empty(MAX_GREENS, np.int32)
    n_red = 0
    n_green = 0
    for i in np.argsort(strength):
        if blobs[i, 0] > 0 and n_red < MAX_REDS:
            reds[n_red] = i
            n_red += 1
        elif blobs[i, 0] < 0 and n_green < MAX_GREENS:
            greens[n_green] = i
            n_green += 1
    greens = greens[:n_green]
    found = _green_triples(blobs, greens, opponent, quads)
    near = np.empty(MAX_NEAR, np.int32)
    merit = np.empty(MAX_NEAR)
    for r in reds[:n_red]:
        count = _near_greens(blobs, greens, blobs[r], near, merit)
        found = _quads_of_red(blobs, blobs[r], near[:count], quads, found)
    return found


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _interior_score(opponent, luma, quad):  # type: ignore[no-untyped-def]
    """How far the weakest marker's colour stands out of what lies between the markers, in its spreads; -1 for no plate.

    Between the markers a plate is neutral and has contrast; foliage has colour all over, a road has no contrast.
    """
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
            xi = int(x + 0.5)
            yi = int(y + 0.5)
            if xi < 0 or yi < 0 or xi >= width or yi >= height:
                continue
            total += 1
            value = luma[yi, xi]
            low = min(low, value)
            high = max(high, value)
            o = float(opponent[yi, xi])
            mean += o
            square += o * o
    if total < 12 or high - low < 8:
        return -1.0
    mean /= total
    spread = np.sqrt(max(square / total - mean * mean, 0.0)) + 1.0
    weakest = 1.0e9
    second = 1.0e9
    for k in range(4):
        x = int(min(max(quad[2 * k] + 0.5, 0), width - 1))
        y = int(min(max(quad[2 * k + 1] + 0.5, 0), height - 1))
        o = (opponent[y, x] - mean) / spread
        if k > 0:
            o = -o
        if o < weakest:
            second = weakest
            weakest = o
        elif o < second:
            second = o
    return second + 0.2 * weakest
