"""Rows of a survey become columns of markers, thousands at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import Any

import numpy as np

from app.families.rules import PLANNED
from app.families.surveys import Flags, RowCodes, Rows, SurveyImport, digits_column, texts_of, unknown_texts
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.table import Fault, Floats
from app.markers.status import STATUSES
from app.registry.columns import Columns, JsonTexts, json_objects
from app.registry.grade_columns import grade_columns
from app.surveys.georeference import GeoreferencedSurvey

_EMPTY: dict[str, Any] = dict.fromkeys(
    ("scheme", "digits", "check_digits", "digits_match_position", "n", "unit_mm", "gap_mm", "thickness_mm", "spec")
)


def check_values(survey: GeoreferencedSurvey, wanted: Flags) -> Iterator[Fault]:
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
    rmse_m = provenance.get("horizontal_rmse_m")
    same = {
        "family": declaration.family,
        "status": declaration.status or PLANNED,
        "road": declaration.road,
        "heading_deg": None,
        "heading_rmse_deg": None,
        "horizontal_rmse_m": rmse_m,
        "vertical_rmse_m": provenance.get("vertical_rmse_m"),
        "crs": placed.crs,
        "realization": placed.realization,
        "epoch": placed.epoch,
        "survey_method": provenance.get("survey_method"),
        "check_points": provenance.get("check_points"),
        "surveyor": provenance.get("surveyor"),
        "instrument": provenance.get("instrument"),
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
    of_survey = {**_known(**declaration.survey), "file_sha256": sha256, "format": table.format}
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


def _known(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _optional(values: Floats, rows: Rows) -> list[float | None]:
    """Values of rows, None where there is none."""
    chosen = values[rows]
    listed: list[float | None] = chosen.tolist()
    if np.isfinite(chosen).all():
        return listed
    return [value if known else None for value, known in zip(listed, np.isfinite(chosen).tolist(), strict=True)]
