"""Frame to readings: find candidates, fit each, measure its units, decode their symbols, accept or refuse.

In a colour frame red and green are searched by their difference first, by their ratio where that gives no digits. A
thermal frame has no colours: each warm quadrangle is fitted in four orientations. `marker_colours` tests the colours of
a plate, `evidence` decides when its digits are returned.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.decoders.plate.confirm import UnitVerification, with_expected
from app.decoders.plate.decode_symbols import RIVAL_CELLS, DecodedSymbols
from app.decoders.plate.detect_blobs import MarkerSignal, half_planes
from app.decoders.plate.detect_quads import MarkerQuad
from app.decoders.plate.detect_thermal import ORIENTATION_EVIDENCE, find_warm_plates
from app.decoders.plate.evidence import CLEAN_EXPLAINED, PlateEvidence, read_evidence
from app.decoders.plate.find_candidates import Candidate, find_candidates
from app.decoders.plate.find_registered import find_registered
from app.decoders.plate.fit import PlateFit, finish_fit, fit_coarsely, project, refine_corners
from app.decoders.plate.follow_plate import read_pattern
from app.decoders.plate.marker_colours import (
    MIN_MARGIN,
    MarkerColours,
    find_wrong_colour,
    is_promising,
    measure_marker_colours,
    with_red_around,
)
from app.decoders.plate.pose import marker_centroids, with_pose
from app.decoders.plate.unit_likelihoods import (
    UnitEvidence,
    code_units,
    unit_log_likelihoods,
    verify_units,
    with_hidden_markers,
)
from app.errors import InvalidParameter
from app.markers.plate import EXPECTED_GEOMETRIES, PlateCode, PlateGeometry, plate_capacity
from app.markers.reading import PlateGrade, PlateOutcome, PlateReading
from app.sensors.camera import Camera
from app.values import Floats

Frame = npt.NDArray[np.uint8]
Refusal = tuple[PlateOutcome, str]

DEFAULT_GEOMETRIES = EXPECTED_GEOMETRIES
MIN_SIDE_PX = 24
"""[px] least side of a frame: no plate that can be read fits in less."""


@dataclass(frozen=True, slots=True)
class FitLimits:
    """Which candidates of a frame are fitted, and which fits may be plates.

    Chosen so that plates stay read and the time of a frame is short; `python -m benchmarks.plates` counts and measures
    both.
    """

    min_explained: float = 0.6  # [1] share of the pixels' variance that any plate explains
    # [log odds] of a candidate that gets a second geometry where the first explains nothing
    min_second_log_odds: float = -3.0
    # [1] by which a coarse fit may explain less than the best fit under another geometry, and still be finished
    coarse_loss: float = 0.04
    max_candidates: int = 6  # of all signals: a cluttered frame has more look-alikes than there is time for
    same_marker: float = 0.03  # [plate] distance of two candidates' markers up to which one fit serves both
    # [plate, px] distance of the fitted markers from the detected ones, the sum of both
    max_centroid_shift: tuple[float, float] = (0.15, 1.5)


LIMITS = FitLimits()


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
    found = read_plates(image, camera=camera, codebook=codebook, thermal=thermal, geometries=geometries)
    readings = [reading for reading, _evidence in found]
    if thermal or camera is None or any(reading.code is not None for reading in readings):
        return readings
    registered = _read_registered(image, camera, codebook, geometries)
    return readings if registered is None else with_expected(readings, [registered])


def read_plates(
    image: Frame,
    *,
    camera: Camera | None = None,
    codebook: Sequence[PlateCode] = (),
    thermal: bool = False,
    geometries: Sequence[PlateGeometry] = DEFAULT_GEOMETRIES,
) -> list[PlateInFrame]:
    """Plates in a frame as `decode_plates`, each with the evidence that it rests on, for `accumulate`."""
    _check(image, camera, thermal, geometries)
    frame = FrameReader(image, camera, codebook, geometries)
    found = frame.read_warm() if thermal else frame.read_coloured()
    return list(_without_overlaps(found))


def _read_registered(
    image: Frame, camera: Camera, codebook: Sequence[PlateCode], geometries: Sequence[PlateGeometry]
) -> PlateReading | None:
    """A plate whose colours do not show, where its units are those of a registered one."""
    for likely in find_registered(image, camera, codebook, geometries):
        missing = PlateOutcome.UNSURE, "found by a pattern of the registry"
        read = read_pattern(image, likely.corners_px, likely.geometry, codebook, missing, likely.tries)
        if read is not None and read[0].code is not None and _is_distinct(read[0].code, codebook):
            return with_pose(read[0], camera)
    return None


def _is_distinct(code: PlateCode, codebook: Sequence[PlateCode]) -> bool:
    """Whether what covers a unit cannot make a code of another registered one: by its checks, or by its digits."""
    apart = (
        sum(a != b for a, b in zip(code.symbols, other.symbols, strict=True))
        for other in codebook
        if other.n == code.n and other.digits != code.digits
    )
    return code.scheme.corrects or min(apart, default=0) >= RIVAL_CELLS


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


class PlateInFrame(NamedTuple):
    """A candidate that looks like a plate, read or refused."""

    reading: PlateReading
    evidence: PlateEvidence | None  # None where the units do not stand out of the noise

    def covers(self, point_px: Floats) -> bool:
        """Whether a point is within the extent of the plate's image."""
        corners_px = self.reading.corners_px
        if corners_px is None:
            return False
        return bool(((point_px > corners_px.min(axis=0)) & (point_px < corners_px.max(axis=0))).all())


