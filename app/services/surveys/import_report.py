"""The report on an import: what was found in the survey, row by row, and what was stored of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, cast

import numpy as np
from pydantic import BaseModel, Field, JsonValue, create_model
from typing_extensions import TypedDict

from app.errors import InvalidParameter, naming
from app.families import FAMILIES, FamilyName
from app.families.surveys import Rows
from app.formats.format import SpooledFile
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.table import Change, Detected, Fault, Severity
from app.inputs import INPUT, Flag, Text
from app.markers.reading import MarkerRow
from app.plots.track import draw_residuals
from app.registry.conditions import grade_columns
from app.services.documents import cut_text, document_of
from app.services.markers.plausibility import AccuracyDocument, accuracy_document
from app.surveys.comparison import Comparison, ComparisonFigures
from app.surveys.georeference import GeoreferencedSurvey, LocalGridDocument
from app.values import JsonObject

# === What is declared of an import: of the file, of its markers, and what is done with it.


DECLARATION_EXAMPLE: JsonObject = {
    "layout": "pnezd",
    "crs": "EPSG:25832",
    "epoch": 2025.4,
    "vertical_datum": "ellipsoid",
    "family": "cerpm",
    "columns": {"code": "point"},
    "side": "left",
    "area_deg": [8.3, 48.9, 8.6, 49.1],
    "survey": {"horizontal_rmse_m": 0.015, "survey_method": "GNSS RTK", "surveyor": "A. Muster"},
    "dry_run": True,
}


SURVEY_IMPORTS = {family.name: family.survey for family in FAMILIES if family.survey is not None}
"""Families whose markers can be imported from points, and how."""
MAX_ROWS_LISTED = 2000
"""Rows of a survey that a report can list; about 200 kB."""


if TYPE_CHECKING:

    class _FamilyMembers(BaseModel):
        """Members of a declaration that only one family has, of all families."""

else:
    _FamilyMembers = create_model(
        "_FamilyMembers", __base__=tuple(survey.members for survey in SURVEY_IMPORTS.values())
    )


class DeclarationIn(ImportDeclaration, _FamilyMembers):
    """What is declared of a survey."""

    model_config = INPUT | {"frozen": True, "json_schema_extra": {"examples": [DECLARATION_EXAMPLE]}}

    family: FamilyName = "plate"
    dry_run: Flag = Field(False, description="Report only; nothing is stored.")
    mode: Literal["all", "good"] = Field("all", description="Store all rows or none, or the good ones.")
    warnings: Literal["store", "refuse"] = Field(
        "store", description="What a warning means: its row is stored, or refused as a faulty one is."
    )
    list_rows: Annotated[int, Field(strict=True, ge=0, le=MAX_ROWS_LISTED)] = Field(
        0, description="Rows that the report lists with their positions, those with faults first."
    )
    reason: Annotated[Text, Field(min_length=1, max_length=500)] | None = None


@dataclass(frozen=True, slots=True)
class ImportInput:
    """A file with what is declared of it; `defaults` are what its markers have in common, as their family knows it."""

    file: SpooledFile
    declaration: DeclarationIn
    defaults: Any


def import_input(declaration: DeclarationIn, file: SpooledFile) -> ImportInput:
    """A file with its declaration.

    Raises
    ------
    InvalidParameter
        Members of a family contradict each other, or the family's markers are no points; the field is below
        ``declaration``.
    """
    members = declaration.model_dump()
    with naming("declaration"):  # members of the other families are checked too
        defaults = {name: survey.defaults(members) for name, survey in SURVEY_IMPORTS.items()}
        if declaration.family not in defaults:
            raise InvalidParameter(
                f"{declaration.family!r} cannot be imported from points",
                field="family",
                limit=", ".join(SURVEY_IMPORTS),
                cure="register markers of the other families one by one or in bulk: POST /v1/markers",
            )
    return ImportInput(file, declaration, defaults[declaration.family])


# === What the API returns about imports of surveys.


_MAX_TEXT_BYTES, _MAX_FIELD_BYTES = 320, 120  # source: a report of a thousand faults then takes less than 1 MB
MAX_RESIDUALS = 1000
"""Rows of a comparison that a report has the residuals of."""
Outcome = Literal["checked", "stored", "refused"]
RowState = Literal["good", "warning", "refused", "left-out"]


class FaultDocument(TypedDict):
    """Something wrong with a row, or with the file where row is null."""

    row: int | None
    field: str
    code: str
    message: str
    proposal: str | None
    severity: Literal["refused", "warning"]
    changes: Annotated[
        dict[str, JsonValue] | None,
        Field(description="The correction, where it is one of the declaration: JSON to merge into it (RFC 7396)."),
    ]


class SurveyRow(TypedDict):
    """A row with its position in WGS 84; null where it has none."""

    row: int
    state: RowState
    point: str | None
    code: str | None
    lon_deg: float | None
    lat_deg: float | None
    height_m: Annotated[float | None, Field(description="Above the declared vertical datum.")]


class Residual(TypedDict):
    """Surveyed position minus registered position of one row."""

    row: int
    marker_id: str
    east_m: float
    north_m: float
    up_m: float | None
    horizontal_m: float


class ComparisonDocument(ComparisonFigures):
    """Figures, residuals row by row, and a map of them."""

    residuals: list[Residual]
    map_svg: str | None


class ImportReport(TypedDict):
    """What was found in a survey, and what was stored of it."""

    outcome: Outcome
    dry_run: bool
    mode: Literal["all", "good"]
    warnings: Literal["store", "refuse"]
    format: str
    file_sha256: str
    crs: str
    localization_grade: str
    transform_note: str | None
    detected: Annotated[list[Detected], Field(description="What was not declared, with its evidence.")]
    local_grid: LocalGridDocument | None
    accuracy: Annotated[AccuracyDocument, Field(description="Of the RMSE that was declared for the whole survey.")]
    rows: int
    good_rows: int
    refused_rows: int
    warned_rows: int
    left_out_rows: int
    stored: int
    extent_deg: Annotated[list[float] | None, Field(description="West, south, east, north.")]
    counts: Annotated[dict[str, int], Field(description="Faults by code.")]
    comparison: ComparisonDocument | None
    faults: Annotated[list[FaultDocument], Field(description="The first thousand, refusals first.")]
    faults_left_out: int
    listed: Annotated[list[SurveyRow], Field(description="As many rows as `list_rows` asks for.")]


def comparison_document(
    found: Comparison, survey: GeoreferencedSurvey, known: Sequence[MarkerRow], tolerance_m: float
) -> ComparisonDocument:
    """A comparison as reports of imports have it; `known` are the markers that its rows are matched with."""
    residuals: list[Residual] = [
        {
            "row": int(row) + 1,
            "marker_id": known[int(found.matched[row])].id,
            "east_m": round(float(found.east_m[row]), 4),
            "north_m": round(float(found.north_m[row]), 4),
            "up_m": round(float(found.up_m[row]), 4) if np.isfinite(found.up_m[row]) else None,
            "horizontal_m": round(float(found.horizontal_m[row]), 4),
        }
        for row in np.flatnonzero(np.isfinite(found.east_m))[:MAX_RESIDUALS]
    ]
    drawn = draw_residuals(survey, found, tolerance_m)
    return {**found.document(tolerance_m), "residuals": residuals, "map_svg": drawn}


def fault_document(fault: Fault) -> FaultDocument:
    """A fault as reports of imports have it."""
    return document_of(
        FaultDocument,
        fault,
        field=cut_text(fault.field, _MAX_FIELD_BYTES),
        message=cut_text(fault.message, _MAX_TEXT_BYTES),
        proposal=None if fault.proposal is None else cut_text(fault.proposal, _MAX_TEXT_BYTES),
        severity=fault.severity.value,
        changes=merge_patch(fault.changes),
    )


def merge_patch(changes: Sequence[Change]) -> dict[str, JsonValue] | None:
    """Changes of a declaration as JSON to merge into it; None without any."""
    patch: dict[str, JsonValue] = {}
    for change in changes:
        *parents, name = change.member.split(".")
        place = patch
        for parent in parents:
            place = cast("dict[str, JsonValue]", place.setdefault(parent, {}))
        place[name] = change.value
    return patch or None


# === The report on an import.


ALL: Final = "all"
MAX_FAULTS = 1000
_MAX_CELL = 80


def import_report(
    outcome: Outcome,
    request: ImportInput,
    survey: GeoreferencedSurvey,
    *,
    good_rows: Rows,
    stored: int,
    local_grid: LocalGridDocument | None,
    comparison: ComparisonDocument | None,
) -> ImportReport:
    """The report on an import, as the API returns it."""
    table, placed, faults = survey.table, survey.placed, survey.table.faults
    refused = faults.flags(table.rows, Severity.REFUSED)
    warned = faults.flags(table.rows, Severity.WARNING)
    shown = faults.shown(MAX_FAULTS)
    declared, stated = request.declaration, request.declaration.survey
    grade = grade_columns(stated.horizontal_rmse_m, placed.transform_accuracy_m, placed.note)
    lon, lat = placed.lon_deg[placed.placed], placed.lat_deg[placed.placed]
    return {
        "outcome": outcome,
        "dry_run": declared.dry_run,
        "mode": declared.mode,
        "warnings": declared.warnings,
        "format": table.format,
        "file_sha256": request.file.sha256,
        "crs": table.crs,
        "localization_grade": grade["localization_grade"],
        "transform_note": grade["transform_note"],
        "detected": list(table.detected),
        "local_grid": local_grid,
        "accuracy": accuracy_document(stated.horizontal_rmse_m, stated.vertical_rmse_m, stated.check_points),
        "rows": table.rows,
        "good_rows": len(good_rows),
        "refused_rows": int(refused.sum()),
        "warned_rows": int((warned & ~refused).sum()),
        "left_out_rows": sum(row <= table.rows for row in set(declared.leave_out)),
        "stored": stored,
        "extent_deg": [float(lon.min()), float(lat.min()), float(lon.max()), float(lat.max())] if len(lon) else None,
        "counts": dict(faults.counts),
        "comparison": comparison,
        "faults": [fault_document(fault) for fault in shown],
        "faults_left_out": len(faults) - len(shown),
        "listed": _listed_rows(request, survey, shown) if declared.list_rows else [],
    }


def _listed_rows(request: ImportInput, survey: GeoreferencedSurvey, shown: list[Fault]) -> list[SurveyRow]:
    """Rows with faults, and others evenly spread over the file, in the order of the file."""
    rows, most = survey.table.rows, request.declaration.list_rows
    faulty = dict.fromkeys(fault.row - 1 for fault in shown if fault.row is not None and fault.row <= rows)
    chosen = set(list(faulty)[:most])
    if rows <= most:
        chosen = set(range(rows))
    elif len(chosen) < most:
        spread = np.linspace(0, rows - 1, most - len(chosen)).round().astype(int).tolist()
        chosen.update(spread)
    states = _states(request, survey)
    return [_row(survey, index, states[index]) for index in sorted(chosen)]


def _states(request: ImportInput, survey: GeoreferencedSurvey) -> list[RowState]:
    rows = survey.table.rows
    states: list[RowState] = ["good"] * rows
    flags: tuple[tuple[RowState, Severity], ...] = (("warning", Severity.WARNING), ("refused", Severity.REFUSED))
    for state, severity in flags:
        for index in np.flatnonzero(survey.table.faults.flags(rows, severity)).tolist():
            states[index] = state
    for row in request.declaration.leave_out:
        if row <= rows:
            states[row - 1] = "left-out"
    return states


def _row(survey: GeoreferencedSurvey, index: int, state: RowState) -> SurveyRow:
    placed, height_m = survey.placed, float(survey.height_m[index])
    is_placed = bool(placed.placed[index])
    return {
        "row": index + 1,
        "state": state,
        "point": _cell(survey, "point", index),
        "code": _cell(survey, "code", index),
        "lon_deg": round(float(placed.lon_deg[index]), 9) if is_placed else None,
        "lat_deg": round(float(placed.lat_deg[index]), 9) if is_placed else None,
        "height_m": round(height_m, 4) if np.isfinite(height_m) else None,
    }


def _cell(survey: GeoreferencedSurvey, role: str, index: int) -> str | None:
    texts = survey.table.texts.get(role)
    return (texts[index][:_MAX_CELL] or None) if texts is not None else None
