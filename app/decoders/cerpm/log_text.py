"""Text of uploaded logs: its encoding, lines, rows and columns, read so that a broken line costs only itself."""

from __future__ import annotations

import codecs
import csv
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from app.errors import UnreadableUpload

MAX_LINE = 1 << 18
"""Longest line that is read; longer ones are left out. [characters]"""
MAX_COLUMNS = 256
MAX_NAME = 120
_BOMS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_LATIN = re.compile(rb"[\x80-\x9f]")
_CONTROL = re.compile(rb"[\x01-\x08\x0b\x0c\x0e-\x1f]")


def is_text(data: bytes) -> bool:
    """Whether bytes look like text: with a byte order mark, or without control characters at their beginning."""
    if data.startswith(tuple(bom for bom, _name in _BOMS)):
        return True
    head = data[:4096]
    return len(_CONTROL.findall(head)) + head.count(0) <= len(head) // 50


def decode_text(name: str, data: bytes) -> tuple[str, str | None]:
    """Text of a file, and what was odd about its encoding.

    Raises
    ------
    UnreadableUpload
        A byte order mark that the rest does not keep to.
    """
    for bom, encoding in _BOMS:
        if data.startswith(bom):
            try:
                return data.decode(encoding), None
            except UnicodeDecodeError as error:
                raise UnreadableUpload(
                    f"{name} begins as {encoding} and does not go on so",
                    field="file",
                    limit="UTF-8",
                    cure="save the file as UTF-8",
                ) from error
    try:
        return data.decode("utf-8"), None
    except UnicodeDecodeError as error:
        note = f"{name} is not UTF-8 from byte {error.start} on; characters that cannot be read stand as '?'"
    if not _LATIN.search(data):
        return data.decode("latin-1"), f"{name} is not UTF-8; it was read as ISO 8859-1"
    return data.decode("utf-8", "replace"), note


def clean_text(value: object, length: int = MAX_NAME) -> str | None:
    """A text that can be stored and shown; None where there is none."""
    if not isinstance(value, str | int) or isinstance(value, bool):
        return None
    text = value[:length].strip() if isinstance(value, str) else str(value) if abs(value) < 10**20 else ""
    if not text.isprintable():  # lone surrogates and NUL are not
        text = "".join(c if c.isprintable() else "?" for c in text)
    return text or None


def numbered_lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines that hold something, with their numbers from 0."""
    for number, line in enumerate(text.split("\n")):
        stripped = line.strip("\r \t\ufeff")
        if stripped:
            yield number, stripped


def normal_name(name: str) -> str:
    """A column's name as names are compared: `Latitude [deg]` is `latitude_deg`."""
    return re.sub(r"[^a-z0-9]+", "_", name.strip().lower()).strip("_")


@dataclass(frozen=True, slots=True)
class TextTable:
    """Columns of a text table.

    Attributes
    ----------
    columns : tuple of str
        As written.
    delimiter : str
    decimal_comma : bool
    """

    columns: tuple[str, ...]
    delimiter: str
    decimal_comma: bool = False

    def cells(self, line: str) -> list[str] | None:
        """Cells of a row; None where it has another number of them, or cannot be read."""
        if '"' not in line:
            cells = line.split(self.delimiter)
        elif "\0" in line:
            return None
        else:
            try:
                cells = next(csv.reader([line], delimiter=self.delimiter, strict=True), [])
            except csv.Error:
                return None
        return cells if len(cells) == len(self.columns) else None


def find_table(header: str) -> TextTable:
    """Columns from the first line."""
    delimiter = max(",;\t|", key=header.count)
    reader = csv.reader([header.lstrip("#").strip()], delimiter=delimiter)
    try:
        names = next(reader, [])
    except csv.Error:
        names = []
    return TextTable(tuple(name.strip()[:MAX_NAME] for name in names[:MAX_COLUMNS]), delimiter, delimiter != ",")


def match_columns(
    names: Sequence[str], aliases: Mapping[str, Sequence[str]], declared: Mapping[str, str]
) -> dict[str, int]:
    """Place of each quantity among columns: as declared, or else by the first of its names that is there."""
    places: dict[str, int] = {}
    normal = [normal_name(name) for name in names]
    for quantity, wanted in aliases.items():
        if quantity in declared:
            name = declared[quantity]
            if name in names:
                places[quantity] = list(names).index(name)
            continue
        for alias in wanted:
            if alias in normal:
                places[quantity] = normal.index(alias)
                break
    return places


def repeated_names(names: Iterable[str]) -> list[str]:
    """Names that stand over several columns."""
    normal = [normal_name(name) for name in names]
    return sorted({name for name in normal if name and normal.count(name) > 1})


def read_number(value: object, *, decimal_comma: bool = False) -> float:
    """A number from a cell or a JSON value; NaN where it is empty.

    Raises
    ------
    ValueError
        Text that is no number, or a number that is not finite.
    """
    if value is None or value == "":
        return math.nan
    if isinstance(value, str):
        text = value.strip()
        if not text or text.lower() in ("nan", "null", "none", "-", "n/a", "na"):
            return math.nan
        if len(text) > 40 or "_" in text:
            raise ValueError("not a number")
        number = float(text.replace(",", ".") if decimal_comma else text)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        number = float(value) if abs(value) < 1e300 else math.inf
    else:
        raise ValueError("not a number")
    if not math.isfinite(number):
        raise ValueError("not a finite number")
    return number
