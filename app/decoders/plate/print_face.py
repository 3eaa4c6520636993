"""The face of a printed plate from a photo: rectified, in even light, its units and their edges measured.

Face coordinates are millimetres to the right and down from the plate's upper left corner.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate.pose import unit_shapes
from app.markers.plate import PlateGeometry
from app.values import Floats, Floats32

PX_PER_MM = 2.0
"""[px/mm] of the rectified face. A gap of 2 mm has four pixels."""
CENTRE_SHARE = 0.5
"""[units] side of the part of a unit whose median is its reflectance. A displaced, larger or blurred unit still fills
it."""
MIN_EDGE_CONTRAST = 0.25
"""[contrast] of a unit and the gap, below which the edge between them is not measured. One of the two paints always has
twice of it."""
MERGED = 0.5
"""[1] share of units that touch a neighbour from which the gaps count as closed."""
CLIPPED_LEVEL = 251
"""[grey level] from which a pixel counts as over-exposed. JPEG moves 255 by a few levels."""
_LUMA = np.array([0.0722, 0.7152, 0.2126], np.float32)
"""Luminance of linear blue, green, red. Source: IEC 61966-2-1 with ITU-R BT.709."""
_DARK_WEIGHT = 0.2  # of dark units in the estimate of the light: stray light makes them brighter
_HUBER = 0.05  # [natural log] residual from which a unit counts less in the light
_LIGHT_STEPS = 12  # of reweighted least squares; it settles after six
_MAX_LIGHTS_FOR_LINEAR = 9  # light units up to which the light is linear
_EDGE_REACH = 0.6  # [units] beyond a gap in which an edge is looked for
_STEEPEST = 99.0  # percentile of the slopes; edges of 0.3 mm cover more than a hundredth
_MAX_OFF = 0.55  # [units] of an edge from its place; more leaves the unit's centre uncovered
_REFINEMENTS = 2  # of the homography by the units' edges
_MIN_CENTRES = 8  # measured units that refine the homography
_MAX_OFF_MM = 1.5  # [mm] of a unit that counts as in its place in the homography


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredFace:
    """A plate's face as it was printed."""

    reflectance: Floats32  # float32, shape (H, W, 3): linear, relative to the light units; blue, green, red
    image_from_face: Floats  # shape (3, 3): millimetres to pixels of the photo
    levels: Floats  # shape (n, n): luminance of each unit relative to the light ones, NaN in the corner cells
    dark: npt.NDArray[np.bool_]  # shape (n, n): whether a unit looks dark; False in the corner cells
    # `dark_level`, `gap_level`: medians of the dark units and of the gaps
    dark_level: float
    gap_level: float
    light_ratio: float  # Brightest over darkest light on the plate
    white_level: float  # [grey level] Brightest channel of the light units in the photo
    clipped: float  # share of the light units' pixels that are over-exposed
    # shape (n, n, 2): [mm] how far units lie right of and below their places, by one edge where they touch a neighbour;
    # NaN where they were not measured
    offsets_mm: Floats
    widths_mm: Floats  # shape (n, n, 2): [mm] widths and heights of units, NaN where they were not measured
    merged: float  # share of the units that stand out of the gaps and touch a neighbour
    edge_mm: float  # [mm] median width of edges from 10 to 90 %; of the steepest ones where the gaps are closed

    @property
    def luminance(self) -> Floats32:
        """Of the face, relative to the light units, shape (H, W)."""
        return np.asarray(self.reflectance @ _LUMA, np.float32)


