"""Plates in camera frames: what is looked for, and which registered plate a reading is of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import sqlalchemy as sa
from typing_extensions import TypedDict

from app.decoding.declarations import CoarsePosition
from app.decoding.frames import (
    DecodePlates,
    Match,
    Nearby,
    Pixels,
    PlateSearch,
    decode_plates,
    distance_to_row,
    match_plate,
    read_plates,
    search_plates,
)
from app.errors import NotFound
from app.families.family import FrameReader, rounded
from app.geodesy.frames import distance_m
from app.markers.plate import (
    PlateCode,
    PlateScheme,
    ResolvedPosition,
    decimal_codes,
    resolve_position,
)
from app.markers.reading import PlateGrade, PlatePose, PlateReading
from app.registry import markers as store
from app.registry.markers import MarkerFilter
from app.sensors.camera import Camera

# === Plates in camera frames.


_MAX_ELSEWHERE = 500
_M_PER_DEG = 111_000.0


class ReadGeometryDocument(TypedDict):
    """Dimensions of a plate, as far as a frame shows them."""

    n: int
    unit_mm: float
    gap_mm: float


class PossibleSchemeDocument(TypedDict):
    """A scheme whose checks the digits of a plate satisfy; `check_digits` of `position-check`."""

    scheme: str
    check_digits: int | None


class PlateReadingDocument(TypedDict):
    """A candidate plate in a frame and what was read from it.

    `certainty` is `sure` with `digits` that Reed-Solomon checks or a registered plate nearby confirm, and `unchecked`
    with others: a unit that peeled off or is taped over shows other digits in every frame, so `confidence` is at most
    0.99. It is `tentative` with `likely_digits`, which are too unsure to be matched or to give a position, and
    `doubtful_cells`, the cells that may be wrong: other frames of an archive, or a registered plate nearby, may confirm
    them. It is null where there are no digits, and `confidence` is then 0.

    `has_check` is whether the scheme of the digits has Reed-Solomon checks; the check digits of `position-check` do not
    count, because a frame does not show that a plate has them.

    `scheme` is that of the registered plate nearby with these digits. Without one, `possible_schemes` has all schemes
    whose checks the digits satisfy: one check digit holds by accident for one `position` plate in ten, two for one in a
    hundred.
    """

    family: Literal["plate"]
    outcome: str
    reason: str | None
    certainty: str | None
    digits: str | None
    likely_digits: str | None
    doubtful_cells: list[int]
    scheme: str | None
    has_check: bool | None
    possible_schemes: list[PossibleSchemeDocument]
    registry_number: int | None
    confidence: float
    cell_confidence: list[float]
    corrected_cells: list[int]
    from_codebook: bool
    evidence_frames: list[int]
    corners_px: list[list[float]] | None
    corner_sigma_px: float | None
    height_px: float
    width_px: float
    geometry: ReadGeometryDocument | None
    grade: PlateGrade | None
    pose: PlatePose | None


class PlateFrames(FrameReader[PlateReading, PlateSearch]):
    """Reads plates in frames.

    Parameters
    ----------
    decode : callable, optional
        The plate decoder; tests put another one in its place.
    """

    document_type = PlateReadingDocument

    def __init__(self, decode: DecodePlates = decode_plates) -> None:
        self._decode = decode

    def search(self, nearby: Nearby, camera: Camera | None) -> PlateSearch:
        """The codes nearby, and their dimensions beside the usual ones."""
        return search_plates(nearby, camera)

    def read(self, pixels: Pixels, search: PlateSearch, *, thermal: bool) -> Sequence[PlateReading]:
        """Decode the plates of a frame."""
        return read_plates(pixels, search, self._decode, thermal=thermal)

    def match(
        self,
        connection: sa.Connection,
        agency_id: str,
        reading: PlateReading,
        position: CoarsePosition | None,
        nearby: Nearby,
    ) -> Match | None:
        """The registered plate with the digits that were read, nearest to the approximate position.

        Returns
        -------
        Match or None
            None where nothing was read or there is no position to look from.
        """
        code = reading.code
        if code is None or position is None:
            return None
        match = match_plate(nearby, code, position)
        if not nearby.complete:
            around = MarkerFilter(near=(position.lon_deg, position.lat_deg, position.reach_m), digits=code.digits)
            found = store.list_markers(connection, agency_id, around, after=None, limit=_MAX_ELSEWHERE)
            match = match_plate(Nearby(tuple(row for row in found if row.status != "retired")), code, position)
        if match is not None:
            return match
        if code.scheme is PlateScheme.ID:
            return _match_elsewhere(connection, agency_id, code, position)
        return _resolve_unregistered(code, position)

    def document(self, reading: PlateReading) -> PlateReadingDocument:
        """A reading as clients see it."""
        code, likely, geometry = reading.code, reading.likely_code, reading.geometry
        shown, covariance, checked = code or likely, reading.corners_covariance_px2, PlateScheme.POSITION_CHECK
        return {
            "family": "plate",
            "outcome": str(reading.outcome),
            "reason": reading.reason or None,
            "certainty": reading.certainty,
            "digits": reading.digits,
            "likely_digits": likely.digits if likely else None,
            "doubtful_cells": [int(cell) for cell in reading.doubtful_cells],
            "scheme": shown.scheme if shown else None,
            "has_check": shown.scheme.corrects if shown else None,
            "possible_schemes": [
                {"scheme": one.scheme, "check_digits": one.check_digits if one.scheme is checked else None}
                for one in (_possible_codes(shown) if shown else ())
            ],
            "registry_number": code.registry_number if code and code.scheme is PlateScheme.ID else None,
            "confidence": float(reading.confidence),
            "cell_confidence": [round(float(value), 6) for value in reading.cell_confidence],
            "corrected_cells": [int(cell) for cell in reading.corrected_cells],
            "from_codebook": bool(reading.from_codebook),
            "evidence_frames": list(reading.frames),
            "corners_px": rounded(reading.corners_px, 3),
            "corner_sigma_px": None if covariance is None else float(np.sqrt(np.trace(covariance) / len(covariance))),
            "height_px": round(float(reading.height_px), 2),
            "width_px": round(float(reading.width_px), 2),
            "geometry": {"n": geometry.n, "unit_mm": geometry.unit_mm, "gap_mm": geometry.gap_mm} if geometry else None,
            "grade": reading.grade,
            "pose": reading.pose,
        }

    def observation(self, reading: PlateReading) -> dict[str, object]:
        """Confidence, grade and corrections."""
        return {
            "confidence": float(reading.confidence),
            "grade": reading.grade.letter if reading.grade else None,
            "corrected_cells": len(reading.corrected_cells),
            "from_codebook": bool(reading.from_codebook),
        }


def _match_elsewhere(connection: sa.Connection, agency_id: str, code: PlateCode, position: CoarsePosition) -> Match:
    """An id plate names itself wherever it is: one far from its place was moved or copied."""
    known = store.find_id_code(connection, code.digits, code.n)
    try:
        row = store.get_marker(connection, agency_id, known.id) if known is not None else None
    except NotFound:  # another agency's
        row = None
    if row is None:
        return Match(None, note="no plate of this agency carries this registry number")
    note = "the plate is registered elsewhere: moved, copied, or the coarse position is wrong"
    if row.status == "retired":
        note = "the plate is retired"
    return Match(row, row.lon_deg, row.lat_deg, distance_to_row(row, position), False, (), note)


def _possible_codes(code: PlateCode) -> tuple[PlateCode, ...]:
    """The code under each scheme whose checks its digits satisfy; one code where it has Reed-Solomon checks."""
    return (code,) if code.scheme.corrects else decimal_codes(code.symbols, code.n)


def _resolve_unregistered(code: PlateCode, position: CoarsePosition) -> Match:
    """Where the digits place a plate: under the scheme with most check digits of those that place it within reach."""
    codes = _possible_codes(code)
    places = [resolve_position(one, position.lon_deg, position.lat_deg) for one in codes]
    matches = [_match_at(one, place, position) for one, place in zip(codes, places, strict=True)]
    plausible = [(place, match) for place, match in zip(places, matches, strict=True) if match.plausible]
    if not plausible:
        return matches[0]
    (plain, _), (checked, match) = plausible[0], plausible[-1]
    if plain is checked:
        return match
    apart_m = distance_m(plain.lon_deg, plain.lat_deg, checked.lon_deg, checked.lat_deg)
    return replace(match, note=f"{match.note}; otherwise it is {apart_m:.1f} m away")


def _match_at(code: PlateCode, resolved: ResolvedPosition, position: CoarsePosition) -> Match:
    away_m = distance_m(position.lon_deg, position.lat_deg, resolved.lon_deg, resolved.lat_deg)
    next_m = resolved.next_distance_deg * _M_PER_DEG * math.cos(math.radians(position.lat_deg))
    plausible = away_m <= position.reach_m
    fits_two = plausible and next_m <= position.reach_m
    if not plausible:
        note = "the digits say a place out of reach of the coarse position: not a position plate, or a misread"
    elif fits_two:
        note = "ambiguous: the decimals fit two places within reach of the coarse position"
    elif code.scheme is PlateScheme.POSITION_CHECK:
        note = f"not registered; the position is what its digits say if {code.check_digits} of them are check digits"
    else:
        note = "not registered; the position is what its digits say"
    return Match(None, resolved.lon_deg, resolved.lat_deg, away_m, plausible, (), note, fits_two)
