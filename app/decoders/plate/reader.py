"""Frame to readings: detect, fit, unit likelihoods, decode, accept.

Red and green are searched by their difference first, by their ratio where that gives no digits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from app.decoders.plate.confirm import UnitVerification
from app.decoders.plate.decode_symbols import DecodedSymbols
from app.decoders.plate.detect_blobs import MarkerSignal, half_planes
from app.decoders.plate.detect_quads import MarkerQuad
from app.decoders.plate.detect_thermal import ORIENTATION_EVIDENCE, WarmFrame, fit_warm_plates, orientation_evidence
from app.decoders.plate.evidence import CLEAN_EXPLAINED, PlateEvidence, read_evidence
from app.decoders.plate.find_candidates import Candidate, find_candidates
from app.decoders.plate.fit import PlateFit, fit_plate, project, refine_corners
from app.decoders.plate.light_field import MarkerColours, marker_colours, red_around_triangle
from app.decoders.plate.pose import marker_centroids, unit_centres, with_pose
from app.decoders.plate.unit_likelihoods import UnitEvidence, code_units, unit_log_likelihoods, verify_units
from app.errors import InvalidParameter
from app.markers.plate import EXPECTED_GEOMETRIES, PlateCode, PlateGeometry, plate_capacity
from app.markers.reading import PlateGrade, PlateOutcome, PlateReading
from app.sensors.camera import Camera

# === Waymark grade of a read plate, modelled on ISO/IEC 15415 without claiming conformance.
#
# The grade of a print by a photo is another thing: app/decoders/plate/print_grade.py.


_CONTRAST = (0.20, 0.40, 0.55, 0.70)
"""[light units] span of the levels for grades 1, 2, 3, 4. Source: symbol contrast of ISO/IEC 15415, section 7.8."""
_MODULATION = (0.20, 0.30, 0.40, 0.50)
"""[1] margin of the weakest cell for grades 1 to 4. Source: modulation of ISO/IEC 15415, section 7.8."""
_UNUSED = (0.25, 0.37, 0.50, 0.62)
"""[1] unused error correction for grades 1 to 4. Source: ISO/IEC 15415, section 7.8."""
_MARKERS = (2.0, 3.0, 4.5, 6.0)
"""[standard deviations] colour margin of the weakest marker for grades 1 to 4. Source: chosen by hand."""
_AXES = (0.15, 0.25, 0.40, 0.60)
"""[1] shorter over longer side of a unit in the image for grades 1 to 4. Source: chosen by hand."""
_GRID = (0.60, 0.75, 0.85, 0.93)
"""[1] share of the pixels' variance that the grid explains for grades 1 to 4. Source: chosen by hand."""
MODULATION_FULL = 20.0
"""[root of cost] margin of the weakest cell on a sharp, clean plate, which counts as 1. Source: chosen by hand."""


def _grade(value: float, limits: tuple[float, float, float, float]) -> float:
    """Grade from 0 to 4: the number of limits that are reached."""
    return float(np.searchsorted(limits, value, side="right"))


def grade_plate(fit: PlateFit, evidence: UnitEvidence, decoded: DecodedSymbols, weakest_marker: float) -> PlateGrade:
    """Grade of a plate that was read.

    Parameters
    ----------
    fit : PlateFit
    evidence : UnitEvidence
    decoded : DecodedSymbols
    weakest_marker : float
        Colour margin of the marker that stands out least.
    """
    values = fit.units[~np.isnan(fit.units)]
    light = max(float(np.percentile(values, 95)), 1e-6)
    contrast = evidence.span / light
    modulation = min(1.0, float(np.sqrt(max(evidence.cell_margin.min(), 0.0))) / MODULATION_FULL)
    sides = np.linalg.norm(np.roll(fit.corners_px, -1, axis=0) - fit.corners_px, axis=1)
    axial = float(min(sides[0] + sides[2], sides[1] + sides[3]) / max(sides[0] + sides[2], sides[1] + sides[3]))
    unused = 1.0
    if decoded.code is not None and decoded.code.scheme.corrects:
        capacity = plate_capacity(decoded.code.n, decoded.code.scheme).correctable_cells
        unused = max(0.0, 1 - len(decoded.corrected) / capacity)
    elif decoded.corrected:
        unused = 0.0
    parts = (
        _grade(contrast, _CONTRAST), _grade(modulation, _MODULATION), _grade(weakest_marker, _MARKERS),
        _grade(axial, _AXES), _grade(fit.explained, _GRID), _grade(unused, _UNUSED),
    )  # fmt: skip
    return PlateGrade(min(parts), *parts)


