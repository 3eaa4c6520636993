"""Rows of a survey become columns of markers, thousands at a time."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from datetime import datetime
from typing import Any

import numpy as np
import sqlalchemy as sa

from app.families.family import Family, Registration
from app.families.surveys import (
    PLANNED,
    MarkerRules,
    RowCodes,
    Rows,
    SurveyImport,
    digits_column,
    texts_of,
    unknown_texts,
)
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.table import Fault
from app.geodesy.frames import distance_m
from app.markers.reading import STATUSES, MarkerRow
from app.registry import markers
from app.registry.bulk_load import Columns, JsonTexts, json_objects
from app.registry.conditions import grade_columns
from app.registry.marker_rows import CodeRow
from app.registry.markers import PlaceRow
from app.registry.spatial import Box
from app.surveys.comparison import RegisteredPoints
from app.surveys.georeference import GeoreferencedSurvey
from app.surveys.location_checks import NEAR_M, Neighbours
from app.values import Bools, Floats, JsonObject

# === Codes of a survey's markers: assigned where they are missing, and compared with each other and the registry.


_SAME_CODE = 20
_PART = 20_000


def assign_codes(
    connection: sa.Connection,
    registration: Registration,
    family: Family[Any, Any],
    codes: RowCodes,
    survey: GeoreferencedSurvey,
    defaults: Any,
) -> Iterator[Fault]:
    """Give codes to the rows without one, and name the rows whose code another marker has."""
    assert family.survey is not None
    family.survey.assign_missing(connection, registration.agency_id, codes)
    yield from _check_within(family.survey, codes, survey, registration.rules)
    yield from _check_stored(connection, registration, family, codes, survey, defaults)


def _check_within(
    family: SurveyImport[Any], codes: RowCodes, survey: GeoreferencedSurvey, rules: MarkerRules
) -> Iterator[Fault]:
    """Codes that two rows of the file carry."""
    is_unique = family.is_unique(codes)
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


def _apart_m(survey: GeoreferencedSurvey, codes: RowCodes, one: int, other: int) -> float:
    placed, (a, b) = survey.placed, (codes.rows[one], codes.rows[other])
    return distance_m(placed.lon_deg[a], placed.lat_deg[a], placed.lon_deg[b], placed.lat_deg[b])


def _check_stored(
    connection: sa.Connection,
    registration: Registration,
    family: Family[Any, Any],
    codes: RowCodes,
    survey: GeoreferencedSurvey,
    defaults: Any,
) -> Iterator[Fault]:
    assert family.survey is not None
    agency_id, rules = registration.agency_id, registration.rules
    for start in range(0, len(codes.rows), _PART):
        part = codes.of(slice(start, start + _PART))
        stored: dict[str, list[CodeRow]] = defaultdict(list)
        texts = [digits.decode() for digits in part.digits.tolist()]
        for known in markers.list_by_digits(connection, family.name, texts):
            stored[known.digits].append(known)
        for row, text in zip(part.rows.tolist(), texts, strict=True) if stored else ():
            place = float(survey.placed.lon_deg[row]), float(survey.placed.lat_deg[row])
            for known in stored.get(text, ()):
                if family.survey.collides(codes, defaults, place, known, agency_id, rules):
                    own = known.agency_id == agency_id
                    whose = f"marker {known.id}" if own else "a marker of another agency"
                    proposal = "declare compare if the survey measures it, or give another code"
                    yield Fault(row + 1, "code", "code_taken", f"the code {text} is taken by {whose}", proposal)
                    break


# === Registered markers around a survey, which its rows are compared with.


MAX_NEIGHBOURS = 50_000
"""Registered markers that a survey is compared with at most. To bound memory."""
_MARGIN_DEG = NEAR_M / 90_000.0


def survey_box(survey: GeoreferencedSurvey) -> Box | None:
    """The box of the middle nine tenths of the rows, widened: one row far away must not stretch it."""
    placed = survey.placed
    if not placed.placed.any():
        return None
    west, east = np.quantile(placed.lon_deg[placed.placed], [0.05, 0.95])
    south, north = np.quantile(placed.lat_deg[placed.placed], [0.05, 0.95])
    wide, high = _MARGIN_DEG * 2 + (east - west) / 8, _MARGIN_DEG + (north - south) / 8
    clipped = np.clip([west - wide, east + wide], -180.0, 180.0), np.clip([south - high, north + high], -90.0, 90.0)
    return Box(float(clipped[0][0]), float(clipped[1][0]), float(clipped[0][1]), float(clipped[1][1]))


def list_neighbours(
    connection: sa.Connection, agency_id: str, survey: GeoreferencedSurvey
) -> tuple[Neighbours, RegisteredPoints]:
    """The agency's markers around a survey: their places, and the rows of surveys that they come from."""
    box = survey_box(survey)
    found = markers.list_places_in(connection, agency_id, box, limit=MAX_NEIGHBOURS) if box is not None else []
    lon, lat, height = places_of(found)
    registered = RegisteredPoints(
        lon,
        lat,
        tuple(row.id for row in found),
        tuple(row.family for row in found),
        tuple(row.point for row in found),
        tuple(row.survey_file_sha256 for row in found),
    )
    return Neighbours(lon, lat, height, tuple(row.vertical_datum for row in found)), registered


