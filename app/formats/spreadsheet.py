"""Tables as CSV that a spreadsheet program opens as text and numbers, and never as formulas."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable
from typing import TextIO

# source: OWASP, CSV injection; the wide forms are taken for formulas by spreadsheets in East Asian locales
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")
_NUMBER = re.compile(r"[+-]?[0-9]+(\.[0-9]*)?([eE][+-]?[0-9]+)?")


def plain_text(text: str) -> str:
    """Text that no spreadsheet runs as a formula: an apostrophe precedes what it would run. Numbers stay."""
    return f"'{text}" if text.startswith(_FORMULA) and not _NUMBER.fullmatch(text) else text


class TableWriter:
    """Writes rows as CSV (RFC 4180), with `plain_text` for every cell that is a text. All tables are written by it.

    Parameters
    ----------
    stream : TextIO
    line_end : str
    """

    def __init__(self, stream: TextIO, line_end: str = "\r\n") -> None:
        self._writer = csv.writer(stream, lineterminator=line_end)

    def write_row(self, cells: Iterable[object]) -> None:
        """One row; None is an empty cell."""
        self._writer.writerow([plain_text(cell) if isinstance(cell, str) else cell for cell in cells])
