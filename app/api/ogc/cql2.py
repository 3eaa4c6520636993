"""Filter expressions of clients: Common Query Language (OGC 21-065r2), basic-cql2 and LIKE, BETWEEN, IN, text and JSON.

A property stands on one side of a comparison, a value of its kind on the other. The geometry is compared with another
one by S_INTERSECTS, S_WITHIN, S_DISJOINT and, as the common extension, S_DWITHIN. Old clients say "cql-text" of the
same, with INTERSECTS, WITHIN, DISJOINT and DWITHIN.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Any, NamedTuple, NoReturn

import orjson
import shapely
from shapely.errors import ShapelyError

from app.errors import MalformedRequest
from app.formats.json_text import parse_json
from app.registry.conditions import (
    COMPARISONS,
    GEOMETRY,
    Compared,
    Condition,
    Constant,
    Joined,
    Located,
    Missing,
    Not,
    Value,
)
from app.registry.spatial import Area
from app.values import JsonObject

LANGUAGES = ("cql2-text", "cql2-json", "cql-text")
MAX_DEPTH = 20
MAX_CONDITIONS = 200
MAX_PATTERNS = 20
"""Conditions with LIKE, each of which reads a text of every feature. Source: `python -m benchmarks.abuse`; 150 take 3 s
on 200,000 markers."""
_TOKEN = re.compile(
    r"""\s*(?:
    (?P<text>'(?:[^'\\]|''|\\.)*')
    | (?P<name>"[^"]{1,80}"|[A-Za-z_][A-Za-z0-9_]{0,79})
    | (?P<number>[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?)
    | (?P<sign><>|<=|>=|[=<>(),])
    )""",
    re.ASCII | re.VERBOSE | re.DOTALL,
)
_ESCAPED = re.compile(r"''|\\.", re.DOTALL)
_CONTROLS = {"a": "\a", "b": "\b", "t": "\t", "n": "\n", "v": "\v", "f": "\f", "r": "\r"}
_WORDS = ("AND", "OR", "NOT", "IS", "NULL", "LIKE", "BETWEEN", "IN", "TRUE", "FALSE", "TIMESTAMP", "DATE")
_MIRRORED = {"<": ">", ">": "<", "<=": ">=", ">=": "<="}
_GEOMETRIES = (GEOMETRY, "geom")
SPATIAL = ("S_INTERSECTS", "S_WITHIN", "S_DISJOINT", "S_DWITHIN")
_OLD_SPATIAL = {name.removeprefix("S_"): name for name in SPATIAL}
_WKT = ("POINT", "LINESTRING", "POLYGON", "MULTIPOINT", "MULTILINESTRING", "MULTIPOLYGON", "GEOMETRYCOLLECTION")
_M_PER_UNIT = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("km", "kilometer", "kilometers", "kilometre", "kilometres"), 1000.0),
    **dict.fromkeys(("ft", "feet"), 0.3048),
    **dict.fromkeys(("mi", "mile", "miles", "statute miles"), 1609.344),
}
MAX_SPATIAL = 20
"""Spatial conditions, each of which asks the index and compares what it finds. Bounds the time; chosen by hand."""
Token = tuple[str, str]
Sides = tuple[float, ...]  # numbers of a BBOX: four, or six with heights


class Placed(NamedTuple):
    """A geometry or a box of a filter: the areas that it consists of, and the heights of a box that has some."""

    areas: tuple[Area, ...]
    heights_m: tuple[float, float] | None = None


Place = Callable[[shapely.Geometry | Sides, float], Placed]
Moment = Callable[[str], datetime]
Number = Callable[[str], float]


class Reader:
    """Reads expressions over properties of given kinds.

    Parameters
    ----------
    kinds : mapping
        string, number, integer or date-time, by the name of each property.
    moment, number : callable
        The moment or the number that a text says.
    place : callable
        The areas of a geometry or a box in the filter's CRS, with all that is within a distance of it. [m]
    """

    def __init__(self, kinds: Mapping[str, str], moment: Moment, number: Number, place: Place) -> None:
        self._kinds = kinds
        self._moment = moment
        self._number = number
        self._place = place

    def read(self, expression: str, language: str) -> Condition:
        """The condition that an expression says.

        Raises
        ------
        MalformedRequest
            It cannot be read, or is about a property or a kind of value that there is not.
        """
        condition = _Json(self).read(expression) if language == "cql2-json" else _Text(self, expression).read()
        if _count(condition) > MAX_CONDITIONS:
            refuse_filter("the filter has too many conditions", f"{MAX_CONDITIONS} conditions")
        if (places := _count(condition, lambda one: isinstance(one, Located))) > MAX_SPATIAL:
            refuse_filter(f"the filter has {places} spatial conditions", f"{MAX_SPATIAL} of them")
        patterns = _count(condition, lambda one: isinstance(one, Compared) and one.operator == "like")
        if patterns > MAX_PATTERNS:
            refuse_filter(
                f"the filter has {patterns} conditions with LIKE",
                f"{MAX_PATTERNS} of them",
                "compare with whole texts by IN or =, or send several requests",
            )
        return condition

    def compared(self, name: str, symbol: str, value: object) -> Compared:
        """A comparison, its value of the property's kind."""
        kind = self.kind_of(name)
        if symbol == "like" and (kind != "string" or not isinstance(value, str)):
            refuse_filter(f"LIKE compares {name} with a pattern", "a property that is text, a pattern that is text")
        return Compared(name, symbol, self._of_kind(name, kind, value))

    def missing(self, name: str) -> Condition:
        """Whether a property has no value; every feature has a geometry."""
        if name in _GEOMETRIES:
            return Constant(False)
        self.kind_of(name)
        return Missing(name)

    def located(self, name: str, operator: str, shape: shapely.Geometry | Sides, within_m: float = 0.0) -> Condition:
        """A comparison of the geometry with another one, or with a box."""
        if name not in _GEOMETRIES:
            refuse_filter(f"{name[:80]} is no geometry", f"{operator} compares {GEOMETRY} with a geometry")
        if isinstance(shape, shapely.Geometry) and (shape.is_empty or not shape.is_valid):
            refuse_filter("a geometry in the filter is empty or crosses itself", "valid points, lines and polygons")
        if operator == "S_DWITHIN" and not within_m > 0:
            refuse_filter("S_DWITHIN has no distance above 0", "S_DWITHIN(geometry, POINT(8.4 49), 500, 'm')")
        if operator == "S_WITHIN" and isinstance(shape, shapely.GeometryCollection):
            refuse_filter("S_WITHIN compares with a GEOMETRYCOLLECTION", "its parts, joined by OR")
        areas, heights_m = self._place(shape, within_m)
        found = tuple(Located(area, operator == "S_WITHIN", heights_m) for area in areas)
        condition = found[0] if len(found) == 1 else Joined(False, found)
        return Not(condition) if operator == "S_DISJOINT" else condition

    def kind_of(self, name: str) -> str:
        """Kind of a property that there is."""
        if name not in self._kinds:
            refuse_filter(f"there is no property {name[:80]!r}", ", ".join(self._kinds))
        return self._kinds[name]

    def number(self, text: str) -> float:
        """The number that a text says."""
        return self._number(text)

    def _of_kind(self, name: str, kind: str, value: object) -> Value:
        if kind == "date-time" and isinstance(value, str):
            return self._moment(value)
        if kind in ("number", "integer") and isinstance(value, int | float) and not isinstance(value, bool):
            return self._number(repr(value))
        if kind == "string" and isinstance(value, str):
            return value
        return refuse_filter(f"{name} is compared with something of another kind", f"a {kind}")


