"""Rows of a survey that are registered already: the same file once more, or the same points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.table import Fault, Floats, Severity
from app.surveys.consistency_checks import nearest_of
from app.surveys.georeference import GeoreferencedSurvey, east_north_m
from app.surveys.location_checks import measured_changes

_SAME_M = 0.1  # [m] two markers of a family are never this near: plates are 0.3 m wide
_SAME_RMSE = 2.0  # [1] times the RMSE of the survey within which two measurements of a marker lie (95 %)
_NAMED_M = 0.5  # [m] greatest distance of rows with the same point number; also a bound for inaccurate surveys
_NEAREST = 4  # registered markers that a row is compared with; of other families may be as near
_CURE = 'declare compare: true if the survey measures registered markers, or duplicates: "store" to register it again'


@dataclass(frozen=True, slots=True)
class RegisteredPoints:
    """Registered markers around a survey, as they were surveyed.

    Attributes
    ----------
    lon_deg, lat_deg : ndarray, shape (M,)
    marker_ids, families : sequence of str
    points, files : sequence of str or None
        Point number in the survey, and SHA-256 of its file.
    """

    lon_deg: Floats
    lat_deg: Floats
    marker_ids: tuple[str, ...]
    families: tuple[str, ...]
    points: tuple[str | None, ...]
    files: tuple[str | None, ...]


def find_duplicates(
    survey: GeoreferencedSurvey, declaration: ImportDeclaration, file_sha256: str, known: RegisteredPoints
) -> Iterator[Fault]:
    """A fault for a file that was imported before, and one for each row whose marker is registered.

    A row is the same marker if one of its family is registered within the accuracy of the survey, or near by from a row
    with the same point number. Nothing is reported of a comparison, or where duplicates are declared to be stored.
    """
    if declaration.compare or declaration.duplicates == "store" or not known.marker_ids:
        return
    again = known.files.count(file_sha256)
    if again:
        message = f"this file was imported before: {again} registered markers come from it"
        yield Fault(None, "content", "file_already_imported", message, _CURE)
        return
    rows = np.flatnonzero(survey.placed.placed)
    same = np.flatnonzero(np.array([family == declaration.family for family in known.families]))
    if not len(rows) or not len(same):
        return
    origin, changes = survey.origin_deg, measured_changes(survey)
    others = np.column_stack(east_north_m(known.lon_deg[same], known.lat_deg[same], origin))
    here = np.column_stack([survey.east_m[rows], survey.north_m[rows]])
    distance, index = nearest_of(here, others, min(_NEAREST, len(same)))
    rmse_m = _rmse_m(survey, declaration)[rows]
    points: Any = survey.table.texts.get("point")
    within = np.clip(_SAME_RMSE * np.nan_to_num(rmse_m), _SAME_M, _NAMED_M)
    for k in np.flatnonzero(distance[:, 0] <= _NAMED_M).tolist():
        name = points[int(rows[k])] if points is not None else ""
        for metres, other in zip(distance[k].tolist(), same[index[k]].tolist(), strict=True):
            if metres <= within[k] or (metres <= _NAMED_M and name and name == known.points[other]):
                marker = f"marker {known.marker_ids[other]}"
                shown = f" from point {known.points[other]}" if known.points[other] else ""
                message = f"{marker} is registered{shown}, {metres:.2f} m from this row"
                yield Fault(
                    int(rows[k]) + 1, "position", "already_registered", message, _CURE, Severity.REFUSED, changes
                )  # fmt: skip
                break


def _rmse_m(survey: GeoreferencedSurvey, declaration: ImportDeclaration) -> Floats:
    """Horizontal RMSE of each row; NaN where it is not declared. [m]"""
    whole = declaration.survey.get("horizontal_rmse_m")
    of_all = np.full(survey.table.rows, np.nan if whole is None else float(whole))
    own = survey.table.numbers.get("horizontal_rmse_m")
    return of_all if own is None else np.where(np.isfinite(own), own, of_all)
