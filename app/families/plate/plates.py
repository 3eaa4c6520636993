"""The family of plates: requests and documents, codes and where these are free, surveys, plans, artwork, snapshots.

How plates are read in camera frames is in `app.families.plate.frames`.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
import sqlalchemy as sa
from pydantic import BaseModel, ConfigDict, Field, JsonValue
from typing_extensions import TypedDict

from app.decoding.frames import plate_code, plate_geometry
from app.encoders.plate import ArtworkOptions, Drawing, PlateOrder, PlateReader, encode_plate, prove_plate
from app.encoders.plate.bundle import ARTWORK_VERSION
from app.encoders.plate.face import reference_text
from app.errors import CodeMismatch, CodeTaken, InvalidParameter, WaymarkError, naming
from app.families.documents import (
    POSITION_EXAMPLE,
    Headed,
    MarkerDocument,
    MarkerIn,
    PositionIn,
    WarningDocument,
    marker_head,
    marker_place,
    place_input,
    position_columns,
)
from app.families.family import ArtworkProof, Family, Registration, map_point
from app.families.plate.frames import PlateFrames
from app.families.surveys import (
    PLANNED,
    RETIRED,
    ColumnValues,
    Commitment,
    MarkerRules,
    PlannedRow,
    RowCodes,
    Rows,
    SurveyImport,
    is_placed_again,
    listed_codes,
)
from app.formats.surveys.roles import CodeForm
from app.formats.surveys.table import Fault
from app.geodesy import UNFIT_TEXT, PlacedPosition
from app.geodesy.frames import distance_m
from app.inputs import Number, StrictModel, Text, Whole
from app.markers.plate import (
    NO_CHECK_TEXT,
    RECOMMENDED_SCHEME,
    PlateCode,
    PlateGeometry,
    PlateScheme,
    code_cells,
    id_digits,
    position_digits,
    recommended_geometry,
    registry_number_bits,
)
from app.markers.reading import MarkerRow
from app.planning.outputs.hd_map import MapMarker
from app.planning.plan import PlannedMarker, PlannedPlate
from app.registry import markers as store
from app.registry.bulk_load import Columns
from app.registry.marker_rows import CodeRow
from app.surveys.georeference import GeoreferencedSurvey
from app.values import Bools

# === Schemas of requests that register plates.


SCHEME_DESCRIPTION = (
    "`id`: a registry number; `position-robust`: the position, on 10 x 10 or 12 x 12 units; both correct wrong cells. "
    "`position-check` and `position` correct none."
)


class CodeInput(StrictModel):
    """The plate's code; without digits they follow from the position or the registry number."""

    scheme: PlateScheme = Field(RECOMMENDED_SCHEME, description=SCHEME_DESCRIPTION)
    digits: Text | None = Field(None, min_length=1, max_length=64, description="Digits to use instead of derived ones.")
    check_digits: Annotated[int, Field(strict=True, ge=1, le=2)] | None = Field(
        None, description="For `position-check`: 1 (default) or 2."
    )
    registry_number: Annotated[int, Field(strict=True, ge=0, le=2**64 - 1)] | None = Field(
        None, description="For `id`: the number; allocated if left out."
    )
    allow_mismatched_digits: Annotated[bool, Field(strict=True)] = Field(
        False, description="Store digits that do not fit the position; such a plate is found through the registry only."
    )


class GeometryIn(StrictModel):
    """Dimensions of the plate."""

    n: Whole | None = Field(
        None, description="Units along a side: 8, 10 or 12. Without: 10 for the scheme `position-robust`, else 8."
    )
    unit_mm: Number | None = Field(
        None, description="Side of a unit, 20 to 50. Without: 27 for `position-robust` on 10 x 10, else 35. [mm]"
    )
    gap_mm: Number = Field(5.0, description="Gap between units and round the border, 2 to 10. [mm]")
    thickness_mm: Number = Field(20.0, description="Thickness of the base plate, 5 to 50. [mm]")

    def of_scheme(self, scheme: PlateScheme) -> PlateGeometry:
        """The dimensions of a plate of a scheme, all of them."""
        with naming("geometry"):
            return recommended_geometry(
                scheme, n=self.n, unit_mm=self.unit_mm, gap_mm=self.gap_mm, thickness_mm=self.thickness_mm
            )


PLATE_EXAMPLES: list[JsonValue] = [
    {"position": POSITION_EXAMPLE, "heading_deg": 78.5, "status": "surveyed", "road": "Cheong Wan Road"},
    {"position": POSITION_EXAMPLE, "code": {"scheme": "position-robust"}},
    {"position": POSITION_EXAMPLE, "code": {"scheme": "position-check", "check_digits": 2}, "geometry": {"n": 10}},
    {
        "position": POSITION_EXAMPLE,
        "code": {"scheme": "position", "digits": "023792168411", "allow_mismatched_digits": True},
    },
]


