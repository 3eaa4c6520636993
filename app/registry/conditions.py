"""Conditions on properties from filter expressions, as SQL with the same result on both databases.

Values are bound parameters; which properties there are, and of which kind a value must be, whoever reads the expression
has checked.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import shapely
import sqlalchemy as sa
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.functions import FunctionElement

from app.geodesy import LocalizationGrade, grade_accuracy, total_accuracy_m
from app.geodesy.place import stored_frame
from app.geodesy.systems import ELLIPSOID
from app.registry.column_types import AnyColumn
from app.registry.spatial import Area, within_area
from app.values import JsonObject

# === Columns of a marker's grade, also for rows and versions from before there were grades.


MAX_NOTE = 500  # characters of the column transform_note
NO_RMSE = "no horizontal accuracy is stated: state horizontal_rmse_m"
"""Cure of a position that is unfit for localization for lack of it."""


def grade_columns(horizontal_rmse_m: float | None, accuracy_m: float | None, note: str | None) -> JsonObject:
    """Columns of a position's grade: by its survey, and by the accuracy of its frame with the note on it."""
    notes = [text for text in (NO_RMSE if horizontal_rmse_m is None else None, note) if text]
    return {
        "transform_accuracy_m": accuracy_m,
        "localization_grade": str(grade_accuracy(total_accuracy_m(horizontal_rmse_m, accuracy_m))),
        "transform_note": "; ".join(notes)[:MAX_NOTE] or None,
    }


def is_graded(values: Mapping[str, object]) -> bool:
    """Whether a row or a version has a grade; older ones are ``exact`` or ``approximate``."""
    return values.get("localization_grade") in list(LocalizationGrade)


def regraded(values: Mapping[str, Any]) -> dict[str, object]:
    """The columns of the grade of a row or a version that has none.

    Parameters
    ----------
    values : mapping
        Columns of a marker; missing ones are None.
    """
    place_deg = (values["lon_deg"], values["lat_deg"])
    stated = (values.get(name) for name in ("realization", "epoch", "transform_accuracy_m"))
    accuracy_m, added = stored_frame(values["crs"], place_deg, *stated)
    note = values.get("transform_note") or ""
    parts = [part for part in (note.removeprefix(NO_RMSE).removeprefix("; "), added) if part]
    return grade_columns(values.get("horizontal_rmse_m"), accuracy_m, "; ".join(dict.fromkeys(parts)))


# === Conditions on properties from filter expressions, as SQL with the same result on both databases.


Value = str | float | datetime
Bound = float | sa.BindParameter[float]
COMPARISONS: dict[str, Callable[[Any, Any], Any]] = {
    "=": operator.eq,
    "<>": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
    "<=": operator.le,
    ">=": operator.ge,
}


@dataclass(frozen=True, slots=True)
class Compared:
    """A property beside a value, by an operator of `COMPARISONS`; `like` takes a pattern with % and _ and \\."""

    name: str
    operator: str
    value: Value


@dataclass(frozen=True, slots=True)
class Missing:
    """A property has no value."""

    name: str


@dataclass(frozen=True, slots=True)
class Constant:
    """True or false for every row."""

    value: bool


@dataclass(frozen=True, slots=True)
class Not:
    """The negation, in SQL's three-valued logic: that of unknown is unknown."""

    condition: Condition


@dataclass(frozen=True, slots=True)
class Joined:
    """All or any of several conditions."""

    every: bool
    conditions: tuple[Condition, ...]


@dataclass(frozen=True, slots=True)
class Located:
    """The feature is in an area or touches it; `strictly`: it is within the area, and not on its edge alone."""

    area: Area
    strictly: bool = False
    heights_m: tuple[float, float] | None = None  # [m] lowest and highest ellipsoidal height; one without is in


Condition = Compared | Missing | Constant | Not | Joined | Located
GEOMETRY = "geometry"
"""The name of a feature's geometry in filters, beside those of its properties."""


def condition_sql(condition: Condition, columns: dict[str, AnyColumn], table: sa.Table) -> sa.ColumnElement[bool]:
    """The condition as SQL on columns, by their properties' names, and on the places of a table's rows."""
    match condition:
        case Located(area, strictly, heights_m):
            found = within_area(area, table, strictly=strictly)
            return found.self_group() if heights_m is None else sa.and_(found, between_heights(table, *heights_m))
        case Constant(value):
            return sa.literal(1, sa.Integer) == sa.literal(int(value), sa.Integer)
        case Missing(name):
            return columns[name].is_(None)
        case Not(inner):
            return sa.not_(condition_sql(inner, columns, table).self_group())
        case Joined(every, conditions):
            join = sa.and_ if every else sa.or_
            return join(*(condition_sql(inner, columns, table).self_group() for inner in conditions)).self_group()
        case Compared(name, "like", value):
            return _Like(columns[name], sa.literal(str(value)), sa.literal(_glob(str(value))))
        case Compared(name, symbol, value):
            column = columns[name]
            bound = sa.literal(value, column.type if isinstance(value, datetime) else None)
            if isinstance(value, str) and symbol not in ("=", "<>"):
                column = _Bytewise(column)
            result: sa.ColumnElement[bool] = COMPARISONS[symbol](column, bound)
            return result


