"""Rows of a survey become columns of markers, with codes that are free."""

from __future__ import annotations

import secrets
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime
from functools import lru_cache
from typing import Any

import numpy as np
import sqlalchemy as sa

from app.encoders.cerpm.settings import RadioSettings
from app.errors import InvalidParameter, WaymarkError
from app.markers.cerpm import MAX_NUMBER, LaneSide, SpeedLimit
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme
from app.registry import bulk, cerpms
from app.registry.exchange.declaration import ImportDeclaration
from app.registry.exchange.place import PlacedSurvey
from app.registry.exchange.table import Fault
from app.registry.ids import new_id
from app.registry.spatial import distance_m
from app.services.access import Caller
from app.services.cerpm_markers import message_of, speed_limit_document
from app.services.marker_rules import PLANNED, MarkerRules

_ID_BITS = {8: 32, 10: 48, 12: 64}
_LETTERS = frozenset("ABCDEF")
_STATUSES = ("planned", "built", "surveyed", "active", "suspect", "retired")


@dataclass(frozen=True, slots=True)
class MarkerDefaults:
    """What a survey's markers have in common."""

    scheme: PlateScheme = PlateScheme.POSITION
    check_digits: int | None = None
    geometry: PlateGeometry = field(default_factory=PlateGeometry)
    side: LaneSide = LaneSide.UNKNOWN
    speed_limit: SpeedLimit | None = None


@dataclass(slots=True)
class PreparedRow:
    """A row with the columns of its marker."""

    row: int
    columns: dict[str, Any]
    given_code: bool


def prepare_rows(
    survey: PlacedSurvey,
    rows: Sequence[int],
    declaration: ImportDeclaration,
    defaults: MarkerDefaults,
    *,
    now: datetime,
    file_sha256: str,
) -> tuple[list[PreparedRow], list[Fault]]:
    """Columns of the markers of these rows (indices from 0), and the faults of rows whose marker cannot be."""
    prepared: list[PreparedRow] = []
    faults: list[Fault] = []
    of_family = _cerpm_columns if declaration.family == "cerpm" else _plate_columns
    ids = sorted(new_id(now) for _ in rows)  # lists are in the order of ids: keep that of the file
    for marker_id, index in zip(ids, rows, strict=True):
        try:
            common = common_columns(survey, index, declaration, file_sha256=file_sha256)
            own, given = of_family(survey, index, common, defaults)
        except WaymarkError as error:
            faults.append(Fault(index + 1, error.field or "code", "not_a_marker", error.message, error.cure))
            continue
        columns = {"id": marker_id, **_EMPTY, **common, **own, "version": 1, "created_at": now, "updated_at": now}
        prepared.append(PreparedRow(index, columns, given))
    return prepared, faults


_EMPTY: dict[str, Any] = dict.fromkeys(
    ("scheme", "digits", "check_digits", "digits_match_position", "n", "unit_mm", "gap_mm", "thickness_mm", "spec")
)


def common_columns(
    survey: PlacedSurvey, index: int, declaration: ImportDeclaration, *, file_sha256: str
) -> dict[str, Any]:
    """Columns that markers of every family have: place, provenance, road.

    Raises
    ------
    InvalidParameter
        A status or heading is none.
    """
    table, placed = survey.table, survey.placed
    texts = {role: values[index] for role, values in table.texts.items()}
    numbers = {role: _finite(values[index]) for role, values in table.numbers.items()}
    status = texts.get("status") or declaration.status or PLANNED
    if status not in _STATUSES:
        raise InvalidParameter(f"there is no status {status[:40]!r}", field="status", limit=", ".join(_STATUSES))
    heading_deg = numbers.get("heading_deg")
    if heading_deg is not None and not 0 <= heading_deg < 360:
        raise InvalidParameter(f"the heading is {heading_deg:g}", field="heading_deg", limit="0 to 360 deg")
    height = _finite(placed.height_m[index])
    said = declaration.survey
    return {
        "family": declaration.family,
        "status": status,
        "lon_deg": float(placed.lon_deg[index]),
        "lat_deg": float(placed.lat_deg[index]),
        "height_m": height,
        "heading_deg": heading_deg,
        "heading_rmse_deg": None,
        "crs": placed.crs,
        "realization": placed.realization,
        "epoch": declaration.epoch,
        "vertical_datum": declaration.vertical_datum if height is not None else None,
        "horizontal_rmse_m": numbers.get("horizontal_rmse_m") or said.get("horizontal_rmse_m"),
        "vertical_rmse_m": numbers.get("vertical_rmse_m") or said.get("vertical_rmse_m"),
        "survey_method": said.get("survey_method"),
        "original": _original(survey, index, texts, declaration, file_sha256),
        "localization_grade": str(placed.grade),
        "transform_note": placed.note,
        "road": texts.get("road") or declaration.road,
        "measure_m": numbers.get("measure_m"),
        "offset_m": numbers.get("offset_m"),
    }


