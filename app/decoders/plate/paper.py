"""Algorithm 1 of the PolyU paper (``method="paper"``): the peer in our tables, on single colour frames.

Source: Wang et al., IEEE T-ITS 23(11), 2022, section II-D. The paper crops a frame to the box of a detector that it
trained (YOLOv5); here the boxes are those of our candidates. Where there is none, boxes around coloured blobs that lie
together stand in, so that what is cut off or hidden is rejected by name. It gives no values for its thresholds; those
here were chosen on the trials with seed 6001.

A dark unit is 1. The paper contradicts itself (docs/benchmarks.md): lines 21 to 24 of its listing have white = 1, the
text of section II-D4 has black = 1. Only with black = 1 do the units of its figures show the digits that it prints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate import Array
from app.decoders.plate.detect_blobs import (
    AREA,
    PEAK,
    X0,
    X1,
    Y0,
    Y1,
    MarkerSignal,
    difference_signal,
    find_blobs,
    half_planes,
)
from app.decoders.plate.find_candidates import find_candidates
from app.decoders.plate.pose import marker_centroids, with_pose
from app.errors import InvalidParameter
from app.markers.plate import PlateGeometry, decimal_codes, unit_index
from app.markers.reading import PlateOutcome, PlateReading
from app.sensors.camera import Camera

Frame = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.uint8]

GEOMETRY = PlateGeometry()
"""The paper's plate: 8 x 8 units, decimal digits."""
GREEN_RANGE_DEG, RED_RANGE_DEG = 120.0, 60.0
"""[deg] alpha of equations 1 and 2: width of the range of hues around 120 and 0."""
MIN_SATURATION, MIN_VALUE = 0.18, 0.1
"""[1] beta and gamma of the same equations."""
DARK_SHARE = 0.5
"""[1] epsilon: mean of a unit's binary pixels above which it is dark."""
MIN_AREA_PX = 4
"""[px] of an open area: smaller ones are noise."""
SQUARE_PX = 300
"""[px] side of the square image. Source: section II-D3."""
HARRIS_BLOCK, HARRIS_APERTURE, HARRIS_K, HARRIS_SHARE = 2, 3, 0.04, 0.01
"""Window [px], Sobel aperture [px] and k of Harris and Stephens, and the share of the strongest response from which a
pixel is a corner."""
MAX_VERTEX_PX = 2.0
"""[px] of a vertex from the marker that it is of, beyond which it is not that of a marker."""
BOX_PAD = 0.03
"""[extent] around a plate that a detector's box leaves."""
MAX_BOXES = 4
"""[boxes] of a frame."""
REACH = 7.0
"""[extents of a blob] within which another one may be of the same plate: a plate's sides are 5.3 markers long."""
CONFIDENCE = 0.5
"""[probability] of every reading: the paper gives none."""
VERTEX_SIGMA_PX = 1.0
"""[px] standard deviation of a vertex: it is a pixel."""
ALREADY_READ = 0.5
"""[box] share of a box that one that was tried before covers, from which on it is not tried."""


