"""Reasons why a marker's position is unfit for localization."""

from __future__ import annotations

from app.geodesy import UNFIT_TEXT, LocalizationGrade

SURVEYED = ("surveyed", "active")


def position_warnings(what: str, *, grade: str, transform_note: str | None, status: str) -> list[str]:
    """Warnings about the position of a marker; none if it is fit for localization.

    Parameters
    ----------
    what : str
        What the marker is called: plate, tag.
    grade : str
        A `LocalizationGrade`.
    transform_note : str or None
        Note on the transformation of its position.
    status : str
    """
    localization_warnings = []
    if grade == LocalizationGrade.UNFIT:
        localization_warnings.append(transform_note or f"the {what}'s position is {UNFIT_TEXT}")
    if status not in SURVEYED:
        localization_warnings.append(f"the {what} is {status}, its position is not surveyed")
    return localization_warnings
