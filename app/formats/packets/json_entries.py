"""Entries of packet logs in JSON: a document, an array, lines, or documents one after the other.

Every character is parsed at most three times whatever the file holds, so that no file takes longer than its length.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from app.errors import UploadTooLarge
from app.formats.packets.rows import BrokenEntry
from app.formats.text import MAX_LINE, numbered_lines

Record = tuple[int, "dict[str, Any] | BrokenEntry"]

_LISTS = ("packets", "uplinks", "events", "records", "messages", "results")
_MAX_DEPTH = 32  # levels of nesting; chosen by hand
_SPACE = " \t\r\n,\x1e\ufeff"


def read_records(name: str, text: str, document_chars: int) -> Iterator[Record]:
    """Objects with the numbers of their entries; an entry that is no object is a `BrokenEntry`.

    Raises
    ------
    UploadTooLarge
        One document, rather than lines, of more characters than the limit.
    """
    text = text.lstrip(_SPACE)
    first = text.split("\n", 1)[0].rstrip()
    if text[:1] in ("{", "[") and not isinstance(_parse(first[:MAX_LINE]), dict):
        # no object in the first line: one document over many lines, several of them, or broken lines
        if len(text) <= document_chars:
            whole = _parse(text)
            if not isinstance(whole, BrokenEntry):
                return _from_document(whole)
            several = list(_read_concatenated(text))
            if several and isinstance(several[0][1], dict):
                return iter(several)
        elif first in ("[", "{"):
            raise UploadTooLarge(
                f"{name} is one JSON document of {len(text)} characters",
                field="file",
                limit=f"{document_chars} characters in one document",
                cure="write one JSON object a line",
            )
    elif "\n" not in text.rstrip():
        return _from_document(_parse(text))
    return _read_lines(text)


def _from_document(document: Any) -> Iterator[Record]:
    if isinstance(document, dict):
        within = next((document[n] for n in _LISTS if isinstance(document.get(n), list)), None)
        document = [document] if within is None else within
    for entry, item in enumerate(document if isinstance(document, list) else [document]):
        yield entry, _checked(item)


def _read_lines(text: str) -> Iterator[Record]:
    entry = -1
    for _number, line in numbered_lines(text):
        at = line.find("{", 0, 1024)
        if at < 0 and line.startswith(("event:", "id:", ":", "retry:", "#")):
            continue
        entry += 1
        if at < 0:
            yield entry, BrokenEntry("json", "the line holds no JSON object")
        elif len(line) > MAX_LINE:
            yield entry, BrokenEntry("long-line", f"the line has more than {MAX_LINE} characters")
        else:
            yield entry, _checked(_parse(line[at:].rstrip(",")))


def _read_concatenated(text: str) -> Iterator[Record]:
    """Documents one after the other, over several lines each; what follows a broken one is lost with it."""
    at, entry = 0, 0
    while True:
        while at < len(text) and text[at] in _SPACE:
            at += 1
        if at >= len(text):
            return
        try:
            found, at = _DECODER.raw_decode(text, at)
        except (ValueError, RecursionError) as error:
            yield entry, BrokenEntry("json", f"{_why(error)}; from character {at} on nothing is read")
            return
        yield entry, _checked(found)
        entry += 1


class _Ambiguous(dict[str, Any]):
    """An object that has a key twice."""


def _parse(text: str) -> Any:
    """A JSON value, or the reason why the text is none."""
    try:
        return _DECODER.decode(text)
    except (ValueError, RecursionError) as error:
        return BrokenEntry("json", _why(error))


def _checked(value: Any) -> dict[str, Any] | BrokenEntry:
    """An object that is neither deep nor ambiguous, or the reason why it is left out."""
    if isinstance(value, BrokenEntry):
        return value
    if not isinstance(value, dict):
        return BrokenEntry("json", "the entry is no JSON object")
    wrong = _what_is_wrong(value, _MAX_DEPTH)
    return BrokenEntry("json", wrong) if wrong else value


def _what_is_wrong(value: Any, levels: int) -> str | None:
    if levels == 0:
        return f"more than {_MAX_DEPTH} levels"
    if isinstance(value, _Ambiguous):
        return "an object has a key twice"
    for item in value.values() if isinstance(value, dict) else value:
        if isinstance(item, dict | list) and (wrong := _what_is_wrong(item, levels - 1)):
            return wrong
    return None


def _why(error: Exception) -> str:
    if isinstance(error, RecursionError):
        return f"more than {_MAX_DEPTH} levels"
    return f"not JSON: {str(error)[:120]}"


def _object_of(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    return found if len(found) == len(pairs) else _Ambiguous(found)


_DECODER = json.JSONDecoder(object_pairs_hook=_object_of)
"""NaN and infinity become floats that are refused where a number is read."""
