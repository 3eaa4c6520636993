"""Units in the names of columns: ``Easting_ft``, ``Elevation (ft, NAVD88)``, ``Azimuth [gon]``."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Sequence
from typing import NamedTuple

_MAX_NAME = 100  # [character] of a name that are looked at
_MAX_WORDS = 4  # of a unit: ``U.S. survey feet``
_BRACKETS = re.compile(r"[\[({<]([^\])}>]*)[\])}>]*")
_LAST_BRACKETS = re.compile(r"\s*[\[({<][^\])}>]*[\])}>]+\s*$")  # a unit or a datum behind the name
_SMALL_THEN_LARGE = re.compile(r"(?<=[a-z])(?=(?:Ft|Feet|Usft|USft|M|Km|Gon)$)")
_FOOT = "(?:ft|feet|foot|fuss)"
_PATTERNS = {
    "ft-us": rf"(?:s?us(?:s|survey)?|survey|s){_FOOT}|{_FOOT}(?:s?us(?:survey)?|survey)",
    "ft-intl": rf"i(?:nt|ntl|nternational)?{_FOOT}|{_FOOT}i(?:nt|ntl|nternational)",
    "ft": rf"{_FOOT}|fts|pies",
    "m": "m|met(?:re|er)s?|mtrs?|metros?",
    "mm": "mm|millimet(?:re|er)s?",
    "cm": "cm|centimet(?:re|er)s?",
    "dm": "dm|decimet(?:re|er)s?",
    "km": "km|kms|kilomet(?:re|er)s?",
    "in": "in|inch|inches|usin|zoll",
    "yd": "yds?|yards?",
    "mi": "mi|miles?",
    "chain": "chains?",
    "link": "link",
    "vara": "varas?",
    "deg": "deg|degs|degrees?|dd|decdeg|decimaldegrees?|degdec|degreesdecimal",
    "degrees, minutes": "h?d{2,3}m{2}[ms]*|dmm|dms|hms|degmin(?:sec)?|degreesminutes(?:seconds)?",
    "gon": "gons?|grads|grades?|gradians?|neugrad",
    "grad (gon, or degrees in German)": "grad",
    "rad": "rad|rads|radians?",
    "mil": "mils?|mrad",
}
_UNITS = {unit: re.compile(pattern) for unit, pattern in _PATTERNS.items()}
_SHORT = frozenset({
    "m", "in", "mi", "deg", "dd", "rad", "grad", "dm", "mm", "mil", "link", "grade", "pies",
    "chain", "chains",
})  # fmt: skip
"""Words that may be parts of other names; they are units only in brackets or at the end."""
LENGTHS = frozenset({"ft-us", "ft-intl", "ft", "m", "mm", "cm", "dm", "km", "in", "yd", "mi", "chain", "link", "vara"})


class NamedUnit(NamedTuple):
    """A column's name in two parts."""

    stem: str  # without its unit, accents, case and blanks
    unit: str | None  # one of `_PATTERNS`, several joined by " and ", or None


def split_unit(name: str) -> NamedUnit:
    """The name without its unit, and the unit: ``Height US ft`` is ``height`` in ``ft-us``.

    Notes
    -----
    The words of brackets are searched for a unit, and the last words of the name; also the other words if they cannot
    be parts of other names. A name that is a unit alone (``km``) is its own stem.
    """
    name = name.strip()[:_MAX_NAME]
    bare = _LAST_BRACKETS.sub("", name) or name
    words = _words(bare)
    found: dict[str, None] = {}
    for inside in _BRACKETS.findall(name):
        found.update(dict.fromkeys(_units_in(inside)))
    rest = _words(_BRACKETS.sub(" ", name))
    for part in (words, rest):
        for count in range(min(_MAX_WORDS, len(part) - 1), 0, -1):
            if (unit := _unit_of(part[-count:])) is not None:
                found[unit] = None
                del part[-count:]
                if len(part) > 1 and part[-1] == "in":  # height in feet
                    part.pop()
                break
    if rest:
        found.update(dict.fromkeys(_units_of(rest, is_bracket=False)))
    if not found and len(words) == 1 and (unit := _unit_of(words)) is not None:
        found[unit] = None
    return NamedUnit("".join(words), " and ".join(found) or None)


def unit_of_cell(text: str) -> str | None:
    """The unit that a cell of a row of units names; None if it names none."""
    text = text.strip()[:_MAX_NAME].strip("[]() ")
    return "deg" if text == "°" else " and ".join(dict.fromkeys(_units_in(text))) or None


def is_unit(text: str) -> bool:
    """Whether a cell holds nothing but a unit."""
    return text.strip(" []()") == "°" or _unit_of(_words(text)) is not None


def _words(text: str) -> list[str]:
    text = unicodedata.normalize("NFKD", _SMALL_THEN_LARGE.sub(" ", text))
    text = "".join(c for c in text if not unicodedata.combining(c)).casefold()
    return re.findall(r"[a-z0-9]+", text)


def _unit_of(words: Sequence[str]) -> str | None:
    """The unit that these words are together."""
    joined = "".join(words)
    return next((unit for unit, pattern in _UNITS.items() if pattern.fullmatch(joined)), None)


def _units_in(inside: str) -> Iterator[str]:
    """Units among the words of brackets."""
    if inside.strip() in ("'", "′", "’"):
        yield "ft"
        return
    words = _words(inside)
    whole = _unit_of(words)
    if whole is not None:
        yield whole
        return
    letters = [word for word in words if word.isalpha()]
    yield from _units_of(words if letters == ["in"] else [word for word in words if word != "in"], is_bracket=True)


def _units_of(words: Sequence[str], *, is_bracket: bool) -> Iterator[str]:
    """Units among words, the longest first: ``us survey feet`` is one unit."""
    start = 0
    while start < len(words):
        for count in range(min(_MAX_WORDS, len(words) - start), 0, -1):
            part = words[start : start + count]
            if (unit := _unit_of(part)) is not None and (is_bracket or "".join(part) not in _SHORT):
                yield unit
                start += count
                break
        else:
            start += 1