# === Frame to readings.


DEFAULT_GEOMETRIES = EXPECTED_GEOMETRIES
MIN_EXPLAINED = 0.6
"""[1] share of the pixels' variance below which a candidate is no plate. Source: chosen by hand."""
MIN_SECOND_LOG_ODDS = -3.0
"""[log odds] of a candidate that gets a second geometry when the first explains nothing. Source: chosen by hand, for
speed."""
MIN_MARGIN = 1.0
"""[standard deviations] colour margin of a marker that is there. Source: chosen by hand."""
MIN_MARGIN_ALONE = 2.2
"""[standard deviations] the same without a registry. Source: a board with three green corners was read with 1.5 (set
`look-alikes` of `python -m benchmarks.plates false --seed 2712`)."""
MIN_TINT_ALONE, MIN_TRIANGLE_TINT_ALONE = 0.35, 0.5
"""[median square] green of a square and red of the triangle, without a registry. Source: for the squares by hand;
boards with red fringes on dark corners have 0.39 and 0.48 (the same, seeds 2711 and 2712)."""
MAX_REST_ALONE = 0.65
"""[1] red of the other half of the triangle's cell over the triangle's, without a registry. Source: 144 plates that
were read have at most 0.60 below 1.5 px a unit, 0.53 below 2 and 0.35 above; red squares have 0.7 to 1.2 (set
`look-alikes` of `python -m benchmarks.plates false`)."""
MAX_BESIDE_ALONE = 1.0
"""[1] red beside the plate over the triangle's, without a registry. Source: 171 plates that were read have at most 0.91
below 2 px a unit and 0.47 above; a look-alike beside a red sign, whose red spread into its dark corner, has 15 to 50
(`python -m benchmarks.plates false --sets free --seed 930`)."""
MAX_PALENESS_ALONE, PALE_MARGIN_ALONE = 0.8, 3.5
"""[1, standard deviations] `MarkerColours.paleness` above which a square is white unless all margins are larger than
this, without a registry. Source: 423 plates that were read have at most 0.57, but 0.75 in dapple and 1.05 in glare,
with margins from 4.7 on; one with a white square on a pink road has 0.91 and 2.2 (set `look-alikes`, seed 3504)."""
MIN_TRIANGLE_RED_ALONE = -0.4
"""[1] `MarkerColours.triangle_red` below which the triangle is black. Source: the same plates have -0.24 at least; one
with a black square in its place has -0.69 (the same, seed 3507)."""
CAST_ALONE = (0.65, 1.5)
"""[green] blue and red of the units beyond which they are not grey, without a registry. Source: chosen by hand; effect:
`python -m benchmarks.plates.thresholds`."""
COARSE_MARGIN, COARSE_TINT, COARSE_CAST = 1.5, 0.4, (0.74, 1.35)
"""Margin and tint of the second weakest marker and cast of the units for which a coarse fit is refined, units as above.
Source: chosen by hand, for speed."""
COARSE_WEAKEST = (1.0, 0.3)
"""Margin and tint of the weakest marker, the same. Source: chosen by hand, for speed."""
COARSE_LOSS = 0.04
"""[1] by which a coarse fit may explain less than the best fit under another geometry, and be refined. Source: chosen
by hand, for speed."""
CLEAR_EXPLAINED, CLEAR_MARGIN = 0.93, 8.0
"""Share of variance, or margin of the second weakest marker, with which the weakest may be missing. Source: chosen by
hand."""
MAX_CENTROID_SHIFT = (0.15, 1.5)
"""[plate, px] distance of the fitted markers from the detected ones, the sum of both. Source: chosen by hand."""
MIN_SIDE_PX = 24
"""[px] least side of a frame. Source: chosen by hand; no plate that can be read fits in less."""
SAME_MARKER = 0.03
"""[plate] distance of two candidates' markers up to which one fit serves both. Source: chosen by hand."""
Frame = npt.NDArray[Any]
Array = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class _Task:
    """What all candidates of a frame share, and the candidates fitted so far, good and bad."""

    image: Frame
    camera: Camera | None
    codebook: Sequence[PlateCode]
    geometries: Sequence[PlateGeometry]
    fits: list[tuple[PlateGeometry, Array, PlateFit | None]] = field(default_factory=list)
    evidence: list[PlateEvidence] = field(default_factory=list)
    units: list[tuple[PlateFit, UnitEvidence | None]] = field(default_factory=list)
    verifications: list[tuple[PlateFit, str, UnitVerification | None]] = field(default_factory=list)

    def verify(
        self, fit: PlateFit, geometry: PlateGeometry, units: UnitEvidence, code: PlateCode
    ) -> UnitVerification | None:
        """The pixels compared with a code; that of the same fit in an earlier pass serves again."""
        for known, digits, found in self.verifications:
            if known is fit and digits == code.digits:
                return found
        found = verify_units(self.image, fit, geometry, code_units(code), units)
        self.verifications.append((fit, code.digits, found))
        return found

    def is_clear(self) -> bool:
        """Whether a plate with all of its markers was seen clearly: other signals show the same units."""
        return any(one.missing is None and one.explained > CLEAN_EXPLAINED for one in self.evidence)

    def unit_evidence(self, fit: PlateFit) -> UnitEvidence | None:
        """Evidence of a fit about its units; that of an earlier pass serves again."""
        for known, found in self.units:
            if known is fit:
                return found
        evidence = unit_log_likelihoods(fit, thermal=self.image.ndim == 2)
        self.units.append((fit, evidence))
        return evidence

    def fit_candidate(
        self, signal: MarkerSignal, quad: MarkerQuad, geometry: PlateGeometry, other_explained: float
    ) -> PlateFit | None:
        """Fit of a candidate, if it may explain more than that under another geometry.

        The fit of about the same markers in an earlier pass serves again.
        """
        has_colours = True

        def promising(plate_from_image: Array, explained: float) -> bool:
            nonlocal has_colours
            if explained < other_explained - COARSE_LOSS:
                return False
            colours = marker_colours(signal, plate_from_image, marker_centroids(geometry), unit_centres(geometry))
            has_colours = _is_promising(colours, explained)
            return has_colours

        reach_px = SAME_MARKER * np.ptp(quad.centroids_px, axis=0) + 0.5
        for known, centroids_px, earlier in self.fits:
            apart_px = np.abs(centroids_px - quad.centroids_px)
            if known == geometry and (apart_px < reach_px).all():
                return earlier
        fit = fit_plate(self.image, quad.centroids_px, geometry, promising=promising)
        if has_colours:  # else another signal may show them
            self.fits.append((geometry, quad.centroids_px, fit))
        if fit is not None and fit.explained > CLEAN_EXPLAINED:
            fitted_px = project(np.linalg.inv(fit.plate_from_image), marker_centroids(geometry))
            self.fits.append((geometry, fitted_px, fit))
        return fit


