"""Plates: their codes, where these are free, and what follows when a plate moves."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from app.errors import CodeMismatch, CodeTaken, InvalidParameter
from app.geodesy import PlacedPosition
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme, plate_capacity
from app.registry import markers as store
from app.registry.markers import Row
from app.services.access import Caller
from app.services.marker_documents import plate_document
from app.services.marker_rules import PLANNED, MarkerRules, is_back_in_use
from app.services.positions import GivenPosition, naming, place_given, position_columns

_LETTERS = frozenset("ABCDEF")
_MIN_LETTERS = 3
_ALLOCATION_TRIES = 1000


@dataclass(frozen=True, slots=True)
class GivenCode:
    """A plate's code as it was asked for."""

    scheme: PlateScheme = PlateScheme.POSITION
    digits: str | None = None
    check_digits: int | None = None
    registry_number: int | None = None
    allow_mismatched_digits: bool = False


@dataclass(frozen=True, slots=True)
class NewPlate:
    """A plate to register."""

    position: GivenPosition
    code: GivenCode = field(default_factory=GivenCode)
    geometry: PlateGeometry = field(default_factory=PlateGeometry)
    status: str = PLANNED
    heading_deg: float | None = None
    heading_rmse_deg: float | None = None
    road: str | None = None
    measure_m: float | None = None
    offset_m: float | None = None
    kind: str | None = None
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class _Plate:
    """A code with its relation to the position."""

    code: PlateCode
    digits_match_position: bool | None
    given: bool


