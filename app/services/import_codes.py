"""Codes of a survey's markers: read or drawn for all rows at once, and held against each other and the registry."""

from __future__ import annotations

import secrets
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import sqlalchemy as sa

from app.errors import InvalidParameter, WaymarkError
from app.markers.cerpm import MAX_NUMBER
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme
from app.markers.plate_digits import Digits, id_digits, position_digits, registry_number_bits
from app.registry import bulk, cerpms
from app.registry.exchange.place import PlacedSurvey
from app.registry.exchange.table import Fault, Texts
from app.registry.spatial import distance_m
from app.services.access import Caller
from app.services.marker_rules import MarkerRules

_LETTERS = np.frombuffer(b"ABCDEF", dtype=np.uint8)
_LEAST_LETTERS = 3
_REDRAWS = 20
_SAME_CODE = 20

Rows = npt.NDArray[np.intp]
Flags = npt.NDArray[np.bool_]


@dataclass(slots=True)
class RowCodes:
    """Codes of the rows of a survey that can have one.

    Attributes
    ----------
    rows : ndarray of int, shape (N,)
        Indices of the rows, rising.
    digits : ndarray of bytes, shape (N,)
        Empty where a code is still to be given.
    given : ndarray of bool, shape (N,)
        Whether the file says it.
    scheme : str
    """

    rows: Rows
    digits: Digits
    given: Flags
    scheme: str

    def of(self, chosen: Flags | slice) -> RowCodes:
        """The codes of some of the rows."""
        return RowCodes(self.rows[chosen], self.digits[chosen], self.given[chosen], self.scheme)


def given_codes(survey: PlacedSurvey, rows: Rows) -> Iterator[tuple[int, str]]:
    """Place in `rows` and text of each row that has a code."""
    texts = survey.table.texts.get("code", Texts())
    place_of = np.full(survey.table.rows, -1, dtype=np.intp)
    place_of[rows] = np.arange(len(rows))
    start = 0
    for part in texts.parts():
        for k, text in zip(place_of[start : start + len(part)].tolist(), part, strict=True):
            if text and k >= 0:
                yield k, text
        start += len(part)


def read_cerpm_codes(survey: PlacedSurvey, rows: Rows) -> tuple[RowCodes, list[Fault]]:
    """Numbers of CERPMs, and the rows whose number is none."""
    numbers = np.zeros(len(rows), dtype=np.int64)
    faults: list[Fault] = []
    for k, text in given_codes(survey, rows):
        if text.isdigit() and text.isascii() and len(text) <= 10 and 1 <= (number := int(text)) <= MAX_NUMBER:
            numbers[k] = number
        else:
            numbers[k] = -1
            message = f"{text[:40]!r} is no number of a CERPM"
            faults.append(Fault(int(rows[k]) + 1, "code", "not_a_marker", message, "a whole number"))
    good = numbers >= 0
    digits = np.where(numbers > 0, numbers, 0).astype("S10")
    digits[numbers == 0] = b""
    return RowCodes(rows, digits, numbers > 0, "cerpm").of(good), faults


def read_position_codes(
    survey: PlacedSurvey, rows: Rows, geometry: PlateGeometry, check_digits: int
) -> tuple[RowCodes, list[Fault]]:
    """Digits of position plates; a row whose digits are not those of its place is refused."""
    placed = survey.placed
    digits = position_digits(placed.lon_deg[rows], placed.lat_deg[rows], n=geometry.n, check_digits=check_digits)
    good = np.ones(len(rows), dtype=bool)
    faults: list[Fault] = []
    for k, text in given_codes(survey, rows):
        if text.encode() != digits[k]:
            good[k] = False
            message = f"the digits {text[:40]} are not those of the position, {digits[k].decode()}"
            cure = (
                "leave the digits out, correct the position, or declare compare if this measures a plate that is built"
            )
            faults.append(Fault(int(rows[k]) + 1, "code", "not_a_marker", message, cure))
    scheme = PlateScheme.POSITION_CHECK if check_digits else PlateScheme.POSITION
    return RowCodes(rows, digits, np.zeros(len(rows), dtype=bool), str(scheme)).of(good), faults


def read_id_codes(survey: PlacedSurvey, rows: Rows, geometry: PlateGeometry) -> tuple[RowCodes, list[Fault]]:
    """Digits of id plates, given as digits or as registry numbers; drawn where none is given."""
    n, cells = geometry.n, PlateCode.from_registry_number(0, n=geometry.n).digits
    digits = np.zeros(len(rows), dtype=f"S{len(cells)}")
    good, given = np.ones(len(rows), dtype=bool), np.zeros(len(rows), dtype=bool)
    faults: list[Fault] = []
    for k, text in given_codes(survey, rows):
        is_number = text.isascii() and text.isdigit() and len(text) < len(cells)
        try:
            code = PlateCode.from_registry_number(int(text), n=n) if is_number else PlateCode(text, PlateScheme.ID, n)
        except WaymarkError as error:
            good[k] = False
            faults.append(Fault(int(rows[k]) + 1, error.field or "code", "not_a_marker", error.message, error.cure))
        else:
            digits[k], given[k] = code.digits.encode(), True
    codes = RowCodes(rows, digits, given, str(PlateScheme.ID)).of(good)
    _draw(codes, ~codes.given, n)
    return codes, faults


