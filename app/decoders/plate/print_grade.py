"""Photo of a printed plate to the grade of its print: find the plate, refuse what cannot be graded, measure, grade.

The grade of a plate that a vehicle read in traffic is another thing: `grade_plate` of app/decoders/plate/reader.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate.pose import marker_centroids
from app.decoders.plate.print_face import (
    CLIPPED_LEVEL,
    MERGED,
    MeasuredFace,
    is_unit,
    measure_face,
    unit_centres_mm,
    window,
)
from app.decoders.plate.reader import DEFAULT_GEOMETRIES, decode_plates
from app.errors import PrintNotGraded
from app.markers.plate import PlateCode, PlateGeometry, reed_solomon_words, unit_index
from app.markers.print_grade import LETTERS, THRESHOLDS, PrintGrade, PrintParameter, PrintParameterName, PrintView
from app.markers.reading import PlateReading
from app.values import Floats

# === Parameters of a print grade: what was measured on a face -> values, grades, causes and cures.


DAMAGED = 0.3
"""[contrast] by which a spot of a unit differs from the unit. Above the noise and grain of a photo, below the least
paint that turns a unit."""
DAMAGE_SHARE = 0.8
"""[units] side of the part of a unit that is searched for stains; its edges are those of the print growth."""
NEARLY_WHOLE, WHOLE_UNIT, STAINED_GAP = 0.94, 0.985, 0.25
"""[units, 1, 1] side of a unit without its edges, share of it that counts as all of it, and share of the gaps around it
that a stain covers too. A round stain leaves the corners free, or covers more than one gap."""
MIN_WIDTHS = 3
"""Units of a paint whose median is its width. One that is damaged has no say then."""
MARKER_REACH = 0.35
"""[units] half side of the part of a marker whose colour is taken. Half of the triangle's width about its centroid."""
WHITE = 0.75
"""[1] reflectance of white paint as the decoder's trials have it. Source: `PlateLook.light` of
app/simulation/plate_face.py."""
_NAMES = ("red triangle", "green square top right", "green square bottom right", "green square bottom left")


@dataclass(frozen=True, slots=True)
class PrintEvidence:
    """What a print is graded by."""

    face: MeasuredFace
    code: PlateCode  # what the plate should be
    geometry: PlateGeometry  # of the drawing
    axes: tuple[Floats, Floats]  # the print's axes, right and down, in the camera's frame, shape (3,) each
    reading: PlateReading  # of the photo, without a registry
    with_registry: bool  # whether it is read with the registry that has the code


def grade_parameters(evidence: PrintEvidence) -> tuple[PrintParameter, ...]:
    """All parameters of a print, in the order of the report."""
    parameters = [
        _contrast(evidence), _modulation(evidence), _margin(evidence), _axial(evidence), _grid(evidence),
        _growth(evidence), _colour(evidence), _damage(evidence),
    ]  # fmt: skip
    if evidence.code.scheme.corrects:
        parameters.append(_unused(evidence))
    return (*parameters, _decode(evidence))


def reflectance_margins(face: MeasuredFace, code: PlateCode) -> Floats:
    """How far each unit is on its side of the threshold, over half the contrast; negative: on the other side.

    Notes
    -----
    ISO/IEC 15415, reflectance margin: 2 (R - GT) / SC, GT being the middle of the two paints. At most 1.
    """
    half = (1 - face.dark_level) / 2
    signed = np.where(code.units.astype(bool), -1.0, 1.0) * (face.levels - (1 + face.dark_level) / 2) / half
    return np.minimum(signed, 1.0)


def _graded(
    name: PrintParameterName,
    value: float,
    finding: str,
    cure: str,
    unit_at: tuple[int, int] | None = None,
    grade: float | None = None,
) -> PrintParameter:
    value, thresholds = round(float(value), 4), THRESHOLDS[name]
    found = thresholds.grade(value) if grade is None else grade
    cure_of_found = cure if found < 4 else None
    return PrintParameter(
        name, value, thresholds.unit, found, LETTERS[int(found)], thresholds, finding, cure_of_found, unit_at
    )


# --- reflectance ------------------------------------------------------------------------------------------------------