class PlateIn(Headed, MarkerIn):
    """A plate to register."""

    model_config = ConfigDict(json_schema_extra={"examples": PLATE_EXAMPLES})

    family: Literal["plate"] = "plate"
    position: PositionIn
    code: CodeInput = Field(default_factory=CodeInput)
    geometry: GeometryIn = Field(default_factory=GeometryIn)


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
    """A plate. `code_warnings` state what its code is not fit for."""

    family: Literal["plate"]
    code: PlateCodeDocument
    code_warnings: list[WarningDocument]
    geometry: PlateGeometryDocument


NO_CHECK: WarningDocument = {
    "field": "code.scheme",
    "code": "scheme-without-check",
    "message": f"the scheme {PlateScheme.POSITION} has no check: {NO_CHECK_TEXT} by a vehicle that reads alone",
    "proposal": f"{PlateScheme.POSITION_ROBUST} or {PlateScheme.ID}",
}
"""Of plain positions."""


def plate_geometry_document(geometry: PlateGeometry) -> PlateGeometryDocument:
    """Dimensions of a plate as clients see them."""
    n, unit_mm, gap_mm = geometry.n, geometry.unit_mm, geometry.gap_mm
    return {
        "n": n,
        "unit_mm": unit_mm,
        "gap_mm": gap_mm,
        "thickness_mm": geometry.thickness_mm,
        "side_mm": geometry.side_mm,
    }


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
        "code_warnings": [] if PlateScheme(row.scheme).has_check else [NO_CHECK],
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


# === Surveys of plates.


_LETTER_BYTES = np.frombuffer(b"ABCDEF", dtype=np.uint8)
_MIN_LETTERS = 3  # in the digits of a registry number, so that they are not taken for a position
_REDRAWS = 20


class PlateSurveyIn(BaseModel):
    """Members of a survey's declaration that plates have."""

    scheme: PlateScheme = Field(RECOMMENDED_SCHEME, description=f"Of plates. {SCHEME_DESCRIPTION}")
    check_digits: Annotated[int, Field(strict=True, ge=1, le=2)] | None = None
    geometry: GeometryIn = Field(default_factory=GeometryIn, description="Of plates.")


@dataclass(frozen=True, slots=True)
class PlateDefaults:
    """What a survey's plates have in common."""

    scheme: PlateScheme = RECOMMENDED_SCHEME
    check_digits: int | None = None
    geometry: PlateGeometry = field(default_factory=PlateGeometry)

    @property
    def checks(self) -> int:
        """Check digits of position plates."""
        return (self.check_digits or 1) if self.scheme is PlateScheme.POSITION_CHECK else 0


class PlateSurvey(SurveyImport[PlateDefaults]):
    """Points that become plates: their digits follow from the position, or are registry numbers."""

    members = PlateSurveyIn

    def defaults(self, declared: Mapping[str, object]) -> PlateDefaults:
        """Scheme, check digits and dimensions."""
        sent = PlateSurveyIn.model_validate(declared)
        if sent.check_digits is not None and sent.scheme is not PlateScheme.POSITION_CHECK:
            raise InvalidParameter(
                "check_digits means nothing in this scheme", field="check_digits", limit="position-check"
            )
        return PlateDefaults(sent.scheme, sent.check_digits, sent.geometry.of_scheme(sent.scheme))

    def code_form(self, defaults: PlateDefaults, *, compare: bool) -> CodeForm:
        """Digits of the declared size and scheme, or registry numbers; digits of any plate in comparisons."""
        cells = len(code_cells(defaults.geometry.n))
        if compare:
            return CodeForm("[0-9A-F]{5,}", True, "digits of plates")
        if defaults.scheme is PlateScheme.ID:
            pattern = f"[0-9A-F]{{{cells}}}|[0-9]{{1,{cells - 1}}}"
            return CodeForm(pattern, True, f"{cells} digits of an id plate, or its registry number")
        digits = "[0-9A-F]" if defaults.scheme.corrects else "[0-9]"
        return CodeForm(f"{digits}{{{cells}}}", True, f"{cells} digits of a plate")

    def read_codes(
        self, survey: GeoreferencedSurvey, rows: Rows, defaults: PlateDefaults
    ) -> tuple[RowCodes, list[Fault]]:
        """Digits by the scheme."""
        if defaults.scheme is PlateScheme.ID:
            return _read_id_codes(survey, rows, defaults.geometry)
        return _read_position_codes(survey, rows, defaults)

    def is_unique(self, codes: RowCodes) -> bool:
        """A registry number names one plate."""
        return codes.scheme == PlateScheme.ID

    def collides(
        self,
        codes: RowCodes,
        defaults: PlateDefaults,
        place: tuple[float, float],
        known: CodeRow,
        agency_id: str,
        rules: MarkerRules,
    ) -> bool:
        """With any plate of the same registry number, or with one nearby of the same digits."""
        if codes.scheme == PlateScheme.ID:
            return known.scheme == "id" and known.n == defaults.geometry.n
        if known.status == RETIRED:
            return False
        radius_m = rules.position_code_radius_m if known.digits_match_position else rules.explicit_code_radius_m
        return distance_m(*place, known.lon_deg, known.lat_deg) <= radius_m

    def columns(self, survey: GeoreferencedSurvey, codes: RowCodes, defaults: PlateDefaults) -> Columns:
        """Scheme and dimensions."""
        geometry = defaults.geometry
        same = {
            "scheme": codes.scheme,
            "check_digits": defaults.checks or None,
            "digits_match_position": None if defaults.scheme is PlateScheme.ID else True,
            **asdict(geometry),
        }
        return Columns(len(codes.rows), same, {})


