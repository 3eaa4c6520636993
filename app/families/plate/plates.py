"""The family of plates: their codes, where these are free, and what follows when a plate moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import sqlalchemy as sa

from app.errors import CodeTaken
from app.families.family import Family, Registration, map_point
from app.families.plate.artwork import PlateArtwork
from app.families.plate.coding import CodedPlate, coded_plate, position_code
from app.families.plate.documents import PlateDocument, plate_document
from app.families.plate.frames import PlateFrames
from app.families.plate.inputs import PLATE_EXAMPLES, PlateIn
from app.families.plate.planned import PlannedPlates
from app.families.plate.registration import NewPlate
from app.families.plate.rows import plate_code, plate_geometry
from app.families.plate.snapshot import PlateSnapshot
from app.families.plate.survey import PlateSurvey
from app.families.positions import place_input, position_columns
from app.families.rules import PLANNED, is_placed_anew
from app.geodesy import PlacedPosition
from app.markers.plate import PlateCode, PlateScheme, plate_capacity
from app.planning.outputs.hd_map import MapMarker
from app.registry import markers as store
from app.registry.marker_rows import MarkerRow

_LETTERS = frozenset("ABCDEF")
_MIN_LETTERS = 3
_ALLOCATION_TRIES = 1000


class Plates(Family[NewPlate, PlacedPosition]):
    """The family of plates."""

    name = "plate"
    label = "plate"
    title = "Plates"
    schema = PlateIn
    examples = PLATE_EXAMPLES
    snapshot = PlateSnapshot()
    survey = PlateSurvey()
    planned = PlannedPlates()
    artwork = PlateArtwork()
    frames = PlateFrames()
    document_type = PlateDocument
    detail_type = PlateDocument

    def prepare(self, registration: Registration, new: NewPlate) -> PlacedPosition:
        """The plate's place in WGS 84."""
        return place_input(new.position, registration.rules.crs_accuracy_m)

    def columns(
        self, connection: sa.Connection, registration: Registration, new: NewPlate, prepared: PlacedPosition
    ) -> dict[str, Any]:
        """Code, dimensions and place of a plate whose code is free.

        Raises
        ------
        InvalidParameter, CodeMismatch
            The code contradicts itself or the position.
        CodeTaken
            Another plate near by carries the code.
        """
        coded = coded_plate(
            new.code, new.geometry.n, (prepared.lon_deg, prepared.lat_deg),
            lambda: _allocate(connection, registration, new.geometry.n),
        )  # fmt: skip
        _check_free(connection, registration, coded, prepared.lon_deg, prepared.lat_deg)
        geometry, code = new.geometry, coded.code
        return {
            "family": self.name,
            "scheme": str(code.scheme),
            "digits": code.digits,
            "check_digits": code.check_digits if code.scheme is PlateScheme.POSITION_CHECK else None,
            "digits_match_position": coded.digits_match_position,
            "n": geometry.n,
            "unit_mm": geometry.unit_mm,
            "gap_mm": geometry.gap_mm,
            "thickness_mm": geometry.thickness_mm,
            "heading_deg": new.heading_deg,
            **position_columns(new.position, prepared),
        }

    def feature_members(self, properties: Mapping[str, Any]) -> dict[str, Any]:
        """Scheme and digits."""
        code = {"scheme": properties.get("scheme"), "digits": properties.get("code")}
        return {"code": {name: value for name, value in code.items() if value is not None}}

    def document(self, row: MarkerRow) -> PlateDocument:
        """A plate."""
        return plate_document(row)

    def map_markers(self, row: MarkerRow) -> Sequence[MapMarker]:
        """A square that lies on the road."""
        return (map_point(row, kind=row.scheme, side_m=plate_geometry(row).side_mm / 1000),)

    def revise(
        self, connection: sa.Connection, registration: Registration, row: MarkerRow, values: dict[str, Any]
    ) -> dict[str, Any]:
        """Columns of the code after a move: a planned plate's digits follow, a built one's stay as they are.

        Raises
        ------
        CodeTaken
            At its new place, or back in use, its code collides with another plate's.
        """
        if not is_placed_anew(row, values):
            return {}
        merged = row._replace(**values)
        code = plate_code(row)
        matches = row.digits_match_position
        is_explicit = matches is False
        if code.scheme is not PlateScheme.ID:
            expected = position_code(merged.lon_deg, merged.lat_deg, code.n, code.scheme, row.check_digits)
            if row.status == PLANNED and matches:
                code = expected
            matches = code == expected
        coded = CodedPlate(code, matches, is_explicit)
        _check_free(connection, registration, coded, merged.lon_deg, merged.lat_deg, row.id)
        return {"digits": code.digits, "digits_match_position": matches}


PLATE = Plates()


def _allocate(connection: sa.Connection, registration: Registration, n: int) -> PlateCode:
    """A free registry number at random, whose codeword cannot be taken for a position with two cells damaged."""
    bits = round(plate_capacity(n, PlateScheme.ID).bits)
    for _ in range(_ALLOCATION_TRIES):
        code = PlateCode.from_registry_number(registration.random_bits(bits), n=n)
        if sum(d in _LETTERS for d in code.digits) < _MIN_LETTERS:
            continue
        if store.find_id_code(connection, code.digits, n) is None:
            return code
    raise CodeTaken("no free registry number was found", field="code.registry_number", cure="use a larger plate")


def _check_free(
    connection: sa.Connection,
    registration: Registration,
    plate: CodedPlate,
    lon_deg: float,
    lat_deg: float,
    ignoring: str | None = None,
) -> None:
    if plate.code.scheme is PlateScheme.ID:
        other = store.find_id_code(connection, plate.code.digits, plate.code.n)
        limit = "a registry number names one plate for ever"
    else:
        wide_m = registration.rules.explicit_code_radius_m
        radius_m = wide_m if plate.is_explicit else registration.rules.position_code_radius_m
        other = store.find_code_near(
            connection,
            plate.code.digits,
            lon_deg,
            lat_deg,
            radius_m,
            mismatched_radius_m=wide_m,
            ignoring=ignoring,
        )
        limit = f"no two plates with the same digits within {radius_m:g} m"
    if other is None or other.id == ignoring:
        return
    own = other.agency_id == registration.agency_id
    raise CodeTaken(
        f"the digits {plate.code.digits} are taken by "
        + (f"marker {other.id}" if own else "a marker of another agency"),
        field="code.digits" if plate.is_explicit else "position",
        limit=limit,
        cure="choose other digits or another position, or retire the other plate",
    )