def _contrast(evidence: PrintEvidence) -> PrintParameter:
    dark = evidence.face.dark_level
    return _graded(
        PrintParameterName.SYMBOL_CONTRAST,
        100 * (1 - dark),
        f"dark units reflect {dark:.0%} of what the white ones reflect",
        "use a matt black paint or a denser ink; make sure that nothing glossy mirrors the sky",
    )


def _modulation(evidence: PrintEvidence) -> PrintParameter:
    values = np.abs(reflectance_margins(evidence.face, evidence.code))
    return _by_unit(
        evidence, PrintParameterName.MODULATION, values, "cover every unit evenly, and replace faded or stained ones"
    )


def _margin(evidence: PrintEvidence) -> PrintParameter:
    values = np.maximum(reflectance_margins(evidence.face, evidence.code), 0.0)
    return _by_unit(evidence, PrintParameterName.REFLECTANCE_MARGIN, values,
                    "print the unit in the other paint where it is wrong; otherwise as for modulation")  # fmt: skip


def _by_unit(evidence: PrintEvidence, name: PrintParameterName, values: Floats, cure: str) -> PrintParameter:
    row, column = np.unravel_index(np.nanargmin(values), values.shape)
    at = (int(row) + 1, int(column) + 1)
    paint = "dark" if evidence.code.units[row, column] else "light"
    finding = (
        f"the weakest unit, row {at[0]}, column {at[1]}, which should be {paint}, reflects "
        f"{max(evidence.face.levels[row, column], 0.0):.0%} of the white; the threshold is "
        f"{(1 + evidence.face.dark_level) / 2:.0%}"
    )
    grade = _with_correction(evidence.code, values, name) if evidence.code.scheme.corrects else None
    return _graded(name, 100 * values[row, column], finding, cure, at, grade)


def _with_correction(code: PlateCode, values: Floats, name: PrintParameterName) -> float:
    """Grade of values of units when cells below a grade are left to error correction, the best over all grades.

    Source: ISO/IEC 15415, modulation: the lower of the grade assumed and of the error correction left by it.
    """
    weakest = values.ravel()[unit_index(code.n)].min(axis=1)
    grades = np.array([THRESHOLDS[name].grade(100 * value) for value in weakest])
    unused = THRESHOLDS[PrintParameterName.UNUSED_ERROR_CORRECTION]
    return max(min(float(level), unused.grade(_unused_share(code, grades < level))) for level in range(5))


def _unused_share(code: PlateCode, wrong: npt.NDArray[np.bool_]) -> float:
    """Least error correction that a codeword has left with these cells wrong."""
    words = reed_solomon_words(code.n, code.scheme)
    return max(0.0, min(1 - 2 * int(wrong[list(word.cells)].sum()) / word.checks for word in words))


# --- geometry ---------------------------------------------------------------------------------------------------------


def _axial(evidence: PrintEvidence) -> PrintParameter:
    right, down = evidence.axes
    lengths = np.linalg.norm([right, down], axis=1)
    diagonals = np.linalg.norm([right + down, right - down], axis=1)
    sides, skew = (abs(a - b) / ((a + b) / 2) for a, b in (lengths, diagonals))
    if skew > sides:
        finding = f"the diagonals differ by {skew:.1%}: the print is no square"
    else:
        longer = "across" if lengths[0] > lengths[1] else "along"
        finding = f"the units' spacing is {sides:.1%} longer {longer} the direction of travel"
    return _graded(
        PrintParameterName.AXIAL_NONUNIFORMITY, max(sides, skew), finding,
        "print at 100 % without fitting to the page; check the plotter's feed, and send the whole photo uncropped",
    )  # fmt: skip


def _grid(evidence: PrintEvidence) -> PrintParameter:
    off = np.linalg.norm(evidence.face.offsets_mm, axis=-1)
    cure = "place the units by the drawing: check the template, or the cutter's steps"
    if not np.isfinite(off).any():
        return _graded(
            PrintParameterName.GRID_NONUNIFORMITY, 1.0, "no unit has edges against the gaps", cure, grade=0.0
        )
    row, column = np.unravel_index(np.nanargmax(off), off.shape)
    at = (int(row) + 1, int(column) + 1)
    finding = (
        f"the unit in row {at[0]}, column {at[1]} is {off[row, column]:.1f} mm off its place, the most of "
        f"{int(np.isfinite(off).sum())} units that stand out of the gaps"
    )
    value = off[row, column] / evidence.geometry.pitch_mm
    return _graded(PrintParameterName.GRID_NONUNIFORMITY, value, finding, cure, at)