def _read_position_codes(
    survey: GeoreferencedSurvey, rows: Rows, defaults: PlateDefaults
) -> tuple[RowCodes, list[Fault]]:
    """Digits of position plates; a row whose digits are not those of its place is refused."""
    placed = survey.placed
    digits = position_digits(
        placed.lon_deg[rows],
        placed.lat_deg[rows],
        n=defaults.geometry.n,
        scheme=defaults.scheme,
        check_digits=defaults.checks,
    )
    good = np.ones(len(rows), dtype=bool)
    faults: list[Fault] = []
    for k, text in listed_codes(survey, rows):
        if text.encode() != digits[k]:
            good[k] = False
            message = f"the digits {text[:40]} are not those of the position, {digits[k].decode()}"
            cure = (
                "leave the digits out, correct the position, or declare compare if this measures a plate that is built"
            )
            faults.append(Fault(int(rows[k]) + 1, "code", "not_a_marker", message, cure))
    return RowCodes(rows, digits, np.zeros(len(rows), dtype=bool), str(defaults.scheme)).of(good), faults


def _read_id_codes(survey: GeoreferencedSurvey, rows: Rows, geometry: PlateGeometry) -> tuple[RowCodes, list[Fault]]:
    """Digits of id plates, as digits or as registry numbers; drawn where the file has none."""
    n, cells = geometry.n, PlateCode.from_registry_number(0, n=geometry.n).digits
    digits = np.zeros(len(rows), dtype=f"S{len(cells)}")
    good, from_file = np.ones(len(rows), dtype=bool), np.zeros(len(rows), dtype=bool)
    faults: list[Fault] = []
    for k, text in listed_codes(survey, rows):
        is_number = text.isascii() and text.isdigit() and len(text) < len(cells)
        try:
            code = PlateCode.from_registry_number(int(text), n=n) if is_number else PlateCode(text, PlateScheme.ID, n)
        except WaymarkError as error:
            good[k] = False
            faults.append(Fault(int(rows[k]) + 1, error.field or "code", "not_a_marker", error.message, error.cure))
        else:
            digits[k], from_file[k] = code.digits.encode(), True
    codes = RowCodes(rows, digits, from_file, str(PlateScheme.ID)).of(good)
    _draw(codes, ~codes.from_file, n)
    return codes, faults


def _draw(codes: RowCodes, wanted: Bools, n: int) -> None:
    """Give rows random numbers, again where they are too like a decimal number or somebody else's in the file."""
    for _ in range(_REDRAWS):
        count = int(wanted.sum())
        if not count:
            return
        drawn = np.frombuffer(secrets.token_bytes(8 * count), dtype=np.uint64)
        codes.digits[wanted] = id_digits(drawn >> np.uint64(64 - registry_number_bits(n)), n=n)
        letters = np.isin(codes.digits.view(np.uint8).reshape(len(codes.digits), -1), _LETTER_BYTES).sum(axis=1)
        _values, first, count_of = np.unique(codes.digits, return_index=True, return_counts=True)
        twice = np.ones(len(codes.digits), dtype=bool)
        twice[first[count_of == 1]] = False
        wanted = ~codes.from_file & ((letters < _MIN_LETTERS) | twice)
    raise InvalidParameter("no registry numbers are left to draw", field="geometry.n", cure="take larger plates")


# === Artwork of plates.