def refuse_filter(message: str, limit: str, cure: str = "/ogc/api describes the parameters") -> NoReturn:
    """Refuse a filter."""
    raise MalformedRequest(message, field="filter", limit=limit, cure=cure)


def refuse_function(name: str) -> NoReturn:
    """Refuse a function that is not offered."""
    known = ", ".join(SPATIAL)
    refuse_filter(f"there is no function {name[:40].upper()}", known, f"the functions in filters are {known}")


def _count(condition: Condition, counts: Callable[[Condition], bool] = lambda _condition: True) -> int:
    """How many of the conditions that are joined count."""
    if isinstance(condition, Joined):
        return sum(_count(inner, counts) for inner in condition.conditions)
    if isinstance(condition, Not):
        return _count(condition.condition, counts)
    return int(counts(condition))


def distance_m(distance: float, unit: object) -> float:
    """A distance in one of the usual units. [m]"""
    factor = _M_PER_UNIT.get(unit.lower()) if isinstance(unit, str) else None
    if factor is None:
        refuse_filter(f"{str(unit)[:40]!r} is no unit of distances", ", ".join(_M_PER_UNIT))
    return distance * factor


class _Text:
    """Recursive descent over the tokens of a text."""

    def __init__(self, reader: Reader, text: str) -> None:
        self._reader = reader
        self._tokens = _tokens(text)
        self._at = 0

    def read(self) -> Condition:
        condition = self._any(0)
        if self._at < len(self._tokens):
            self._unexpected()
        return condition

    def _any(self, depth: int) -> Condition:
        if depth > MAX_DEPTH:
            refuse_filter("the filter is nested too deeply", f"{MAX_DEPTH} levels")
        return self._joined(False, "OR", lambda: self._joined(True, "AND", lambda: self._negated(depth)))

    def _joined(self, every: bool, word: str, part: Callable[[], Condition]) -> Condition:
        parts = [part()]
        while self._takes(word):
            parts.append(part())
        return parts[0] if len(parts) == 1 else Joined(every, tuple(parts))

    def _negated(self, depth: int) -> Condition:
        negated = False
        while self._takes("NOT"):
            negated = not negated
        condition = self._single(depth)
        return Not(condition) if negated else condition

    def _single(self, depth: int) -> Condition:
        if self._takes("("):
            condition = self._any(depth + 1)
            self._expect(")")
            return condition
        if self._peek() in (("word", "TRUE"), ("word", "FALSE")):
            return Constant(self._next()[1] == "TRUE")
        if self._peek()[0] == "name":
            name = self._next()[1]
            operator = _OLD_SPATIAL.get(name.upper(), name.upper())
            if operator in SPATIAL and self._takes("("):
                return self._spatial(operator)
            self._refuse_call(name)
            return self._about(name)
        value = self._value()
        symbol = self._comparison()
        kind, name = self._next()
        if kind != "name":
            self._unexpected()
        return self._reader.compared(name, _MIRRORED.get(symbol, symbol), value)

    def _spatial(self, operator: str) -> Condition:
        """A spatial condition after its opening parenthesis; the geometry may stand on both sides."""
        first = self._place()
        self._expect(",")
        second = self._place()
        within_m = 0.0
        if operator == "S_DWITHIN":
            self._expect(",")
            distance = self._value()
            self._expect(",")
            kind, unit = self._next()
            if kind not in ("name", "text") or not isinstance(distance, float):
                self._at -= 1
                self._unexpected()
            within_m = distance_m(distance, unit)
        self._expect(")")
        name, shape = (first, second) if isinstance(first, str) else (second, first)
        if not isinstance(name, str) or isinstance(shape, str) or (operator == "S_WITHIN" and shape is first):
            refuse_filter(f"{operator} compares {GEOMETRY} with a geometry", f"{operator}({GEOMETRY}, POINT(8.4 49))")
        return self._reader.located(name, operator, shape, within_m)

    def _refuse_call(self, name: str) -> None:
        """Refuse the function that a name calls."""
        if self._peek() == ("sign", "("):
            refuse_function(name)

    def _place(self) -> str | shapely.Geometry | Sides:
        """The name of a property, or a geometry in well-known text or as BBOX."""
        kind, name = self._next()
        if kind != "name":
            self._at -= 1
            self._unexpected()
        if name.upper() not in (*_WKT, "BBOX"):
            self._refuse_call(name)
            return name
        words, depth = [name.upper()], 0
        inner = ("Z", *_WKT) if name.upper() == "GEOMETRYCOLLECTION" else ("Z",) * (name.upper() != "BBOX")
        while True:
            kind, text = self._next()
            is_inner = kind == "name" and text.upper() in inner and (depth or len(words) == 1)
            if kind != "number" and not is_inner and (kind != "sign" or text not in "(),"):
                self._at -= 1
                self._unexpected()
            depth += (text == "(") - (text == ")")
            words.append(text.upper())
            if not depth and not is_inner:
                break
        if name.upper() == "BBOX":
            return _sides([self._reader.number(word) for word in words if word not in ("BBOX", "(", ")", ",")])
        try:
            return shapely.from_wkt(" ".join(words))
        except ShapelyError:
            return refuse_filter(f"a {name.upper()} of the filter cannot be read", "well-known text: POINT(8.4 49)")

    def _about(self, name: str) -> Condition:
        if self._takes("IS"):
            negated = self._takes("NOT")
            self._expect("NULL")
            condition = self._reader.missing(name)
            return Not(condition) if negated else condition
        negated = self._takes("NOT")
        condition = self._ranged(name, negated)
        return Not(condition) if negated else condition

    def _ranged(self, name: str, negated: bool) -> Condition:
        if self._takes("LIKE"):
            return self._reader.compared(name, "like", self._value(is_pattern=True))
        if self._takes("BETWEEN"):
            low = self._value()
            self._expect("AND")
            high = self._value()
            return _between(self._reader, name, low, high)
        if self._takes("IN"):
            self._expect("(")
            values = [self._value()]
            while self._takes(","):
                values.append(self._value())
            self._expect(")")
            return Joined(False, tuple(self._reader.compared(name, "=", value) for value in values))
        if negated:
            self._unexpected()
        return self._reader.compared(name, self._comparison(), self._value())

    def _comparison(self) -> str:
        kind, symbol = self._next()
        if kind != "sign" or symbol not in COMPARISONS:
            self._at -= 1
            self._unexpected()
        return symbol

    def _value(self, *, is_pattern: bool = False) -> str | float:
        kind, text = self._next()
        if kind == "text":
            return _unescaped(text, is_pattern=is_pattern)
        if kind == "name":
            self._refuse_call(text)
        if kind == "number":
            return self._reader.number(text)
        if text in ("TIMESTAMP", "DATE") and kind == "word":
            self._expect("(")
            inner, moment = self._next()
            self._expect(")")
            if inner == "text":
                return _unescaped(moment)
        self._at -= 1
        return self._unexpected()

    def _peek(self) -> Token:
        return self._tokens[self._at] if self._at < len(self._tokens) else ("end", "the end")

    def _next(self) -> Token:
        token = self._peek()
        self._at += 1
        return token

    def _takes(self, text: str) -> bool:
        if self._peek() not in (("word", text), ("sign", text)):
            return False
        self._at += 1
        return True

    def _expect(self, text: str) -> None:
        if not self._takes(text):
            self._unexpected()

    def _unexpected(self) -> NoReturn:
        kind, text = self._peek()
        refuse_filter(
            f"the filter cannot be read at {text[:40] if kind != 'end' else 'its end'!r}",
            "e.g. road = 'A7' AND measure_m BETWEEN 0 AND 500 AND NOT status IN ('planned', 'retired')",
        )


