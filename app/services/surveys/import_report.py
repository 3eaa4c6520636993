"""The report on an import: what was found in the survey, row by row, and what was stored of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from app.families.surveys import Rows
from app.formats.spooled_file import SpooledFile
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.table import Fault, Faults, Severity
from app.registry.grade_columns import grade_columns
from app.services.markers.accuracy import accuracy_document
from app.services.surveys.documents import (
    ComparisonDocument,
    ImportReport,
    Outcome,
    RowState,
    SurveyRow,
    detected_document,
    fault_document,
)
from app.surveys.georeference import GeoreferencedSurvey
from app.surveys.local_grid import LocalGridDocument

ALL: Final = "all"
MAX_FAULTS = 1000
MAX_ROWS_LISTED = 2000
"""Rows of a survey that a report can list; about 200 kB. Chosen by hand."""
_ACCURACY = ("horizontal_rmse_m", "vertical_rmse_m", "check_points")
_MAX_CELL = 80


@dataclass(frozen=True, slots=True)
class ImportInput:
    """A file with what is declared of it."""

    file: SpooledFile
    declaration: ImportDeclaration
    defaults: Any = None
    dry_run: bool = False
    mode: Literal["all", "good"] = ALL
    reason: str | None = None
    refuse_warnings: bool = False
    list_rows: int = 0


@dataclass(frozen=True, slots=True)
class Found:
    """What an import has found and stored.

    Attributes
    ----------
    request, survey, faults
    good : ndarray of int
        Indices of the rows that are stored, or would be.
    stored : int
    grid, comparison
        Their documents.
    """

    request: ImportInput
    survey: GeoreferencedSurvey
    faults: Faults
    good: Rows
    stored: int
    grid: LocalGridDocument | None
    comparison: ComparisonDocument | None


def import_report(outcome: Outcome, found: Found) -> ImportReport:
    """The report on an import, as the API returns it."""
    request, table, placed = found.request, found.survey.table, found.survey.placed
    refused = found.faults.flags(table.rows, Severity.REFUSED)
    warned = found.faults.flags(table.rows, Severity.WARNING)
    shown = found.faults.shown(MAX_FAULTS)
    rmse_m = request.declaration.survey.get("horizontal_rmse_m")
    grade = grade_columns(rmse_m, placed.transform_accuracy_m, placed.note)
    lon, lat = placed.lon_deg[placed.placed], placed.lat_deg[placed.placed]
    return {
        "outcome": outcome,
        "dry_run": request.dry_run,
        "mode": request.mode,
        "warnings": "refuse" if request.refuse_warnings else "store",
        "format": table.format,
        "file_sha256": request.file.sha256,
        "crs": table.crs,
        "localization_grade": grade["localization_grade"],
        "transform_note": grade["transform_note"],
        "detected": [detected_document(detected) for detected in table.detected],
        "local_grid": found.grid,
        "accuracy": accuracy_document(*(request.declaration.survey.get(name) for name in _ACCURACY)),
        "rows": table.rows,
        "good_rows": len(found.good),
        "refused_rows": int(refused.sum()),
        "warned_rows": int((warned & ~refused).sum()),
        "left_out_rows": sum(row <= table.rows for row in set(request.declaration.leave_out)),
        "stored": found.stored,
        "extent_deg": [float(lon.min()), float(lat.min()), float(lon.max()), float(lat.max())] if len(lon) else None,
        "counts": dict(found.faults.counts),
        "comparison": found.comparison,
        "faults": [fault_document(fault) for fault in shown],
        "faults_left_out": len(found.faults) - len(shown),
        "listed": _listed_rows(found, shown) if request.list_rows else [],
    }


def _listed_rows(found: Found, shown: list[Fault]) -> list[SurveyRow]:
    """Rows with faults, and others evenly spread over the file, in the order of the file."""
    rows, most = found.survey.table.rows, found.request.list_rows
    faulty = dict.fromkeys(fault.row - 1 for fault in shown if fault.row is not None and fault.row <= rows)
    chosen = set(list(faulty)[:most])
    if rows <= most:
        chosen = set(range(rows))
    elif len(chosen) < most:
        spread = np.linspace(0, rows - 1, most - len(chosen)).round().astype(int).tolist()
        chosen.update(spread)
    states = _states(found)
    return [_row(found.survey, index, states[index]) for index in sorted(chosen)]


def _states(found: Found) -> list[RowState]:
    rows = found.survey.table.rows
    states: list[RowState] = ["good"] * rows
    flags: tuple[tuple[RowState, Severity], ...] = (("warning", Severity.WARNING), ("refused", Severity.REFUSED))
    for state, severity in flags:
        for index in np.flatnonzero(found.faults.flags(rows, severity)).tolist():
            states[index] = state
    for row in found.request.declaration.leave_out:
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