def decode_plates(
    image: Frame,
    *,
    camera: Camera | None = None,
    codebook: Sequence[PlateCode] = (),
    thermal: bool = False,
    geometries: Sequence[PlateGeometry] = DEFAULT_GEOMETRIES,
) -> list[PlateReading]:
    """Plates in a frame.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3) or (H, W)
        Blue, green, red; or grey levels of a thermal camera.
    camera : Camera, optional
        Gives every reading a pose.
    codebook : sequence of PlateCode
        Codes of the plates registered nearby; they decide where the frame alone is uncertain.
    thermal : bool
        Dark units are warm, that is bright, and there are no colours.
    geometries : sequence of PlateGeometry
        Plates that may occur, the likeliest first.

    Returns
    -------
    list of PlateReading
        Read plates first; candidates that look like plates but were refused follow with their outcome. Empty where
        there is none.

    Raises
    ------
    InvalidParameter
        The image is not of this type, or not of the camera's size.
    """
    options: dict[str, Any] = {"camera": camera, "codebook": codebook, "thermal": thermal, "geometries": geometries}
    return [reading for reading, _evidence in read_plates(image, **options)]


def read_plates(
    image: Frame,
    *,
    camera: Camera | None = None,
    codebook: Sequence[PlateCode] = (),
    thermal: bool = False,
    geometries: Sequence[PlateGeometry] = DEFAULT_GEOMETRIES,
) -> list[tuple[PlateReading, PlateEvidence | None]]:
    """Plates in a frame as `decode_plates`, each with the evidence that it rests on, for `accumulate`."""
    _check(image, camera, thermal, geometries)
    task = _Task(image, camera, codebook, geometries)
    readings = _decode_thermal(task) if thermal else _decode_colour(task)
    return [
        (reading, next((e for e in task.evidence if e.corners_px is reading.corners_px), None))
        for reading in _suppress_overlapping(readings)
    ]