def _draw(codes: RowCodes, wanted: Flags, n: int) -> None:
    """Give rows random numbers, again where they are too like a decimal number or somebody else's in the file."""
    for _ in range(_REDRAWS):
        count = int(wanted.sum())
        if not count:
            return
        drawn = np.frombuffer(secrets.token_bytes(8 * count), dtype=np.uint64)
        codes.digits[wanted] = id_digits(drawn >> np.uint64(64 - registry_number_bits(n)), n=n)
        letters = np.isin(codes.digits.view(np.uint8).reshape(len(codes.digits), -1), _LETTERS).sum(axis=1)
        _values, first, count_of = np.unique(codes.digits, return_index=True, return_counts=True)
        twice = np.ones(len(codes.digits), dtype=bool)
        twice[first[count_of == 1]] = False
        wanted = ~codes.given & ((letters < _LEAST_LETTERS) | twice)
    raise InvalidParameter("no registry numbers are left to draw", field="geometry.n", cure="take larger plates")


def settle_codes(
    connection: sa.Connection,
    caller: Caller,
    codes: RowCodes,
    survey: PlacedSurvey,
    geometry: PlateGeometry,
    rules: MarkerRules,
) -> Iterator[Fault]:
    """Give CERPMs without a number the next ones, and name the rows whose code another marker has."""
    if codes.scheme == "cerpm":
        _number_the_rest(connection, caller, codes)
    yield from _check_within(codes, survey, rules)
    yield from _check_stored(connection, caller, codes, survey, geometry, rules)


def _number_the_rest(connection: sa.Connection, caller: Caller, codes: RowCodes) -> None:
    highest = int(codes.digits[codes.given].astype(np.int64).max()) if codes.given.any() else 0
    last = max(cerpms.last_number(connection, caller.agency_id), highest)
    missing = codes.digits == b""
    count = int(missing.sum())
    if last + count > MAX_NUMBER:
        raise InvalidParameter(
            "there are not enough numbers left", field="code", limit=f"1 to {MAX_NUMBER}", cure="give the numbers"
        )
    codes.digits[missing] = np.arange(last + 1, last + 1 + count).astype("S10")


def _check_within(codes: RowCodes, survey: PlacedSurvey, rules: MarkerRules) -> Iterator[Fault]:
    """Codes that two rows of the file carry."""
    is_unique = codes.scheme in ("cerpm", PlateScheme.ID)
    order = np.argsort(codes.digits, kind="stable")
    same = codes.digits[order[1:]] == codes.digits[order[:-1]]
    if not same.any():
        return
    groups = np.split(order, np.flatnonzero(~same) + 1)
    found = []
    for group in (g for g in groups if len(g) > 1):
        for place, k in enumerate(group[1:].tolist(), 1):
            for other in group[: min(place, _SAME_CODE)].tolist():
                if is_unique or _apart_m(survey, codes, k, other) <= rules.position_code_radius_m:
                    found.append((k, other))
                    break
    for k, other in sorted(found):
        message = f"row {codes.rows[other] + 1} has the same code {codes.digits[k].decode()}"
        yield Fault(int(codes.rows[k]) + 1, "code", "duplicate_code", message, "leave one of the two out")


def _apart_m(survey: PlacedSurvey, codes: RowCodes, one: int, other: int) -> float:
    placed, (a, b) = survey.placed, (codes.rows[one], codes.rows[other])
    return distance_m(placed.lon_deg[a], placed.lat_deg[a], placed.lon_deg[b], placed.lat_deg[b])


def _check_stored(
    connection: sa.Connection,
    caller: Caller,
    codes: RowCodes,
    survey: PlacedSurvey,
    geometry: PlateGeometry,
    rules: MarkerRules,
) -> Iterator[Fault]:
    family = "cerpm" if codes.scheme == "cerpm" else "plate"
    for start in range(0, len(codes.rows), _PART):
        part = codes.of(slice(start, start + _PART))
        stored: dict[str, list[Any]] = defaultdict(list)
        texts = [digits.decode() for digits in part.digits.tolist()]
        for known in bulk.list_by_digits(connection, family, texts):
            stored[known["digits"]].append(known)
        for row, text in zip(part.rows.tolist(), texts, strict=True) if stored else ():
            place = float(survey.placed.lon_deg[row]), float(survey.placed.lat_deg[row])
            for known in stored.get(text, ()):
                if _collides(codes.scheme, geometry.n, place, known, caller, rules):
                    own = known["agency_id"] == caller.agency_id
                    whose = f"marker {known['id']}" if own else "a marker of another agency"
                    proposal = "declare compare if the survey measures it, or give another code"
                    yield Fault(row + 1, "code", "code_taken", f"the code {text} is taken by {whose}", proposal)
                    break


_PART = 20_000


def _collides(scheme: str, n: int, place: tuple[float, float], known: Any, caller: Caller, rules: MarkerRules) -> bool:
    if scheme == "cerpm":
        return bool(known["agency_id"] == caller.agency_id)
    if scheme == PlateScheme.ID:
        return bool(known["scheme"] == "id" and known["n"] == n)
    if known["status"] == "retired":
        return False
    radius_m = rules.position_code_radius_m if known["digits_match_position"] else rules.explicit_code_radius_m
    return distance_m(*place, known["lon_deg"], known["lat_deg"]) <= radius_m
