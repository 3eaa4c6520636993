"""Plates in a thermal frame: quadrangles that are warmer, or colder, than the road.

The markers and the dark units are heated, or in the sun; at night they may be colder than the road instead. There are
no colours to find the triangle's corner by, and a slow sensor draws a trail behind everything that moves.

The frame is searched once. At half of its warmth the outline of a moving region keeps its shape: it only lags by 0.69
trails. Each quadrangle is fitted with the trail taken off, under every geometry. The trail is the one that leaves two
levels of units: with a wrong one, units echo in the row above. The triangle is then in the corner whose halves differ.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate import Array
from app.decoders.plate.fit import PlateFit, finish_fit, fit_coarsely, fit_plate, refit_plate
from app.decoders.plate.pose import marker_centroids
from app.markers.plate import PlateGeometry, unit_index

Grey = Array  # of uint8, shape (H, W)


@dataclass(frozen=True, slots=True)
class WarmSearch:
    """How a thermal frame is searched.

    Chosen on drives of `python -m benchmarks.plates --sets thermal` with seeds 5001 to 5003, for quadrangles within 9 %
    of the plate's corners in few milliseconds.
    """

    min_warmth: float = 6.0  # [grey levels] at which regions are cut out at least
    road_spreads: float = 4.0  # [mean warmth of the frame] the same
    level_factors: tuple[float, ...] = (1.0, 2.0, 4.0)  # of the least level, at which regions are cut out
    closings_px: tuple[int, ...] = (9, 25)  # closings that join warm units: the pitch of units on 16 to 200 px
    road_px: int = 168  # window of the median that is the road's level
    min_extent_px: int = 12  # least width and height of a region: 1.25 pixels a unit on 8 x 8, and blur
    min_fill: float = 0.35  # [1] least share of its box that a region fills
    max_regions: int = 10  # of each polarity, the warmest and largest first. For speed
    max_quads: int = 5  # of a frame. For speed
    same_box: float = 0.12  # [extent] by which the sides of boxes of one region differ
    edge_share: float = 0.5  # [warmth of the region] level of its outline, which a trail moves as a whole
    joined: float = 0.3  # [extent] over which light units are closed
    # [warmth of the region] of all corners, of three of them, and of the road beside a side: of 37 quadrangles on
    # plates the least are 0.43 and 0.55, and the most is 0.19
    min_marker: float = 0.35
    min_square: float = 0.45
    max_beside: float = 0.35
    # side of the patch on which neighbours are compared [px], and the least mean squared step across and along of its
    # variance: smooth warm patches of road have 0.08 to 0.13, plates 0.2 to 0.5
    detail_px: int = 32
    min_detail: float = 0.18


SEARCH = WarmSearch()
TRAILS = (0.0, 0.03, 0.06, 0.09, 0.12, 0.16, 0.21, 0.27, 0.34, 0.43)
"""[rows of the quadrangle] trails that are tried. Source: 6 to 12 ms at 10 to 30 km/h are 17 to 100 mm of 325."""
FIRST_TRAILS = (0.09, 0.0, 0.21)
"""Of these, those under which all geometries are tried. Source: a fit converges with a trail that is wrong by half of
it."""
EDGE_LAG = math.log(2.0)
"""[trails] by which the outline at half of the warmth lags: exp(-x) = 1/2."""
STRETCH_PERCENT = (0.2, 99.8)
"""[%] of the pixels around a plate that become 0 and 255."""
MIN_TWO_LEVEL, CLEAR_TWO_LEVEL = 0.75, 0.9
"""[1] share of the variance of units that two levels explain, from which a fit may be a plate, and from which no other
geometry is tried. Source: an even distribution has 0.75; of fits of plates under wrong geometries, the most is
0.82, and under the right one plates of 18 rows and more have 0.87 to 0.99."""
MIN_COARSE_TWO_LEVEL = 0.6
"""[1] the same share after the coarse stage, below which a fit is not finished: a normal distribution has 0.64."""
MIN_UNIT_ROWS = 1.25
"""[px] height of a unit below which a geometry is not tried. Source: `evidence.MIN_ROWS_ALONE`."""
MARKER_SPREAD = 0.1
"""[contrast] standard deviation of a marker's level about that of the units, beside the spread of the units."""
ORIENTATIONS = np.array([[0, 1, 0, 0, 0], [0, 0, 0.45, 0, 0], [0, 0, 0, 0.45, 0], [0, 0, 0, 0, 0.45]])
"""[contrast] levels of the triangle, of its other half and of the squares where the triangle is in the first corner, or
in another one, clockwise."""
MAX_MARKER_MISFIT = 25.0
"""[1] sum of the five markers' squared deviations, in spreads, from which there is no triangle. Source: chi-squared of
five degrees of freedom, 1e-4."""
ORIENTATION_EVIDENCE = 12.0
"""[log likelihood] by which the best orientation must exceed the next. Effect: `python -m
benchmarks.plates.thresholds`."""