class Plates:
    """The family of plates.

    Parameters
    ----------
    rules : MarkerRules
    random_bits : callable, optional
        Source of the allocator's numbers.
    """

    def __init__(self, rules: MarkerRules, random_bits: Callable[[int], int] = secrets.randbits) -> None:
        self._rules = rules
        self._random_bits = random_bits

    def prepare(self, caller: Caller, new: NewPlate, now: datetime) -> PlacedPosition:
        """The plate's place."""
        return place_given(new.position, self._rules.crs_accuracy_m)

    def columns(
        self, connection: sa.Connection, caller: Caller, new: NewPlate, prepared: PlacedPosition
    ) -> dict[str, Any]:
        """Code, dimensions and place of a plate whose code is free.

        Raises
        ------
        InvalidParameter, CodeMismatch
            The code contradicts itself or the position.
        CodeTaken
            Another plate near by carries the code.
        """
        with naming("code"):
            coded = self._code(connection, new, prepared)
        self._check_free(connection, caller, coded, prepared.lon_deg, prepared.lat_deg)
        geometry, code = new.geometry, coded.code
        return {
            "family": "plate",
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

    def index(self, connection: sa.Connection, caller: Caller, row: Row) -> None:
        """Nothing: plates are found by the columns that they have."""

    def document(self, row: Row | dict[str, Any]) -> dict[str, Any]:
        """A plate."""
        return plate_document(row)

    detail = document

    def revised(
        self, connection: sa.Connection, caller: Caller, row: Row, values: dict[str, Any], *, moved: bool
    ) -> dict[str, Any]:
        """Columns of the code after a move: a planned plate's digits follow, a built one's stay as they are.

        Raises
        ------
        CodeTaken
            At its new place, or back in use, its code collides with another plate's.
        """
        if not moved and not is_back_in_use(row, values):
            return {}
        merged = {**row, **values}
        code = plate_code(row)
        matches = row["digits_match_position"]
        given = matches is False
        if code.scheme is not PlateScheme.ID:
            expected = _position_code(merged["lon_deg"], merged["lat_deg"], code.n, code.scheme, row["check_digits"])
            if row["status"] == PLANNED and matches:
                code = expected
            matches = code == expected
        self._check_free(
            connection, caller, _Plate(code, matches, given), merged["lon_deg"], merged["lat_deg"], row["id"]
        )
        return {"digits": code.digits, "digits_match_position": matches}

    def _code(self, connection: sa.Connection, plate: NewPlate, placed: PlacedPosition) -> _Plate:
        given, n = plate.code, plate.geometry.n
        _check_code_request(given)
        if given.scheme is PlateScheme.ID:
            if given.digits is not None:
                return _Plate(PlateCode(given.digits, PlateScheme.ID, n), None, True)
            if given.registry_number is not None:
                return _Plate(PlateCode.from_registry_number(given.registry_number, n=n), None, True)
            return _Plate(self._allocate(connection, n), None, False)
        expected = _position_code(placed.lon_deg, placed.lat_deg, n, given.scheme, given.check_digits)
        if given.digits is None:
            return _Plate(expected, True, False)
        code = PlateCode(given.digits, given.scheme, n, given.check_digits or 1)
        matches = code == expected
        if not matches and not given.allow_mismatched_digits:
            raise CodeMismatch(
                f"the digits {code.digits} do not fit the position {placed.lon_deg:.6f}, {placed.lat_deg:.6f}, "
                f"whose digits are {expected.digits}",
                field="code.digits",
                limit=f"{expected.digits} at {placed.lon_deg:.6f}, {placed.lat_deg:.6f} deg",
                cure="leave the digits out, correct the position, or set code.allow_mismatched_digits for a test plate",
            )
        return _Plate(code, matches, not matches)

    def _allocate(self, connection: sa.Connection, n: int) -> PlateCode:
        """A free registry number at random, whose codeword cannot be taken for a position with two cells damaged."""
        bits = round(plate_capacity(n, PlateScheme.ID).bits)
        for _ in range(_ALLOCATION_TRIES):
            code = PlateCode.from_registry_number(self._random_bits(bits), n=n)
            if sum(d in _LETTERS for d in code.digits) < _MIN_LETTERS:
                continue
            if store.find_id_code(connection, code.digits, n) is None:
                return code
        raise CodeTaken("no free registry number was found", field="code.registry_number", cure="use a larger plate")

    def _check_free(
        self,
        connection: sa.Connection,
        caller: Caller,
        plate: _Plate,
        lon_deg: float,
        lat_deg: float,
        ignoring: str | None = None,
    ) -> None:
        if plate.code.scheme is PlateScheme.ID:
            other = store.find_id_code(connection, plate.code.digits, plate.code.n)
            limit = "a registry number names one plate for ever"
        else:
            wide_m = self._rules.explicit_code_radius_m
            radius_m = wide_m if plate.given else self._rules.position_code_radius_m
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
        if other is None or other["id"] == ignoring:
            return
        own = other["agency_id"] == caller.agency_id
        raise CodeTaken(
            f"the digits {plate.code.digits} are taken by "
            + (f"marker {other['id']}" if own else "a marker of another agency"),
            field="code.digits" if plate.given else "position",
            limit=limit,
            cure="choose other digits or another position, or retire the other plate",
        )


def plate_code(row: Row | dict[str, Any]) -> PlateCode:
    """Code of a plate's row."""
    return PlateCode(row["digits"], PlateScheme(row["scheme"]), row["n"], row["check_digits"] or 1)


def plate_geometry(row: Row | dict[str, Any]) -> PlateGeometry:
    """Geometry of a plate's row."""
    return PlateGeometry(row["n"], row["unit_mm"], row["gap_mm"], row["thickness_mm"])


def _check_code_request(given: GivenCode) -> None:
    is_id = given.scheme is PlateScheme.ID
    for name, misplaced in (
        ("registry_number", not is_id and given.registry_number is not None),
        ("check_digits", given.scheme is not PlateScheme.POSITION_CHECK and given.check_digits is not None),
        ("allow_mismatched_digits", is_id and given.allow_mismatched_digits),
    ):
        if misplaced:
            raise InvalidParameter(
                f"{name} means nothing in the scheme {given.scheme}",
                field=f"code.{name}",
                limit="registry_number: id; check_digits: position-check; allow_mismatched_digits: position schemes",
                cure=f"leave {name} out or choose the scheme it belongs to",
            )
    if given.digits is not None and given.registry_number is not None:
        raise InvalidParameter(
            "give the digits or the registry number, not both",
            field="code.registry_number",
            limit="one of digits, registry_number",
            cure="leave one of the two out",
        )


def _position_code(lon_deg: float, lat_deg: float, n: int, scheme: PlateScheme, check_digits: int | None) -> PlateCode:
    checks = (check_digits or 1) if scheme is PlateScheme.POSITION_CHECK else 0
    return PlateCode.from_position(lon_deg, lat_deg, n=n, check_digits=checks)
