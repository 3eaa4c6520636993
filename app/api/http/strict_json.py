"""Strict reading of JSON bodies: what would later cause a 500 or a wrong row is refused here, at a bounded cost."""

from __future__ import annotations

import asyncio
import difflib
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import cache
from typing import Annotated, Literal, TypeVar

from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, FailFast, Field, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from app.formats.json_text import parse_json
from app.inputs import Number
from app.services.request_work import counted
from app.values import JsonObject

T = TypeVar("T")
_UNKNOWN = "extra_forbidden"
_NEAR = 0.75
"""How similar a name is that is proposed for an unknown one (`difflib`): single slips of the keyboard."""
_LARGE_BYTES = 16 * 1024
"""Larger documents are read in a thread. Source: by measurement, a smaller one takes 20 ms at most."""
_READER = ThreadPoolExecutor(1, "json")
"""Reading holds the interpreter's lock, so a second thread would only delay the event loop further."""
_MAX_LISTED = 10_000
"""Errors that are listed. Source: by measurement, listing more keeps the interpreter's lock for over 20 ms."""


async def in_thread_if_large(size_bytes: int, read: Callable[[], T]) -> T:
    """Read a document: a large one in a thread, so that the event loop goes on."""
    if size_bytes <= _LARGE_BYTES:
        return counted(read)
    context = copy_context()
    return await asyncio.get_running_loop().run_in_executor(_READER, lambda: context.run(counted, read))


def read_body(body: TypeAdapter[T], raw: bytes) -> T:
    """A JSON body as a model; errors as of `parse_json` and `validated`."""
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
            message = f"{error.error_count()} values are not as documented"
            raise RequestValidationError([{"type": "invalid", "loc": where, "msg": message}]) from None
        faults = error.errors(include_url=False, include_input=False)
        for fault in faults:
            if fault["type"] == "unexpected_keyword_argument":  # what pydantic calls it in a dataclass
                fault["type"], fault["msg"] = _UNKNOWN, "Extra inputs are not permitted"
        names = _names_in(adapter) if any(fault["type"] == _UNKNOWN for fault in faults) else ()
        raise RequestValidationError([_located(fault, where, names) for fault in faults]) from None


def _located(fault: ErrorDetails, where: tuple[str, ...], names: Collection[str]) -> JsonObject:
    """A fault with its place in the request, and with the known name that is nearest to an unknown one."""
    found: JsonObject = {**fault, "loc": (*where, *fault["loc"])}
    if fault["type"] == _UNKNOWN:
        unknown = str(fault["loc"][-1])[:80].lower()
        longer = sorted((name for name in names if name.startswith(f"{unknown}_")), key=len)
        if near := longer or difflib.get_close_matches(unknown, names, 1, _NEAR):
            found["ctx"] = {"near": near[0]}
    return found


@cache
def _names_in(adapter: TypeAdapter[object]) -> tuple[str, ...]:
    """Names of all members of a model and of the models in it."""
    schema = adapter.json_schema()
    return tuple(
        sorted({name for model in (schema, *schema.get("$defs", {}).values()) for name in model.get("properties", ())})
    )


# === Schemas of the GeoJSON geometries that requests carry (RFC 7946).


# Long lists stop at their first error: a body of 1 MiB has room for 200,000 of them.
Position = Annotated[list[Number], Field(min_length=2, max_length=4), FailFast()]
Ring = Annotated[list[Position], Field(min_length=4), FailFast()]


class _Geometry(BaseModel):
    model_config = ConfigDict(extra="ignore")  # RFC 7946, section 6.1: foreign members


class PolygonIn(_Geometry):
    """A polygon: its outer ring, then its holes."""

    type: Literal["Polygon"]
    coordinates: Annotated[list[Ring], Field(min_length=1), FailFast()]


class MultiPolygonIn(_Geometry):
    """Several polygons."""

    type: Literal["MultiPolygon"]
    coordinates: Annotated[
        list[Annotated[list[Ring], Field(min_length=1), FailFast()]], Field(min_length=1), FailFast()
    ]


AnyPolygon = Annotated[PolygonIn | MultiPolygonIn, Field(discriminator="type")]