def _original(
    survey: PlacedSurvey, index: int, texts: Mapping[str, str | None], declaration: ImportDeclaration, sha256: str
) -> dict[str, Any]:
    """The row exactly as it was given, and the survey it belongs to."""
    table = survey.table
    names = ("easting", "northing") if table.projected else ("lon_deg", "lat_deg")
    if table.projected and table.unit == "m":
        names = ("easting_m", "northing_m")
    values: dict[str, Any] = {names[0]: float(table.first[index]), names[1]: float(table.second[index])}
    if table.projected and table.unit != "m":
        values["unit"] = table.unit
    height = _finite(table.height[index]) if table.height is not None else None
    if height is not None:
        values["height_m" if table.height_unit == "m" else "height"] = height
        if table.height_unit != "m":
            values["height_unit"] = table.height_unit
    values |= {
        "crs": table.crs,
        "realization": declaration.realization,
        "epoch": declaration.epoch,
        "vertical_datum": declaration.vertical_datum,
        "point": texts.get("point"),
        "description": texts.get("description"),
    }
    survey_of = {name: value for name, value in declaration.survey.items() if value is not None}
    values["survey"] = {**survey_of, "file_sha256": sha256, "format": table.format, "row": index + 1}
    return {name: value for name, value in values.items() if value is not None}


def _plate_columns(
    survey: PlacedSurvey, index: int, common: dict[str, Any], defaults: MarkerDefaults
) -> tuple[dict[str, Any], bool]:
    codes = survey.table.texts.get("code")
    text = codes[index] if codes is not None else None
    code, matches, given = _plate_code(text, common["lon_deg"], common["lat_deg"], defaults)
    geometry = defaults.geometry
    return {
        "scheme": str(code.scheme),
        "digits": code.digits,
        "check_digits": code.check_digits if code.scheme is PlateScheme.POSITION_CHECK else None,
        "digits_match_position": matches,
        "n": geometry.n,
        "unit_mm": geometry.unit_mm,
        "gap_mm": geometry.gap_mm,
        "thickness_mm": geometry.thickness_mm,
    }, given


def _plate_code(
    text: str | None, lon_deg: float, lat_deg: float, defaults: MarkerDefaults
) -> tuple[PlateCode, bool | None, bool]:
    n, scheme = defaults.geometry.n, defaults.scheme
    if scheme is PlateScheme.ID:
        if text is None:
            return _random_code(n), None, False
        is_number = text.isascii() and text.isdigit() and len(text) < len(_random_code(n).digits)
        code = PlateCode.from_registry_number(int(text), n=n) if is_number else PlateCode(text, scheme, n)
        return code, None, True
    checks = (defaults.check_digits or 1) if scheme is PlateScheme.POSITION_CHECK else 0
    expected = PlateCode.from_position(lon_deg, lat_deg, n=n, check_digits=checks)
    if text is None or text == expected.digits:
        return expected, True, False
    raise InvalidParameter(
        f"the digits {text[:40]} are not those of the position, {expected.digits}",
        field="code",
        limit=expected.digits,
        cure="leave the digits out, correct the position, or declare compare if this measures a plate that is built",
    )


def _random_code(n: int) -> PlateCode:
    while True:
        code = PlateCode.from_registry_number(secrets.randbits(_ID_BITS[n]), n=n)
        if sum(digit in _LETTERS for digit in code.digits) >= 3:
            return code


