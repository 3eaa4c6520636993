"""Surveys as Leica GSI: lines of words with 8 or 16 characters of data.

Source: Leica Geosystems, GSI Online for TPS and DNA, "GSI data format".
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

from app.errors import UnreadableUpload
from app.formats.surveys.declaration import FEET, ImportDeclaration
from app.formats.surveys.table import MAX_ROWS, Detected, Fault, Faults, SourceTable
from app.formats.text import as_utf8

_WORD = re.compile(r"([0-9]{2})([0-9.]{4}|[0-9.]{2,3}[^+\-]{1,2})([+-])(\S{16}|\S{8})(?=\s|$)")
_POINT, _REMARK = "11", "71"
_TARGET = {"81": "easting", "82": "northing", "83": "height"}
_STATION = {"84": "easting", "85": "northing", "86": "height"}
_UNITS = {"0": ("m", 3), "1": (FEET, 3), "6": ("m", 4), "7": (FEET, 4), "8": ("m", 5)}
"""Unit of a length and its decimals, by the sixth character of a word."""
_NAMES = ("point", "easting", "northing", "height", "description")
_CURE = "export the points with their coordinates (word indices 11, 81, 82, 83)"


class _Line(NamedTuple):
    number: int
    words: dict[str, tuple[str, str, str]]  # index to unit, sign and data


def read_gsi(data: bytes, declaration: ImportDeclaration) -> SourceTable:
    """Points with coordinates; the stations only in a file without any other points.

    Raises
    ------
    UnreadableUpload
        It is no GSI, has no coordinates, or lengths in metres and feet.
    """
    utf8, _encoding = as_utf8(data, declaration.encoding)
    lines = list(_lines(utf8.decode()))
    targets = [line for line in lines if _TARGET.keys() & line.words.keys() >= {"81", "82"}]
    stations = [line for line in lines if _STATION.keys() & line.words.keys() >= {"84", "85"}]
    chosen, indices = (targets, _TARGET) if targets else (stations, _STATION)
    if not chosen:
        raise UnreadableUpload("the GSI has no coordinates", field="file", limit="words 81 and 82", cure=_CURE)
    units = {
        _UNITS.get(line.words[index][0], ("", 0))[0] for line in chosen for index in indices if index in line.words
    }
    if len(units) != 1 or "" in units:
        raise UnreadableUpload(
            "the coordinates of the GSI are in several units, or in one that lengths do not have",
            field="file",
            limit="metres or feet",
            cure=_CURE,
        )
    columns: dict[str, list[str | float | None]] = {name: [] for name in _NAMES}
    faults = Faults()
    for row, line in enumerate(chosen, 1):
        columns["point"].append(_text(line, _POINT))
        columns["description"].append(_text(line, _REMARK))
        for index, name in indices.items():
            value = _length(line, index)
            if value is None and not _is_missing(line, index):
                message = f"line {line.number}: word {index} holds no number"
                faults.add([Fault(row, name, "not_a_number", message, "export the points again")])
            columns[name].append(value)
    detected = [Detected("words", "GSI-16" if b"*" in utf8[:2] else "GSI-8", "the length of the words")]
    if targets and stations:
        left_out = f"{len(stations)} lines left out"
        detected.append(Detected("stations", left_out, "they have the words 84 and 85 of an instrument's place"))
    if left := len(lines) - len(targets) - len(stations):
        detected.append(Detected("other lines", f"{left} left out", "codes and measurements without coordinates"))
    table = tuple(columns[name] for name in _NAMES)
    return SourceTable("gsi", _NAMES, table, unit=units.pop(), faults=faults, detected=tuple(detected))


def _lines(text: str) -> Iterator[_Line]:
    for number, line in enumerate(text.splitlines(), 1):
        words = {index: (info[-1], sign, body) for index, info, sign, body in _WORD.findall(line.lstrip("*"))}
        if number > MAX_ROWS:
            raise UnreadableUpload("too many lines", field="file", limit=f"{MAX_ROWS} lines", cure="cut the file")
        if line.strip() and not words:
            raise UnreadableUpload(
                f"line {number} is no line of GSI", field="file", limit="words of 8 or 16 characters", cure=_CURE
            )
        if words:
            yield _Line(number, words)


def _text(line: _Line, index: str) -> str:
    """Data of a word without the zeros that fill it."""
    return line.words[index][2].lstrip("0") or "0" if index in line.words else ""


def _is_missing(line: _Line, index: str) -> bool:
    """Whether there is no such word, or one without a value, which instruments write as dashes."""
    return index not in line.words or (line.words[index][2].strip("0-") == "" and "-" in line.words[index][2])


def _length(line: _Line, index: str) -> float | None:
    if index not in line.words:
        return None
    unit, sign, body = line.words[index]
    if not (body.isascii() and body.isdigit()):
        return None
    return float(int(sign + body) / 10 ** _UNITS[unit][1])