def _tokens(text: str) -> list[Token]:
    tokens: list[Token] = []
    at, text = 0, text.rstrip()
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None or match.lastgroup is None:
            refuse_filter(f"the filter cannot be read at {text[at : at + 40]!r}", "CQL2 text")
        kind, found = match.lastgroup, match[match.lastgroup]
        if kind == "text" or (kind == "name" and found.startswith('"')):
            found = found[1:-1]
        elif kind == "name" and found.upper() in _WORDS:
            kind, found = "word", found.upper()
        tokens.append((kind, found))
        at = match.end()
    return tokens


def _unescaped(text: str, *, is_pattern: bool = False) -> str:
    """A text without its escapes (/req/cql2-text/escaping). In a pattern a backslash keeps the one before it."""

    def one(match: re.Match[str]) -> str:
        found = match[0][1]
        if found == "'" or (found == "\\" and not is_pattern):
            return found
        return _CONTROLS.get(found, match[0])

    return _ESCAPED.sub(one, text)


class _Json:
    """Recursive descent over a JSON document."""

    def __init__(self, reader: Reader) -> None:
        self._reader = reader

    def read(self, text: str) -> Condition:
        try:
            document = parse_json(text.encode(), "filter")
        except MalformedRequest as error:
            error.field = "filter"
            raise
        return self._condition(document, 0)

    def _condition(self, node: object, depth: int) -> Condition:
        if depth > MAX_DEPTH:
            refuse_filter("the filter is nested too deeply", f"{MAX_DEPTH} levels")
        if isinstance(node, bool):
            return Constant(node)
        if not (isinstance(node, dict) and set(node) == {"op", "args"} and isinstance(node["args"], list)):
            refuse_filter(
                "the filter holds something that is no condition", 'true, false or {"op": ..., "args": [...]}'
            )
        symbol, arguments = node["op"], node["args"]
        if symbol in ("and", "or") and len(arguments) >= 2:
            return Joined(symbol == "and", tuple(self._condition(inner, depth + 1) for inner in arguments))
        if symbol == "not" and len(arguments) == 1:
            return Not(self._condition(arguments[0], depth + 1))
        return self._predicate(symbol, arguments)

    def _predicate(self, symbol: Any, arguments: list[object]) -> Condition:
        match symbol, arguments:
            case "isNull", [{"property": str(name)}]:
                return self._reader.missing(name)
            case "between", [{"property": str(name)}, low, high]:
                return _between(self._reader, name, _literal(low), _literal(high))
            case "in", [{"property": str(name)}, [*values]] if values:
                return Joined(False, tuple(self._reader.compared(name, "=", _literal(value)) for value in values))
            case "like", [{"property": str(name)}, str(pattern)]:
                return self._reader.compared(name, "like", pattern)
            case str(), [{"property": str(name)}, dict(shape), *more] if symbol.upper() in SPATIAL:
                return self._located(symbol.upper(), name, shape, more)
            case str(), [dict(shape), {"property": str(name)}] if symbol.upper() in SPATIAL[::2]:
                return self._located(symbol.upper(), name, shape, [])
            case str(), [{"property": str(name)}, value] if symbol in COMPARISONS:
                return self._reader.compared(name, symbol, _literal(value))
            case str(), [value, {"property": str(name)}] if symbol in COMPARISONS:
                return self._reader.compared(name, _MIRRORED.get(symbol, symbol), _literal(value))
        return refuse_filter(
            f"the filter has an operation that is not offered with these arguments: {str(symbol)[:40]!r}",
            f"and, or, not, isNull, between, in, like, {', '.join(COMPARISONS)}; a property and values; "
            f"{', '.join(name.lower() for name in SPATIAL)}",
        )

    def _located(self, operator: str, name: str, shape: JsonObject, more: list[object]) -> Condition:
        match operator, more:
            case "S_DWITHIN", [int() | float() as distance, unit]:
                within_m = distance_m(self._reader.number(repr(distance)), unit)
            case (("S_INTERSECTS" | "S_WITHIN" | "S_DISJOINT"), []):
                within_m = 0.0
            case _:
                refuse_filter(
                    f"{operator.lower()} has other arguments", "a property, a geometry, a distance and its unit"
                )
        found: shapely.Geometry | Sides
        if set(shape) == {"bbox"} and isinstance(shape["bbox"], list):
            sides = shape["bbox"]
            if not all(isinstance(side, int | float) and not isinstance(side, bool) for side in sides):
                refuse_filter("a bbox in the filter holds something that is no number", "four or six numbers")
            found = _sides([self._reader.number(repr(side)) for side in sides])
        else:
            try:
                found = shapely.from_geojson(orjson.dumps(shape))
            except (ShapelyError, TypeError):
                refuse_filter("a geometry in the filter cannot be read", "a geometry of GeoJSON, or a bbox")
        return self._reader.located(name, operator, found, within_m)


def _sides(numbers: list[float]) -> Sides:
    if len(numbers) not in (4, 6):
        refuse_filter(f"a box in the filter has {len(numbers)} numbers", "four, or six with heights")
    return tuple(numbers)


def _between(reader: Reader, name: str, low: Any, high: Any) -> Condition:
    return Joined(True, (reader.compared(name, ">=", low), reader.compared(name, "<=", high)))


def _literal(value: object) -> Any:
    match value:
        case {"timestamp": str(text)} | {"date": str(text)}:
            return text
        case {"op": str(name), "args": _}:
            refuse_function(name)
    return value