def _cerpm_columns(
    survey: PlacedSurvey, index: int, common: dict[str, Any], defaults: MarkerDefaults
) -> tuple[dict[str, Any], bool]:
    codes, sides = survey.table.texts.get("code"), survey.table.texts.get("side")
    text = codes[index] if codes is not None else None
    side = sides[index] if sides is not None else None
    if side is not None and side.upper() not in LaneSide.__members__:
        raise InvalidParameter(f"there is no side {side[:40]!r}", field="side", limit="left, right, unknown")
    number = _number(text) if text is not None else 1
    spec = {
        "side": (LaneSide[side.upper()] if side is not None else defaults.side).name.lower(),
        "speed_limit": speed_limit_document(defaults.speed_limit),
        "dev_eui": None,
        "radio": _default_radio(),
    }
    columns = {"scheme": "cerpm", "digits": str(number), "spec": spec}
    message_of({**common, **columns})
    return columns, text is not None


@lru_cache
def _default_radio() -> dict[str, Any]:
    """Worked out once: a million rows share it, and none changes it."""
    return asdict(RadioSettings())


def _number(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 10 and 1 <= int(text) <= MAX_NUMBER):
        raise InvalidParameter(
            f"{text[:40]!r} is no number of a CERPM", field="code", limit=f"1 to {MAX_NUMBER}", cure="a whole number"
        )
    return int(text)


def settle_codes(
    connection: sa.Connection, caller: Caller, prepared: list[PreparedRow], family: str, rules: MarkerRules
) -> list[Fault]:
    """Give CERPMs without a number the next ones, and name the rows whose code another marker has."""
    if family == "cerpm":
        last = max(cerpms.last_number(connection, caller.agency_id), _last_given(prepared))
        for row in prepared:
            if not row.given_code:
                last += 1
                row.columns["digits"] = str(last)
    unique = family == "cerpm" or (bool(prepared) and prepared[0].columns["scheme"] == "id")
    faults = _check_within(prepared, rules.position_code_radius_m, unique=unique)
    return faults + _check_stored(connection, caller, prepared, rules, family)


def _last_given(prepared: list[PreparedRow]) -> int:
    return max((int(row.columns["digits"]) for row in prepared if row.given_code), default=0)


def _check_within(prepared: list[PreparedRow], radius_m: float, *, unique: bool) -> list[Fault]:
    """Codes that two rows of the file carry."""
    by_digits: dict[str, list[PreparedRow]] = defaultdict(list)
    faults = []
    for row in prepared:
        for other in by_digits[row.columns["digits"]][:20]:
            if unique or _apart_m(row.columns, other.columns) <= radius_m:
                message = f"row {other.row + 1} has the same code {row.columns['digits']}"
                faults.append(Fault(row.row + 1, "code", "duplicate_code", message, "leave one of the two out"))
                break
        by_digits[row.columns["digits"]].append(row)
    return faults


def _check_stored(
    connection: sa.Connection, caller: Caller, prepared: list[PreparedRow], rules: MarkerRules, family: str
) -> list[Fault]:
    stored: dict[str, list[Any]] = defaultdict(list)
    for known in bulk.list_by_digits(connection, family, [row.columns["digits"] for row in prepared]):
        stored[known["digits"]].append(known)
    faults = []
    for row in prepared if stored else ():
        for known in stored.get(row.columns["digits"], ()):
            if _collides(row.columns, known, caller, rules):
                own = known["agency_id"] == caller.agency_id
                whose = f"marker {known['id']}" if own else "a marker of another agency"
                message = f"the code {row.columns['digits']} is taken by {whose}"
                proposal = "declare compare if the survey measures it, or give another code"
                faults.append(Fault(row.row + 1, "code", "code_taken", message, proposal))
                break
    return faults


def _collides(columns: dict[str, Any], known: Any, caller: Caller, rules: MarkerRules) -> bool:
    if columns["family"] == "cerpm":
        return bool(known["agency_id"] == caller.agency_id)
    if columns["scheme"] == "id":
        return bool(known["scheme"] == "id" and known["n"] == columns["n"])
    if known["status"] == "retired":
        return False
    radius_m = rules.position_code_radius_m if known["digits_match_position"] else rules.explicit_code_radius_m
    return _apart_m(columns, known) <= radius_m


def _apart_m(one: Any, other: Any) -> float:
    return distance_m(one["lon_deg"], one["lat_deg"], other["lon_deg"], other["lat_deg"])


def _finite(value: Any) -> float | None:
    return float(value) if value is not None and np.isfinite(value) else None