def _without_overlaps(found: list[PlateInFrame]) -> Iterator[PlateInFrame]:
    """Of candidates in one place only the read one, or the most probable of those that were refused."""
    kept: list[PlateInFrame] = []
    for plate in sorted(found, key=lambda plate: (plate.reading.code is None, -plate.reading.confidence)):
        corners_px = plate.reading.corners_px
        if corners_px is None or not any(other.covers(corners_px.mean(axis=0)) for other in kept):
            kept.append(plate)
            yield plate


class FittedPlate:
    """A plate that was fitted in a frame, with what its pixels show, each computed once."""

    def __init__(self, image: Frame, fit: PlateFit, geometry: PlateGeometry) -> None:
        self.image, self.fit, self.geometry = image, fit, geometry
        self._verifications: dict[str, UnitVerification | None] = {}

    @cached_property
    def units(self) -> UnitEvidence | None:
        """Costs of the symbols; None where the units do not stand out of the noise."""
        return unit_log_likelihoods(self.fit, thermal=self.image.ndim == 2)

    def verify(self, code: PlateCode) -> UnitVerification | None:
        """How well the pixels agree with a code; None where the plate has too few."""
        if code.digits not in self._verifications:
            assert self.units is not None
            dark = code_units(code)
            self._verifications[code.digits] = verify_units(self.image, self.fit, self.geometry, dark, self.units)
        return self._verifications[code.digits]

    def lacks_view(self) -> Refusal | None:
        """The refusal of a plate that is not wholly in the image."""
        height, width = self.image.shape[:2]
        corners_px = self.fit.corners_px
        if (corners_px < -0.5).any() or (corners_px > np.array([width, height]) - 0.5).any():
            return PlateOutcome.FEWER_THAN_FOUR_VERTICES, "a corner is out of view"
        return None


class _KnownFit(NamedTuple):
    """The result of a fit: of candidates with markers in about the same places it is the same."""

    geometry: PlateGeometry
    centroids_px: Floats
    plate: FittedPlate | None  # None where there is no plate