class WarmQuad:
    """A quadrangle that may be a plate's."""

    def __init__(self, inverted: Grey, corners_px: Array) -> None:
        self.inverted = inverted  # the frame, bright where the quadrangle is not
        self.corners_px = corners_px  # shape (4, 2): clockwise in the image
        self.rows_px = float(np.ptp(corners_px[:, 1]))

    def without_trail(self, trail: float) -> Grey:
        """The frame without a trail around the quadrangle. [rows of the quadrangle]"""
        return without_trail(self.inverted, self.corners_px, trail * self.rows_px)


class _TrailFit(NamedTuple):
    """A fit under a geometry and a trail."""

    geometry: PlateGeometry
    trail: float  # [rows of the quadrangle]
    fit: PlateFit
    share: float  # of the variance of the units that two levels explain
    sharp: Grey  # the frame without the trail


class WarmPlate(NamedTuple):
    """A quadrangle that was fitted as a plate."""

    geometry: PlateGeometry
    fit: PlateFit
    # [log likelihood] by which the markers show the triangle in this corner rather than in another one
    orientation_evidence: float


def find_warm_plates(image: Grey, geometries: Sequence[PlateGeometry]) -> Iterator[WarmPlate]:
    """What may be plates in a thermal frame, one in each place."""
    found: list[npt.NDArray[np.float32]] = []
    for quad in detect_warm_quads(image):
        centre = quad.corners_px.mean(axis=0).tolist()
        if any(cv2.pointPolygonTest(known, centre, measureDist=False) > 0 for known in found):
            continue
        plate = _fit_quad(quad, geometries)
        if plate is not None:
            found.append(plate.fit.corners_px.astype(np.float32))
            yield plate


# === The search.