def places_of(rows: Sequence[MarkerRow | PlaceRow]) -> tuple[Floats, Floats, Floats]:
    """Longitude, latitude and height of markers, each of shape (N,); NaN where there is no height."""
    values = [(row.lon_deg, row.lat_deg, np.nan if row.height_m is None else row.height_m) for row in rows]
    array = np.array(values, dtype=np.float64).reshape(-1, 3)
    return array[:, 0], array[:, 1], array[:, 2]


# === Rows of a survey become columns of markers, thousands at a time.


_EMPTY: JsonObject = dict.fromkeys(
    ("scheme", "digits", "check_digits", "digits_match_position", "n", "unit_mm", "gap_mm", "thickness_mm", "spec")
)


def check_values(survey: GeoreferencedSurvey, wanted: Bools) -> Iterator[Fault]:
    """Faults of the wanted rows that no marker of any family can have: a status or a heading."""
    texts, numbers = survey.table.texts, survey.table.numbers
    yield from unknown_texts(texts.get("status"), wanted, "status", set(STATUSES), ", ".join(STATUSES))
    heading = numbers.get("heading_deg")
    if heading is not None:
        for row in np.flatnonzero(wanted & ((heading < 0) | (heading >= 360))):
            message, cure = f"the heading is {heading[row]:g}", "0 to 360 deg"
            yield Fault(int(row) + 1, "heading_deg", "not_a_marker", message, cure)


def marker_columns(
    survey: GeoreferencedSurvey,
    codes: RowCodes,
    declaration: ImportDeclaration,
    family: SurveyImport[Any],
    defaults: Any,
    *,
    ids: list[str],
    now: datetime,
    file_sha256: str,
) -> Columns:
    """Columns of new markers."""
    common = common_columns(survey, codes.rows, declaration, file_sha256=file_sha256)
    of_family = family.columns(survey, codes, defaults)
    same = {
        **_EMPTY,
        **common.same,
        **of_family.same,
        "version": 1,
        "created_at": now,
        "updated_at": now,
    }
    own: dict[str, Sequence[Any]] = {"id": ids, "digits": digits_column(codes), **of_family.own}
    return Columns(len(ids), same, dict(common.own)).but(**own)


