"""What a file says, before and after its columns have roles; and what can be wrong with a row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

MAX_ROWS = 1_000_000
MAX_COLUMNS = 256
MAX_TEXT = 500


class Severity(StrEnum):
    """What a fault means for its row, or for the whole file where it names no row."""

    REFUSED = "refused"
    WARNING = "warning"


class Fault(NamedTuple):
    """Something that is wrong, or may be.

    Attributes
    ----------
    row : int or None
        Number of the row as people count it: the first row of data is 1. None is the file.
    field : str
    code : str
        Kind of the fault, for programs.
    message : str
    proposal : str or None
        What would cure it.
    severity : Severity
    """

    row: int | None
    field: str
    code: str
    message: str
    proposal: str | None = None
    severity: Severity = Severity.REFUSED


@dataclass(frozen=True, slots=True)
class SourceTable:
    """The contents of a file: named columns, and the coordinates of its points where it has geometry.

    Attributes
    ----------
    format : str
    names : tuple of str
    columns : tuple of sequences
        One a name, of text or of numbers; None where a value is missing.
    points : tuple of three float64 arrays, or None
        x, y, z of each row; NaN where there is none.
    crs : str or None
        As the file says, in the form ``EPSG:code``.
    unit : str or None
        Unit of length of the coordinates, as the file says.
    faults : tuple of Fault
    """

    format: str
    names: tuple[str, ...]
    columns: tuple[Sequence[Any], ...]
    points: tuple[Floats, Floats, Floats] | None = None
    crs: str | None = None
    unit: str | None = None
    faults: tuple[Fault, ...] = ()

    @property
    def rows(self) -> int:
        """Rows of data."""
        return len(self.points[0]) if self.points is not None else len(self.columns[0]) if self.columns else 0


@dataclass(frozen=True, slots=True)
class SurveyTable:
    """Rows of a survey with their coordinates as they were given.

    Attributes
    ----------
    format : str
    first, second : ndarray of float64, shape (N,)
        Longitude and latitude [deg], or easting and northing in `unit`; NaN where they could not be read.
    height : ndarray of float64, shape (N,), or None
        In `height_unit`; NaN where there is none.
    projected : bool
    crs : str
    unit, height_unit : str
        ``m``, ``ft-us``, ``ft-intl`` or ``deg``.
    texts : dict of lists of str or None
        By role: point, code, description, road, side, status.
    numbers : dict of arrays
        By role: heading_deg, measure_m, offset_m, horizontal_rmse_m, vertical_rmse_m.
    faults : tuple of Fault
    """

    format: str
    first: Floats
    second: Floats
    height: Floats | None
    projected: bool
    crs: str
    unit: str
    height_unit: str
    texts: dict[str, list[str | None]] = field(default_factory=dict)
    numbers: dict[str, Floats] = field(default_factory=dict)
    faults: tuple[Fault, ...] = ()

    @property
    def rows(self) -> int:
        """Rows of data."""
        return len(self.first)