def rectify_face(image: npt.NDArray[np.uint8], image_from_face: Floats, geometry: PlateGeometry) -> Floats32:
    """Linear light of a plate's face, shape (H, W, 3); the photo is averaged down first where it is finer."""
    size = round(geometry.side_mm * PX_PER_MM)
    corners = cv2.perspectiveTransform(_square(geometry.side_mm)[None], image_from_face)[0]
    side_px = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean())
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 8, 0)
    high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 8, image.shape[1::-1])
    part = image[low[1] : high[1], low[0] : high[0]]
    shrink = min(1.0, 1.25 * size / side_px)
    wide, tall = max(round(part.shape[1] * shrink), 1), max(round(part.shape[0] * shrink), 1)
    light = np.asarray(cv2.LUT(part, _LINEAR), np.float32)
    if shrink < 1:
        light = np.asarray(cv2.resize(light, (wide, tall), interpolation=cv2.INTER_AREA), np.float32)
    scale = np.array([wide / part.shape[1], tall / part.shape[0]])
    # pixel centres are at integers in the photo, in its part, and in the face
    shift = np.array(
        [[scale[0], 0, (0.5 - low[0]) * scale[0] - 0.5], [0, scale[1], (0.5 - low[1]) * scale[1] - 0.5], [0, 0, 1]]
    )
    face_from_px = np.array([[1 / PX_PER_MM, 0, 0.5 / PX_PER_MM], [0, 1 / PX_PER_MM, 0.5 / PX_PER_MM], [0, 0, 1]])
    warp = shift @ image_from_face @ face_from_px
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpPerspective(light, warp, (size, size), flags=flags, borderMode=cv2.BORDER_REPLICATE))


def measure_face(image: npt.NDArray[np.uint8], corners_px: Floats, geometry: PlateGeometry) -> MeasuredFace | None:
    """Rectify a plate, even its light, and measure its units.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3)
        The photo; blue, green, red.
    corners_px : ndarray, shape (4, 2)
        Outer corners, clockwise from the triangle's. [px]
    geometry : PlateGeometry
        Of the drawing.

    Returns
    -------
    MeasuredFace or None
        None where the units have one level only.
    """
    source = _square(geometry.side_mm).astype(np.float32)
    image_from_face: Floats = cv2.getPerspectiveTransform(source, corners_px.astype(np.float32)).astype(np.float64)
    for _ in range(_REFINEMENTS):
        face = _measure(image, image_from_face, geometry)
        if face is None:
            return None
        correction = _correction(face.offsets_mm, face.widths_mm, geometry)
        image_from_face = image_from_face @ correction
    return _measure(image, image_from_face, geometry)


def unit_centres_mm(geometry: PlateGeometry) -> Floats:
    """Places of all units on the face, shape (n, n, 2): right, down. [mm]"""
    middle = geometry.gap_mm + geometry.unit_mm / 2 + geometry.pitch_mm * np.arange(geometry.n)
    return np.stack(np.meshgrid(middle, middle), axis=-1)


def is_unit(n: int) -> npt.NDArray[np.bool_]:
    """Whether a place of the grid is a unit of the code, shape (n, n)."""
    return np.asarray(unit_shapes(n) >= 0)


def window(at_mm: Floats, reach_mm: float | Floats, size: int) -> tuple[slice, slice]:
    """Rows and columns of the face about a place."""
    low = np.clip(np.round((at_mm - reach_mm) * PX_PER_MM).astype(int), 0, size - 1)
    high = np.clip(np.round((at_mm + reach_mm) * PX_PER_MM).astype(int), low + 1, size)
    return slice(low[1], high[1]), slice(low[0], high[0])


_VALUES = np.arange(256) / 255.0
_LINEAR = np.where(_VALUES <= 0.04045, _VALUES / 12.92, ((_VALUES + 0.055) / 1.055) ** 2.4).astype(np.float32)
"""Linear light of the values of a photo. Source: IEC 61966-2-1."""


def _square(side_mm: float) -> Floats:
    return np.array([(0.0, 0.0), (side_mm, 0.0), (side_mm, side_mm), (0.0, side_mm)])


