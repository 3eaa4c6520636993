"""Registering, finding and changing markers."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import datetime, timedelta
from typing import Any

import sqlalchemy as sa

from app.errors import CodeMismatch, CodeTaken, InvalidParameter, StaleVersion
from app.geodesy import PlacedPosition, place_position
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme, plate_capacity
from app.registry import markers as store
from app.registry.database import Database
from app.registry.ids import new_id
from app.registry.markers import MarkerFilter, Row
from app.services.access import Caller
from app.services.idempotency import IdempotencyKey, find_answer, keep_answer
from app.services.marker_documents import marker_document, version_document
from app.services.ports import Clock

PLANNED = "planned"
RETIRED = "retired"
_LETTERS = frozenset("ABCDEF")
_MIN_LETTERS = 3
_ALLOCATION_TRIES = 1000


@dataclass(frozen=True, slots=True)
class GivenPosition:
    """A position as it was sent: lon_deg and lat_deg, or easting_m and northing_m."""

    lon_deg: float | None = None
    lat_deg: float | None = None
    easting_m: float | None = None
    northing_m: float | None = None
    height_m: float | None = None
    crs: str | None = None
    realization: str | None = None
    epoch: float | None = None
    vertical_datum: str | None = None
    horizontal_rmse_m: float | None = None
    vertical_rmse_m: float | None = None
    survey_method: str | None = None


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
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class MarkerChange:
    """What to change: `values` by column, and the position if it is to be replaced."""

    values: dict[str, Any] = field(default_factory=dict)
    position: GivenPosition | None = None
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class MarkerRules:
    """Limits that a deployment can set."""

    explicit_code_radius_m: float = 20_000.0
    position_code_radius_m: float = 1_000.0
    crs_accuracy_m: float = 0.1
    idempotency_ttl: timedelta = timedelta(hours=24)


@dataclass(frozen=True, slots=True)
class _Plate:
    """A code with its relation to the position."""

    code: PlateCode
    digits_match_position: bool | None
    given: bool


@contextmanager
def naming(part: str) -> Iterator[None]:
    """Complete the field of an error that a part of the request caused."""
    try:
        yield
    except InvalidParameter as error:
        if error.field is not None and not error.field.startswith(f"{part}."):
            error.field = f"{part}.{error.field}"
        raise


class Markers:
    """Use cases on markers, one transaction each.

    Parameters
    ----------
    database : Database
    clock : Clock
    rules : MarkerRules
    random_bits : callable, optional
        Source of the allocator's numbers.
    """

    def __init__(
        self,
        database: Database,
        clock: Clock,
        rules: MarkerRules | None = None,
        random_bits: Callable[[int], int] = secrets.randbits,
    ) -> None:
        self._database = database
        self._clock = clock
        self._rules = rules or MarkerRules()
        self._random_bits = random_bits

    def register_plate(
        self, caller: Caller, plate: NewPlate, key: IdempotencyKey | None = None
    ) -> tuple[dict[str, Any], bool]:
        """Store a new plate.

        Returns
        -------
        marker : dict
        replayed : bool
            The request had been made before under the same Idempotency-Key; nothing was stored now.

        Raises
        ------
        InvalidParameter, CodeMismatch, ReferenceSystemError
            The request contradicts itself or a limit.
        CodeTaken
            Another plate near by carries the code.
        """
        now = self._clock()
        placed = self._place(plate.position)
        with self._database.write() as connection:
            answer = find_answer(connection, caller.agency_id, key, now)
            if answer is not None:
                return answer, True
            with naming("code"):
                coded = self._code(connection, plate, placed)
            self._check_free(connection, caller, coded, placed.lon_deg, placed.lat_deg)
            values = _new_row(plate, placed, coded, now)
            row = store.add_marker(connection, caller.agency_id, values, who=caller.label, why=plate.reason)
            marker = marker_document(row)
            keep_answer(connection, caller.agency_id, key, marker, now, self._rules.idempotency_ttl)
        return marker, False

    def get(self, caller: Caller, marker_id: str) -> dict[str, Any]:
        """One marker."""
        with self._database.read() as connection:
            return marker_document(store.get_marker(connection, caller.agency_id, marker_id))

    def page(
        self, caller: Caller, narrowed: MarkerFilter, *, after: str | None = None, limit: int = 100
    ) -> tuple[list[dict[str, Any]], str | None]:
        """A page of markers, and the id to continue after if there may be more."""
        with self._database.read() as connection:
            rows = store.list_markers(connection, caller.agency_id, narrowed, after=after, limit=limit + 1)
        page = [marker_document(row) for row in rows[:limit]]
        return page, page[-1]["id"] if len(rows) > limit else None

    def change(self, caller: Caller, marker_id: str, change: MarkerChange, version: int | None) -> dict[str, Any]:
        """Change a marker that is still at `version`; None changes whatever version is stored.

        Raises
        ------
        StaleVersion
            The marker was changed since the caller read it.
        CodeTaken
            At its new place, or back in use, its code collides with another plate's.
        """
        now = self._clock()
        placed = self._place(change.position) if change.position is not None else None
        with self._database.write() as connection:
            row = store.get_marker(connection, caller.agency_id, marker_id)
            if version is not None and row["version"] != version:
                raise StaleVersion(
                    f"marker {marker_id} is at version {row['version']}, the change is based on version {version}",
                    field="If-Match",
                    limit=f'"{row["version"]}"',
                    cure="read the marker again and repeat the change on what it is now",
                )
            values = dict(change.values)
            if placed is not None and change.position is not None:
                values |= _position_columns(change.position, placed)
            if placed is not None or (row["status"] == RETIRED and values.get("status", RETIRED) != RETIRED):
                values |= self._recoded(connection, caller, row, values)
            changed = store.update_marker(
                connection,
                caller.agency_id,
                marker_id,
                values,
                version=row["version"],
                now=now,
                who=caller.label,
                why=change.reason,
            )
        return marker_document(changed)

    def history(
        self, caller: Caller, marker_id: str, *, after: int = 0, limit: int = 100
    ) -> tuple[list[dict[str, Any]], int | None]:
        """A page of a marker's versions, oldest first, and the version to continue after."""
        with self._database.read() as connection:
            store.get_marker(connection, caller.agency_id, marker_id)
            rows = store.list_versions(connection, caller.agency_id, marker_id, after=after, limit=limit + 1)
        page = [version_document(row) for row in rows[:limit]]
        return page, page[-1]["version"] if len(rows) > limit else None

    def _place(self, given: GivenPosition) -> PlacedPosition:
        geographic = (given.lon_deg, given.lat_deg)
        projected = (given.easting_m, given.northing_m)
        pairs = [pair for pair in (geographic, projected) if pair != (None, None)]
        if len(pairs) != 1 or None in pairs[0]:
            raise InvalidParameter(
                "a position is lon_deg and lat_deg, or easting_m and northing_m with a projected crs",
                field="position",
                limit="one complete pair",
                cure="send both members of exactly one pair",
            )
        first, second = (value for value in pairs[0] if value is not None)
        return place_position(
            first,
            second,
            given.height_m,
            crs=given.crs,
            projected=pairs[0] is projected,
            realization=given.realization,
            epoch=given.epoch,
            ellipsoidal_height=given.vertical_datum in (None, "ellipsoid"),
            accuracy_m=self._rules.crs_accuracy_m,
        )

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

    def _recoded(self, connection: sa.Connection, caller: Caller, row: Row, values: dict[str, Any]) -> dict[str, Any]:
        """Columns of the code after a move: a planned plate's digits follow, a built one's stay as they are."""
        if row["family"] != "plate":
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


