"""Tables of surveys, before and after columns have roles, and the faults of their rows."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, NamedTuple, overload

import numpy as np

from app.geodesy.systems import HeightSystem
from app.values import Bools, Floats

MAX_ROWS = 1_000_000
MAX_COLUMNS = 256
MAX_TEXT = 500
"""Largest survey that is read in one file, and the longest text of a cell. [character]"""
KEPT_FAULTS = 1000
"""Faults of one kind that are kept with their texts; all are counted and flagged."""
_PART = 10_000  # texts that are joined into one string


class Severity(StrEnum):
    """Consequence of a fault for its row, or for the whole file if it names no row."""

    REFUSED = "refused"
    WARNING = "warning"


class Change(NamedTuple):
    """A member of the declaration, and the value that it should have."""

    member: str  # its path, such as ``unit`` or ``columns.easting``
    value: str | float | bool | None


class Fault(NamedTuple):
    """A mistake, or a possible one."""

    row: int | None  # number of the row, counted from 1; None for the whole file
    field: str
    code: str  # kind of the fault, for programs
    message: str
    proposal: str | None = None  # how to correct it
    severity: Severity = Severity.REFUSED
    changes: tuple[Change, ...] = ()  # how the declaration would have to be changed, where that is the correction


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


@dataclass(frozen=True, slots=True)
class Detected:
    """A property of a file that was not declared, with the evidence for it."""

    what: str  # the property, such as ``encoding`` or ``column of code``
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

    def flags(self, rows: int, severity: Severity) -> Bools:
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
    """The contents of a file: named columns, and the coordinates of its points where it has geometry."""

    format: str
    names: tuple[str, ...]
    columns: tuple[Sequence[Any], ...]  # one a name, of text or of numbers; None where a value is missing
    points: tuple[Floats, Floats, Floats] | None = None  # x, y, z of each row; NaN where there is none
    crs: str | None = None  # as the file declares it: ``EPSG:code``, or WKT where that has no code
    # unit of length of the coordinates, as the file declares it; ``ft`` where it does not state which foot
    unit: str | None = None
    height_unit: str | None = None  # of the heights, where the file declares another one for them
    faults: Faults = field(default_factory=Faults)
    detected: tuple[Detected, ...] = ()
    has_names: bool = True  # whether the names are the file's own; those of a layout by position are not
    heights: HeightSystem | None = None  # what the heights are above, where the file's CRS states it
    units: tuple[str, ...] = ()  # one a name, where a row of units follows the header

    @property
    def rows(self) -> int:
        """Rows of data."""
        return len(self.points[0]) if self.points is not None else len(self.columns[0]) if self.columns else 0


@dataclass(frozen=True, slots=True)
class SurveyTable:
    """Rows of a survey with their coordinates as in the file."""

    format: str
    # `first`, `second`: float64, shape (N,): longitude and latitude [deg], or easting and northing in `unit`; NaN where
    # they could not be read
    first: Floats
    second: Floats
    height: Floats | None  # float64, shape (N,), or None: in `height_unit`; NaN where there is none
    projected: bool
    crs: str
    # `unit`, `height_unit`: ``m``, ``ft-us``, ``ft-intl`` or ``deg``
    unit: str
    height_unit: str
    # by role: point, code, description, road, side, status; empty where there is none
    texts: dict[str, Texts] = field(default_factory=dict)
    # by role: heading_deg, measure_m, offset_m, horizontal_rmse_m, vertical_rmse_m
    numbers: dict[str, Floats] = field(default_factory=dict)
    faults: Faults = field(default_factory=Faults)
    detected: tuple[Detected, ...] = ()  # what was not declared
    # coordinates as the file has them, where `first` and `second` are others
    written: tuple[Floats, Floats] | None = None
    vertical_datum: str | None = None  # of the heights: declared, or that of the file's CRS

    @property
    def rows(self) -> int:
        """Rows of data."""
        return len(self.first)


# === Numbers as people type them: a cell that is no number gets a fault that names the likely mistake.
#
# How numbers are written is the same in the whole file: it is declared, or most cells show it. A cell that is written
# in another way is a fault.


_PLAIN = re.compile(r"[ \t]*[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?[ \t]*")
_PART_CELLS = 10_000  # cells read in one step
_NOT_NUMERIC = re.compile(r"[^0-9+\-.eE \x00]")
_DECIMAL_COMMA = re.compile(r"\s*[+-]?[0-9]+,[0-9]+\s*")
_GROUPED = re.compile(r"\s*[+-]?[0-9]{1,3}(?:[,' \u00a0\u2009][0-9]{3})+(?:\.[0-9]*)?\s*")
_SEXAGESIMAL = re.compile(
    r"\s*([NSEWO])?\s*([+-]?[0-9]{1,3})\s*[°d: ]\s*([0-9]{1,2}(?:\.[0-9]*)?)\s*"
    r"(?:['′’m: ]\s*([0-9]{1,2}(?:\.[0-9]*)?)?\s*(?:\"|″|”|''|s)?)?\s*([NSEWO])?\s*",
    re.IGNORECASE,
)
_SPACES = " \u00a0\u2009\u202f"  # blank, no-break, thin and narrow no-break space separate groups (SI Brochure, 5.4.4)
_GROUPS = f",.'\u2019{_SPACES}"
_IN_GROUPS = re.compile(
    rf"[+-]?[0-9]{{1,3}}(?P<mark>[{_GROUPS}])[0-9]{{3}}(?:(?P=mark)[0-9]{{3}})*(?P<rest>[.,][0-9]*)?"
)
_WITH_COMMA = re.compile(r"[+-]?([0-9]+),([0-9]+)")
_WITH_POINT = re.compile(r"[+-]?[0-9]+\.[0-9]+")
_MAX_SHOWN = 60  # [character] of a cell that is no plain number; none that is one in another form is longer
_MIN_SHARE = 0.5  # [1] of the numbers above 999 that must be in groups
_WHOLE_DEGREES = re.compile(
    r"\s*([NSEW])?\s*([+-]?[0-9]{1,3})\s*[°d]\s*([0-9]{1,2}(?:[.,][0-9]*)?)\s*['′’m]\s*"
    r"(?:([0-9]{1,2}(?:[.,][0-9]*)?)\s*(?:\"|″|”|''|s))?\s*([NSEW])?\s*"
)  # with the sign of degrees, and no O, which is Ost (east) or Ouest (west)
_HEMISPHERE = re.compile(r"\s*(?:([NSEWO])\s*([0-9.]+)|([0-9.]+)\s*°?\s*([NSEWO]))\s*", re.IGNORECASE)
_WITH_UNIT = re.compile(r"\s*([+-]?[0-9.]+)\s*(m|ft|us-?ft|sft|feet|'|cm|mm|km)\.?\s*", re.IGNORECASE)


STATION = re.compile(r"([+-]?)([0-9]{1,6})\+([0-9]{3}(?:[.,][0-9]*)?)")
"""A measure as kilometres and metres, 12+345.67. Two digits behind the sign are stations of 100 ft, which are none."""
_STATION_100_FT = re.compile(r"[+-]?[0-9]+\+[0-9]{2}(?:[.,][0-9]*)?")


class NumberForm(NamedTuple):
    """How numbers are written: the decimal sign, and the sign between groups of three digits, or none."""

    decimal: str = "."
    group: str = ""


PLAIN = NumberForm()


def detect_number_form(cells: Iterable[str], decimal: str | None) -> tuple[NumberForm, str]:
    """How the majority of cells is written, and the cells that show it.

    Parameters
    ----------
    cells : iterable of str
        A sample of the cells of coordinates.
    decimal : str or None
        If it is declared.

    Notes
    -----
    A comma before three digits may separate decimals or thousands (``432,345``); such a cell shows nothing.
    """
    decimals, groups, large = Counter[str](), Counter[str](), 0
    shown: dict[str, str] = {}
    for text in (cell.strip()[:_MAX_SHOWN] for cell in cells):
        mark = sign = ""
        if found := _IN_GROUPS.fullmatch(text):
            rest = found["rest"] or ""
            if rest or found["mark"] not in ",." or text.count(found["mark"]) > 1:
                mark, sign = found["mark"], rest[:1] or (_other(found["mark"]) if found["mark"] in ",." else "")
            elif found["mark"] == ".":
                sign = "."  # 432.345 is a number with a decimal point, as programs write it
            if mark == sign:
                mark = ""
        elif found := _WITH_COMMA.fullmatch(text):
            sign = ","  # four digits before it, or not three after it
        elif _WITH_POINT.fullmatch(text):
            sign = "."
        large += len(re.sub(r"[.,][0-9]*$", "", text) if not mark else text) > 3
        decimals.update([sign] if sign else [])
        groups.update([mark] if mark else [])
        shown.setdefault(mark or sign, text[:30])
    sign = decimal or (decimals.most_common(1)[0][0] if decimals else ".")
    mark, count = groups.most_common(1)[0] if groups else ("", 0)
    if mark == sign or count < _MIN_SHARE * large:
        mark = ""
    return NumberForm(sign, mark), shown.get(mark or sign, "")


def _other(mark: str) -> str:
    return "." if mark == "," else ","


def read_numbers(cells: Any, field: str, *, form: NumberForm = PLAIN, required: bool) -> tuple[Floats, list[Fault]]:
    """Numbers of a column, shape (N,); NaN and a fault where a cell holds none.

    Parameters
    ----------
    field : str
        Name of the column in faults.
    required : bool
        An empty cell is a fault.
    """
    if isinstance(cells, np.ndarray) and cells.dtype.kind in "fi" and np.isfinite(cells).all():
        return cells.astype(np.float64), []
    values = np.full(len(cells), np.nan)
    faults: list[Fault] = []
    start = 0
    for part in _parts(cells):
        fast = _read_fast(part) if form == PLAIN else None
        if fast is not None:
            values[start : start + len(part)] = fast
        else:
            for index, cell in enumerate(part, start):
                value = _read_one(cell, field, index + 1, form, required)
                if isinstance(value, Fault):
                    faults.append(value)
                else:
                    values[index] = value
        start += len(part)
    return values, faults


def are_stations(cells: Iterable[object]) -> bool:
    """Whether all cells that are filled are kilometres and metres such as 12+345.67."""
    filled = [text for cell in cells if cell is not None and (text := str(cell).strip()[:_MAX_SHOWN])]
    return bool(filled) and all(STATION.fullmatch(text) for text in filled)


def are_sexagesimal(cells: Iterable[str]) -> bool:
    """Whether most of the cells are degrees, minutes and seconds with their signs."""
    filled = [text for cell in cells if (text := cell.strip()[:_MAX_SHOWN])]
    return sum(1 for text in filled if _WHOLE_DEGREES.fullmatch(text)) > _MIN_SHARE * len(filled)


def read_sexagesimal(cells: Sequence[str], field: str) -> tuple[Floats, list[Fault]]:
    """Decimal degrees of a column of degrees, minutes and seconds, shape (N,); NaN and a fault for any other cell."""
    values = np.full(len(cells), np.nan)
    faults: list[Fault] = []
    for index, text in enumerate(cells):
        found = _WHOLE_DEGREES.fullmatch(text.strip()[:_MAX_SHOWN])
        letter = (found[1] or found[5] or "") if found else ""
        if found is None or letter not in ("", *_LETTERS.get(field, "")) or not _in_range(found):
            shown = repr(text.strip()[:40])
            message = f"{field} is {shown}, not degrees, minutes and seconds like most of the others"
            faults.append(Fault(index + 1, field, "not_a_number", message, "write all rows in the same form"))
            continue
        values[index] = _decimal_degrees(found)
    return values, faults


_OST_OR_OUEST = "write decimal degrees, negative in the west: O may be Ost (east) or Ouest (west)"
_LETTERS = {"lon_deg": "EW", "lat_deg": "NS"}


def _in_range(found: re.Match[str]) -> bool:
    return all(float((found[k] or "0").replace(",", ".")) < 60 for k in (3, 4))


def _parts(cells: Sequence[object]) -> Iterator[Sequence[object]]:
    if isinstance(cells, Texts):
        return cells.parts()
    return (cells[start : start + _PART_CELLS] for start in range(0, len(cells), _PART_CELLS))


def _read_fast(cells: Sequence[Any]) -> Floats | None:
    """All cells in one step if they are plain numbers, which is the fast path for large surveys; None otherwise."""
    try:
        if _NOT_NUMERIC.search("\x00".join(cells)):
            return None
        values = np.array(cells, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return values if np.isfinite(values).all() else None


def _read_one(cell: object, field: str, row: int, form: NumberForm, required: bool) -> float | Fault:
    if cell is None or (isinstance(cell, str) and not cell.strip()) or (isinstance(cell, float) and np.isnan(cell)):
        if required:
            return Fault(row, field, "missing", f"{field} is empty", "fill it in, or leave the row out")
        return float("nan")
    if isinstance(cell, bool) or not isinstance(cell, str | int | float | np.number):
        return Fault(row, field, "not_a_number", f"{field} holds a {type(cell).__name__}, not a number")
    text = str(cell)
    plain = text
    if form.group and (found := _IN_GROUPS.fullmatch(text.strip())) and found["mark"] == form.group:
        plain = text.replace(form.group, "") if found["rest"] is None or found["rest"][0] == form.decimal else text
    if form.decimal == "," and "." not in plain:
        plain = plain.replace(",", ".")
    elif form.decimal == "," and isinstance(cell, str) and _PLAIN.fullmatch(plain):
        message = f"{field} is {text.strip()[:40]!r}: a point, in a file with decimal commas"
        cure = "write all numbers in the same form; declare decimal if the point is the decimal sign of the file"
        return Fault(row, field, "decimal_point", message, cure)
    if _PLAIN.fullmatch(plain):
        value = float(plain)
        if np.isfinite(value):
            return value
    if field == "measure_m" and (found := STATION.fullmatch(text.strip()[:_MAX_SHOWN])):
        metres = 1000.0 * int(found[2]) + float(found[3].replace(",", "."))
        return -metres if found[1] == "-" else metres
    return _fault_of(text, field, row, form.decimal)


def _fault_of(text: str, field: str, row: int, decimal: str) -> Fault:
    text = text.strip()[:_MAX_SHOWN]  # patterns with several optional blanks take quadratic time
    shown = repr(text[:40])
    if decimal == "." and _DECIMAL_COMMA.fullmatch(text):
        cure = f'declare decimal ",", or write {text.strip().replace(",", ".")}'
        return Fault(row, field, "decimal_comma", f"{field} is {shown}: a decimal comma", cure)
    if _GROUPED.fullmatch(text):
        cure = f"write {re.sub(r'[^0-9.+-]', '', text)}"
        return Fault(row, field, "grouped_digits", f"{field} is {shown}: digits in groups", cure)
    if field == "measure_m" and _STATION_100_FT.fullmatch(text):
        message = f"{field} is {shown}: a station of 100 ft, or of metres with a digit missing"
        return Fault(row, field, "station_of_100_ft", message, "write metres, or kilometres and metres: 12+345.67")
    if (found := _HEMISPHERE.fullmatch(text)) is not None:
        letter, number = found[1] or found[4], found[2] or found[3]
        sign = "-" if letter.upper() in "SW" else ""
        cure = f"write {sign}{number}" if letter.upper() != "O" else _OST_OR_OUEST
        return Fault(row, field, "hemisphere_letter", f"{field} is {shown}: a letter in place of the sign", cure)
    if (found := _WITH_UNIT.fullmatch(text)) is not None:
        return Fault(
            row,
            field,
            "unit_in_value",
            f"{field} is {shown}: a unit in the value",
            f"write {found[1]} and declare the unit of the column",
        )
    if (found := _SEXAGESIMAL.fullmatch(text)) is not None:
        letter = (found[1] or found[5] or "").upper()
        cure = f"write {_decimal_degrees(found):.9f}" if letter != "O" else _OST_OR_OUEST
        message = f"{field} is {shown}: degrees and minutes, not decimal degrees"
        return Fault(row, field, "degrees_minutes", message, cure)
    return Fault(row, field, "not_a_number", f"{field} is {shown}, not a finite number", "write plain decimal numbers")


def _decimal_degrees(found: re.Match[str]) -> float:
    degrees = abs(float(found[2]))
    minutes, seconds = (float((found[k] or "0").replace(",", ".")) for k in (3, 4))
    letter = (found[1] or found[5] or "").upper()
    negative = found[2].startswith("-") or letter in ("S", "W")
    value = degrees + minutes / 60 + seconds / 3600
    return -value if negative else value