def _growth(evidence: PrintEvidence) -> PrintParameter:
    face, geometry = evidence.face, evidence.geometry
    name, cure = (
        PrintParameterName.PRINT_GROWTH,
        "adjust the ink, the stencil or the cut, so that the gaps have their width",
    )
    if face.merged > MERGED:
        return _graded(name, 1.0, f"{face.merged:.0%} of the units touch a neighbour: the gaps are closed", cure)
    means = []
    for paint, which in (("dark", face.dark), ("light", ~face.dark)):
        widths = face.widths_mm[which & np.isfinite(face.widths_mm).all(axis=-1)]
        if len(widths) >= MIN_WIDTHS:
            means.append((float(np.median(widths)) - geometry.unit_mm, paint))
    if not means:
        return _graded(name, 1.0, "too few units have edges against the gaps", cure)
    growth, paint = max(means, key=lambda one: abs(one[0]))
    finding = (
        f"{paint} units are {geometry.unit_mm + growth:.1f} mm wide in place of {geometry.unit_mm:g} mm, so the gaps "
        f"between them have {geometry.gap_mm - growth:.1f} mm in place of {geometry.gap_mm:g} mm"
    )
    return _graded(name, abs(growth) / geometry.gap_mm, finding, cure)


# --- colour and damage ------------------------------------------------------------------------------------------------


def _colour(evidence: PrintEvidence) -> PrintParameter:
    face, geometry = evidence.face, evidence.geometry
    reach, colours = MARKER_REACH * geometry.unit_mm, []
    for k, centroid in enumerate(marker_centroids(geometry)):
        part = face.reflectance[window(centroid * geometry.side_mm, reach, len(face.reflectance))]
        blue, green, red = _encoded(np.median(part.reshape(-1, 3), axis=0) * WHITE)
        colours.append(red - max(green, blue) if k == 0 else green - max(red, blue))
    palest = int(np.argmin(colours))
    main, others = ("red", "green and blue") if palest == 0 else ("green", "red and blue")
    finding = (
        f"the {_NAMES[palest]} is the palest marker: its {main} exceeds {others} by {colours[palest]:.2f} of full scale"
    )
    return _graded(
        PrintParameterName.COLOUR, colours[palest], finding,
        "use traffic red (RAL 3020) and traffic green (RAL 6024), unfaded, in their places",
    )  # fmt: skip


def _encoded(light: npt.NDArray[np.floating]) -> Floats:
    """sRGB of linear light, 0 to 1."""
    clipped = np.clip(light, 0, 1).astype(np.float64)
    return np.asarray(np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055))


def _damage(evidence: PrintEvidence) -> PrintParameter:
    face, geometry, code = evidence.face, evidence.geometry, evidence.code
    shares = _damaged_shares(face, code, geometry)
    wrong = np.argwhere(is_unit(code.n) & (face.dark != code.units.astype(bool))) + 1
    row, column = np.unravel_index(np.nanargmax(shares), shares.shape)
    stained = 100 * float(np.nanmean(shares))
    if len(wrong):
        places = ", ".join(f"{r}/{c}" for r, c in wrong[:6]) + (", ..." if len(wrong) > 6 else "")
        finding = f"{len(wrong)} units are of the wrong paint (row/column {places})"
        if stained >= 0.1:
            finding += f", and {stained:.1f} % of the units' area is stained"
        at = (int(wrong[0][0]), int(wrong[0][1]))
    else:
        finding = f"{stained:.1f} % of the units' area is stained or worn"
        at = (int(row) + 1, int(column) + 1)
    grade = 0.0 if len(wrong) and not code.scheme.corrects else None
    return _graded(
        PrintParameterName.DAMAGE, stained, finding, "clean or repaint the units named; print again what is wrong",
        at if len(wrong) or stained >= 0.1 else None, grade,
    )  # fmt: skip