def holds(condition: Condition, values: Mapping[str, object]) -> bool | None:
    """Whether the condition holds of these values by their properties' names, as `condition_sql` has it; None of what
    is unknown. The value of `GEOMETRY` is a shape.
    """
    match condition:
        case Located(area, strictly):  # values in hand are of lines, which have no heights
            shape = values[GEOMETRY]
            return bool(shapely.contains(area.shape, shape) if strictly else shapely.intersects(area.shape, shape))
        case Constant(value):
            return value
        case Missing(name):
            return values[name] is None
        case Not(inner):
            found = holds(inner, values)
            return None if found is None else not found
        case Joined(every, conditions):
            parts = [holds(inner, values) for inner in conditions]
            if (not every) in parts:
                return not every
            return None if None in parts else every
        case Compared(name, symbol, value):
            known = values[name]
            if known is None:
                return None
            if symbol == "like":
                return _is_like(str(known), _pattern_parts(str(value)))
            return bool(COMPARISONS[symbol](known, value))


def between_heights(table: sa.Table, low_m: Bound, high_m: Bound) -> sa.ColumnElement[bool]:
    """Rows with an ellipsoidal height in a range, and those without one."""
    c = table.c
    other = [c.vertical_datum != ELLIPSOID] if "vertical_datum" in c else []
    return sa.or_(c.height_m.is_(None), *other, c.height_m.between(low_m, high_m))


def pinned_values(condition: Condition | None) -> dict[str, Value]:
    """Properties that must have one value for the condition to hold; there may be more."""
    match condition:
        case Compared(name, "=", value):
            return {name: value}
        case Joined(True, conditions):
            return {name: value for inner in conditions for name, value in pinned_values(inner).items()}
        case _:
            return {}


class _Bytewise(FunctionElement[str]):
    """A text in the order of code points, as SQLite sorts; PostgreSQL would sort by the database's language."""

    name = "waymark_bytewise"
    type = sa.String()
    inherit_cache = True


@compiles(_Bytewise, "sqlite")
def _plain(element: _Bytewise, compiler: SQLCompiler, **how: object) -> str:
    return compiler.process(next(iter(element.clauses)), **how)


@compiles(_Bytewise, "postgresql")
def _in_c(element: _Bytewise, compiler: SQLCompiler, **how: object) -> str:
    return f'({compiler.process(next(iter(element.clauses)), **how)} COLLATE "C")'


class _Like(FunctionElement[bool]):
    """LIKE that distinguishes upper and lower case: SQLite's LIKE does not, its GLOB does."""

    name = "waymark_like"
    type = sa.Boolean()
    inherit_cache = True

    def self_group(self, against: object = None) -> _Like:
        """Itself: SQLAlchemy would compare it with 1."""
        return self


@compiles(_Like, "sqlite")
def _by_glob(element: _Like, compiler: SQLCompiler, **how: object) -> str:
    text, _, pattern = element.clauses
    return f"({compiler.process(text, **how)} GLOB {compiler.process(pattern, **how)})"


@compiles(_Like, "postgresql")
def _by_like(element: _Like, compiler: SQLCompiler, **how: object) -> str:
    text, pattern, _ = element.clauses
    return f"({compiler.process(text, **how)} LIKE {compiler.process(pattern, **how)} ESCAPE '\\')"


def _glob(like: str) -> str:
    """A pattern of LIKE, converted to GLOB."""

    def part(match: re.Match[str]) -> str:
        text = match[0]
        if text in "%_":
            return {"%": "*", "_": "?"}[text]
        text = text[-1]
        return f"[{text}]" if text in "*?[" else text

    return re.sub(r"\\.|[%_*?\[]", part, like, flags=re.DOTALL)


def _pattern_parts(like: str) -> list[str | None]:
    """A pattern of LIKE by characters: None for any text, an empty one for any character."""
    return [
        {"%": None, "_": ""}.get(part, part[-1])  # an escaped character stands for itself
        for part in re.findall(r"\\.|.", like, flags=re.DOTALL)
    ]


def _is_like(text: str, parts: Sequence[str | None]) -> bool:
    """Whether a text is like a pattern; goes back to the last % only, so it takes their lengths' product at most."""
    at = part = 0
    last, resumed = -1, 0
    while at < len(text):
        if part < len(parts) and parts[part] is None:
            last, resumed = part, at
            part += 1
        elif part < len(parts) and parts[part] in ("", text[at]):
            at, part = at + 1, part + 1
        elif last >= 0:
            resumed += 1
            at, part = resumed, last + 1
        else:
            return False
    return all(rest is None for rest in parts[part:])
