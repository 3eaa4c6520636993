"""Strict reading of JSON bodies: what would later cause a 500 or a wrong row is refused here."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Coroutine
from typing import Any, NoReturn

from fastapi import Request, Response
from fastapi.routing import APIRoute

from app.api.http.problems import BodyRefused
from app.errors import MalformedRequest

MAX_DEPTH = 32
_MAX_INT = 2**64
_MAX_INT_DIGITS = 20


class StrictRoute(APIRoute):
    """A route whose JSON body goes through `parse_json`."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Handle the request with a strict reader of its body."""
        handler = super().get_route_handler()

        async def handle(request: Request) -> Response:
            return await handler(_StrictRequest(request.scope, request.receive))

        return handle


class _StrictRequest(Request):
    async def json(self) -> Any:
        raw = await self.body()
        try:
            return parse_json(raw)
        except MalformedRequest as error:
            raise BodyRefused(error) from error


def parse_json(raw: bytes, field: str = "body") -> Any:
    """Parse JSON, refusing what the standard or the store cannot hold.

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
        levels, a lone surrogate or a NUL in a text.
    """
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError as error:
        _refuse("the body is not UTF-8", field, "UTF-8", error)
    try:
        value = json.loads(
            text,
            object_pairs_hook=_unique,
            parse_constant=lambda name: _refuse(f"{name} is not a JSON number", field, "finite numbers"),
            parse_float=_finite,
            parse_int=_bounded,
        )
    except json.JSONDecodeError as error:
        _refuse(f"not JSON: {error.msg} at character {error.pos}", field, "RFC 8259", error)
    except RecursionError as error:
        _refuse("the JSON is nested too deeply", field, f"{MAX_DEPTH} levels", error)
    _check_tree(value, field, MAX_DEPTH)
    return value


def _refuse(message: str, field: str, limit: str, cause: Exception | None = None) -> NoReturn:
    raise MalformedRequest(message, field=field, limit=limit, cure="correct the body and send it again") from cause


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        names = [name for name, _ in pairs]
        double = next(name for name in names if names.count(name) > 1)
        _refuse(f"the key {double[:80]!r} appears twice in one object", _printable(double), "unique keys")
    return found


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        _refuse(f"the number {text[:40]} is beyond double precision", "body", "1.8e308")
    return value


def _bounded(text: str) -> int:
    if len(text.lstrip("-")) > _MAX_INT_DIGITS or not -_MAX_INT < int(text) < _MAX_INT:
        _refuse(f"the integer {text[:40]} is beyond 64 bits", "body", "64 bits")
    return int(text)


def _check_tree(value: Any, path: str, depth: int) -> None:
    if isinstance(value, str):
        _check_text(value, path)
    elif isinstance(value, dict | list):
        if depth == 0:
            _refuse("the JSON is nested too deeply", path[:200], f"{MAX_DEPTH} levels")
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for name, item in items:
            if isinstance(name, str):
                _check_text(name, path)
            _check_tree(item, f"{path}.{name}", depth - 1)


def _check_text(text: str, path: str) -> None:
    if "\x00" in text:
        _refuse("a text holds NUL", _printable(path), "no U+0000")
    try:
        text.encode("utf-8")
    except UnicodeEncodeError as error:
        _refuse("a text holds half a surrogate pair", _printable(path), "valid Unicode", error)


def _printable(path: str) -> str:
    return path[:200].encode("utf-8", "replace").decode().replace("\x00", "?")