def _damaged_shares(face: MeasuredFace, code: PlateCode, geometry: PlateGeometry) -> Floats:
    """Share of each unit's area that differs from its paint, NaN in the corner cells, shape (n, n).

    A unit that differs as a whole while the gaps around it do not is faded or wrong, not stained: it has no share.
    """
    luminance, places = face.luminance, unit_centres_mm(geometry)
    offsets = np.nan_to_num(face.offsets_mm)
    limit = DAMAGED * (1 - face.dark_level)
    shares = np.full(face.levels.shape, np.nan)
    for row, column in np.argwhere(is_unit(geometry.n)):
        at = places[row, column] + offsets[row, column]
        paint = face.dark_level if code.units[row, column] else 1.0
        share, nearly_whole = (
            float((np.abs(luminance[window(at, size * geometry.unit_mm / 2, len(luminance))] - paint) > limit).mean())
            for size in (DAMAGE_SHARE, NEARLY_WHOLE)
        )
        if nearly_whole > WHOLE_UNIT and _gap_share(face, luminance, places[row, column], geometry) < STAINED_GAP:
            share = 0.0
        shares[row, column] = share
    return shares


def _gap_share(face: MeasuredFace, luminance: npt.NDArray[np.float32], at_mm: Floats, geometry: PlateGeometry) -> float:
    """Share of the gaps around a unit that differs from the other gaps."""
    middle, reach = (geometry.unit_mm + geometry.gap_mm) / 2, geometry.gap_mm / 4
    along = np.array([geometry.unit_mm / 2, reach])
    strips = [(np.array([0.0, middle]), along), (np.array([0.0, -middle]), along),
              (np.array([middle, 0.0]), along[::-1]), (np.array([-middle, 0.0]), along[::-1])]  # fmt: skip
    values = [luminance[window(at_mm + place, size, len(luminance))].ravel() for place, size in strips]
    return float((np.abs(np.concatenate(values) - face.gap_level) > DAMAGED * (1 - face.dark_level)).mean())


# --- reading ----------------------------------------------------------------------------------------------------------


def _unused(evidence: PrintEvidence) -> PrintParameter:
    code, face = evidence.code, evidence.face
    differs = (face.dark != code.units.astype(bool)).ravel()[unit_index(code.n)].any(axis=1)
    return _graded(
        PrintParameterName.UNUSED_ERROR_CORRECTION,
        _unused_share(code, differs),
        f"{int(differs.sum())} of {len(differs)} cells have a wrong unit, which error correction must make good",
        "print the wrong units again: dirt and wear need the margin of a print that is right when new",
    )


def _decode(evidence: PrintEvidence) -> PrintParameter:
    reading, code = evidence.reading, evidence.code
    read = reading.digits == code.digits
    if read:
        finding = f"the decoder reads {code.digits} from the photo alone"
    elif evidence.with_registry:
        finding = f"the decoder reads it with the registry only; alone: {reading.reason or reading.outcome}"
    elif reading.code is not None:
        finding = f"the decoder reads {reading.digits}, not {code.digits}"
    else:
        finding = f"the decoder does not read the photo: {reading.reason or reading.outcome}"
    return _graded(
        PrintParameterName.DECODE, 1.0 if read or evidence.with_registry else 0.0, finding,
        "photograph the plate that is declared, or print it again" if reading.code else "see the other parameters",
    )  # fmt: skip


# === Photo of a printed plate to the grade of its print.


SEARCH_SIDE_PX = 1600
"""[px] longest side of the reduced photo in which the plate is searched. For speed: a plate of 24 rows there is far too
small to be graded."""
MIN_SIDE_PX = 400.0
"""[px] least side of a plate that is graded. Its gaps of 5 mm then have six pixels."""
MIN_GAP_PX = 4.0
"""[px] least width of a gap, which narrow gaps need."""
MAX_EDGE_GAPS = 0.8
"""[gaps] widest edge, from 10 to 90 %: wider ones of neighbours run into each other."""
MAX_CLIPPED = 0.05
"""[1] share of over-exposed pixels on the light units."""
MIN_WHITE_LEVEL = 70.0
"""[grey level] least brightness of the light units. Noise is 3 % of the white there."""
MAX_LIGHT_RATIO = 2.0
"""[1] brightest over darkest light on the plate."""
MAX_SHADED, SHADED_LEVEL = 0.25, 0.75
"""[1] share of light units that may be darker than this share of the others, as in a shadow."""
MAX_TILT_DEG, MAX_TILT_ASSUMED_DEG = 30.0, 15.0
"""[deg] greatest tilt with the focal length of the photo's EXIF, and with an assumed one. Source: a focal length that
is off by 15 % changes the ratio of the axes by 2 % at 15 degrees, a third of grade A's limit."""
ASSUMED_FOCAL_35MM = 26.0
"""[mm] focal length on 36 mm film of a phone's main camera, 24 to 28. Source: makers' data sheets."""
MIN_AGREEMENT = 0.75
"""[1] share of units as expected in a plate that the decoder cannot read. Of 48 units at random, 36 agree once in 2,800
times."""
_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
_MIN_CHROMA = 12  # [grey levels] of the most colourful hundredth of a photo

