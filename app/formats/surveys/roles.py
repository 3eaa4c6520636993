"""Roles of a table's columns: by declaration, or by the columns' names together with their values."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from app.errors import InvalidParameter
from app.formats.surveys.declaration import COORDINATE_ROLES, NUMBER_ROLES, TEXT_ROLES, ImportDeclaration
from app.formats.surveys.table import STATION, Change, Detected, Fault, SourceTable, warn
from app.markers.reading import STATUSES

# === Units in the names of columns: ``Easting_ft``, ``Elevation (ft, NAVD88)``, ``Azimuth [gon]``.


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


# === Roles of columns.


_NAMES = {
    "lon_deg": ("lon", "longitude", "long", "lng", "laenge", "lange", "longitud"),
    "lat_deg": ("lat", "latitude", "breite", "latitud"),
    "easting": (
        "easting", "east", "e", "x", "rechtswert", "rw", "rechts", "ostwert", "ost", "este", "grideasting", "xcoord",
        "xcoordinate",
    ),
    "northing": (
        "northing", "north", "n", "y", "hochwert", "hw", "hoch", "nordwert", "nord", "norte", "gridnorthing",
        "ycoord", "ycoordinate",
    ),
    "height": (
        "height", "elevation", "elev", "z", "h", "altitude", "alt", "ele", "hohe", "hoehe", "cota", "orthoheight",
        "orthometricheight", "gridelevation", "rl", "zcoord",
    ),
    "point": (
        "point", "pointid", "pointname", "pointnumber", "pointno", "pt", "ptid", "p", "name",
        "no", "nr", "punkt", "punktnummer", "punktnr", "pnr", "pkt", "pktnr", "station", "punto", "id",
    ),
    "code": ("code", "digits", "number", "registrynumber"),
    "measure_m": ("measure", "chainage", "kilometrierung", "stationierung", "station", "km"),
    "description": ("description", "desc", "d", "descr", "beschreibung", "bemerkung", "remark", "remarks", "notes"),
}  # fmt: skip
"""Names of columns as survey software writes them, in English, German and Spanish; the first that is there is taken."""
_ELLIPSOIDAL = ("ellipsoidalheight", "ellipsoidheight", "ellheight", "ellipsheight", "hell", "ellh")
_OWN_SYSTEM = frozenset({"geometry_vertical_datum", "geom_vdatm"})  # columns of our own exports
WKT_NAMES = ("wkt", "wktgeom", "geom", "geometry", "thegeom", "geomwkt")
_SAMPLE = 2000  # values by which a column is recognised
_MIN_SHARE = 0.5  # [1] of the values that must fit a role; the others are faults of their rows
_MAX_SHOWN = 20  # names in a report
_NUMBER = r"[+-]?[0-9.,]+(?:[eE][+-]?[0-9]+)?"
_SIDES = ("left", "right", "unknown")


class CodeForm(NamedTuple):
    """What the codes of a family's markers look like in a survey."""

    pattern: str  # Regular expression of a code
    differ: bool  # whether two markers never have the same code
    name: str  # for people


class Roles(NamedTuple):
    """Columns by role, and how the ones that were not declared were recognised."""

    places: dict[str, int | None]
    faults: list[Fault]
    detected: list[Detected]


def plain_name(name: str) -> str:
    """A column's name without accents, case, blanks and unit: ``Punkt-Nr.`` is ``punktnr``, ``Höhe [m]`` ``hohe``."""
    return split_unit(name).stem


def names_coordinates(names: Sequence[str]) -> bool:
    """Whether columns of these names hold coordinates."""
    plain = {plain_name(name) for name in names}
    pairs = (("easting", "northing"), ("lon_deg", "lat_deg"))
    return any(all(plain.intersection(_NAMES[role]) for role in pair) for pair in pairs) or not plain.isdisjoint(
        WKT_NAMES
    )


def find_roles(source: SourceTable, declaration: ImportDeclaration, code_form: CodeForm | None) -> Roles:
    """Columns of all roles; a role that is declared null has none.

    Parameters
    ----------
    code_form : CodeForm, optional
        Without it any text is a code.

    Raises
    ------
    InvalidParameter
        A declared column is not in the file.
    """
    roles = Roles({}, [], [])
    taken = {name for name in declaration.columns.values() if name}
    for role in (*_NAMES, *TEXT_ROLES, *NUMBER_ROLES):
        if role in roles.places:
            continue
        if source.points is not None and _is_of_geometry(source, role, declaration):
            roles.places[role] = None
        elif role in declaration.columns:
            roles.places[role] = _declared(source, role, declaration.columns[role])
        else:
            roles.places[role] = _detected(source, role, declaration, taken, code_form, roles)
    used = set(roles.places.values())
    if unread := [name.strip() for k, name in enumerate(source.names) if k not in used and name.strip() != ""]:
        shown = ", ".join(unread[:_MAX_SHOWN]) + (" and others" if len(unread) > _MAX_SHOWN else "")
        roles.detected.append(Detected("columns without a role", shown[:300], "their names, or their values"))
    return roles