def _decode_colour(task: _Task) -> list[PlateReading]:
    image = task.image
    planes = half_planes(image)
    readings: list[PlateReading] = []
    for signal, candidates in find_candidates(planes, task.geometries):
        for candidate in candidates:
            if not any(_covers(reading, candidate.quad) for reading in readings):
                readings += _read_candidate(task, signal, candidate)
        if any(reading.code for reading in readings) or task.is_clear():
            break
    return readings


def _decode_thermal(task: _Task) -> list[PlateReading]:
    readings: list[PlateReading] = []
    frame = WarmFrame(task.image)
    for geometry in task.geometries:
        for fits in fit_warm_plates(frame, geometry):
            centre = fits[0].corners_px.mean(axis=0)
            if fits[0].explained >= MIN_EXPLAINED and not any(_inside(centre, r) for r in readings):
                readings.append(_read_orientations(task, fits, geometry))
        if any(reading.code for reading in readings):
            break
    return readings


def _read_orientations(task: _Task, fits: list[PlateFit], geometry: PlateGeometry) -> PlateReading:
    """Reading of the likeliest orientation; of another one only where the codebook confirms it."""
    unsure = PlateOutcome.RED_MARKER_MISSING, "the triangle cannot be distinguished from the squares"
    first: PlateReading | None = None
    evidence = orientation_evidence(fits)
    for fit in fits:
        missing = _out_of_view(task.image.shape, fit)
        if missing is None and (first is not None or evidence < ORIENTATION_EVIDENCE):
            missing = unsure
        reading = _read_fit(task, fit, geometry, missing)
        if reading.code is not None:
            return reading
        first = first or reading
        if not task.codebook:
            break
    assert first is not None
    return first


def _check(image: Frame, camera: Camera | None, thermal: bool, geometries: Sequence[PlateGeometry]) -> None:
    if image.dtype != np.uint8 or image.ndim != (2 if thermal else 3) or (image.ndim == 3 and image.shape[2] != 3):
        expected = "(H, W) grey levels" if thermal else "(H, W, 3) blue, green, red"
        raise InvalidParameter(f"a frame is uint8 {expected}, not {image.dtype} {image.shape}", field="image")
    if min(image.shape[:2]) < MIN_SIDE_PX:
        raise InvalidParameter("the frame is too small", field="image", limit=f"at least {MIN_SIDE_PX} px a side")
    if camera is not None and (camera.height_px, camera.width_px) != image.shape[:2]:
        raise InvalidParameter(
            f"the camera gives {camera.width_px} x {camera.height_px} px, the frame has "
            f"{image.shape[1]} x {image.shape[0]}",
            field="camera.width_px",
            cure="give the camera of this frame, or scale its intrinsics",
        )
    if not geometries:
        raise InvalidParameter("no plate geometry to look for", field="geometries", limit="at least one")


