"""The family of plates: their codes, where these are free, and what follows when a plate moves."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import sqlalchemy as sa
from typing_extensions import TypedDict

from app.errors import CodeMismatch, CodeTaken, InvalidParameter, naming
from app.families.documents import MarkerDocument, marker_head, marker_place, place_input, position_columns
from app.families.family import Family, Registration, SnapshotRecord, map_point
from app.families.plate.frames import PlateArtwork, PlateFrames
from app.families.plate.inputs import PLATE_EXAMPLES, CodeInput, NewPlate, PlateIn, plate_code, plate_geometry
from app.families.plate.survey import PlateSurvey
from app.families.surveys import PLANNED, Commitment, PlannedMarkers, PlannedRow, is_placed_again
from app.geodesy import PlacedPosition
from app.markers.plate import PlateCode, PlateScheme, plate_capacity
from app.planning.outputs.hd_map import MapMarker
from app.planning.plan import PlannedMarker, PlannedPlate
from app.registry import markers as store
from app.registry.marker_rows import CodeRow, MarkerRow

# === Plates as clients see them.


class PlateCodeDocument(TypedDict):
    """A plate's code."""

    scheme: str
    digits: str
    check_digits: int | None
    registry_number: int | None
    digits_match_position: bool | None


class PlateGeometryDocument(TypedDict):
    """Dimensions of a plate."""

    n: int
    unit_mm: float
    gap_mm: float
    thickness_mm: float
    side_mm: float


class PlateDocument(MarkerDocument):
    """A plate."""

    family: Literal["plate"]
    code: PlateCodeDocument
    geometry: PlateGeometryDocument


def plate_document(row: MarkerRow) -> PlateDocument:
    """A plate's row as clients see it."""
    n, unit_mm, gap_mm = row.n, row.unit_mm, row.gap_mm
    return {
        **marker_head(row),
        "family": "plate",
        "code": {
            "scheme": row.scheme,
            "digits": row.digits,
            "check_digits": row.check_digits,
            "registry_number": _registry_number(row.digits, n) if row.scheme == "id" else None,
            "digits_match_position": row.digits_match_position,
        },
        "geometry": {
            "n": n,
            "unit_mm": unit_mm,
            "gap_mm": gap_mm,
            "thickness_mm": row.thickness_mm,
            "side_mm": n * unit_mm + (n + 1) * gap_mm,
        },
        **marker_place(row),
    }


@lru_cache(maxsize=2**16)
def _registry_number(digits: str, n: int) -> int:
    return PlateCode(digits, PlateScheme.ID, n).registry_number


# === The code requested for a plate: explicit, or derived from its position or its registry number.


@dataclass(frozen=True, slots=True)
class CodedPlate:
    """A code with its relation to the position."""

    code: PlateCode
    digits_match_position: bool | None  # None for registry numbers, and where no position is known
    is_explicit: bool  # the request has the code, and it does not follow from the position


def coded_plate(
    wanted: CodeInput, n: int, place_deg: tuple[float, float] | None, allocate: Callable[[], PlateCode]
) -> CodedPlate:
    """The code that was asked for, or the one that follows from the position or from an allocated registry number.

    Parameters
    ----------
    wanted : CodeInput
    n : int
        Units along a side.
    place_deg : (float, float) or None
        Longitude and latitude; None where the plate has no position yet. [deg]
    allocate : callable
        Allocates a registry number if the request has none.

    Raises
    ------
    InvalidParameter, CodeMismatch
        The code contradicts itself or the position, or it follows from a position that is not known.
    """
    if wanted.scheme is not PlateScheme.ID and wanted.digits is None and place_deg is None:
        raise InvalidParameter(
            f"the digits of the scheme {wanted.scheme} follow from the position, and there is none",
            field="position",
            limit="a position, or the digits",
            cure="send the position of the plate's centre",
        )
    with naming("code"):
        _check_code_request(wanted)
        if wanted.scheme is PlateScheme.ID:
            return _numbered(wanted, n, allocate)
        if place_deg is None:
            return CodedPlate(PlateCode(wanted.digits or "", wanted.scheme, n, wanted.check_digits or 1), None, True)
        return _at_position(wanted, n, place_deg)