Image = npt.NDArray[np.uint8]


def grade_print(
    photo: Image,
    *,
    code: PlateCode | None = None,
    geometry: PlateGeometry | None = None,
    focal_35mm: float | None = None,
) -> PrintGrade:
    """Grade a printed plate by a photo.

    Parameters
    ----------
    photo : ndarray of uint8, shape (H, W, 3)
        Upright and whole; blue, green, red in sRGB.
    code : PlateCode, optional
        What the plate should be; without it, it is what the photo shows.
    geometry : PlateGeometry, optional
        Of the drawing; without it, units of 35 mm and gaps of 5 mm.
    focal_35mm : float, optional
        Focal length on 36 mm film, of the photo's EXIF. [mm]

    Raises
    ------
    PrintNotGraded
        There is no plate, more than one, or the photo does not show it well enough; with the limit and the cure.
    """
    reading, with_registry = _find_plate(photo, code, geometry)
    drawn = geometry or reading.geometry
    assert reading.corners_px is not None
    assert drawn is not None
    _check_size(photo, reading.corners_px, drawn)
    face = measure_face(photo, reading.corners_px, drawn)
    if face is None:
        raise PrintNotGraded(
            "fewer than two dark or three light units can be told apart", field="photo",
            limit="two dark and three light units", cure="grade a plate of another code, or print with more contrast",
        )  # fmt: skip
    expected = code or reading.code
    assert expected is not None
    _check_agreement(reading, expected, face)
    _check_light(face)
    view = _view(photo, face, drawn, focal_35mm)
    _check_view(view, drawn)
    axes = _axes(photo, face.image_from_face, drawn, focal_35mm)[0]
    parameters = grade_parameters(PrintEvidence(face, expected, drawn, axes, reading, with_registry))
    return PrintGrade(
        expected, drawn, code is not None, reading.outcome, reading.digits, view, parameters,
        reflectance_margins(face, expected), is_unit(drawn.n) & (face.dark != expected.units.astype(bool)),
        _as_srgb(face.reflectance), face.reflectance,
    )  # fmt: skip


# --- the plate --------------------------------------------------------------------------------------------------------


def _find_plate(photo: Image, code: PlateCode | None, geometry: PlateGeometry | None) -> tuple[PlateReading, bool]:
    """The plate's reading without a registry, its corners in the photo, and whether a registry with the code helps."""
    shrink = min(1.0, SEARCH_SIDE_PX / max(photo.shape[:2]))
    small = photo
    if shrink < 1:
        size = (round(photo.shape[1] * shrink), round(photo.shape[0] * shrink))
        small = np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), np.uint8)
    wanted = (geometry,) if geometry is not None else DEFAULT_GEOMETRIES
    found = [one for one in decode_plates(small, geometries=wanted) if one.corners_px is not None]
    read = [one for one in found if one.code is not None]
    if len(read) > 1:
        raise PrintNotGraded(
            f"{len(read)} plates are in the photo", field="photo", limit="one plate", cure="photograph one plate alone"
        )
    if not read and (code is None or not found):
        raise _no_plate(small, found)
    best = (read or found)[0]
    if code is None and best.code is None:
        raise _no_plate(small, found)
    with_registry, place = False, best
    if code is not None and best.code is None:
        known = [one for one in decode_plates(small, geometries=wanted, codebook=(code,)) if one.digits == code.digits]
        with_registry, place = bool(known), (known or [best])[0]
    _check_same_size(best, code)
    assert place.corners_px is not None
    scale = np.array([photo.shape[1] / small.shape[1], photo.shape[0] / small.shape[0]])
    corners_px = (place.corners_px + 0.5) * scale - 0.5
    if (corners_px < -0.5).any() or (corners_px > np.array(photo.shape[1::-1]) - 0.5).any():
        raise PrintNotGraded(
            "a corner of the plate is out of the photo", field="photo", limit="the whole plate",
            cure="photograph the whole plate with some ground around it",
        )  # fmt: skip
    return _moved(best, corners_px), with_registry