def common_columns(
    survey: GeoreferencedSurvey, rows: Rows, declaration: ImportDeclaration, *, file_sha256: str
) -> Columns:
    """Columns that markers of every family have: place, provenance, road."""
    placed, provenance, texts, numbers = survey.placed, declaration.survey, survey.table.texts, survey.table.numbers
    rmse_m = provenance.horizontal_rmse_m
    same = {
        "family": declaration.family,
        "status": declaration.status or PLANNED,
        "road": declaration.road,
        "heading_deg": None,
        "heading_rmse_deg": None,
        "horizontal_rmse_m": rmse_m,
        "vertical_rmse_m": provenance.vertical_rmse_m,
        "crs": placed.crs,
        "realization": placed.realization,
        "epoch": placed.epoch,
        "survey_method": provenance.survey_method,
        "check_points": provenance.check_points,
        "surveyor": provenance.surveyor,
        "instrument": provenance.instrument,
        "survey_file_sha256": file_sha256,
        **grade_columns(rmse_m, placed.transform_accuracy_m, placed.note),
        "measure_m": None,
        "offset_m": None,
    }
    heights, datum = _optional(placed.height_m, rows), declaration.vertical_datum
    own: dict[str, Sequence[Any]] = {
        "lon_deg": placed.lon_deg[rows].tolist(),
        "lat_deg": placed.lat_deg[rows].tolist(),
        "height_m": heights,
        "vertical_datum": [None if height is None else datum for height in heights],
        "original": _originals(survey, rows, declaration, file_sha256),
    }
    for name in ("status", "road"):
        if name in texts:
            own[name] = [text or same[name] for text in texts_of(survey, rows, name)]
    for name in ("heading_deg", "measure_m", "offset_m"):
        if name in numbers:
            own[name] = _optional(numbers[name], rows)
    for name in ("horizontal_rmse_m", "vertical_rmse_m"):
        if name in numbers:
            own[name] = [value or same[name] for value in _optional(numbers[name], rows)]
    if "horizontal_rmse_m" in own:
        grades = [grade_columns(value, placed.transform_accuracy_m, placed.note) for value in own["horizontal_rmse_m"]]
        own |= {name: [of_row[name] for of_row in grades] for name in ("localization_grade", "transform_note")}
    return Columns(len(rows), same, {}).but(**own)


def _originals(survey: GeoreferencedSurvey, rows: Rows, declaration: ImportDeclaration, sha256: str) -> JsonTexts:
    """The rows exactly as they were given, and the survey they belong to."""
    table = survey.table
    written = table.written or (table.first, table.second)
    names = ("easting", "northing") if table.projected else ("lon_deg", "lat_deg")
    if table.projected and table.unit == "m":
        names = ("easting_m", "northing_m")
    if declaration.local_grid is not None:
        names = (f"local_{names[0]}", f"local_{names[1]}")
    same = _known(
        unit=table.unit if table.projected and table.unit != "m" else None,
        crs=table.crs,
        realization=declaration.realization,
        epoch=declaration.epoch,
        vertical_datum=declaration.vertical_datum,
    )
    of_survey = {**_known(**asdict(declaration.survey)), "file_sha256": sha256, "format": table.format}
    own: dict[str, Sequence[Any]] = {
        names[0]: written[0][rows].tolist(),
        names[1]: written[1][rows].tolist(),
        "survey": json_objects(Columns(len(rows), of_survey, {"row": (rows + 1).tolist()})),
    }
    if table.height is not None:
        heights = _optional(table.height, rows)
        if table.height_unit == "m":
            own["height_m"] = heights
        else:
            own["height"] = heights
            own["height_unit"] = [None if height is None else table.height_unit for height in heights]
    for name in ("point", "description"):
        if name in table.texts:
            own[name] = [text or None for text in texts_of(survey, rows, name)]
    return json_objects(
        Columns(len(rows), same, own), optional=("height_m", "height", "height_unit", "point", "description")
    )


def _known(**values: Any) -> JsonObject:
    return {name: value for name, value in values.items() if value is not None}


def _optional(values: Floats, rows: Rows) -> list[float | None]:
    """Values of rows, None where there is none."""
    chosen = values[rows]
    listed: list[float | None] = chosen.tolist()
    if np.isfinite(chosen).all():
        return listed
    return [value if known else None for value, known in zip(listed, np.isfinite(chosen).tolist(), strict=True)]