def plate_order(row: MarkerRow, record_url: str) -> PlateOrder:
    """The plate of a row as the workshop is asked to make it."""
    return PlateOrder(
        plate_id=row.id,
        code=plate_code(row),
        geometry=plate_geometry(row),
        record_url=record_url,
        revision=row.version,
        lon_deg=row.lon_deg,
        lat_deg=row.lat_deg,
        crs=reference_system(row),
    )


def reference_system(row: MarkerRow) -> str:
    """Reference system for the margin, with a warning if the position is not for localization."""
    warning = UNFIT_TEXT if is_unfit(row) else None
    return reference_text(row.realization, row.epoch, warning)


def is_unfit(row: MarkerRow) -> bool:
    """Whether the position is not fit for localization."""
    return row.localization_grade == "unfit"


# === The family of plates.


_LETTERS = frozenset("ABCDEF")
_ALLOCATION_TRIES = 1000
_KIND = ("scheme", "check_digits", "n", "unit_mm", "gap_mm", "thickness_mm")


class Plates(Family[PlateIn, PlacedPosition]):
    """The family of plates."""

    name = "plate"
    label = "plate"
    title = "Plates"
    schema = PlateIn
    examples = PLATE_EXAMPLES
    artwork_version = ARTWORK_VERSION
    survey = PlateSurvey()
    frames = PlateFrames()
    document_type = PlateDocument
    detail_type = PlateDocument

    def prepare(self, registration: Registration, new: PlateIn) -> PlacedPosition:
        """The plate's place in WGS 84."""
        return place_input(new.position, registration.rules.crs_accuracy_m)

    def columns(
        self, connection: sa.Connection, registration: Registration, new: PlateIn, prepared: PlacedPosition
    ) -> ColumnValues:
        """Code, dimensions and place of a plate whose code is free.

        Raises
        ------
        InvalidParameter, CodeMismatch
            The code contradicts itself or the position.
        CodeTaken
            Another plate nearby carries the code.
        """
        geometry, place_deg = new.geometry.of_scheme(new.code.scheme), (prepared.lon_deg, prepared.lat_deg)
        coded = coded_plate(new.code, geometry.n, place_deg, lambda: _allocate(connection, registration, geometry.n))
        _check_free(connection, registration, coded, *place_deg)
        return {
            "family": self.name,
            **_kind_columns(coded.code, geometry, coded.digits_match_position),
            "heading_deg": new.heading_deg,
            **position_columns(new.position, prepared),
        }

    def feature_members(self, properties: Mapping[str, object]) -> dict[str, object]:
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
        self, connection: sa.Connection, registration: Registration, row: MarkerRow, values: ColumnValues
    ) -> ColumnValues:
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

    def draw(self, row: MarkerRow, options: ArtworkOptions, *, record_url: str) -> Drawing:
        """The drawing of a plate."""
        return encode_plate(plate_order(row, record_url), options)

    def prove(self, row: MarkerRow, drawing: Drawing, read_plates: PlateReader) -> ArtworkProof:
        """Read a plate back with the plate decoder."""
        proof = prove_plate(drawing, plate_code(row), plate_geometry(row), read_plates)
        return ArtworkProof(proof.digits, proof.confidence)

    def taken_numbers(self, agency_id: str, known: Iterable[CodeRow]) -> set[int]:
        """A registry number names one plate of the whole server."""
        ids = [row for row in known if row.scheme == PlateScheme.ID]
        return {PlateCode(row.digits, PlateScheme.ID, row.n).registry_number for row in ids}

    def planned_rows(self, commitment: Commitment, markers: Sequence[PlannedMarker]) -> Iterator[PlannedRow]:
        """One row for each plate."""
        for marker in markers:
            detail = marker.detail
            assert isinstance(detail, PlannedPlate)
            matches = None if detail.code.scheme is PlateScheme.ID else True
            columns = commitment.position(marker) | _kind_columns(detail.code, detail.geometry, matches)
            yield PlannedRow(marker.number, columns)

    def snapshot_kind(self, row: MarkerRow) -> dict[str, object]:
        """Scheme and dimensions."""
        return {name: getattr(row, name) for name in _KIND}


PLATE = Plates()


def _kind_columns(code: PlateCode, geometry: PlateGeometry, matches_position: bool | None) -> dict[str, object]:
    """Columns of a plate's code and dimensions."""
    return {
        "scheme": str(code.scheme),
        "digits": code.digits,
        "check_digits": code.check_digits if code.scheme is PlateScheme.POSITION_CHECK else None,
        "digits_match_position": matches_position,
        **asdict(geometry),
    }


def _allocate(connection: sa.Connection, registration: Registration, n: int) -> PlateCode:
    """A free registry number at random, whose codeword cannot be taken for a position with two cells damaged."""
    bits = registry_number_bits(n)
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