def _is_of_geometry(source: SourceTable, role: str, declaration: ImportDeclaration) -> bool:
    """Whether a file with geometry has this role in it alone: coordinates, and heights of our own exports.

    Raises
    ------
    InvalidParameter
        A column is declared for coordinates that the geometry has.
    """
    declared = declaration.columns.get(role)
    if role == "height":  # `height_m` of an export is that of the registry, its geometry may be in another system
        return role not in declaration.columns and not _OWN_SYSTEM.isdisjoint(source.names)
    if role in COORDINATE_ROLES and declared:
        raise InvalidParameter(
            f"the coordinates are those of the file's geometry, not of the column {declared[:60]!r}",
            field=f"columns.{role}",
            limit="files without geometry",
            cure=f"leave columns.{role} out, or send the table as CSV without the geometry",
        )
    return role in COORDINATE_ROLES


def _declared(source: SourceTable, role: str, wanted: str | None) -> int | None:
    if not wanted:
        return None
    if wanted not in source.names:
        raise InvalidParameter(
            f"there is no column {wanted[:60]!r}",
            field=f"columns.{role}",
            limit=", ".join(source.names)[:300],
            cure="declare a column of the file, or null if there is none for this role",
        )
    return source.names.index(wanted)


def _detected(
    source: SourceTable,
    role: str,
    declaration: ImportDeclaration,
    taken: set[str],
    code_form: CodeForm | None,
    roles: Roles,
) -> int | None:
    used = {place for place in roles.places.values() if place is not None}
    refuted: Fault | None = None
    for column in _named(source, role, declaration):
        name = source.names[column]
        if name in taken or column in used:
            continue
        evidence, fits = _evidence(source.columns[column], role, name, code_form)
        shown = f"{name.strip()[:60]!r}"
        if fits:
            if source.has_names:
                shown_evidence = f"its name{evidence and '; '}{evidence}"
                roles.detected.append(Detected(f"column of {role}", name.strip()[:60], shown_evidence))
            return column
        if refuted is None and evidence:
            refuted = warn(
                None,
                role,
                "role_without_evidence",
                f"the column {shown} was not read as {role}: {evidence}",
                f"declare columns {{{role!r}: {shown}}} if it is, or {{{role!r}: null}} if it is not".replace("'", '"'),
                (Change(f"columns.{role}", None),),
            )
    if refuted is not None:
        roles.faults.append(refuted)
    return None


def _named(source: SourceTable, role: str, declaration: ImportDeclaration) -> Iterator[int]:
    """Columns with a usual name of the role, the most usual name first."""
    if role in NUMBER_ROLES and role not in _NAMES:  # names of ours, with their units
        yield from (k for k, name in enumerate(source.names) if name.strip().lower() == role)
        return
    wanted = _NAMES.get(role, (role,))
    if role == "height":
        ellipsoidal_first = declaration.vertical_datum == "ellipsoid"
        wanted = (*_ELLIPSOIDAL, *wanted) if ellipsoidal_first else (*wanted, *_ELLIPSOIDAL)
    names = [plain_name(name) for name in source.names]
    for name in wanted:
        yield from (k for k, other in enumerate(names) if other == name)


def _evidence(cells: Sequence[object], role: str, name: str, code_form: CodeForm | None) -> tuple[str, bool]:
    """What the values show about a role, and whether they fit it."""
    fits: Callable[[str], object]
    if role == "code" and code_form is not None:
        fits, form = re.compile(code_form.pattern).fullmatch, code_form.name
    elif role in ("status", "side"):
        known = STATUSES if role == "status" else _SIDES
        fits, form = lambda text: text.lower() in known, f"one of {', '.join(known)}"
    elif role == "measure_m" and _names_length(name):
        fits, form = re.compile(rf"{_NUMBER}|{STATION.pattern}").fullmatch, "a number"
    elif role == "measure_m":  # numbers may be metres, kilometres or names of points
        if not any(STATION.fullmatch(text) for text in _sample(cells)):
            return "", False
        fits, form = STATION.fullmatch, "kilometres and metres such as 12+345.67"
    elif role == "point":
        if _names_length(name):
            return "", False
        values = list(_sample(cells))
        return "", sum(1 for text in values if STATION.fullmatch(text)) <= _MIN_SHARE * len(values)
    elif role in NUMBER_ROLES:
        fits, form = re.compile(_NUMBER).fullmatch, "a number"
    else:
        return "", True
    values = list(_sample(cells))
    good = sum(1 for text in values if fits(text))
    if not values or good < _MIN_SHARE * len(values):
        other = next((text for text in values if not fits(text)), None)
        return (f"{good} of {len(values)} values are {form}, {other[:40]!r} is not" if other else ""), False
    if role == "code" and code_form is not None and code_form.differ and len(set(values)) < _MIN_SHARE * len(values):
        return f"{len(values)} values are only {len(set(values))} different ones, and each marker has its own", False
    return f"{good} of {len(values)} values are {form}", True


def _names_length(name: str) -> bool:
    """Whether a name is followed by a unit of length, which measures have and names of points have not."""
    stem, unit = split_unit(name)
    return stem != unit and unit in LENGTHS


def _sample(cells: Sequence[object]) -> Iterator[str]:
    """Texts of values throughout a column, without empty ones."""
    for k in range(0, len(cells), max(len(cells) // _SAMPLE, 1)):
        if text := cell_text(cells[k]):
            yield text


def cell_text(value: object) -> str:
    """A value as text; whole numbers without decimals, empty where there is none."""
    if value is None or (isinstance(value, float) and value != value):
        return ""
    if isinstance(value, float | np.floating) and float(value).is_integer():
        value = int(value)
    return str(value).strip()
