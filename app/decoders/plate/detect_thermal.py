"""Heated plates in a thermal frame: warm quadrangles on a cooler road.

There are no colours to find the triangle's corner by: each candidate is fitted in its four possible orientations, and
the one that explains most of the pixels' variance is taken.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from app.decoders.plate import Array
from app.decoders.plate.fit import PlateFit, fit_plate
from app.decoders.plate.pose import marker_centroids
from app.markers.plate import PlateGeometry

TRAILS_PX = (0.0, 1.0, 2.0, 3.0, 4.5, 6.0, 8.0, 11.0)
"""[px] trails that are tried. Source: 6 to 12 ms at 10 to 30 km/h are 17 to 100 mm, that is 0.8 to 12 px on plates of
16 to 40 rows."""
FIRST_TRAILS = (3, 0, 6)
"""Of these, by their places, those in which plates are searched for."""
CLEAR_EXPLAINED = 0.85
"""[1] share of the variance from which a fit is a plate, and no other one is searched for in its place."""
STRETCH_PERCENT = (0.005, 99.995)
"""[%] of the pixels of a sharpened frame that become 0 and 255."""
MAX_QUADS = 8
"""[candidates] of a frame. For speed."""
MIN_EXTENT_PX = 8.0
"""[px] least width and height of a warm region. Source: one pixel a unit on 8 x 8."""
MIN_FILL, MAX_FILL = 0.45, 1.6
"""[1] share of a quadrangle that the hull of its warm region fills at least, and at most."""
MIN_CONTOUR, MIN_AREA_PX2 = 12, 40
"""[points, px^2] least length and area of a warm region's outline."""
MIN_CONTRAST = 6.0
"""[grey levels] least warmth above the road."""
SAME_PLACE, SAME_SIZE = 0.1, 0.2
"""[extent, 1] distance and relative difference in size of quadrangles that are one."""
SHARES = (0.3, 0.5)
"""[strongest warmth] levels at which regions are cut out."""
CLOSINGS = (1, 3, 7, 15, 27)
"""[px] diameters of the closings that join warm units. About the pitch of units on plates of 16 to 200 px."""
ORIENTATION_EVIDENCE = 12.0
"""[log likelihood] by which the best orientation must exceed the next. Effect: `python -m
benchmarks.plates.thresholds`."""
MIN_MISFIT_RATIO = 1.3
"""[1] unexplained variance of the next orientation over that of the best: errors of pixels are not independent. Source:
four wrong frames of one drive in `python -m benchmarks.plates --sets thermal`, seed 75 (docs/benchmarks.md)."""


class WarmFrame:
    """A thermal frame, and by the place of each trail the frame without it and its warm quadrangles, made once."""

    def __init__(self, image: Array) -> None:
        self._image = image
        self._inverted: dict[int, Array] = {}
        self._quads: dict[int, list[Array]] = {}

    def inverted(self, trail: int) -> Array:
        """The frame without a trail, bright where it was cool."""
        if trail not in self._inverted:
            self._inverted[trail] = cv2.bitwise_not(without_trail(self._image, TRAILS_PX[trail]))
        return self._inverted[trail]

    def quads(self, trail: int) -> list[Array]:
        """Warm quadrangles in the frame without a trail."""
        if trail not in self._quads:
            self._quads[trail] = detect_warm_quads(cv2.bitwise_not(self.inverted(trail)))
        return self._quads[trail]


def fit_warm_plates(frame: WarmFrame, geometry: PlateGeometry) -> Iterator[list[PlateFit]]:
    """Fits of each warm quadrangle on the inverted frame, one per orientation, the best first.

    The sensor's trail is taken off by as much as explains most of the pixels around the quadrangle.
    """
    clear: list[Array] = []
    for trail in FIRST_TRAILS:
        for corners in frame.quads(trail):
            centre = corners.mean(axis=0).tolist()
            if any(cv2.pointPolygonTest(known, centre, measureDist=False) > 0 for known in clear):
                continue
            fits = _fit_turned(frame.inverted(trail), corners, geometry)
            if not fits:
                continue
            better = _best_trail(frame, trail, fits[0], geometry)
            if better != trail:
                fits = _fit_turned(frame.inverted(better), fits[0].corners_px, geometry) or fits
            if fits[0].explained > CLEAR_EXPLAINED:
                clear.append(fits[0].corners_px.astype(np.float32))
            yield fits


def orientation_evidence(fits: Sequence[PlateFit]) -> float:
    """Log likelihood by which the best orientation exceeds the next; 0 where their misfits are about the same."""
    second = fits[1].explained if len(fits) > 1 else 0.0
    ratio = (1 - second) / max(1 - fits[0].explained, 1e-6)
    return 0.5 * fits[0].pixels * float(np.log(ratio)) if ratio >= MIN_MISFIT_RATIO else 0.0


def _fit_turned(inverted: Array, corners: Array, geometry: PlateGeometry) -> list[PlateFit]:
    """Fits in the four orientations, the best first."""
    centroids = _centroids(corners, geometry)
    turned = (fit_plate(inverted, np.roll(centroids, turn, axis=0), geometry, linear=True) for turn in range(4))
    return sorted((fit for fit in turned if fit is not None), key=lambda fit: -fit.explained)


