"""Tables of surveys, before and after columns have roles, and the faults of their rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, NamedTuple, overload

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

MAX_ROWS = 1_000_000
MAX_COLUMNS = 256
MAX_TEXT = 500
"""Largest survey that is read in one file, and the longest text of a cell. [character] Chosen by hand."""
KEPT_FAULTS = 1000
"""Faults of one kind that are kept with their texts; all are counted and flagged. Chosen by hand."""
_PART = 10_000  # texts that are joined into one string; chosen by hand


class Severity(StrEnum):
    """Consequence of a fault for its row, or for the whole file if it names no row."""

    REFUSED = "refused"
    WARNING = "warning"


class Change(NamedTuple):
    """A member of the declaration, and the value that it should have.

    Attributes
    ----------
    member : str
        Its path, such as ``unit`` or ``columns.easting``.
    value : str, float, bool or None
    """

    member: str
    value: str | float | bool | None


class Fault(NamedTuple):
    """A mistake, or a possible one.

    Attributes
    ----------
    row : int or None
        Number of the row, counted from 1; None for the whole file.
    field : str
    code : str
        Kind of the fault, for programs.
    message : str
    proposal : str or None
        How to correct it.
    severity : Severity
    changes : tuple of Change
        How the declaration would have to be changed, where that is the correction.
    """

    row: int | None
    field: str
    code: str
    message: str
    proposal: str | None = None
    severity: Severity = Severity.REFUSED
    changes: tuple[Change, ...] = ()


def warn(
    row: int | None,
    field: str,
    code: str,
    message: str,
    proposal: str | None = None,
    changes: tuple[Change, ...] = (),
) -> Fault:
    """A fault that only warns."""
    return Fault(row, field, code, message, proposal, Severity.WARNING, changes)


class Detected(NamedTuple):
    """A property of a file that was not declared, with the evidence for it.

    Attributes
    ----------
    what : str
        The property, such as ``encoding`` or ``column of code``.
    value, evidence : str
    """

    what: str
    value: str
    evidence: str


class Faults:
    """Faults of a survey: counted by kind, flagged for every row, and kept with their texts up to a limit."""

    def __init__(self, faults: Iterable[Fault] = ()) -> None:
        self.counts: Counter[str] = Counter()
        self.refuses_file = False
        self.file_warnings: set[str] = set()
        self._rows = {severity: bytearray() for severity in Severity}
        self._kept: dict[tuple[str, Severity], list[Fault]] = {}
        self._left_out: frozenset[int] = frozenset()
        self.add(faults)

    def add(self, faults: Iterable[Fault]) -> None:
        """Add faults, however many."""
        for fault in faults:
            if fault.row in self._left_out:
                continue
            self.counts[fault.code] += 1
            kept = self._kept.setdefault((fault.code, fault.severity), [])
            if len(kept) < KEPT_FAULTS:
                kept.append(fault)
            if fault.row is None:
                self.refuses_file |= fault.severity is Severity.REFUSED
                if fault.severity is Severity.WARNING:
                    self.file_warnings.add(fault.code)
                continue
            flags = self._rows[fault.severity]
            if len(flags) < fault.row:
                flags.extend(bytes(max(fault.row - len(flags), len(flags))))
            flags[fault.row - 1] = 1

    def leave_out(self, rows: Iterable[int]) -> None:
        """Forget the faults of some rows, counted from 1, and ignore those that are added later."""
        self._left_out = frozenset(rows)
        for (code, _severity), kept in self._kept.items():
            others = [fault for fault in kept if fault.row not in self._left_out]
            self.counts[code] -= len(kept) - len(others)
            kept[:] = others
        self.counts = +self.counts
        for flags in self._rows.values():
            for row in self._left_out:
                if row <= len(flags):
                    flags[row - 1] = 0

    def flags(self, rows: int, severity: Severity) -> Flags:
        """Which of the first `rows` rows have a fault of this severity, shape (rows,)."""
        flags = np.zeros(rows, dtype=bool)
        known = np.frombuffer(bytes(self._rows[severity]), dtype=bool)[:rows]
        flags[: len(known)] = known
        return flags

    def shown(self, limit: int) -> list[Fault]:
        """The first ones by row, refusals before warnings."""
        kept = [fault for faults in self._kept.values() for fault in faults]
        return sorted(kept, key=lambda fault: (fault.severity, fault.row or 0))[:limit]

    def __len__(self) -> int:
        return self.counts.total()


class Texts(Sequence[str]):
    """A column of texts in little memory: ten thousand at a time in one string, with NUL between them."""

    def __init__(self, cells: Iterable[str] = ()) -> None:
        self._parts: list[str] = []
        self._rest: list[str] = []
        self._count = 0
        self._opened: tuple[int, list[str]] = (-1, [])
        self.extend(cells)

    def extend(self, cells: Iterable[str]) -> None:
        """Append texts; none holds NUL."""
        self._rest.extend(cells)
        while len(self._rest) >= _PART:
            part, self._rest = self._rest[:_PART], self._rest[_PART:]
            self._parts.append("\x00".join(part))
            self._count += _PART

    def parts(self) -> Iterator[list[str]]:
        """All texts, ten thousand at a time."""
        for part in self._parts:
            yield part.split("\x00")
        if self._rest:
            yield self._rest

    def joined(self) -> Iterator[str]:
        """As `parts`, with NUL between the texts."""
        yield from self._parts
        if self._rest:
            yield "\x00".join(self._rest)

    def __len__(self) -> int:
        return self._count + len(self._rest)

    @overload
    def __getitem__(self, index: int) -> str: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[str]: ...
    def __getitem__(self, index: int | slice) -> str | Sequence[str]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        index = int(index)
        if not 0 <= index < len(self):
            raise IndexError(index)
        if index >= self._count:
            return self._rest[index - self._count]
        number, within = divmod(index, _PART)
        if self._opened[0] != number:
            self._opened = (number, self._parts[number].split("\x00"))
        return self._opened[1][within]


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
        As the file declares it, in the form ``EPSG:code``.
    unit : str or None
        Unit of length of the coordinates, as the file declares it; ``ft`` where it does not state which foot.
    faults : Faults
    detected : tuple of Detected
    has_names : bool
        Whether the names are the file's own; those of a layout by position are not.
    """

    format: str
    names: tuple[str, ...]
    columns: tuple[Sequence[Any], ...]
    points: tuple[Floats, Floats, Floats] | None = None
    crs: str | None = None
    unit: str | None = None
    faults: Faults = field(default_factory=Faults)
    detected: tuple[Detected, ...] = ()
    has_names: bool = True

    @property
    def rows(self) -> int:
        """Rows of data."""
        return len(self.points[0]) if self.points is not None else len(self.columns[0]) if self.columns else 0


@dataclass(frozen=True, slots=True)
class SurveyTable:
    """Rows of a survey with their coordinates as in the file.

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
    texts : dict of Texts
        By role: point, code, description, road, side, status; empty where there is none.
    numbers : dict of arrays
        By role: heading_deg, measure_m, offset_m, horizontal_rmse_m, vertical_rmse_m.
    faults : Faults
    detected : tuple of Detected
        What was not declared.
    written : tuple of two arrays, or None
        Coordinates as the file has them, where `first` and `second` are others.
    """

    format: str
    first: Floats
    second: Floats
    height: Floats | None
    projected: bool
    crs: str
    unit: str
    height_unit: str
    texts: dict[str, Texts] = field(default_factory=dict)
    numbers: dict[str, Floats] = field(default_factory=dict)
    faults: Faults = field(default_factory=Faults)
    detected: tuple[Detected, ...] = ()
    written: tuple[Floats, Floats] | None = None

    @property
    def rows(self) -> int:
        """Rows of data."""
        return len(self.first)
