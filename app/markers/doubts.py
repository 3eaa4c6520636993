"""What makes a marker's position unfit for localization."""

from __future__ import annotations

from app.geodesy import LocalizationGrade

SURVEYED = ("surveyed", "active")


def position_doubts(
    what: str, *, grade: str, transform_note: str | None, horizontal_rmse_m: float | None, status: str
) -> list[str]:
    """Sentences for people about the position of a marker; none where it is fit.

    Parameters
    ----------
    what : str
        What the marker is called: plate, tag.
    grade : str
        A `LocalizationGrade`.
    transform_note : str or None
        What is to be said of how its position was transformed.
    horizontal_rmse_m : float or None
        [m]
    status : str
    """
    doubts = []
    if grade != LocalizationGrade.EXACT:
        doubts.append(transform_note or f"the {what}'s position is approximate")
    if horizontal_rmse_m is None:
        doubts.append(f"the {what}'s position has no stated accuracy")
    if status not in SURVEYED:
        doubts.append(f"the {what} is {status}, its position is not surveyed")
    return doubts