def _measure(image: npt.NDArray[np.uint8], image_from_face: Floats, geometry: PlateGeometry) -> MeasuredFace | None:
    light = rectify_face(image, image_from_face, geometry)
    places = unit_centres_mm(geometry)
    units = is_unit(geometry.n)
    reach = CENTRE_SHARE * geometry.unit_mm / 2
    raw = np.full((geometry.n, geometry.n, 3), np.nan)
    for row, column in np.argwhere(units):
        part = light[window(places[row, column], reach, len(light))]
        raw[row, column] = np.median(part.reshape(-1, 3), axis=0)
    luma = raw @ _LUMA.astype(np.float64)
    evened = _even_light(np.maximum(luma[units], 1e-4), places[units] / geometry.side_mm - 0.5)
    if evened is None:
        return None
    dark_units, coefficients = evened
    dark = np.zeros_like(units)
    dark[units] = dark_units
    axis = (np.arange(len(light)) + 0.5) / len(light) - 0.5
    field = np.exp(_field(list(np.meshgrid(axis, axis)), coefficients))
    at_units = np.exp(_field(list(np.moveaxis(places / geometry.side_mm - 0.5, -1, 0)), coefficients))
    even = raw / at_units[..., None]
    white = np.median(even[units & ~dark], axis=0)
    reflectance = np.asarray(light / field[..., None] / white, np.float32)
    levels = (raw / at_units[..., None] / white) @ _LUMA.astype(np.float64)
    luminance = np.asarray(reflectance @ _LUMA, np.float32)
    gap, dark_level = _gap_level(luminance, geometry), float(np.median(levels[dark]))
    standing = units & _stands_out(levels, np.where(dark, dark_level, 1.0), gap, 1 - dark_level)
    offsets, widths, edges = _edges(luminance, levels, standing, gap, geometry)
    merged = 1 - float(np.isfinite(widths[standing]).all(axis=-1).mean()) if standing.any() else 1.0
    lights = [light[window(places[row, column], reach, len(light))].max(axis=-1).ravel()
              for row, column in np.argwhere(units & ~dark)]  # fmt: skip
    return MeasuredFace(
        reflectance, image_from_face, levels, dark, dark_level, gap, float(field.max() / field.min()),
        white_level=float(np.searchsorted(_LINEAR, np.median(np.concatenate(lights)))),
        clipped=float((np.concatenate(lights) >= _LINEAR[CLIPPED_LEVEL]).mean()),
        offsets_mm=offsets, widths_mm=widths,
        merged=merged,
        edge_mm=float(np.median(edges)) if merged <= MERGED else _steepest_edge_mm(luminance, 1 - dark_level),
    )  # fmt: skip


def _even_light(luma: Floats, places: Floats) -> tuple[npt.NDArray[np.bool_], Floats] | None:
    """Which units are dark, and the coefficients of the light's logarithm, a polynomial of second degree.

    The polynomial and one level for each of the two paints are fitted by least squares, with Huber's weights.
    """
    logs = np.log(luma)
    dark = logs < (np.percentile(logs, 3) + np.percentile(logs, 97)) / 2
    solution = np.zeros(7)
    for step in range(_LIGHT_STEPS):
        lights = int((~dark).sum())
        if lights < 3 or dark.sum() < 2:
            return None
        terms = _terms([places[:, 0], places[:, 1]])
        if lights <= _MAX_LIGHTS_FOR_LINEAR:
            terms[:, 2:] = 0
        design = np.column_stack([terms, ~dark, dark]).astype(np.float64)
        weight = np.where(dark, _DARK_WEIGHT, 1.0)
        if step:
            weight = weight * np.minimum(1.0, _HUBER / np.maximum(np.abs(logs - design @ solution), 1e-9))
        solution = np.linalg.lstsq(design * np.sqrt(weight)[:, None], logs * np.sqrt(weight), rcond=None)[0]
        even = luma / np.exp(terms @ solution[:5])
        dark = even < (np.exp(solution[5]) + np.exp(solution[6])) / 2
    return dark, solution[:5]


def _terms(places: list[Floats]) -> Floats:
    x, y = places
    return np.stack([x, y, x * x, x * y, y * y], axis=-1)


def _field(places: list[Floats], coefficients: Floats) -> Floats:
    return np.asarray(_terms(places) @ coefficients)


def _gap_level(luminance: Floats32, geometry: PlateGeometry) -> float:
    """Median of the crossings of gaps, away from the units."""
    lines = geometry.gap_mm / 2 + geometry.pitch_mm * np.arange(1, geometry.n)
    inner = [(x, y) for x in lines for y in lines]
    reach = geometry.gap_mm / 4
    values = [luminance[window(np.array(place), reach, len(luminance))].ravel() for place in inner]
    return float(np.median([np.median(value) for value in values]))


def _stands_out(levels: Floats, paints: Floats, gap_level: float, contrast: float) -> npt.NDArray[np.bool_]:
    """Units whose paint differs from the gaps, and that have it."""
    limit = MIN_EDGE_CONTRAST * contrast
    return np.asarray((np.abs(paints - gap_level) > limit) & (np.abs(levels - paints) < limit))