def _moved(reading: PlateReading, corners_px: Floats) -> PlateReading:
    return PlateReading(
        reading.outcome, corners_px, code=reading.code, confidence=reading.confidence, geometry=reading.geometry,
        corrected_cells=reading.corrected_cells, reason=reading.reason,
    )  # fmt: skip


def _no_plate(small: Image, found: list[PlateReading]) -> PrintNotGraded:
    values = small.reshape(-1, 3)
    chroma = np.percentile(values.max(axis=1).astype(int) - values.min(axis=1), 99)
    if chroma < _MIN_CHROMA:
        return PrintNotGraded(
            "the photo is grey, so the red triangle and the green squares cannot be found", field="photo",
            limit="a colour photo", cure="photograph in colour, without a monochrome filter",
        )  # fmt: skip
    if found:
        return PrintNotGraded(
            f"a plate was found but not read: {found[0].reason or found[0].outcome}",
            field="code",
            limit="a plate that can be read, or its digits",
            cure="declare the code that the plate should have, then a plate that cannot be read is graded too",
        )
    return PrintNotGraded(
        "no plate was found in the photo", field="photo", limit="one whole plate of the declared geometry",
        cure="photograph the whole plate from above, in even light and in focus, and check n, unit_mm and gap_mm; "
            "if all is so, the red triangle and the green squares are too pale",
    )  # fmt: skip


def _check_same_size(reading: PlateReading, code: PlateCode | None) -> None:
    if code is not None and reading.geometry is not None and reading.geometry.n != code.n:
        raise PrintNotGraded(
            f"the photo shows a plate of {reading.geometry.n} x {reading.geometry.n} units, not {code.n} x {code.n}",
            field="geometry.n", limit=f"n = {code.n}", cure="photograph the plate that is declared",
        )  # fmt: skip


def _check_agreement(reading: PlateReading, expected: PlateCode, face: MeasuredFace) -> None:
    """A candidate that was not read must look like the plate that is expected."""
    units = is_unit(expected.n)
    agreement = float((face.dark == expected.units.astype(bool))[units].mean())
    if reading.code is None and agreement < MIN_AGREEMENT:
        raise PrintNotGraded(
            f"the plate cannot be read, and only {agreement:.0%} of its units are as expected",
            field="code",
            limit=f"{MIN_AGREEMENT:.0%} of the units",
            cure="photograph the plate that is declared, in even light",
        )


# --- the photo --------------------------------------------------------------------------------------------------------


def _side_px(corners_px: Floats) -> float:
    return float(np.linalg.norm(np.roll(corners_px, -1, axis=0) - corners_px, axis=1).mean())


def _check_size(photo: Image, corners_px: Floats, geometry: PlateGeometry) -> None:
    side_px = _side_px(corners_px)
    least_px = max(MIN_SIDE_PX, MIN_GAP_PX * geometry.side_mm / geometry.gap_mm)
    if side_px < least_px:
        raise PrintNotGraded(
            f"the plate covers {side_px:.0f} px of a photo of {photo.shape[1]} x {photo.shape[0]} px", field="photo",
            limit=f"at least {least_px:.0f} px a side", cure=f"come nearer until the plate covers {least_px:.0f} px",
        )  # fmt: skip


