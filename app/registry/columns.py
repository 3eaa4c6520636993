"""Many rows by column: shared values are stored once, and the JSON of each row is made from one template."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import orjson


class JsonTexts(list[str]):
    """A column of values that are JSON already, their keys sorted."""


@dataclass(frozen=True, slots=True)
class Columns:
    """Rows that have the same columns.

    Attributes
    ----------
    count : int
        Rows.
    same : dict
        Columns in which all rows agree: name to value.
    own : dict
        The others: name to `count` values; of JSON columns either values or `JsonTexts`.
    """

    count: int
    same: dict[str, Any]
    own: dict[str, Sequence[Any]]

    @classmethod
    def of(cls, count: int, same: Mapping[str, Any], lists: Mapping[str, Sequence[Any]]) -> Columns:
        """Columns from lists; a list whose values are all the same becomes one shared value."""
        alike = {name for name, values in lists.items() if not isinstance(values, JsonTexts) and _is_one_value(values)}
        return cls(
            count,
            {**same, **{name: lists[name][0] for name in alike}},
            {name: values for name, values in lists.items() if name not in alike},
        )

    def but(self, **lists: Sequence[Any]) -> Columns:
        """A copy with other values in some columns."""
        return Columns.of(
            self.count,
            {name: value for name, value in self.same.items() if name not in lists},
            {**self.own, **lists},
        )

    def values(self, name: str) -> list[Any]:
        """A column as a list."""
        return list(self.own[name]) if name in self.own else [self.same[name]] * self.count

    def rows(self) -> list[dict[str, Any]]:
        """The rows one by one."""
        lists = [
            [orjson.loads(text) for text in values] if isinstance(values, JsonTexts) else values
            for values in self.own.values()
        ]
        if not lists:
            return [dict(self.same) for _ in range(self.count)]
        return [{**self.same, **dict(zip(self.own, row, strict=True))} for row in zip(*lists, strict=True)]


def json_objects(columns: Columns, *, names: Sequence[str] | None = None, optional: Collection[str] = ()) -> JsonTexts:
    """Each row as a JSON object: byte by byte what `orjson.dumps` with sorted keys writes.

    Parameters
    ----------
    columns : Columns
    names : sequence of str, optional
        All columns in the order of the members, instead of sorted.
    optional : collection of str
        Columns of `own` that a row leaves out where its value is None.
    """
    template: list[str] = []
    texts: list[Sequence[str]] = []
    for name in names or sorted({*columns.same, *columns.own}):
        key = f",{_text(name)}:".replace("%", "%%")
        if name in columns.same:
            template.append(key + _text(columns.same[name]).replace("%", "%%"))
        elif name in optional:
            template.append("%s")
            own = json_texts(columns.own[name])
            texts.append(["" if text == "null" else f",{_text(name)}:{text}" for text in own])
        else:
            template.append(key + "%s")
            texts.append(json_texts(columns.own[name]))
    members = "".join(template)
    if not texts:
        return JsonTexts(["{" + (members % ())[1:] + "}"] * columns.count)
    return JsonTexts(["{" + (members % row)[1:] + "}" for row in zip(*texts, strict=True)])


def json_texts(values: Sequence[Any]) -> Sequence[str]:
    """Each value as JSON with sorted keys."""
    if isinstance(values, JsonTexts):
        return values
    texts = orjson.dumps(values, option=orjson.OPT_SORT_KEYS)[1:-1].decode().split(",")
    if len(texts) == len(values):  # there is no comma within a value
        return texts
    return [_text(value) for value in values]


def _text(value: Any) -> str:
    return orjson.dumps(value, option=orjson.OPT_SORT_KEYS).decode()


def _is_one_value(values: Sequence[Any]) -> bool:
    """Whether all values are equal and of one type: 0 is not False."""
    first = values[0] if values else None
    return bool(values) and list(values).count(first) == len(values) and len(set(map(type, values))) == 1