class FrameReader:
    """Reads the plates of one frame; parameters as of `decode_plates`."""

    def __init__(
        self,
        image: Frame,
        camera: Camera | None = None,
        codebook: Sequence[PlateCode] = (),
        geometries: Sequence[PlateGeometry] = DEFAULT_GEOMETRIES,
    ) -> None:
        self._image, self._camera, self._codebook, self._geometries = image, camera, codebook, geometries
        self._fits: list[_KnownFit] = []
        self._is_clear = False  # a plate with all of its markers was seen clearly

    def read_coloured(self) -> list[PlateInFrame]:
        """Plates by their red and green markers, from one signal after the other until one gives digits.

        Another signal shows the same units, so none is searched either once a plate was seen clearly.
        """
        found: list[PlateInFrame] = []
        left = LIMITS.max_candidates
        for signal, candidates in find_candidates(half_planes(self._image), self._geometries):
            for candidate in candidates[:left]:
                left -= 1
                centre_px = candidate.quad.centroids_px.mean(axis=0)
                if not any(plate.reading.code and plate.covers(centre_px) for plate in found):
                    plate = self._read_candidate(signal, candidate)
                    found += [plate] if plate else []
            if self._is_clear or any(plate.reading.code for plate in found):
                break
        return found

    def read_warm(self) -> list[PlateInFrame]:
        """Plates that are warmer or colder than the road in a thermal frame."""
        found: list[PlateInFrame] = []
        for warm in find_warm_plates(self._image, self._geometries):
            plate = FittedPlate(self._image, warm.fit, warm.geometry)
            unsure = PlateOutcome.RED_MARKER_MISSING, "the triangle cannot be distinguished from the squares"
            missing = unsure if warm.orientation_evidence < ORIENTATION_EVIDENCE else None
            found.append(self._read_plate(plate, plate.lacks_view() or missing))
        return found

    def _read_candidate(self, signal: MarkerSignal, candidate: Candidate) -> PlateInFrame | None:
        """A candidate under the geometry that explains most of its pixels; None when it is no plate."""
        best: PlateInFrame | None = None
        most_explained = LIMITS.min_explained
        for geometry in candidate.geometries:
            plate = self._fit(signal, candidate.quad, geometry, most_explained)
            if plate is not None and plate.fit.explained >= most_explained:
                most_explained = plate.fit.explained
                colours = measure_marker_colours(signal, plate.fit.plate_from_image, geometry)
                if np.sort(colours.margins)[1] >= MIN_MARGIN:
                    colours = with_red_around(colours, self._image, plate.fit.plate_from_image, geometry)
                    missing = _find_missing(plate, candidate.quad, colours.margins) or find_wrong_colour(colours)
                    best = self._read_plate(plate, missing, colours)
                    if best.reading.code is not None:
                        break
            if candidate.log_odds < LIMITS.min_second_log_odds:
                break
        return best

    def _fit(
        self, signal: MarkerSignal, quad: MarkerQuad, geometry: PlateGeometry, best_explained: float
    ) -> FittedPlate | None:
        """The fit of a candidate, where it may explain more than that under another geometry."""
        reach_px = LIMITS.same_marker * np.ptp(quad.centroids_px, axis=0) + 0.5
        for known in self._fits:
            if known.geometry == geometry and (np.abs(known.centroids_px - quad.centroids_px) < reach_px).all():
                return known.plate
        fit: PlateFit | None = None
        coarse = fit_coarsely(self._image, quad.centroids_px, geometry)
        if coarse is not None and coarse.explained >= best_explained - LIMITS.coarse_loss:
            if not is_promising(measure_marker_colours(signal, coarse.plate_from_image, geometry), coarse.explained):
                return None  # another signal may show the colours, so this is not the last word
            fit = finish_fit(self._image, coarse, geometry)
        plate = None if fit is None else FittedPlate(self._image, fit, geometry)
        self._fits.append(_KnownFit(geometry, quad.centroids_px, plate))
        if fit is not None and fit.explained > CLEAN_EXPLAINED:
            self._fits.append(_KnownFit(geometry, _fitted_centroids_px(fit, geometry), plate))
        return plate

    def _read_plate(
        self, plate: FittedPlate, missing: Refusal | None, colours: MarkerColours | None = None
    ) -> PlateInFrame:
        """Decode a fitted plate, or say why it has no digits; `missing` is what it lacks without a registry."""
        fit, units = plate.fit, plate.units
        extent_px = np.ptp(fit.corners_px, axis=0)
        reading = PlateReading(
            PlateOutcome.CELLS_UNDECODABLE,
            fit.corners_px,
            fit.corners_covariance_px2,
            geometry=plate.geometry,
            width_px=float(extent_px[0]),
            height_px=float(extent_px[1]),
        )
        if units is None:
            outcome, reason = missing or (reading.outcome, "the units do not stand out of the noise")
            return PlateInFrame(replace(reading, outcome=outcome, reason=reason), None)
        is_thermal = self._image.ndim == 2
        if colours is not None:
            units = with_hidden_markers(units, colours.tints, plate.geometry.n)
        evidence = PlateEvidence(
            units=units,
            geometry=plate.geometry,
            corners_px=fit.corners_px,
            corners_covariance_px2=fit.corners_covariance_px2,
            explained=fit.explained,
            unit_px=fit.unit_px,
            extent_px=float(extent_px.min()),
            weakest_marker=math.inf if colours is None else float(colours.margins.min()),
            thermal=is_thermal,
            missing=missing,
            colours=colours,
        )
        self._is_clear |= missing is None and fit.explained > CLEAN_EXPLAINED
        reading, decoded = read_evidence(reading, evidence, self._codebook, None if is_thermal else plate.verify)
        evidence = replace(evidence, verification=decoded.verification)
        if self._camera is not None and not is_thermal and (reading.code or reading.likely_code):
            refined = refine_corners(self._image, fit, plate.geometry)
            if refined is not None:  # a pose needs better corners than the digits
                corners_px, covariance_px2 = refined
                reading = replace(reading, corners_px=corners_px, corners_covariance_px2=covariance_px2)
                evidence = replace(evidence, corners_px=corners_px, corners_covariance_px2=covariance_px2)
        if reading.code is not None:
            grade = grade_plate(fit, units, decoded, evidence.weakest_marker)
            reading = with_pose(replace(reading, grade=grade), self._camera)
        return PlateInFrame(reading, evidence)


