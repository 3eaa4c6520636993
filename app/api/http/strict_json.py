"""Strict reading of JSON bodies: what would later cause a 500 or a wrong row is refused here, at a bounded cost."""

from __future__ import annotations

import asyncio
import difflib
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Coroutine
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import cache, partial
from typing import Any, NoReturn, TypeVar

from fastapi import Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from app.api.http.components import with_reference
from app.api.http.costs import EXPENSIVE, bounded
from app.errors import MalformedRequest, UnsupportedUpload
from app.services.request_work import counted

T = TypeVar("T")
MAX_DEPTH = 32
MAX_VALUES = 200_000
"""Values in one document. Source: a road of 1 MiB, the largest body, has 50,000 vertices of three values each."""
MAX_MEMBERS = 1_000
"""Members of one object. Source: chosen by hand, the largest that a route takes has about 40."""
_MAX_INT = 2**64
_MAX_INT_DIGITS = 20
_UNKNOWN = "extra_forbidden"
_NEAR = 0.75
"""How similar a name is that is proposed for an unknown one (`difflib`). Source: chosen by hand, on single slips."""
_LARGE_BYTES = 16 * 1024
"""Larger documents are read in a thread. Source: by measurement, a smaller one takes 20 ms at most."""
_READER = ThreadPoolExecutor(1, "json")
"""Reading holds the interpreter's lock, so a second thread would only delay the event loop further."""
_MAX_LISTED = 10_000
"""Errors that are listed. Source: by measurement, listing more keeps the interpreter's lock for over 20 ms."""
_SUSPECT = re.compile(rb"\\u(?:0000|[dD][89a-fA-F])")
"""Escapes of NUL and of halves of surrogate pairs; unescaped, neither is JSON in UTF-8."""
_EMPTY = re.compile(rb"[\[{][ \t\r\n]*+[\]}]")
_TEXT = re.compile(rb'"(?:[^"\\]|\\.)*+(?:"|\Z)', re.DOTALL)


class StrictRoute(APIRoute):
    """A route whose endpoint is `bounded`, and whose JSON body goes through `parse_json`: a large one in a thread.

    The schemas of its responses are made for the OpenAPI document only, not when the server starts.
    """

    def __init__(self, path: str, endpoint: Callable[..., Any], **options: Any) -> None:
        expensive = any(f"{method} {path}" in EXPENSIVE for method in options.get("methods") or ())
        described = {status: with_reference(response) for status, response in (options.pop("responses") or {}).items()}
        super().__init__(path, bounded(endpoint, expensive=expensive), responses=described, **options)

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Handle the request with a strict reader of its body."""
        handler = super().get_route_handler()
        if self.body_field is None:
            return handler
        model = self.body_field.field_info.annotation
        assert model is not None
        read = partial(_read_body, TypeAdapter(model))

        async def handle(request: Request) -> Response:
            body = await request.body()
            if body:
                _check_media_type(request)
                # FastAPI takes what is there for the parsed body, and a valid model for a valid body
                request._json = await in_thread_if_large(len(body), partial(read, body))
            return await handler(request)

        return handle


def _check_media_type(request: Request) -> None:
    sent = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    kind, _, subtype = sent.partition("/")
    if kind != "application" or not (subtype == "json" or subtype.endswith("+json")):
        raise UnsupportedUpload(
            f"the body is JSON, but its Content-Type is {sent[:80] or 'missing'}",
            field="Content-Type",
            limit="application/json",
            cure="send the header Content-Type: application/json",
        )


async def in_thread_if_large(size_bytes: int, read: Callable[[], T]) -> T:
    """Read a document: a large one in a thread, so that the event loop goes on."""
    if size_bytes <= _LARGE_BYTES:
        return counted(read)
    context = copy_context()
    return await asyncio.get_running_loop().run_in_executor(_READER, lambda: context.run(counted, read))


def _read_body(body: TypeAdapter[Any], raw: bytes) -> Any:
    return validated(body, parse_json(raw), "body")


def validated(adapter: TypeAdapter[T], value: object, *where: str) -> T:
    """A value as a model.

    Raises
    ------
    RequestValidationError
        It is not valid; the locations begin with `where`, because the problem table expects them inside a request.
    """
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        if error.error_count() > _MAX_LISTED:
            fault: Any = {"type": "invalid", "loc": where, "msg": f"{error.error_count()} values are not as documented"}
            raise RequestValidationError([fault]) from None
        faults = error.errors(include_url=False, include_input=False)
        names = _names_in(adapter) if any(fault["type"] == _UNKNOWN for fault in faults) else ()
        raise RequestValidationError([_located(fault, where, names) for fault in faults]) from None


def _located(fault: ErrorDetails, where: tuple[str, ...], names: Collection[str]) -> dict[str, Any]:
    """A fault with its place in the request, and with the known name that is nearest to an unknown one."""
    found: dict[str, Any] = {**fault, "loc": (*where, *fault["loc"])}
    if fault["type"] == _UNKNOWN:
        unknown = str(fault["loc"][-1])[:80].lower()
        longer = sorted((name for name in names if name.startswith(f"{unknown}_")), key=len)
        if near := longer or difflib.get_close_matches(unknown, names, 1, _NEAR):
            found["ctx"] = {"near": near[0]}
    return found


@cache
def _names_in(adapter: TypeAdapter[Any]) -> tuple[str, ...]:
    """Names of all members of a model and of the models in it."""
    schema = adapter.json_schema()
    return tuple(
        sorted({name for model in (schema, *schema.get("$defs", {}).values()) for name in model.get("properties", ())})
    )


def parse_json(raw: bytes, field: str = "body") -> Any:
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
    if _is_deep(value) or _SUSPECT.search(raw):
        _check_tree(value, field)
    return value


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


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(pairs) > MAX_MEMBERS:
        _refuse(f"an object has {len(pairs)} members", "body", f"{MAX_MEMBERS} members of an object")
    found = dict(pairs)
    if len(found) != len(pairs):
        double = Counter(name for name, _ in pairs).most_common(1)[0][0]
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


def _is_deep(root: Any) -> bool:
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


def _check_tree(root: Any, field: str) -> None:
    """Refuse what is too deep, and texts that the store cannot hold."""
    waiting = [(root, _Step(field))]
    while waiting:
        value, step = waiting.pop()
        if isinstance(value, str):
            _check_text(value, step)
        elif isinstance(value, dict | list):
            if step.depth == MAX_DEPTH:
                _refuse("the JSON is nested too deeply", step.path(), f"{MAX_DEPTH} levels")
            for name in value if isinstance(value, dict) else ():
                _check_text(name, step)
            items = value.items() if isinstance(value, dict) else enumerate(value)
            waiting += [(item, _Step(name, step)) for name, item in items if isinstance(item, dict | list | str)]


def _check_text(text: str, step: _Step) -> None:
    if "\x00" in text:
        _refuse("a text holds NUL", step.path(), "no U+0000")
    try:
        text.encode("utf-8")
    except UnicodeEncodeError as error:
        _refuse("a text holds half a surrogate pair", step.path(), "valid Unicode", error)


def _printable(path: str) -> str:
    return path[:200].encode("utf-8", "replace").decode().replace("\x00", "?")
