"""Strict reading of JSON, and of values as JSON has them: what would later cause an error or a wrong row is refused.

Bodies, form fields, rules and command files are read here. Large files of points and roads are read by `orjson`, which
refuses the same except for keys that appear twice.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from functools import partial
from typing import NoReturn

from app.errors import MalformedRequest

MAX_DEPTH = 32
MAX_VALUES = 200_000
"""Values in one document. Source: a road of 1 MiB, the largest body, has 50,000 vertices of three values each."""
MAX_MEMBERS = 1_000
"""Members of one object. The largest that a route takes has about 40."""
_MAX_INT = 2**64
_MAX_INT_DIGITS = 20
_SUSPECT = re.compile(rb"\\u(?:0000|[dD][89a-fA-F])|NaN|Infinity|\d{20}|[eE]\+?\d{3}")
"""Escapes of NUL and of half surrogate pairs, which are no JSON in UTF-8, and numbers beyond double precision."""
_EMPTY = re.compile(rb"[\[{][ \t\r\n]*+[\]}]")
_TEXT = re.compile(rb'"(?:[^"\\]|\\.)*+(?:"|\Z)', re.DOTALL)


def parse_json(raw: bytes, field: str = "body") -> object:
    """Parse JSON, refusing what the standard or the store cannot hold. The time is linear in the size.

    Parameters
    ----------
    raw : bytes
        UTF-8 text.
    field : str
        Name of the input in the error.

    Raises
    ------
    MalformedRequest
        Not UTF-8, not JSON, NaN or infinity, a number beyond double precision or 64 bits, a duplicate key, more than 32
        levels, `MAX_VALUES` values or `MAX_MEMBERS` members of an object, a lone surrogate or a NUL in a text.
    """
    _check_count(raw, field)
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError as error:
        _refuse("the text is not UTF-8", field, "UTF-8", error)
    try:
        value = json.loads(
            text,
            object_pairs_hook=partial(_unique, field=field),
            parse_int=partial(_bounded, field=field),
        )
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno} (character {error.pos})"
        _refuse(f"not JSON: {error.msg} at {place}", field, "RFC 8259", error)
    except RecursionError as error:
        _refuse("the JSON is nested too deeply", field, f"{MAX_DEPTH} levels", error)
    if _is_deep(value) or _SUSPECT.search(raw):
        check_values(value, field)
    return value


def check_values(root: object, field: str) -> None:
    """Check that a value that was read from a text, as YAML, is one that JSON can hold; in linear time.

    Raises
    ------
    MalformedRequest
        More than 32 levels, a key that is no text, a number beyond double precision or 64 bits, a value of another type
        (a date, bytes, a set), a lone surrogate or a NUL in a text. `field` is the path of the value.
    """
    waiting = [(root, _Step(field))]
    while waiting:
        value, step = waiting.pop()
        if isinstance(value, str):
            _check_text(value, step)
        elif isinstance(value, dict | list):
            if step.depth == MAX_DEPTH:
                _refuse("the value is nested too deeply", step.path(), f"{MAX_DEPTH} levels")
            for name in value if isinstance(value, dict) else ():
                if not isinstance(name, str):
                    _refuse(f"a key is no text but {_kind(name)}", step.path(), "keys that are texts")
                _check_text(name, step)
            items = value.items() if isinstance(value, dict) else enumerate(value)
            waiting += [(item, _Step(name, step)) for name, item in items if not _is_plain(item)]
        elif not _is_plain(value):
            _refuse(
                f"the value is {_kind(value)}", step.path(), "texts, true, false, null, and finite numbers of 64 bits"
            )


def _is_plain(value: object) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    return value is None or (isinstance(value, int) and -_MAX_INT < value < _MAX_INT)


def _kind(value: object) -> str:
    match value:
        case int():
            return "an integer beyond 64 bits" if not _is_plain(value) else "a number"
        case float():
            return "not a number, or beyond double precision" if not _is_plain(value) else "a number"
    return f"a {type(value).__name__}"


def _refuse(message: str, field: str, limit: str, cause: Exception | None = None) -> NoReturn:
    raise MalformedRequest(message, field=field, limit=limit, cure="correct the body and send it again") from cause


def _check_count(raw: bytes, field: str) -> None:
    """Refuse too many values before one of them is read: each follows a comma, or is the first of what holds it."""
    if _count_marks(raw) >= MAX_VALUES:
        bare = _TEXT.sub(b"0", raw)
        if _count_marks(bare) - _EMPTY.subn(b"", bare)[1] >= MAX_VALUES:
            _refuse(f"the JSON has more than {MAX_VALUES} values", field, f"{MAX_VALUES} values")


def _count_marks(raw: bytes) -> int:
    return raw.count(b",") + raw.count(b"[") + raw.count(b"{")


def _unique(pairs: list[tuple[str, object]], field: str) -> dict[str, object]:
    if len(pairs) > MAX_MEMBERS:
        _refuse(f"an object has {len(pairs)} members", field, f"{MAX_MEMBERS} members of an object")
    found = dict(pairs)
    if len(found) != len(pairs):
        double = Counter(name for name, _ in pairs).most_common(1)[0][0]
        _refuse(f"the key {double[:80]!r} appears twice in one object", _printable(double), "unique keys")
    return found


def _bounded(text: str, field: str) -> int:
    if len(text.lstrip("-")) > _MAX_INT_DIGITS or not -_MAX_INT < int(text) < _MAX_INT:
        _refuse(f"the integer {text[:40]} is beyond 64 bits", field, "64 bits")
    return int(text)


class _Step:
    """The way from the root to a value: its name in what holds it, and the way there."""

    __slots__ = ("above", "depth", "name")

    def __init__(self, name: str | int, above: _Step | None = None) -> None:
        self.name, self.above = name, above
        self.depth: int = 0 if above is None else above.depth + 1

    def path(self) -> str:
        names = [str(self.name)[:200]]
        step = self.above
        while step is not None:
            names.append(str(step.name)[:200])
            step = step.above
        return _printable(".".join(reversed(names)))


def _is_deep(root: object) -> bool:
    """Whether there are more than `MAX_DEPTH` levels: level by level, which costs a tenth of a walk with paths."""
    level = [root]
    for _depth in range(MAX_DEPTH):
        level = [
            item
            for value in level
            for item in (value.values() if isinstance(value, dict) else value if isinstance(value, list) else ())
            if isinstance(item, dict | list)
        ]
        if not level:
            return False
    return True


def _check_text(text: str, step: _Step) -> None:
    if "\x00" in text:
        _refuse("a text holds NUL", step.path(), "no U+0000")
    try:
        text.encode("utf-8")
    except UnicodeEncodeError as error:
        _refuse("a text holds half a surrogate pair", step.path(), "valid Unicode", error)


def _printable(path: str) -> str:
    return path[:200].encode("utf-8", "replace").decode().replace("\x00", "?")