def _find_missing(plate: FittedPlate, quad: MarkerQuad, margins: Floats) -> Refusal | None:
    """The case that the paper filters out, if it is one (PolyU, section II-D4), and the reason."""
    out_of_view = plate.lacks_view()
    if out_of_view is not None:
        return out_of_view
    if margins[0] < MIN_MARGIN:
        return PlateOutcome.RED_MARKER_MISSING, "there is no red triangle in its place"
    if margins[1:].min() < MIN_MARGIN:
        return PlateOutcome.GREEN_MARKER_MISSING, "a green square is missing from its place"
    moved_px = np.abs(_fitted_centroids_px(plate.fit, plate.geometry) - quad.centroids_px).max(axis=0)
    share, extra_px = LIMITS.max_centroid_shift
    if (moved_px > share * np.ptp(plate.fit.corners_px, axis=0) + extra_px).any():
        return PlateOutcome.VERTICES_BEYOND_MARKERS, "the grid's corners are not where the markers are"
    return None


def _fitted_centroids_px(fit: PlateFit, geometry: PlateGeometry) -> Floats:
    """Where a fit has the centroids of the markers."""
    return project(np.linalg.inv(fit.plate_from_image), marker_centroids(geometry))


# === Grade of a read plate, modelled on ISO/IEC 15415 without claiming conformance.
#
# The grade of a print by a photo is another thing: app/decoders/plate/print_grade.py.


@dataclass(frozen=True, slots=True)
class GradeLimits:
    """Values from which on the grades 1, 2, 3 and 4 are given.

    The first three are from ISO/IEC 15415, section 7.8. The others are our own; nothing depends on them.
    """

    contrast: tuple[float, ...] = (0.20, 0.40, 0.55, 0.70)  # [light units] span of the levels
    modulation: tuple[float, ...] = (0.20, 0.30, 0.40, 0.50)  # [1] margin of the weakest cell
    unused_correction: tuple[float, ...] = (0.25, 0.37, 0.50, 0.62)  # [1]
    marker: tuple[float, ...] = (2.0, 3.0, 4.5, 6.0)  # [standard deviations] colour margin of the weakest marker
    axial: tuple[float, ...] = (0.15, 0.25, 0.40, 0.60)  # [1] shorter over longer side of a unit in the image
    grid: tuple[float, ...] = (0.60, 0.75, 0.85, 0.93)  # [1] share of the pixels' variance that the grid explains
    full_modulation: float = (
        20.0  # [root of cost] margin of the weakest cell on a sharp, clean plate, which counts as 1
    )


GRADES = GradeLimits()


def grade_plate(fit: PlateFit, units: UnitEvidence, decoded: DecodedSymbols, weakest_marker: float) -> PlateGrade:
    """Grade of a plate that was read; `weakest_marker` is the colour margin of the marker that stands out least."""
    light = max(float(np.percentile(fit.units[~np.isnan(fit.units)], 95)), 1e-6)
    modulation = min(1.0, float(np.sqrt(max(units.cell_margin.min(), 0.0))) / GRADES.full_modulation)
    sides_px = np.linalg.norm(np.roll(fit.corners_px, -1, axis=0) - fit.corners_px, axis=1)
    wide_px, tall_px = sides_px[0] + sides_px[2], sides_px[1] + sides_px[3]
    unused = 1.0
    if decoded.code is not None and decoded.code.scheme.corrects:
        capacity = plate_capacity(decoded.code.n, decoded.code.scheme).correctable_cells
        unused = max(0.0, 1 - len(decoded.corrected) / capacity)
    elif decoded.corrected:
        unused = 0.0
    parts = (
        _grade(units.span / light, GRADES.contrast),
        _grade(modulation, GRADES.modulation),
        _grade(weakest_marker, GRADES.marker),
        _grade(float(min(wide_px, tall_px) / max(wide_px, tall_px)), GRADES.axial),
        _grade(fit.explained, GRADES.grid),
        _grade(unused, GRADES.unused_correction),
    )
    return PlateGrade("FDCBA"[int(min(parts))], min(parts), *parts)


def _grade(value: float, limits: tuple[float, ...]) -> float:
    """Grade from 0 to 4: the number of limits that are reached."""
    return float(np.searchsorted(limits, value, side="right"))