def _covers(reading: PlateReading, quad: MarkerQuad) -> bool:
    return reading.code is not None and _inside(quad.centroids_px.mean(axis=0), reading)


def _inside(point_px: Array, reading: PlateReading) -> bool:
    if reading.corners_px is None:
        return False
    low, high = reading.corners_px.min(axis=0), reading.corners_px.max(axis=0)
    return bool(((point_px > low) & (point_px < high)).all())


def _suppress_overlapping(readings: list[PlateReading]) -> Iterator[PlateReading]:
    """Of candidates in one place only the read one, or the most probable of those that were refused."""
    kept: list[PlateReading] = []
    for reading in sorted(readings, key=lambda r: (r.code is None, -r.confidence)):
        centre = None if reading.corners_px is None else reading.corners_px.mean(axis=0)
        if centre is None or not any(_inside(centre, other) for other in kept):
            kept.append(reading)
            yield reading


def _read_candidate(task: _Task, signal: MarkerSignal, candidate: Candidate) -> list[PlateReading]:
    """The candidate's reading under the geometry that explains most of it; empty when it is no plate."""
    best: PlateReading | None = None
    quad, most_explained = candidate.quad, MIN_EXPLAINED
    for geometry in candidate.geometries:
        fit = task.fit_candidate(signal, quad, geometry, most_explained)
        if fit is not None and fit.explained >= most_explained:
            most_explained = fit.explained
            colours = marker_colours(signal, fit.plate_from_image, marker_centroids(geometry), unit_centres(geometry))
            if np.sort(colours.margins)[1] >= MIN_MARGIN:
                rest, beside = red_around_triangle(task.image, fit.plate_from_image, geometry, colours.cast)
                colours = replace(colours, rest=rest, beside=beside)
                missing = _missing_parts(task.image.shape, quad, fit, geometry, colours.margins)
                best = _read_fit(task, fit, geometry, missing or wrong_colours(colours), colours)
                if best.code is not None:
                    break
        if candidate.log_odds < MIN_SECOND_LOG_ODDS:
            break
    return [best] if best else []


def _is_promising(colours: MarkerColours, explained: float) -> bool:
    """Whether a coarse fit is refined: most of what is no plate lacks colours where a plate has them."""
    margins, tints = np.sort(colours.margins), np.sort(colours.tints)
    weakest = margins[0] >= COARSE_WEAKEST[0] and tints[0] >= COARSE_WEAKEST[1]
    return bool(
        (weakest or explained >= CLEAR_EXPLAINED or margins[1] >= CLEAR_MARGIN)
        and margins[1] >= COARSE_MARGIN
        and tints[1] >= COARSE_TINT
        and COARSE_CAST[0] < colours.cast.min()
        and colours.cast.max() < COARSE_CAST[1]
    )


def _read_fit(
    task: _Task,
    fit: PlateFit,
    geometry: PlateGeometry,
    missing: tuple[PlateOutcome, str] | None,
    colours: MarkerColours | None = None,
) -> PlateReading:
    """Reading of a fitted candidate, or the reason why there is none."""
    extent = np.ptp(fit.corners_px, axis=0)
    reading = PlateReading(
        PlateOutcome.CELLS_UNDECODABLE,
        fit.corners_px,
        fit.corners_covariance_px2,
        geometry=geometry,
        width_px=float(extent[0]),
        height_px=float(extent[1]),
    )
    units = task.unit_evidence(fit)
    if units is None:
        outcome, reason = missing or (PlateOutcome.CELLS_UNDECODABLE, "the units do not stand out of the noise")
        return replace(reading, outcome=outcome, reason=reason)
    weakest_marker = float(colours.margins.min()) if colours is not None else math.inf
    evidence = PlateEvidence(
        units, geometry, fit.corners_px, fit.corners_covariance_px2, fit.explained, fit.unit_px,
        float(extent.min()), weakest_marker, thermal=task.image.ndim == 2, missing=missing, colours=colours,
    )  # fmt: skip
    verify = partial(task.verify, fit, geometry, units) if task.image.ndim == 3 else None
    reading, decoded = read_evidence(reading, evidence, task.codebook, verify)
    evidence = replace(evidence, verification=decoded.verification)
    if task.camera is not None and task.image.ndim == 3 and (reading.code or reading.likely_code):
        reading, evidence = _refine(task.image, fit, geometry, reading, evidence)
    task.evidence.append(evidence)
    if reading.code is None:
        return reading
    return with_pose(replace(reading, grade=grade_plate(fit, units, decoded, weakest_marker)), task.camera)