def _new_row(plate: NewPlate, placed: PlacedPosition, coded: _Plate, now: datetime) -> dict[str, Any]:
    geometry, code = plate.geometry, coded.code
    return {
        "id": new_id(now),
        "family": "plate",
        "status": plate.status,
        "scheme": str(code.scheme),
        "digits": code.digits,
        "check_digits": code.check_digits if code.scheme is PlateScheme.POSITION_CHECK else None,
        "digits_match_position": coded.digits_match_position,
        "n": geometry.n,
        "unit_mm": geometry.unit_mm,
        "gap_mm": geometry.gap_mm,
        "thickness_mm": geometry.thickness_mm,
        "heading_deg": plate.heading_deg,
        "heading_rmse_deg": plate.heading_rmse_deg,
        "road": plate.road,
        "measure_m": plate.measure_m,
        "offset_m": plate.offset_m,
        "version": 1,
        "created_at": now,
        "updated_at": now,
        **_position_columns(plate.position, placed),
    }


def _position_columns(given: GivenPosition, placed: PlacedPosition) -> dict[str, Any]:
    return {
        "lon_deg": placed.lon_deg,
        "lat_deg": placed.lat_deg,
        "height_m": placed.height_m,
        "crs": placed.crs,
        "realization": placed.realization,
        "epoch": given.epoch,
        "vertical_datum": given.vertical_datum or ("ellipsoid" if given.height_m is not None else None),
        "horizontal_rmse_m": given.horizontal_rmse_m,
        "vertical_rmse_m": given.vertical_rmse_m,
        "survey_method": given.survey_method,
        "original": {name: value for name, value in asdict(given).items() if value is not None},
        "localization_grade": str(placed.grade),
        "transform_note": placed.note,
    }
