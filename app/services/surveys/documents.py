"""What the API returns about imports of surveys."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Annotated, Literal, cast

import numpy as np
from pydantic import Field, JsonValue
from typing_extensions import TypedDict

from app.formats.surveys.table import Change, Detected, Fault
from app.plots.residual_map import draw_residuals
from app.registry.jobs import JobRow, JobState
from app.registry.marker_rows import MarkerRow
from app.services.documents import document_of
from app.services.error_documents import ErrorDocument, cut_text
from app.services.markers.accuracy import AccuracyDocument
from app.surveys.comparison import Comparison, ComparisonFigures
from app.surveys.georeference import GeoreferencedSurvey
from app.surveys.local_grid import LocalGridDocument

_MAX_TEXT_BYTES, _MAX_FIELD_BYTES = 320, 120  # source: a report of a thousand faults then takes less than 1 MB
MAX_RESIDUALS = 1000
"""Rows of a comparison that a report has the residuals of. Chosen by hand."""
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


class DetectedDocument(TypedDict):
    """A property of the file that was not declared, and the evidence for it."""

    what: str
    value: str
    evidence: str


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
    detected: Annotated[list[DetectedDocument], Field(description="What was not declared, with its evidence.")]
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


class ImportJobLinks(TypedDict):
    """Where to read the job again."""

    self: str


class ImportJobSummary(TypedDict):
    """An import that is or was a job, without its report."""

    id: str
    state: JobState
    progress: Annotated[float, Field(description="0 to 1.")]
    attempts: int
    cancel_requested: Annotated[bool, Field(description="A running import stops before it stores anything.")]
    created_at: datetime
    finished_at: datetime | None
    error: Annotated[ErrorDocument | None, Field(description="Why the file or its declaration cannot be used.")]
    links: ImportJobLinks


class ImportJobDocument(ImportJobSummary):
    """An import that is or was a job."""

    report: ImportReport | None


class ImportJobPage(TypedDict):
    """A page of imports, newest first; the Link header leads to the next one."""

    items: list[ImportJobSummary]


def import_job_document(job: JobRow) -> ImportJobDocument:
    """An import with its report, once there is one."""
    return {**import_job_summary(job), "report": cast("ImportReport | None", job.result)}


def import_job_summary(job: JobRow) -> ImportJobSummary:
    """An import without its report."""
    return document_of(ImportJobSummary, job, links={"self": f"/v1/imports/{job.id}"})


def comparison_document(
    found: Comparison | None, survey: GeoreferencedSurvey, known: Sequence[MarkerRow], tolerance_m: float
) -> ComparisonDocument | None:
    """A comparison as reports of imports have it; `known` are the markers that its rows are matched with."""
    if found is None:
        return None
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


def detected_document(detected: Detected) -> DetectedDocument:
    """A detected property as reports of imports have it."""
    return document_of(DetectedDocument, detected)


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