def _numbered(wanted: CodeInput, n: int, allocate: Callable[[], PlateCode]) -> CodedPlate:
    if wanted.digits is not None:
        return CodedPlate(PlateCode(wanted.digits, PlateScheme.ID, n), None, True)
    if wanted.registry_number is not None:
        return CodedPlate(PlateCode.from_registry_number(wanted.registry_number, n=n), None, True)
    return CodedPlate(allocate(), None, False)


def _at_position(wanted: CodeInput, n: int, place_deg: tuple[float, float]) -> CodedPlate:
    expected = position_code(*place_deg, n, wanted.scheme, wanted.check_digits)
    if wanted.digits is None:
        return CodedPlate(expected, True, False)
    code = PlateCode(wanted.digits, wanted.scheme, n, wanted.check_digits or 1)
    matches = code == expected
    if not matches and not wanted.allow_mismatched_digits:
        lon_deg, lat_deg = place_deg
        raise CodeMismatch(
            f"the digits {code.digits} do not fit the position {lon_deg:.6f}, {lat_deg:.6f}, "
            f"whose digits are {expected.digits}",
            field="code.digits",
            limit=f"{expected.digits} at {lon_deg:.6f}, {lat_deg:.6f} deg",
            cure="leave the digits out, correct the position, or set code.allow_mismatched_digits for a test plate",
        )
    return CodedPlate(code, matches, not matches)


def position_code(lon_deg: float, lat_deg: float, n: int, scheme: PlateScheme, check_digits: int | None) -> PlateCode:
    """The code of a plate at a position."""
    return PlateCode.from_position(lon_deg, lat_deg, n=n, scheme=scheme, check_digits=check_digits or 0)


def _check_code_request(wanted: CodeInput) -> None:
    is_id = wanted.scheme is PlateScheme.ID
    for name, misplaced in (
        ("registry_number", not is_id and wanted.registry_number is not None),
        ("check_digits", wanted.scheme is not PlateScheme.POSITION_CHECK and wanted.check_digits is not None),
        ("allow_mismatched_digits", is_id and wanted.allow_mismatched_digits),
    ):
        if misplaced:
            raise InvalidParameter(
                f"{name} means nothing in the scheme {wanted.scheme}",
                field=f"code.{name}",
                limit="registry_number: id; check_digits: position-check; allow_mismatched_digits: position schemes",
                cure=f"leave {name} out or choose the scheme it belongs to",
            )
    if wanted.digits is not None and wanted.registry_number is not None:
        raise InvalidParameter(
            "give the digits or the registry number, not both",
            field="code.registry_number",
            limit="one of digits, registry_number",
            cure="leave one of the two out",
        )


# === Planned plates as rows of the registry.


class PlannedPlates(PlannedMarkers):
    """Scheme, digits and dimensions."""

    def taken_numbers(self, agency_id: str, known: Iterable[CodeRow]) -> set[int]:
        """A registry number names one plate of the whole server."""
        ids = [row for row in known if row.scheme == PlateScheme.ID]
        return {PlateCode(row.digits, PlateScheme.ID, row.n).registry_number for row in ids}

    def rows(self, commitment: Commitment, markers: Sequence[PlannedMarker]) -> Iterator[PlannedRow]:
        """One row for each plate."""
        for marker in markers:
            detail = marker.detail
            assert isinstance(detail, PlannedPlate)
            code, geometry = detail.code, detail.geometry
            checks = code.check_digits if code.scheme is PlateScheme.POSITION_CHECK else None
            columns = {
                **commitment.position(marker),
                "scheme": str(code.scheme),
                "digits": code.digits,
                "check_digits": checks,
                "digits_match_position": None if code.scheme is PlateScheme.ID else True,
                "n": geometry.n,
                "unit_mm": geometry.unit_mm,
                "gap_mm": geometry.gap_mm,
                "thickness_mm": geometry.thickness_mm,
            }
            yield PlannedRow(marker.number, columns)


# === Plates in the snapshot of an area.


_KIND = ("scheme", "check_digits", "n", "unit_mm", "gap_mm", "thickness_mm")


class PlateSnapshot(SnapshotRecord):
    """Code scheme and dimensions of plates."""

    def kind(self, row: MarkerRow) -> dict[str, Any]:
        """Scheme and dimensions."""
        return {name: getattr(row, name) for name in _KIND}


# === The family of plates.


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
            Another plate nearby carries the code.
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
        if not is_placed_again(row, values):
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