def _best_trail(frame: WarmFrame, trail: int, fit: PlateFit, geometry: PlateGeometry) -> int:
    """The trail beside the given one, by its place, that explains most of a plate in the orientation of its fit."""
    centroids = _centroids(fit.corners_px, geometry)
    explained = fit.explained
    for step in (1, -1):
        while 0 <= trail + step < len(TRAILS_PX):
            other = fit_plate(frame.inverted(trail + step), centroids, geometry, linear=True)
            if other is None or other.explained <= explained:
                break
            trail, explained = trail + step, other.explained
    return trail


def without_trail(image: Array, trail_px: float) -> Array:
    """A frame without the trail that a slow sensor draws behind what moves down through the image.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W)
    trail_px : float
        Time constant of the sensor times the speed in the image. [px]

    Notes
    -----
    The temperature T of a bolometer's pixel follows the scene S with the time constant tau: tau dT/dt = S - T. In the
    image of a scene that moves down by v pixels a second, dT/dt = -v dT/dy, so that S = T - tau v dT/dy. The result is
    stretched over the 256 levels.
    """
    if trail_px == 0:
        return image
    seen = image.astype(np.float32)
    below = np.vstack([seen[1:], seen[-1:]])
    sharp = seen + np.float32(trail_px) * (seen - below)
    low, high = np.percentile(sharp, STRETCH_PERCENT)
    return np.asarray(np.clip((sharp - low) * (255 / max(high - low, 1.0)), 0, 255), np.uint8)


def _centroids(corners_px: Array, geometry: PlateGeometry) -> Array:
    """Centroids of the markers as if all four were squares, shape (4, 2). [px]"""
    near = float(marker_centroids(geometry)[3, 0])
    square = np.array([(near, near), (1 - near, near), (1 - near, 1 - near), (near, 1 - near)], np.float32)
    unit = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
    homography = cv2.getPerspectiveTransform(unit, corners_px.astype(np.float32))
    centroids: Array = cv2.perspectiveTransform(square[None], homography)[0].astype(float)
    return centroids


def detect_warm_quads(image: Array) -> list[Array]:
    """Corners of warm quadrangles, clockwise in the image, shape (4, 2) each. [px]"""
    height, width = image.shape
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32)
    reach = max(height, width) // 3 | 1
    small = cv2.resize(smooth, (max(width // 8, 1), max(height // 8, 1)), interpolation=cv2.INTER_AREA)
    level = cv2.medianBlur(np.clip(small, 0, 255).astype(np.uint8), min(reach // 8 | 1, 31))
    warmth = smooth - cv2.resize(level, (width, height), interpolation=cv2.INTER_LINEAR)
    strongest = float(warmth.max())
    quads: list[tuple[float, Array]] = []
    if strongest < MIN_CONTRAST:
        return []
    for share in SHARES:
        mask = (warmth > max(share * strongest, MIN_CONTRAST / 2)).astype(np.uint8)
        for size in CLOSINGS:
            kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
            closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, kernel) if size > 1 else mask
            for contour in cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]:
                quad = _quad_around(contour)
                if quad is not None:
                    quads.append(quad)
    return _distinct(quads)


def _quad_around(contour: Array) -> tuple[float, Array] | None:
    """Quadrangle around a region with its score, the larger and more solid the better; None where there is none."""
    extent = np.ptp(contour[:, 0], axis=0)
    if extent.min() < MIN_EXTENT_PX or len(contour) < MIN_CONTOUR:
        return None
    hull = cv2.convexHull(contour)
    area = cv2.contourArea(hull)
    if len(hull) < 4 or area < MIN_AREA_PX2:
        return None
    corners = cv2.approxPolyN(hull, 4, ensure_convex=True).reshape(-1, 2).astype(float)
    if len(corners) != 4:
        return None
    fill = area / max(cv2.contourArea(corners.astype(np.float32)), 1.0)
    if not MIN_FILL < fill < MAX_FILL:
        return None
    if _signed_area2(corners) < 0:
        corners = corners[::-1]
    solid = cv2.contourArea(contour) / area
    return float(np.sqrt(area)) * solid, corners


def _signed_area2(corners: Array) -> float:
    """Twice the signed area of a polygon, positive when its corners are clockwise in the image. [px^2]"""
    following = np.roll(corners, -1, axis=0)
    return float(np.sum(corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]))


def _distinct(quads: list[tuple[float, Array]]) -> list[Array]:
    """The best quadrangles, of those in about one place and size the best only."""
    kept: list[Array] = []
    for _, corners in sorted(quads, key=lambda item: -item[0]):
        size = np.ptp(corners, axis=0).max()
        if all(np.abs(corners.mean(axis=0) - k.mean(axis=0)).max() > SAME_PLACE * size or
               abs(np.ptp(k, axis=0).max() / size - 1) > SAME_SIZE for k in kept):  # fmt: skip
            kept.append(corners)
    return kept[:MAX_QUADS]