def decode_plates_paper(image: Frame, *, camera: Camera | None = None) -> list[PlateReading]:
    """Plates in a colour frame as the paper reads them.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3)
        Blue, green, red.
    camera : Camera, optional
        Gives every reading a pose.

    Returns
    -------
    list of PlateReading
        Read plates first; rejected boxes follow with the paper's reason, and a confidence of 0.

    Raises
    ------
    InvalidParameter
        The image is not of this type.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < 2 * MIN_AREA_PX:
        raise InvalidParameter(
            f"a frame is uint8 (H, W, 3) blue, green, red, not {image.dtype} {image.shape}", field="image"
        )
    readings = [with_pose(decode_box(image, box), camera) for box in _distinct(_boxes(image))]
    return sorted(readings, key=lambda reading: reading.code is None)


# === Boxes, in place of the paper's detector.


def _boxes(image: Frame) -> Iterator[tuple[int, int, int, int]]:
    """Left, top, right, bottom of boxes that may hold a plate, the likeliest first. [px]"""
    found = False
    for _signal, candidates in find_candidates(half_planes(image), (GEOMETRY,)):
        for candidate in candidates:
            found = True
            source = marker_centroids(GEOMETRY).astype(np.float32)
            matrix = cv2.getPerspectiveTransform(source, candidate.quad.centroids_px.astype(np.float32))
            unit = np.array([[(0, 0), (1, 0), (1, 1), (0, 1)]], np.float32)
            corners_px = cv2.perspectiveTransform(unit, matrix)[0]
            yield _padded(image, corners_px.min(axis=0), corners_px.max(axis=0))
        if found:
            return
    yield from _blob_boxes(image, difference_signal(half_planes(image)))


def _blob_boxes(image: Frame, signal: MarkerSignal) -> Iterator[tuple[int, int, int, int]]:
    """Boxes around two or more coloured blobs of about one size that lie together, the strongest first."""
    blobs = find_blobs(signal)
    blobs = blobs[np.argsort(-blobs[:, PEAK] * np.sqrt(blobs[:, AREA]), kind="stable")][:40]
    for blob in blobs:
        extent = max(blob[X1] - blob[X0], blob[Y1] - blob[Y0]) + 1
        gap = np.maximum(
            np.maximum(blobs[:, X0] - blob[X1], blob[X0] - blobs[:, X1]),
            np.maximum(blobs[:, Y0] - blob[Y1], blob[Y0] - blobs[:, Y1]),
        )
        alike = (blobs[:, AREA] > blob[AREA] / 4) & (blobs[:, AREA] < 4 * blob[AREA])
        near = blobs[alike & (gap < REACH * extent)]
        apart = near[(np.abs(near[:, X0] - blob[X0]) > extent) | (np.abs(near[:, Y0] - blob[Y0]) > extent)]
        if len(apart):
            low = np.minimum(near[:, (X0, Y0)].min(axis=0), blob[[X0, Y0]]) * signal.scale
            high = (np.maximum(near[:, (X1, Y1)].max(axis=0), blob[[X1, Y1]]) + 1) * signal.scale
            yield _padded(image, low, high)


def _padded(image: Frame, low: Array, high: Array) -> tuple[int, int, int, int]:
    pad = BOX_PAD * (high - low) + 1
    left, top = np.maximum(low - pad, 0).astype(int).tolist()
    right, bottom = np.minimum(high + pad + 1, image.shape[1::-1]).astype(int).tolist()
    return left, top, right, bottom


def _distinct(boxes: Iterator[tuple[int, int, int, int]]) -> list[tuple[int, int, int, int]]:
    """The first boxes, without those that one before mostly covers."""
    kept: list[tuple[int, int, int, int]] = []
    for box in boxes:
        left, top, right, bottom = box
        shared = (max(min(right, r) - max(left, x), 0) * max(min(bottom, b) - max(top, y), 0) for x, y, r, b in kept)
        if min(right - left, bottom - top) >= 2 * MIN_AREA_PX and all(
            area < ALREADY_READ * (right - left) * (bottom - top) for area in shared
        ):
            kept.append(box)
            if len(kept) == MAX_BOXES:
                break
    return kept


# === Algorithm 1.


def decode_box(image: Frame, box: tuple[int, int, int, int]) -> PlateReading:
    """The digits in a box, or the scenario in which the paper filters it out (the list at the end of II-D4)."""
    left, top, right, bottom = box
    crop = image[top:bottom, left:right]
    corners_px = np.array([(left, top), (right, top), (right, bottom), (left, bottom)], float) - 0.5
    rejected = PlateReading(
        PlateOutcome.CELLS_UNDECODABLE, corners_px, geometry=GEOMETRY, width_px=float(right - left),
        height_px=float(bottom - top),
    )  # fmt: skip
    greens, reds = find_markers(crop)
    if len(greens) < 3:
        reason = f"{len(greens)} of 3 green boundary markers are in the box"
        return replace(rejected, outcome=PlateOutcome.GREEN_MARKER_MISSING, reason=reason)
    if not reds:
        reason = "no red boundary marker is in the box"
        return replace(rejected, outcome=PlateOutcome.RED_MARKER_MISSING, reason=reason)
    markers = [reds[0], *greens]
    vertices = find_vertices(markers)
    if len(vertices) < 4:
        reason = f"{len(vertices)} of 4 vertices are among the corners of the boundary markers"
        return replace(rejected, outcome=PlateOutcome.FEWER_THAN_FOUR_VERTICES, reason=reason)
    owners = [_marker_at(markers, vertex) for vertex in vertices]
    if sorted(owners) != [0, 1, 2, 3]:
        reason = "the four vertices are not one on each boundary marker"
        return replace(rejected, outcome=PlateOutcome.VERTICES_BEYOND_MARKERS, reason=reason)
    vertices = np.roll(vertices, -owners.index(0), axis=0)  # the red marker is where the reading starts
    code = next(iter(decimal_codes(_symbols(crop, vertices), GEOMETRY.n)), None)
    corners_px = _plate_corners(vertices) + np.array((left, top))
    extent_px = np.ptp(corners_px, axis=0)
    found = replace(rejected, corners_px=corners_px, width_px=float(extent_px[0]), height_px=float(extent_px[1]))
    if code is None:
        return replace(found, reason="a cell shows no decimal digit")
    return replace(
        found, outcome=PlateOutcome.READ, code=code, confidence=CONFIDENCE,
        corners_covariance_px2=VERTEX_SIGMA_PX**2 * np.eye(8),
        cell_confidence=(CONFIDENCE ** (1 / len(code.digits)),) * len(code.digits),
    )  # fmt: skip


def find_markers(crop: Frame) -> tuple[list[Mask], list[Mask]]:
    """The three largest green open areas and the largest red one, as masks of the crop (lines 1 to 17)."""
    hue, saturation, value = cv2.split(cv2.cvtColor(crop.astype(np.float32) / 255, cv2.COLOR_BGR2HSV))
    coloured = (saturation >= MIN_SATURATION) & (value >= MIN_VALUE)
    is_green = coloured & (np.abs(hue - 120) <= GREEN_RANGE_DEG / 2)
    is_red = coloured & (np.minimum(hue, 360 - hue) <= RED_RANGE_DEG / 2)
    return _largest(is_green, 3), _largest(is_red, 1)


def _largest(mask: npt.NDArray[np.bool_], count: int) -> list[Mask]:
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    areas = boxes[1:, cv2.CC_STAT_AREA]
    order = np.argsort(-areas, kind="stable")[:count]
    return [(labels == k + 1).astype(np.uint8) for k in order.tolist() if areas[k] >= MIN_AREA_PX]


def find_vertices(markers: Sequence[Mask]) -> Array:
    """The corners of the markers that are nearest to the corners of the crop, clockwise (line 18, equation 3).

    Returns
    -------
    ndarray, shape (V, 2)
        Column and row [px]; fewer than four where two corners of the crop have the same nearest one.
    """
    binary = np.clip(np.sum(markers, axis=0), 0, 1).astype(np.float32)
    height, width = binary.shape
    padded = cv2.copyMakeBorder(binary, 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=0)
    response = cv2.cornerHarris(padded, HARRIS_BLOCK, HARRIS_APERTURE, HARRIS_K)[2:-2, 2:-2]
    rows, columns = np.nonzero((response > HARRIS_SHARE * response.max()) & (binary > 0))
    candidates = np.column_stack([columns, rows]).astype(float)
    if not len(candidates):
        return np.empty((0, 2))
    targets = np.array([(0, 0), (width, 0), (width, height), (0, height)], float)
    nearest = [int(np.linalg.norm(candidates - target, axis=1).argmin()) for target in targets]
    found: Array = candidates[list(dict.fromkeys(nearest))]
    return found


def _marker_at(markers: Sequence[Mask], vertex: Array) -> int:
    """Place of the marker that has a vertex; -1 for none."""
    for place, marker in enumerate(markers):
        rows, columns = np.nonzero(marker)
        if len(rows) and np.hypot(columns - vertex[0], rows - vertex[1]).min() <= MAX_VERTEX_PX:
            return place
    return -1


def _symbols(crop: Frame, vertices: Array) -> tuple[int, ...]:
    """Symbols of the cells in the square image: units whose pixels are mostly dark are 1 (lines 19 to 25)."""
    square = np.array([(0, 0), (SQUARE_PX, 0), (SQUARE_PX, SQUARE_PX), (0, SQUARE_PX)], np.float32)
    matrix = cv2.getPerspectiveTransform(vertices.astype(np.float32), square)
    grey = cv2.cvtColor(cv2.warpPerspective(crop, matrix, (SQUARE_PX, SQUARE_PX)), cv2.COLOR_BGR2GRAY)
    binary = cv2.threshold(grey, 0, 1, cv2.THRESH_BINARY_INV | cv2.THRESH_OTSU)[1].astype(np.float32)
    shares = cv2.resize(binary, (GEOMETRY.n, GEOMETRY.n), interpolation=cv2.INTER_AREA).reshape(-1)
    bits = shares[unit_index(GEOMETRY.n)] > DARK_SHARE
    return tuple(int(s) for s in bits @ np.array([8, 4, 2, 1]))


def _plate_corners(vertices: Array) -> Array:
    """Corners of the plate's outer edge, a gap outside of the markers' vertices, shape (4, 2). [px]"""
    gap = GEOMETRY.gap_mm / GEOMETRY.side_mm
    inner = np.array([(gap, gap), (1 - gap, gap), (1 - gap, 1 - gap), (gap, 1 - gap)], np.float32)
    matrix = cv2.getPerspectiveTransform(inner, vertices.astype(np.float32))
    corners: Array = cv2.perspectiveTransform(np.array([[(0, 0), (1, 0), (1, 1), (0, 1)]], np.float32), matrix)[0]
    return corners.astype(float)
