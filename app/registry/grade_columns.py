"""Columns of a marker's grade, also for rows and versions from before there were grades."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from app.geodesy import LocalizationGrade, grade_accuracy, total_accuracy_m
from app.geodesy.place import stored_frame

MAX_NOTE = 500  # characters of the column transform_note
NO_RMSE = "no horizontal accuracy is stated: state horizontal_rmse_m"
"""Cure of a position that is unfit for localization for lack of it."""


def grade_columns(horizontal_rmse_m: float | None, accuracy_m: float | None, note: str | None) -> dict[str, Any]:
    """Columns of a position's grade: by its survey, and by the accuracy of its frame with the note on it."""
    notes = [text for text in (NO_RMSE if horizontal_rmse_m is None else None, note) if text]
    return {
        "transform_accuracy_m": accuracy_m,
        "localization_grade": str(grade_accuracy(total_accuracy_m(horizontal_rmse_m, accuracy_m))),
        "transform_note": "; ".join(notes)[:MAX_NOTE] or None,
    }


def is_graded(values: Mapping[str, Any]) -> bool:
    """Whether a row or a version has a grade; older ones are ``exact`` or ``approximate``."""
    return values.get("localization_grade") in list(LocalizationGrade)


def regraded(values: Mapping[str, Any]) -> dict[str, Any]:
    """The columns of the grade of a row or a version that has none.

    Parameters
    ----------
    values : mapping
        Columns of a marker; missing ones are None.
    """
    place_deg = (values["lon_deg"], values["lat_deg"])
    stated = (values.get(name) for name in ("realization", "epoch", "transform_accuracy_m"))
    accuracy_m, added = stored_frame(values["crs"], place_deg, *stated)
    note = values.get("transform_note") or ""
    parts = [part for part in (note.removeprefix(NO_RMSE).removeprefix("; "), added) if part]
    return grade_columns(values.get("horizontal_rmse_m"), accuracy_m, "; ".join(dict.fromkeys(parts)))
