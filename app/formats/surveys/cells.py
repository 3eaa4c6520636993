"""Numbers as people type them: a cell that is no number gets a fault that names the likely mistake.

How numbers are written is the same in the whole file: it is declared, or most cells show it. A cell that is written in
another way is a fault.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from app.formats.surveys.table import Fault, Floats, Texts

_PLAIN = re.compile(r"[ \t]*[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?[ \t]*")
_PART = 10_000  # cells read in one step; chosen by hand
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
_MIN_SHARE = 0.5  # [1] of the numbers above 999 that must be in groups; chosen by hand
_WHOLE_DEGREES = re.compile(
    r"\s*([NSEW])?\s*([+-]?[0-9]{1,3})\s*[°d]\s*([0-9]{1,2}(?:[.,][0-9]*)?)\s*['′’m]\s*"
    r"(?:([0-9]{1,2}(?:[.,][0-9]*)?)\s*(?:\"|″|”|''|s))?\s*([NSEW])?\s*"
)  # with the sign of degrees, and no O, which is Ost (east) or Ouest (west)
_HEMISPHERE = re.compile(r"\s*(?:([NSEWO])\s*([0-9.]+)|([0-9.]+)\s*°?\s*([NSEWO]))\s*", re.IGNORECASE)
_WITH_UNIT = re.compile(r"\s*([+-]?[0-9.]+)\s*(m|ft|us-?ft|sft|feet|'|cm|mm|km)\.?\s*", re.IGNORECASE)


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
    cells : sequence of str, float or None, Texts, or ndarray
    field : str
        Name of the column in faults.
    form : NumberForm
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


def _parts(cells: Sequence[Any]) -> Iterator[Sequence[Any]]:
    if isinstance(cells, Texts):
        return cells.parts()
    return (cells[start : start + _PART] for start in range(0, len(cells), _PART))


def _read_fast(cells: Sequence[Any]) -> Floats | None:
    """All cells in one step if they are plain numbers, which is the fast path for large surveys; None otherwise."""
    try:
        if _NOT_NUMERIC.search("\x00".join(cells)):
            return None
        values = np.array(cells, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return values if np.isfinite(values).all() else None


def _read_one(cell: Any, field: str, row: int, form: NumberForm, required: bool) -> float | Fault:
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
    if _PLAIN.fullmatch(plain):
        value = float(plain)
        if np.isfinite(value):
            return value
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
    if (found := _HEMISPHERE.fullmatch(text)) is not None:
        letter, number = found[1] or found[4], found[2] or found[3]
        sign = "-" if letter.upper() in "SW" else ""
        cure = f"write {sign}{number}" if letter.upper() != "O" else _OST_OR_OUEST
        return Fault(row, field, "hemisphere_letter", f"{field} is {shown}: a letter in place of the sign", cure)
    if (found := _WITH_UNIT.fullmatch(text)) is not None:
        return Fault(
            row, field, "unit_in_value", f"{field} is {shown}: a unit in the value",
            f"write {found[1]} and declare the unit of the column",
        )  # fmt: skip
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