def detect_warm_quads(image: Grey) -> list[WarmQuad]:
    """Quadrangles that are warmer or colder than the road and have four warm corners, the clearest first."""
    height, width = image.shape
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    small = cv2.resize(smooth, (max(width // 8, 1), max(height // 8, 1)), interpolation=cv2.INTER_AREA)
    road = cv2.resize(cv2.medianBlur(small, SEARCH.road_px // 8 | 1), (width, height), interpolation=cv2.INTER_LINEAR)
    found: list[tuple[float, WarmQuad]] = []
    for inverted, warmth in ((cv2.bitwise_not(image), cv2.subtract(smooth, road)), (image, cv2.subtract(road, smooth))):
        half = cv2.resize(warmth, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        for score, box in _regions(half):
            corners_px = _quad_in(warmth, box)
            if corners_px is not None and _is_like_plate(inverted, warmth, corners_px):
                found.append((score, WarmQuad(inverted, corners_px)))
    return [quad for _score, quad in sorted(found, key=lambda one: -one[0])[: SEARCH.max_quads]]


def _regions(half: Grey) -> list[tuple[float, tuple[int, int, int, int]]]:
    """Boxes of warm regions (left, top, right, bottom) with scores, of about the same boxes the first only."""
    height, width = half.shape
    spread = float(half[::4, ::4].mean())  # of the road: half of its mean absolute deviation
    found = []
    for level in (max(SEARCH.min_warmth, SEARCH.road_spreads * spread) * factor for factor in SEARCH.level_factors):
        mask = cv2.threshold(half, level, 1, cv2.THRESH_BINARY)[1]
        for closing_px in SEARCH.closings_px:
            closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((closing_px // 2 | 1,) * 2, np.uint8))
            boxes = cv2.connectedComponentsWithStats(closed, connectivity=8, ltype=cv2.CV_16U)[2][1:]
            wide, tall, area = boxes[:, 2], boxes[:, 3], boxes[:, 4]
            is_large = np.minimum(wide, tall) >= SEARCH.min_extent_px // 2
            is_part = (wide < 0.7 * width) & (tall < 0.7 * height)
            for x, y, w, h, _area in boxes[is_large & is_part & (area > SEARCH.min_fill * wide * tall)].tolist():
                score = cv2.mean(half[y : y + h, x : x + w])[0] * math.sqrt(w * h)
                found.append((score, (2 * x, 2 * y, 2 * (x + w), 2 * (y + h))))
    kept: list[tuple[float, tuple[int, int, int, int]]] = []
    for score, box in sorted(found, reverse=True):
        reach = SEARCH.same_box * max(box[2] - box[0], box[3] - box[1])
        if all(max(abs(a - b) for a, b in zip(box, other, strict=True)) > reach for _score, other in kept):
            kept.append((score, box))
    return kept[: SEARCH.max_regions]


def _quad_in(warmth: Grey, box: tuple[int, int, int, int]) -> Array | None:
    """Corners of the quadrangle around the region in a box at half of its warmth, clockwise; None where it has none."""
    x0, y0, x1, y1 = box
    pad = max(4, (x1 - x0) // 10, (y1 - y0) // 10)
    left, top = max(x0 - pad, 0), max(y0 - pad, 0)
    level = SEARCH.edge_share * _peak(warmth[y0:y1, x0:x1])
    mask = cv2.threshold(warmth[top : y1 + pad, left : x1 + pad], level, 1, cv2.THRESH_BINARY)[1]
    wide, tall = (max(3, int(SEARCH.joined * extent)) | 1 for extent in (x1 - x0, y1 - y0))
    mask = cv2.copyMakeBorder(mask, tall, tall, wide, wide, cv2.BORDER_CONSTANT, value=0)
    closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((tall, wide), np.uint8))
    contours = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=(left - wide, top - tall))[0]
    if not contours:
        return None
    hull = cv2.convexHull(max(contours, key=cv2.contourArea))
    if len(hull) < 4 or min(np.ptp(hull[:, 0], axis=0)) < SEARCH.min_extent_px:
        return None
    corners = cv2.approxPolyN(hull, 4, ensure_convex=True).reshape(-1, 2).astype(float)
    if len(corners) != 4:
        return None
    following = np.roll(corners, -1, axis=0)
    area2 = float(np.sum(corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]))
    return corners if area2 > 0 else corners[::-1].copy()


def _peak(warmth: Grey) -> float:
    """Warmth of the warmest tenth of a region. [grey levels]"""
    counts = np.cumsum(np.bincount(warmth.reshape(-1), minlength=256))
    return float(np.searchsorted(counts, 0.9 * counts[-1]))


def _is_like_plate(inverted: Grey, warmth: Grey, corners_px: Array) -> bool:
    """Whether all corners of a quadrangle are warm, as markers are, the road beside it cool, and units between them."""
    x0, y0 = np.maximum(corners_px.min(axis=0), 0).astype(int)
    x1, y1 = corners_px.max(axis=0).astype(int)
    peak = _peak(warmth[y0:y1, x0:x1])
    image_from_unit = _from_unit_square(corners_px)
    across, along = cv2.perspectiveTransform(_SAMPLES, image_from_unit)[0].T.astype(np.float32)
    levels = cv2.remap(warmth, across, along, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE).reshape(-1) / peak
    markers = np.sort(levels[: 4 * 9].reshape(4, 9).mean(axis=1))
    sides = levels[4 * 9 :].reshape(4, 4).mean(axis=1)
    if markers[0] < SEARCH.min_marker or markers[1] < SEARCH.min_square or sides.max() > SEARCH.max_beside:
        return False
    matrix = image_from_unit @ np.diag([1 / SEARCH.detail_px, 1 / SEARCH.detail_px, 1])
    size = (SEARCH.detail_px, SEARCH.detail_px)
    patch = cv2.warpPerspective(inverted, matrix, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    steps = sum(float(np.square(np.diff(patch.astype(np.float32), axis=axis)).mean()) for axis in (0, 1))
    return steps > SEARCH.min_detail * float(patch.var())


def _from_unit_square(corners_px: Array) -> Array:
    """Homography from the plate to the image."""
    unit = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
    matrix: Array = cv2.getPerspectiveTransform(unit, corners_px.astype(np.float32))
    return matrix


def _sample_places() -> npt.NDArray[np.float32]:
    """Nine points on each marker of 8 x 8, and four beside each side, shape (1, 52, 2). [plate sides]"""
    steps = (-0.05, 0.0, 0.05)
    markers = [(x + i, y + k) for x in (0.125, 0.875) for y in (0.125, 0.875) for i in steps for k in steps]
    along = (0.15, 0.4, 0.6, 0.85)
    beside = [*((t, -0.2) for t in along), *((t, 1.2) for t in along), *((-0.2, t) for t in along)]
    return np.array([[*markers, *beside, *((1.2, t) for t in along)]], np.float32)


_SAMPLES = _sample_places()


# === The fit: geometry, trail, orientation.


def _fit_quad(quad: WarmQuad, geometries: Sequence[PlateGeometry]) -> WarmPlate | None:
    """The fit of a quadrangle under the geometry and the trail that leave two levels of units; None for no plate."""
    best = _first_fit(quad, geometries)
    if best is None or best.share < MIN_TWO_LEVEL:
        return None
    place = TRAILS.index(best.trail)
    shares = {place: best.share}
    for step in (-1, 1):
        while 0 <= place + step < len(TRAILS):
            other = _refit(quad, best, TRAILS[place + step])
            shares[place + step] = 0.0 if other is None else other.share
            if other is None or other.share <= best.share:
                break
            best, place = other, place + step
    if place - 1 in shares and place + 1 in shares:
        between = _refit(quad, best, _vertex(TRAILS[place - 1 : place + 2], [shares[place + k] for k in (-1, 0, 1)]))
        best = best if between is None else between
    return _turned(best)


def _refit(quad: WarmQuad, best: _TrailFit, trail: float) -> _TrailFit | None:
    """The fit with another trail."""
    sharp = quad.without_trail(trail)
    fit = refit_plate(sharp, best.fit, best.geometry, linear=True)
    return None if fit is None else _TrailFit(best.geometry, trail, fit, two_level_share(fit), sharp)


def _vertex(places: Sequence[float], values: Sequence[float]) -> float:
    """Where the parabola through three points, of which the middle one is highest, has its vertex."""
    (a, b, c), (u, v, w) = places, values
    right, left = (b - a) * (v - w), (b - c) * (v - u)
    return b - 0.5 * ((b - a) * right - (b - c) * left) / max(right - left, 1e-12)


def _first_fit(quad: WarmQuad, geometries: Sequence[PlateGeometry]) -> _TrailFit | None:
    """The fit whose units have the clearest levels, of those with a few trails under all geometries.

    The coarse fits decide; only a few of them are finished.
    """
    best: _TrailFit | None = None
    most = MIN_COARSE_TWO_LEVEL
    possible = [geometry for geometry in geometries if quad.rows_px > MIN_UNIT_ROWS * geometry.n]
    for trail in FIRST_TRAILS:
        lag_px = np.array((0.0, EDGE_LAG * trail * quad.rows_px))
        sharp = quad.without_trail(trail)
        for geometry in possible:
            coarse = fit_coarsely(sharp, _centroids(quad.corners_px + lag_px, geometry), geometry, linear=True)
            if coarse is None:
                continue
            share = _best_division(np.sort(coarse.model.values[: unit_index(geometry.n).size]))[0]
            if share < most:
                continue
            fit = finish_fit(sharp, coarse, geometry, linear=True)
            if fit is not None and (best is None or two_level_share(fit) > best.share):
                best, most = _TrailFit(geometry, trail, fit, two_level_share(fit), sharp), share
                if best.share > CLEAR_TWO_LEVEL:
                    return best
    return best


def _turned(found: _TrailFit) -> WarmPlate | None:
    """The fit with the triangle in the corner whose halves differ most; None where no corner has it.

    Between the levels of the dark units, 0, and of the light ones, 1, a square has a value of 0, the triangle 0 and the
    other half of its cell 1; a cell with the triangle that is fitted as a square has about a half.
    """
    fit, geometry = found.fit, found.geometry
    for _ in range(2):
        markers, spread = _marker_levels(fit)
        misfits = np.array([((markers - expected) ** 2).sum() for expected in ORIENTATIONS]) / spread**2
        best = int(misfits.argmin())
        if best == 0:
            is_plate = misfits[0] < MAX_MARKER_MISFIT
            return WarmPlate(geometry, fit, float(misfits[1:].min() - misfits[0]) / 2) if is_plate else None
        turned_px = np.roll(_centroids(fit.corners_px, geometry), -best, axis=0)
        turned = fit_plate(found.sharp, turned_px, geometry, linear=True)
        if turned is None:
            return None
        fit = turned
    return WarmPlate(geometry, fit, 0.0)


def _marker_levels(fit: PlateFit) -> tuple[Array, float]:
    """Triangle, its other half and squares between the dark units' level (0) and the light one (1); their spread."""
    levels = _unit_levels(fit)
    split = _best_division(levels)[1]
    dark, light = float(levels[:split].mean()), float(levels[split:].mean())
    within = split * levels[:split].var() + (len(levels) - split) * levels[split:].var()
    spread = math.sqrt(within / len(levels)) / max(light - dark, 1e-9)
    return (fit.markers - dark) / max(light - dark, 1e-9), math.hypot(spread, MARKER_SPREAD)


def two_level_share(fit: PlateFit) -> float:
    """Share of the variance of the units that two levels explain, at the best division."""
    return _best_division(_unit_levels(fit))[0]


def _unit_levels(fit: PlateFit) -> Array:
    """The units' light in ascending order."""
    levels: Array = np.sort(fit.units.reshape(-1)[unit_index(fit.units.shape[0]).reshape(-1)])
    return levels


def _best_division(levels: Array) -> tuple[float, int]:
    """Share of the variance of ascending levels that two of them explain, and how many belong to the lower one."""
    below = np.arange(1, len(levels))
    sums = np.cumsum(levels)
    apart = sums[:-1] / below - (sums[-1] - sums[:-1]) / (len(levels) - below)
    between = apart**2 * below * (len(levels) - below) / len(levels)
    best = int(between.argmax())
    return float(between[best] / max(len(levels) * levels.var(), 1e-12)), best + 1


def without_trail(image: Grey, corners_px: Array, trail_px: float) -> Grey:
    """A frame without the trail that a slow sensor draws around a plate; the rest of the frame stays as it is.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W)
    corners_px : ndarray, shape (4, 2)
        Of the plate.
    trail_px : float
        Time constant of the sensor times the speed in the image. [px]

    Notes
    -----
    The temperature T of a bolometer's pixel follows the scene S with the time constant tau: tau dT/dt = S - T. In the
    image of a scene that moves down by v pixels a second, dT/dt = -v dT/dy, so that S = T - tau v dT/dy. The result is
    stretched over the 256 levels.
    """
    low, high = corners_px.min(axis=0), corners_px.max(axis=0)
    pad = 0.3 * (high - low) + 6 + (0.0, trail_px)
    x0, y0 = np.clip(low - pad, 0, None).astype(int).tolist()
    x1, y1 = (high + pad).astype(int).tolist()
    seen = image[y0:y1, x0:x1].astype(np.float32)
    if min(seen.shape) < 2:
        return image
    sharp = seen + np.float32(trail_px) * (seen - np.vstack([seen[1:], seen[-1:]]))
    least, most = np.percentile(sharp, STRETCH_PERCENT)
    result = image.copy()
    result[y0:y1, x0:x1] = np.clip((sharp - least) * (255 / max(most - least, 1.0)), 0, 255).astype(np.uint8)
    return result


def _centroids(corners_px: Array, geometry: PlateGeometry) -> Array:
    """Centroids of the markers as if all four were squares, shape (4, 2). [px]"""
    near = float(marker_centroids(geometry)[3, 0])
    square = np.array([(near, near), (1 - near, near), (1 - near, 1 - near), (near, 1 - near)], np.float32)
    centroids: Array = cv2.perspectiveTransform(square[None], _from_unit_square(corners_px))[0].astype(float)
    return centroids