def _edges(
    luminance: Floats32, levels: Floats, standing: npt.NDArray[np.bool_], gap_level: float, geometry: PlateGeometry
) -> tuple[Floats, Floats, list[float]]:
    """Offsets and sizes of the units that stand out of the gaps, and the widths of their edges. [mm]"""
    n, places = geometry.n, unit_centres_mm(geometry)
    offsets, widths = np.full((n, n, 2), np.nan), np.full((n, n, 2), np.nan)
    blurs: list[float] = []
    for row, column in np.argwhere(standing):
        for axis in (0, 1):
            profile, at = _profile(luminance, places[row, column], geometry, axis)
            inside = (profile - gap_level) / (levels[row, column] - gap_level) - 0.5  # positive in the unit
            found = _find_edges(at, inside, geometry)
            offsets[row, column, axis] = np.mean([edge for edge, _blur in found]) if found else np.nan
            if len(found) == 2:
                widths[row, column, axis] = geometry.unit_mm + found[1][0] - found[0][0]
                blurs += [blur for _edge, blur in found]
    return offsets, widths, blurs


def _steepest_edge_mm(luminance: Floats32, contrast: float) -> float:
    """Width of the steepest edges of a face from 10 to 90 %, where the gaps are closed. [mm]"""
    slopes = np.hypot(*np.gradient(luminance)) * PX_PER_MM
    return float(0.8 * contrast / max(np.percentile(slopes, _STEEPEST), 1e-6))


def _profile(luminance: Floats32, at_mm: Floats, geometry: PlateGeometry, axis: int) -> tuple[Floats32, Floats]:
    """Luminance along a line through a unit's place, the median across it, and the places of its samples. [mm]"""
    long_mm = (0.5 + _EDGE_REACH) * geometry.unit_mm + geometry.gap_mm
    across = CENTRE_SHARE * geometry.unit_mm / 2
    reach = np.array([long_mm, across] if axis == 0 else [across, long_mm])
    rows, columns = window(at_mm, reach, len(luminance))
    profile = np.asarray(np.median(luminance[rows, columns], axis=axis))
    start = (columns if axis == 0 else rows).start
    return profile, (np.arange(len(profile)) + start + 0.5) / PX_PER_MM - at_mm[axis]


def _find_edges(at: Floats, inside: npt.NDArray[np.floating], geometry: PlateGeometry) -> list[tuple[float, float]]:
    """How far the lower and the upper edge of a unit are off their places, and their widths from 10 to 90 %. [mm]

    An edge is missing where the unit touches its neighbour.
    """
    middle = int(np.argmin(np.abs(at)))
    if inside[middle] <= 0:
        return []
    upper, lower = np.flatnonzero(inside[middle:] <= 0), np.flatnonzero(inside[: middle + 1] <= 0)
    places = ([(int(lower[-1]), -0.5)] if len(lower) else []) + (
        [(middle + int(upper[0]) - 1, 0.5)] if len(upper) else []
    )
    found = []
    for k, side in places:
        off = _crossing(at, inside, k) - side * geometry.unit_mm
        if abs(off) < _MAX_OFF * geometry.unit_mm:
            slope = float(np.abs(np.diff(inside[max(k - 2, 0) : k + 4])).max()) * PX_PER_MM
            found.append((off, 0.8 / max(slope, 1e-6)))
    return found


def _crossing(at: Floats, inside: npt.NDArray[np.floating], k: int) -> float:
    """Where the line between samples k and k + 1 is 0."""
    a, b = float(inside[k]), float(inside[k + 1])
    return float(at[k] + (at[k + 1] - at[k]) * a / (a - b))


def _correction(offsets_mm: Floats, widths_mm: Floats, geometry: PlateGeometry) -> Floats:
    """Homography from the face as drawn to the face as it was found; identity where few units were measured."""
    known = np.isfinite(widths_mm).all(axis=-1)
    if known.sum() < _MIN_CENTRES:
        return np.eye(3)
    drawn = unit_centres_mm(geometry)[known]
    found = drawn + offsets_mm[known]
    matrix, _used = cv2.findHomography(drawn, found, cv2.RANSAC, _MAX_OFF_MM, maxIters=500, confidence=0.999)
    return np.eye(3) if matrix is None else np.asarray(matrix, np.float64)
