"""What a position is good enough for, by its accuracy (docs/positions.md)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from enum import StrEnum
from typing import Literal

Grade = Literal["cm", "dm", "m", "unfit"]


class LocalizationGrade(StrEnum):
    """Order of magnitude of a position's horizontal accuracy; UNFIT may not be used to localize a vehicle."""

    CM = "cm"
    DM = "dm"
    M = "m"
    UNFIT = "unfit"


UNFIT_TEXT = "not for localization"
"""What people read where a position is UNFIT."""
GRADE_LIMITS_M = {LocalizationGrade.CM: 0.1, LocalizationGrade.DM: 1.0, LocalizationGrade.M: 10.0}
"""RMSE below which a position has a grade. [m] Source: the unit in which the RMSE is written with one digit before the
point."""


def total_accuracy_m(horizontal_rmse_m: float | None, transform_accuracy_m: float | None) -> float | None:
    """Horizontal RMSE of a position in the ITRF, by its survey and its reference frame; None if one is unknown. [m]"""
    if horizontal_rmse_m is None or transform_accuracy_m is None:
        return None
    return math.hypot(horizontal_rmse_m, transform_accuracy_m)


def grade_accuracy(rmse_m: float | None) -> LocalizationGrade:
    """Grade of a position with a horizontal RMSE in the ITRF; None is unknown. [m]"""
    if rmse_m is None:
        return LocalizationGrade.UNFIT
    found = (grade for grade, limit_m in GRADE_LIMITS_M.items() if rmse_m < limit_m)
    return next(found, LocalizationGrade.UNFIT)


def worst_grade(grades: Iterable[LocalizationGrade]) -> LocalizationGrade:
    """The least accurate of at least one grade."""
    return max(grades, key=list(LocalizationGrade).index)
