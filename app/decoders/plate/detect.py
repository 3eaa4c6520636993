"""Where plates may be: red and green blobs at half resolution, joined into marker quadruples.

The search works on how far red stands above green and blue, or green above red and blue: neutral surfaces, sky and
lamps give nothing, a cast gives less than the share of the brightness that is taken off. Where that finds no plate, it
works on the ratio of red to green against the neighbourhood's. A candidate is a red triangle with at least two green
squares in the places where a plate has them; size and shape of the blobs must agree with the affine map that their
centres imply.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numba as nb
import numpy as np
import numpy.typing as npt

BLOCK = 16  # side of a block of the background grid, in half-resolution pixels
MAX_BLOBS = 6000
MAX_REDS = 150
MAX_GREENS = 160
MAX_NEAR = 8
# a red marker beside brown soil needs a high threshold to stand alone, a small one far away a low one to be seen at all
VIVID_LEVELS = ((6, 2), (10, 5), (20, 11))
FAINT_LEVELS = ((6, 0), (14, 0))
FAINTEST_LEVELS = ((3, 0), (7, 0))
NOISE_FACTOR = 3.5
LEAST_INTERIOR = 2.5
MAX_QUADS = 400
MAX_CANDIDATES = 8
# distance between marker centres over the side of a marker: 3.2, 4.27, 5.33 for 8, 10, 12 units of 35 / 5 mm
MARKER_RATIO = {8: 3.2, 10: 4.267, 12: 5.333}


@dataclass(frozen=True, slots=True)
class MarkerSignal:
    """Where a frame of half resolution is red (positive) or green (negative).

    Attributes
    ----------
    opponent : ndarray of int16, shape (H // 2, W // 2)
        Strength of the colour.
    luma : ndarray of uint8, shape (H // 2, W // 2)
        [grey levels]
    peak : ndarray of int16, shape (H // 2, blocks)
        Strongest signal in every run of `BLOCK` pixels of a row.
    threshold : ndarray of int16, shape (blocks, blocks)
        What stands above the roughness around a block.
    levels : tuple of (int, int)
        Thresholds to look at: strength, and share of the brightness in 32nds.
    scale : int
        Pixels of the frame that make one of the signal, along a side.
    """

    opponent: npt.NDArray[Any]
    luma: npt.NDArray[Any]
    peak: npt.NDArray[Any]
    threshold: npt.NDArray[Any]
    levels: tuple[tuple[int, int], ...]
    scale: int = 2


@dataclass(frozen=True, slots=True)
class MarkerQuad:
    """Centroids of a plate's four markers.

    Attributes
    ----------
    centroids_px : ndarray, shape (4, 2)
        Red triangle, then the green squares clockwise; full-resolution pixels.
    found : int
        Bits 1, 2, 4: which of the three green squares were seen; the others are implied by the affine map.
    score : float
        Larger is better.
    colour_margin : float
        How far the weakest markers' colour stands out of what lies between the markers, in its spreads.
    size_ratio : float
        Distance between marker centres over the side of a marker; tells 8 from 10 from 12 units.
    """

    centroids_px: npt.NDArray[Any]
    found: int
    score: float
    colour_margin: float
    size_ratio: float

    @property
    def rank(self) -> float:
        """How likely it is a plate: above 0 worth a fit; large markers must look the part better than small ones."""
        right, down = self.centroids_px[1] - self.centroids_px[0], self.centroids_px[3] - self.centroids_px[0]
        area = max(abs(float(right[0] * down[1] - right[1] * down[0])), 1.0)
        wanted = min(max(5.0 + 4.5 * math.log10(area / 250), 5.0), 8.7 + max(math.log10(area / 3000), 0.0))
        return self.score + 2 * math.log(self.colour_margin) - wanted


def half_frame(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A BGR frame, shape (H, W, 3), at half resolution."""
    return cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA)


def vivid_signal(small: npt.NDArray[Any]) -> MarkerSignal:
    """How far red stands above green and blue, or green above red and blue: strong colours, whatever is around."""
    blue, green, red = cv2.split(small)
    opponent = np.empty(blue.shape, np.int16)
    luma = np.empty(blue.shape, np.uint8)
    _vivid(blue, green, red, opponent, luma)
    return _signal(opponent, luma, VIVID_LEVELS)


def faint_signal(small: npt.NDArray[Any]) -> MarkerSignal:
    """The ratio of red to green against the neighbourhood's: weak colours in haze, glare or a colour cast.

    About 128 times the ratio's logarithm, less in the dark.
    """
    green, red = (np.ascontiguousarray(small[..., k]) for k in (1, 2))
    opponent: npt.NDArray[Any] = np.empty(small.shape[:2], np.int16)
    _ratio(green.reshape(-1), red.reshape(-1), opponent.reshape(-1))
    height, width = opponent.shape
    tiny = (max(width // BLOCK, 1), max(height // BLOCK, 1))
    level = cv2.medianBlur(cv2.resize(opponent, tiny, interpolation=cv2.INTER_AREA), 5)
    opponent = cv2.subtract(opponent, cv2.resize(level, (width, height), interpolation=cv2.INTER_LINEAR))
    return _signal(opponent, cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), FAINT_LEVELS)


def faintest_signal(small: npt.NDArray[Any]) -> MarkerSignal:
    """The same at a quarter of the frame's resolution, where noise is less: large plates in thick haze."""
    tiny = cv2.resize(small, (small.shape[1] // 2, small.shape[0] // 2), interpolation=cv2.INTER_AREA)
    return replace(faint_signal(tiny), levels=FAINTEST_LEVELS, scale=4)


def _blocks(shape: tuple[int, ...]) -> tuple[int, int]:
    return (shape[0] + BLOCK - 1) // BLOCK, (shape[1] + BLOCK - 1) // BLOCK


def _signal(opponent: npt.NDArray[Any], luma: npt.NDArray[Any], levels: tuple[tuple[int, int], ...]) -> MarkerSignal:
    rows, columns = _blocks(opponent.shape)
    peak = np.zeros((opponent.shape[0], columns), np.int16)
    rough = np.zeros((rows, columns), np.int32)
    _block_statistics(opponent, peak, rough)
    return MarkerSignal(opponent, luma, peak, _thresholds(rough), levels)


def _full_px(points: npt.NDArray[Any], scale: int) -> npt.NDArray[Any]:
    """Pixels of the frame from those of a signal; pixel centres are at integers in both."""
    return scale * points + (scale - 1) / 2


def detect_marker_quads(signal: MarkerSignal) -> list[MarkerQuad]:
    """Marker quadruples of a frame, best first, overlapping ones suppressed."""
    blobs, count = np.empty((MAX_BLOBS, 13)), 0
    for floor, slack in signal.levels:
        count = _blobs(signal.opponent, signal.luma, signal.peak, signal.threshold, floor, slack, blobs, count)
    quads, found = _quads(blobs[:count], signal.opponent)
    order = np.argsort(-quads[:found, 8], kind="stable")
    kept = _suppress(signal.opponent, signal.luma, quads, order, MAX_CANDIDATES)
    found_quads = [
        MarkerQuad(
            _full_px(row[:8].reshape(4, 2), signal.scale), int(row[9]), float(row[8]), float(row[11]), float(row[10])
        )
        for row in (quads[k] for k in kept)
    ]
    return sorted((q for q in found_quads if q.rank > 0), key=lambda q: -q.rank)


def marker_margins(
    signal: MarkerSignal, plate_from_image: npt.NDArray[Any], centroids: npt.NDArray[Any],
    units: npt.NDArray[Any],
) -> npt.NDArray[Any]:  # fmt: skip
    """How far each marker's colour stands out of the units', in their spreads; for a fitted plate.

    Parameters
    ----------
    signal : MarkerSignal
    plate_from_image : ndarray, shape (3, 3)
        Full-resolution pixels to plate coordinates.
    centroids : ndarray, shape (4, 2)
        Of the markers, in plate coordinates.
    units : ndarray, shape (U, 2)
        Centres of the units, in plate coordinates.

    Returns
    -------
    ndarray, shape (4,)
        Triangle (red positive) and squares (green positive).
    """
    image_from_plate = np.linalg.inv(plate_from_image)
    spots = (centroids[:, None] + _SPOTS[None]).reshape(-1, 2)
    inside = _signal_at(signal, image_from_plate, spots).reshape(4, -1).mean(axis=1)
    between = _signal_at(signal, image_from_plate, units)
    margins: npt.NDArray[Any] = (inside - between.mean()) / (between.std() + 1.0)
    margins[1:] *= -1
    return margins


_SPOTS = np.array([(x, y) for x in (-0.03, 0.0, 0.03) for y in (-0.03, 0.0, 0.03)])


def _signal_at(signal: MarkerSignal, image_from_plate: npt.NDArray[Any], points: npt.NDArray[Any]) -> npt.NDArray[Any]:
    projected = points @ image_from_plate[:, :2].T + image_from_plate[:, 2]
    half = (projected[:, :2] / projected[:, 2:] - (signal.scale - 1) / 2) / signal.scale
    height, width = signal.opponent.shape
    columns = np.clip(np.rint(half[:, 0]), 0, width - 1).astype(int)
    rows = np.clip(np.rint(half[:, 1]), 0, height - 1).astype(int)
    values: npt.NDArray[Any] = signal.opponent[rows, columns].astype(float)
    return values


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _vivid(blue, green, red, opponent, luma):  # type: ignore[no-untyped-def]
    for y in range(opponent.shape[0]):
        for x in range(opponent.shape[1]):
            b = np.int16(blue[y, x])
            g = np.int16(green[y, x])
            r = np.int16(red[y, x])
            opponent[y, x] = max(r - max(g, b), np.int16(0)) - max(g - max(r, b), np.int16(0))
            luma[y, x] = np.uint8((r + 2 * g + b) >> 2)


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _ratio(green, red, opponent):  # type: ignore[no-untyped-def]
    for k in range(opponent.shape[0]):
        r = np.float32(red[k])
        g = np.float32(green[k])
        opponent[k] = np.int16(np.int32(np.float32(256.0) * (r - g) / (r + g + np.float32(24.0))))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _block_statistics(opponent, peak, rough):  # type: ignore[no-untyped-def]
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


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _thresholds(rough):  # type: ignore[no-untyped-def]
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


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _suppress(opponent, luma, quads, order, most):  # type: ignore[no-untyped-def]
    kept = np.empty(most, np.int64)
    count = 0
    for k in order:
        q = quads[k]
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
        if not fresh:
            continue
        q[11] = _interior_score(opponent, luma, q)
        if q[11] > LEAST_INTERIOR:
            kept[count] = k
            count += 1
            if count == most:
                break
    return kept[:count]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _find(parent, i):  # type: ignore[no-untyped-def]
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _blobs(opponent, luma, peak, threshold, floor, slack, blobs, count):  # type: ignore[no-untyped-def]
    """Connected blobs of red (sign +) and green (sign -) with moments weighted by contrast.

    Columns: sign, weight, x, y, xx, xy, yy (central), area, x0, x1, y0, y1, peak.
    """
    height, width = opponent.shape
    max_runs = 60000
    parent = np.empty(max_runs, np.int32)
    stats = np.empty((max_runs, 12), np.float64)  # w, wx, wy, wxx, wxy, wyy, area, x0, x1, y0, y1, peak
    sign = np.empty(max_runs, np.int8)
    run_x0 = np.empty(max_runs, np.int32)
    run_x1 = np.empty(max_runs, np.int32)
    runs = 0
    prev0 = 0
    prev1 = 0
    for y in range(height):
        start = runs
        scan = prev0
        block_row = y // BLOCK
        x = 0
        while x < width:
            block = x // BLOCK
            stop = min(width, (block + 1) * BLOCK)
            high = max(np.int32(threshold[block_row, block]), floor)
            if peak[y, block] <= high:
                x = stop
                continue
            while x < stop:
                v = np.int32(opponent[y, x])
                if abs(v) <= high or (abs(v) << 5) <= slack * np.int32(luma[y, x]):
                    x += 1
                    continue
                s = 1 if v > 0 else -1
                if runs >= max_runs:
                    x = width
                    break
                w = 0.0
                wx = 0.0
                wxx = 0.0
                top = 0.0
                x0 = x
                while x < width:
                    b = x // BLOCK
                    v = np.int32(s * opponent[y, x])
                    if v <= max(np.int32(threshold[block_row, b]), floor) or (v << 5) <= slack * np.int32(luma[y, x]):
                        break
                    d = np.float64(v)
                    w += d
                    wx += d * x
                    wxx += d * x * x
                    top = max(top, d)
                    x += 1
                me = runs
                runs += 1
                parent[me] = me
                sign[me] = s
                run_x0[me] = x0
                run_x1[me] = x - 1
                q = stats[me]
                q[0] = w
                q[1] = wx
                q[2] = w * y
                q[3] = wxx
                q[4] = wx * y
                q[5] = w * y * y
                q[6] = x - x0
                q[7] = x0
                q[8] = x - 1
                q[9] = y
                q[10] = y
                q[11] = top
                while scan < prev1 and run_x1[scan] < x0 - 1:
                    scan += 1
                k = scan
                while k < prev1 and run_x0[k] <= x:
                    if sign[k] == s:
                        a = _find(parent, k)
                        b2 = _find(parent, me)
                        if a != b2:
                            if a > b2:
                                a, b2 = b2, a
                            parent[b2] = a
                            qa = stats[a]
                            qb = stats[b2]
                            for m in range(7):
                                qa[m] += qb[m]
                            qa[7] = min(qa[7], qb[7])
                            qa[8] = max(qa[8], qb[8])
                            qa[9] = min(qa[9], qb[9])
                            qa[10] = max(qa[10], qb[10])
                            qa[11] = max(qa[11], qb[11])
                    k += 1
        prev0 = start
        prev1 = runs
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
        o[7] = q[6]
        o[8] = q[7]
        o[9] = q[8]
        o[10] = q[9]
        o[11] = q[10]
        o[12] = q[11]
        count += 1
    return count


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
    return max(abs(np.log(low)), abs(np.log(high)))


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
            m = abs(np.log(other[7] / corner[7]))
            if m > 1.3 or abs(np.log(other[12] / corner[12])) > 1.3:
                continue
            k = _keep_nearest(near, merit, k, greens[b], m)
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
                scale = 1.0 / (12.0 * ratio * ratio)
                pxx = (px * px + qx * qx) * scale + 0.3
                pyy = (py * py + qy * qy) * scale + 0.3
                pxy = (px * py + qx * qy) * scale
                shape = max(
                    _shape_error(g1, pxx, pxy, pyy),
                    _shape_error(g2, pxx, pxy, pyy),
                    _shape_error(corner, pxx, pxy, pyy),
                )
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
                q = quads[found]
                q[0] = x
                q[1] = y
                q[2] = g1[2]
                q[3] = g1[3]
                q[4] = corner[2]
                q[5] = corner[3]
                q[6] = g2[2]
                q[7] = g2[3]
                q[8] = (
                    4.0
                    - 0.7 * shape
                    - 0.5 * abs(np.log(g1[7] / g2[7]))
                    - abs(np.log(g1[12] / g2[12]))
                    + 0.5 * np.log(max(red, 0.1 * amplitude) * amplitude)
                    - (3.5 if pale else 0.5)
                )
                q[9] = 7
                q[10] = ratio
                found += 1
    return found


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _quads(blobs, opponent):  # type: ignore[no-untyped-def]
    """Rows: four centroids (x, y), score, bits of the green squares found, size ratio."""
    quads = np.empty((MAX_QUADS, 12), np.float64)
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
    found = _green_triples(blobs, greens[:n_green], opponent, quads)
    near = np.empty(MAX_NEAR, np.int32)
    merit = np.empty(MAX_NEAR)
    for a in range(n_red):
        red = blobs[reds[a]]
        reach = 7.0 * max(red[9] - red[8], red[11] - red[10]) + 10.0
        k = 0
        for gi in range(n_green):
            green = blobs[greens[gi]]
            dx = abs(green[2] - red[2])
            dy = abs(green[3] - red[3])
            if dx > reach or dy > reach:
                continue
            ratio = green[7] / red[7]
            if ratio < 0.4 or ratio > 14.0 or green[12] < 0.12 * red[12]:
                continue
            m = abs(np.log(ratio / 2.0)) - 0.5 * np.log(green[12])
            k = _keep_nearest(near, merit, k, greens[gi], m)
        best_found = 0
        for i in range(k):
            for j in range(k):
                if i == j or found >= MAX_QUADS:
                    continue
                g1 = blobs[near[i]]
                g2 = blobs[near[j]]
                similar = abs(np.log(g1[7] / g2[7]))
                if similar > 1.4:
                    continue
                for role in range(3):  # which two green squares: 0 = TR, BL; 1 = TR, BR; 2 = BR, BL
                    if role == 0:
                        px = g1[2] - red[2]
                        py = g1[3] - red[3]
                        qx = g2[2] - red[2]
                        qy = g2[3] - red[3]
                    elif role == 1:
                        px = g1[2] - red[2]
                        py = g1[3] - red[3]
                        qx = g2[2] - g1[2]
                        qy = g2[3] - g1[3]
                    else:
                        qx = g2[2] - red[2]
                        qy = g2[3] - red[3]
                        px = g1[2] - g2[2]
                        py = g1[3] - g2[3]
                    cross = px * qy - py * qx
                    if cross < 12.0:
                        continue
                    # ratio of centre distance to marker side from the areas in pixels (blur widens small blobs)
                    area = np.sqrt(g1[7] * g2[7])
                    size_ratio = np.sqrt(cross / area)
                    if size_ratio < 1.6 or size_ratio > 7.5:
                        continue
                    scale = 1.0 / (12.0 * size_ratio * size_ratio)
                    pxx = (px * px + qx * qx) * scale + 0.3
                    pyy = (py * py + qy * qy) * scale + 0.3
                    pxy = (px * py + qx * qy) * scale
                    shape = max(_shape_error(g1, pxx, pxy, pyy), _shape_error(g2, pxx, pxy, pyy))
                    if shape > 2.2:
                        continue
                    # the remaining square
                    if role == 0:
                        fx = red[2] + px + qx
                        fy = red[3] + py + qy
                    elif role == 1:
                        fx = red[2] + qx
                        fy = red[3] + qy
                    else:
                        fx = red[2] + px
                        fy = red[3] + py
                    best = 1.0e9
                    fourth = -1
                    for m2 in range(k):
                        if m2 in (i, j):
                            continue
                        g3 = blobs[near[m2]]
                        ex = g3[2] - fx
                        ey = g3[3] - fy
                        # offset in units of the plate's own axes
                        u = (ex * qy - ey * qx) / cross
                        v = (px * ey - py * ex) / cross
                        e = max(abs(u), abs(v))
                        if e < 0.3 and e < best and _shape_error(g3, pxx, pxy, pyy) < 2.5:
                            best = e
                            fourth = m2
                    if fourth >= 0 and role != 0:
                        continue  # the same quadruple comes with role 0
                    complete = fourth >= 0
                    if found >= MAX_QUADS:
                        continue
                    if not complete and best_found == 2:
                        continue
                    bits = 7 if complete else (5 if role == 0 else (3 if role == 1 else 6))
                    red_shape = _shape_error(red, pxx, pxy, pyy)
                    score = (
                        (5.5 if complete else 0.0)
                        - 0.7 * shape
                        - 0.3 * red_shape
                        - 0.5 * similar
                        + 0.5 * np.log(red[12] * np.sqrt(g1[12] * g2[12]))
                    )
                    if complete:
                        score -= 6.0 * best
                        best_found = 2
                    q = quads[found]
                    trx = g1[2] if role != 2 else fx
                    tr_y = g1[3] if role != 2 else fy
                    blx = g2[2] if role != 1 else fx
                    bly = g2[3] if role != 1 else fy
                    if role == 0:
                        brx = blobs[near[fourth], 2] if complete else fx
                        bry = blobs[near[fourth], 3] if complete else fy
                    elif role == 1:
                        brx = g2[2]
                        bry = g2[3]
                    else:
                        brx = g1[2]
                        bry = g1[3]
                    q[0] = red[2]
                    q[1] = red[3]
                    q[2] = trx
                    q[3] = tr_y
                    q[4] = brx
                    q[5] = bry
                    q[6] = blx
                    q[7] = bly
                    q[8] = score
                    q[9] = bits
                    q[10] = size_ratio
                    found += 1
    return quads, found


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
