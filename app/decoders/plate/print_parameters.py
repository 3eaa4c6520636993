"""Parameters of a print grade: what was measured on a face -> values, grades, causes and cures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.decoders.plate.layout import marker_centroids
from app.decoders.plate.print_face import MERGED, MeasuredFace, is_unit, unit_centres_mm, window
from app.markers.plate import PlateCode, PlateGeometry, reed_solomon_words, unit_index
from app.markers.print_grade import THRESHOLDS, PrintParameter, PrintParameterName
from app.markers.reading import PlateReading

DAMAGED = 0.3
"""[contrast] by which a spot of a unit differs from the unit. Source: chosen by hand: above the noise and grain of a
photo, below the least paint that turns a unit."""
DAMAGE_SHARE = 0.8
"""[units] side of the part of a unit that is searched for stains; its edges are those of the print growth."""
NEARLY_WHOLE, WHOLE_UNIT, STAINED_GAP = 0.94, 0.985, 0.25
"""[units, 1, 1] side of a unit without its edges, share of it that counts as all of it, and share of the gaps around it
that a stain covers too. Source: chosen by hand: a round stain leaves the corners free, or covers more than one gap."""
MIN_WIDTHS = 3
"""Units of a paint whose median is its width. Source: chosen by hand: one that is damaged has no say then."""
MARKER_REACH = 0.35
"""[units] half side of the part of a marker whose colour is taken. Source: chosen by hand: half of the triangle's width
about its centroid."""
WHITE = 0.75
"""[1] reflectance of white paint as the decoder's trials have it. Source: `PlateLook.light` of
app/simulation/plate_face.py."""
_NAMES = ("red triangle", "green square top right", "green square bottom right", "green square bottom left")

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PrintEvidence:
    """What a print is graded by.

    Attributes
    ----------
    face : MeasuredFace
    code : PlateCode
        What the plate should be.
    geometry : PlateGeometry
        Of the drawing.
    axes : (ndarray, ndarray)
        The print's axes, right and down, in the camera's frame, shape (3,) each.
    reading : PlateReading
        Of the photo, without a registry.
    with_registry : bool
        Whether it is read with the registry that has the code.
    """

    face: MeasuredFace
    code: PlateCode
    geometry: PlateGeometry
    axes: tuple[Array, Array]
    reading: PlateReading
    with_registry: bool


def grade_parameters(evidence: PrintEvidence) -> tuple[PrintParameter, ...]:
    """All parameters of a print, in the order of the report."""
    parameters = [
        _contrast(evidence), _modulation(evidence), _margin(evidence), _axial(evidence), _grid(evidence),
        _growth(evidence), _colour(evidence), _damage(evidence),
    ]  # fmt: skip
    if evidence.code.scheme.corrects:
        parameters.append(_unused(evidence))
    return (*parameters, _decode(evidence))


def reflectance_margins(face: MeasuredFace, code: PlateCode) -> Array:
    """How far each unit is on its side of the threshold, over half the contrast; negative: on the other side.

    Notes
    -----
    ISO/IEC 15415, reflectance margin: 2 (R - GT) / SC, GT being the middle of the two paints. At most 1.
    """
    half = (1 - face.dark_level) / 2
    signed = np.where(code.units.astype(bool), -1.0, 1.0) * (face.levels - (1 + face.dark_level) / 2) / half
    return np.minimum(signed, 1.0)


def _graded(
    name: PrintParameterName, value: float, finding: str, cure: str, unit_at: tuple[int, int] | None = None,
    grade: float | None = None,
) -> PrintParameter:  # fmt: skip
    value = round(float(value), 4)
    found = THRESHOLDS[name].grade(value) if grade is None else grade
    return PrintParameter(name, value, found, finding, cure if found < 4 else "", unit_at)


# --- reflectance ------------------------------------------------------------------------------------------------------


def _contrast(evidence: PrintEvidence) -> PrintParameter:
    dark = evidence.face.dark_level
    return _graded(
        PrintParameterName.SYMBOL_CONTRAST, 100 * (1 - dark),
        f"dark units reflect {dark:.0%} of what the white ones reflect",
        "use a matt black paint or a denser ink; make sure that nothing glossy mirrors the sky",
    )  # fmt: skip


def _modulation(evidence: PrintEvidence) -> PrintParameter:
    values = np.abs(reflectance_margins(evidence.face, evidence.code))
    return _by_unit(evidence, PrintParameterName.MODULATION, values,
                    "cover every unit evenly, and replace faded or stained ones")  # fmt: skip


def _margin(evidence: PrintEvidence) -> PrintParameter:
    values = np.maximum(reflectance_margins(evidence.face, evidence.code), 0.0)
    return _by_unit(evidence, PrintParameterName.REFLECTANCE_MARGIN, values,
                    "print the unit in the other paint where it is wrong; otherwise as for modulation")  # fmt: skip


def _by_unit(evidence: PrintEvidence, name: PrintParameterName, values: Array, cure: str) -> PrintParameter:
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


def _with_correction(code: PlateCode, values: Array, name: PrintParameterName) -> float:
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


def _encoded(light: npt.NDArray[np.floating]) -> Array:
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


def _damaged_shares(face: MeasuredFace, code: PlateCode, geometry: PlateGeometry) -> Array:
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


def _gap_share(face: MeasuredFace, luminance: npt.NDArray[np.float32], at_mm: Array, geometry: PlateGeometry) -> float:
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
        PrintParameterName.UNUSED_ERROR_CORRECTION, _unused_share(code, differs),
        f"{int(differs.sum())} of {len(differs)} cells have a wrong unit, which error correction must make good",
        "print the wrong units again: what is wrong when new is not left for dirt",
    )  # fmt: skip


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