def _refine(
    image: Frame, fit: PlateFit, geometry: PlateGeometry, reading: PlateReading, evidence: PlateEvidence
) -> tuple[PlateReading, PlateEvidence]:
    """A reading and its evidence with the corners that a pose needs; as they are where these are not found."""
    refined = refine_corners(image, fit, geometry)
    if refined is None:
        return reading, evidence
    corners_px, covariance_px2 = refined
    return (
        replace(reading, corners_px=corners_px, corners_covariance_px2=covariance_px2),
        replace(evidence, corners_px=corners_px, corners_covariance_px2=covariance_px2),
    )


def _missing_parts(
    shape: tuple[int, ...], quad: MarkerQuad, fit: PlateFit, geometry: PlateGeometry, margins: Array
) -> tuple[PlateOutcome, str] | None:
    """The case that the paper filters out, if it is one (PolyU, section II-D4), and the reason."""
    outside = _out_of_view(shape, fit)
    if outside is not None:
        return outside
    if margins[0] < MIN_MARGIN:
        return PlateOutcome.RED_MARKER_MISSING, "there is no red triangle in its place"
    if margins[1:].min() < MIN_MARGIN:
        return PlateOutcome.GREEN_MARKER_MISSING, "a green square is missing from its place"
    fitted_px = project(np.linalg.inv(fit.plate_from_image), marker_centroids(geometry))
    moved = np.abs(fitted_px - quad.centroids_px).max(axis=0)
    if (moved > MAX_CENTROID_SHIFT[0] * np.ptp(fit.corners_px, axis=0) + MAX_CENTROID_SHIFT[1]).any():
        return PlateOutcome.VERTICES_BEYOND_MARKERS, "the grid's corners are not where the markers are"
    return None


def wrong_colours(colours: MarkerColours) -> tuple[PlateOutcome, str] | None:
    """A marker or units whose colours need a registry to confirm them: a look-alike or a worn plate."""
    pale = (colours.margins < MIN_MARGIN_ALONE) | (colours.tints < MIN_TINT_ALONE)
    if pale[0] or colours.tints[0] < MIN_TRIANGLE_TINT_ALONE:
        return PlateOutcome.RED_MARKER_MISSING, "the red triangle is hardly red"
    if colours.beside > MAX_BESIDE_ALONE:
        return PlateOutcome.RED_MARKER_MISSING, "the red spreads from beside the plate"
    if colours.rest > MAX_REST_ALONE:
        return PlateOutcome.RED_MARKER_MISSING, "the red marker is a square, not a triangle"
    if colours.triangle_red < MIN_TRIANGLE_RED_ALONE:
        return PlateOutcome.RED_MARKER_MISSING, "the red triangle is as dark as the dark units"
    if pale.any():
        return PlateOutcome.GREEN_MARKER_MISSING, "a green square is hardly green"
    if colours.paleness > MAX_PALENESS_ALONE and colours.margins.min() < PALE_MARGIN_ALONE:
        return PlateOutcome.GREEN_MARKER_MISSING, "a green square is as light as the light units"
    if colours.cast.min() < CAST_ALONE[0] or colours.cast.max() > CAST_ALONE[1]:
        return PlateOutcome.CELLS_UNDECODABLE, "the units are coloured"
    return None


def _out_of_view(shape: tuple[int, ...], fit: PlateFit) -> tuple[PlateOutcome, str] | None:
    if (fit.corners_px < -0.5).any() or (fit.corners_px > np.array([shape[1], shape[0]]) - 0.5).any():
        return PlateOutcome.FEWER_THAN_FOUR_VERTICES, "a corner is out of view"
    return None