def _check_light(face: MeasuredFace) -> None:
    if face.clipped > MAX_CLIPPED:
        raise PrintNotGraded(
            f"{face.clipped:.0%} of the white is over-exposed",
            field="photo",
            limit=f"at most {MAX_CLIPPED:.0%} of the white's pixels at {CLIPPED_LEVEL} of 255 or more",
            cure="expose less: tap on the plate's white before taking the photo, and avoid direct sun and flash",
        )
    if face.white_level < MIN_WHITE_LEVEL:
        raise PrintNotGraded(
            f"the photo is too dark: the plate's white has the level {face.white_level:.0f} of 255", field="photo",
            limit=f"at least {MIN_WHITE_LEVEL:.0f}", cure="photograph in daylight, and expose more",
        )  # fmt: skip
    units = is_unit(face.dark.shape[0])
    shaded = float((face.levels[units & ~face.dark] < SHADED_LEVEL).mean())
    if face.light_ratio > MAX_LIGHT_RATIO or shaded > MAX_SHADED:
        raise PrintNotGraded(
            f"the light on the plate is uneven: it varies by the factor {face.light_ratio:.1f}, "
            f"and {shaded:.0%} of the light units are darker than the others",
            field="photo",
            limit=f"a factor of {MAX_LIGHT_RATIO:g}, {MAX_SHADED:.0%} of the light units",
            cure="photograph in the open shade or under an overcast sky, without a shadow's edge on the plate",
        )


def _view(photo: Image, face: MeasuredFace, geometry: PlateGeometry, focal_35mm: float | None) -> PrintView:
    side = geometry.side_mm
    square = np.array([[(0.0, 0.0), (side, 0.0), (side, side), (0.0, side)]])
    corners_px = cv2.perspectiveTransform(square, face.image_from_face)[0]
    tilt_deg = _axes(photo, face.image_from_face, geometry, focal_35mm)[1]
    return PrintView(
        _side_px(corners_px),
        tilt_deg,
        face.edge_mm,
        face.light_ratio,
        face.white_level,
        "assumed" if focal_35mm is None else "exif",
    )


def _check_view(view: PrintView, geometry: PlateGeometry) -> None:
    limit_mm = MAX_EDGE_GAPS * geometry.gap_mm
    if not view.edge_mm <= limit_mm:
        raise PrintNotGraded(
            f"the photo is blurred: edges are {view.edge_mm:.1f} mm wide",
            field="photo",
            limit=f"at most {limit_mm:.1f} mm from 10 to 90 %, {MAX_EDGE_GAPS:g} of a gap",
            cure="hold the camera still, focus on the plate, and come nearer; if every photo shows it, the ink bleeds",
        )
    from_exif = view.focal_length_source == "exif"
    limit_deg = MAX_TILT_DEG if from_exif else MAX_TILT_ASSUMED_DEG
    if view.tilt_deg > limit_deg:
        known = "" if from_exif else " (30 degrees with the focal length in the photo's EXIF)"
        raise PrintNotGraded(
            f"the photo is oblique: the camera is tilted by {view.tilt_deg:.0f} degrees against the plate",
            field="photo",
            limit=f"at most {limit_deg:g} degrees{known}",
            cure="hold the camera parallel to the plate, straight above its centre, and send the photo uncropped",
        )


def _axes(
    photo: Image, image_from_face: Floats, geometry: PlateGeometry, focal_35mm: float | None
) -> tuple[tuple[Floats, Floats], float]:
    """The print's own axes, right and down, in the camera's frame at the plate's centre, and the camera's tilt [deg].

    With the camera's matrix K, a homography of a plane is K [r1 r2 t] up to a factor; a print that is stretched or
    sheared has other columns in place of the orthonormal r1 and r2. The camera has square pixels and its principal
    point in the middle of the photo.
    """
    height, width = photo.shape[:2]
    focal_px = (focal_35mm or ASSUMED_FOCAL_35MM) / _FILM_DIAGONAL_MM * math.hypot(width, height)
    camera = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
    middle = np.array([[1, 0, geometry.side_mm / 2], [0, 1, geometry.side_mm / 2], [0, 0, 1]])
    columns = np.linalg.solve(camera, image_from_face @ middle)
    right, down = columns[:, 0], columns[:, 1]
    normal = np.cross(right, down)
    tilt = math.degrees(math.acos(min(1.0, abs(float(normal[2])) / float(np.linalg.norm(normal)))))
    return (right, down), tilt


def _as_srgb(reflectance: npt.NDArray[np.float32]) -> Image:
    """As a picture in which the light units are nearly white."""
    light = np.clip(reflectance * np.float32(0.88), 0, 1)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.power(light, 1 / 2.4) - 0.055)
    return np.asarray(encoded * 255 + 0.5, np.uint8)
