"""Hostile JSON for any route: its example, made deep, wide, long, repeated, degenerate or ambiguous."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from typing import Any, NamedTuple

MAX_BYTES = 1_000_000
_VALUES = 190_000
_LARGEST = 1e8


class JsonRoute(NamedTuple):
    """A route that takes JSON, and an example of its body."""

    method: str
    path: str
    example: Any


def list_json_routes(document: dict[str, Any]) -> list[JsonRoute]:
    """All routes of an OpenAPI document with a JSON body."""
    found = []
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            body = operation.get("requestBody", {}).get("content", {}).get("application/json")
            if body is not None:
                found.append(JsonRoute(method.upper(), path, _example(document, body)))
    return found


def _example(document: dict[str, Any], body: dict[str, Any]) -> Any:
    schema = body.get("schema", {})
    if "$ref" in schema:
        schema = document["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
    examples = schema.get("examples") or [body.get("example", schema.get("example", {}))]
    return examples[0]


def list_bodies(example: Any, *, short: bool) -> Iterator[tuple[str, bytes]]:
    """Hostile bodies by name, each of at most `MAX_BYTES`."""
    yield "deep", b'{"a":' * (MAX_BYTES // 6) + b"1" + b"}" * (MAX_BYTES // 6)
    yield "wide", json.dumps({f"a{number}": 0 for number in range(70_000)}).encode()
    if not short:
        yield "wide, as far as allowed", json.dumps({f"a{number}": 0 for number in range(990)}).encode()
        yield "long name", json.dumps({"a" * (MAX_BYTES - 100): 0}).encode()
        yield "duplicate name", ("{" + ",".join(f'"a{number}":0' for number in range(900)) + ',"a899":0}').encode()
    for place, value in _places(example):
        yield from _changed(example, place, value, short=short)


def _changed(example: Any, place: tuple[str | int, ...], value: Any, *, short: bool) -> Iterator[tuple[str, bytes]]:
    """Bodies with another value at one place of the example."""
    name = ".".join(map(str, place))
    if isinstance(value, list) and value:
        item = value[0]
        length = max(1, min(MAX_BYTES // (len(json.dumps(item)) + 2) - 100, _VALUES // _count(item)))
        yield f"{name} repeated", _with(example, place, [item] * length)
        yield f"{name} of empty lists", _with(example, place, [[]] * _VALUES)
        if not short:
            yield f"{name} of wrong values", _with(example, place, ["x"] * _VALUES)
            yield f"{name} of a thousand", _with(example, place, [item] * 1000)
    elif isinstance(value, str) and not short:
        yield f"{name} long", _with(example, place, "x" * (MAX_BYTES - 5000))
    elif isinstance(value, int | float) and not isinstance(value, bool) and not short:
        kind = type(value)
        yield f"{name} large", _with(example, place, kind(_LARGEST))
        yield f"{name} small", _with(example, place, kind(0.05) if kind is float else 1)


def _places(value: Any, above: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    if above:
        yield above, value
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _places(item, (*above, name))
    elif isinstance(value, list) and value:
        yield from _places(value[0], (*above, 0))


def _count(value: Any) -> int:
    if isinstance(value, dict | list):
        return 1 + sum(_count(item) for item in (value.values() if isinstance(value, dict) else value))
    return 1


def _with(example: Any, place: tuple[str | int, ...], value: Any) -> bytes:
    changed = copy.deepcopy(example)
    inner = changed
    for step in place[:-1]:
        inner = inner[step]
    inner[place[-1]] = value
    return json.dumps(changed).encode()
