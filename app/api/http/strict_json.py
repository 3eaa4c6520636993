"""Strict reading of JSON bodies: what would later cause a 500 or a wrong row is refused here, at a bounded cost."""

from __future__ import annotations

import asyncio
import difflib
from collections.abc import Callable, Collection, Coroutine
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import cache, partial
from threading import RLock
from typing import Annotated, Any, Literal, TypeVar

from fastapi import Depends, Request, Response
from fastapi.datastructures import DefaultPlaceholder
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from pydantic import BaseModel, ConfigDict, FailFast, Field, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails
from starlette.routing import compile_path, get_name

from app.api.http.dependencies import Number, refuse_unknown_parameters
from app.api.http.limits import EXPENSIVE, bounded
from app.api.http.openapi import operation_id
from app.api.http.problems import with_reference
from app.errors import UnsupportedUpload
from app.formats.json_text import parse_json
from app.services.request_work import counted

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
_BUILD = RLock()


class StrictRoute(APIRoute):
    """A route whose endpoint is `bounded`, and whose JSON body goes through `parse_json`: a large one in a thread.

    Routes below /v1 refuse query parameters that they do not know. A route is built, its dependencies analysed and the
    models of its body compiled, when it is first used: by a request, or when the OpenAPI document is made. All routes
    together take a fifth of the time of a start. The schemas of its responses are made for the OpenAPI document only.
    """

    def __init__(self, path: str, endpoint: Callable[..., Any], **options: Any) -> None:
        self._declared: tuple[Callable[..., Any], dict[str, Any]] | None = (endpoint, options)
        self.path, self.endpoint = path, endpoint
        self.name = options.get("name") or get_name(endpoint)
        self.methods = {method.upper() for method in options.get("methods") or ("GET",)}
        self.path_regex, self.path_format, self.param_convertors = compile_path(path)

    def __getattr__(self, name: str) -> Any:
        """Build the route: this is called for attributes that it does not have yet."""
        with _BUILD:
            declared = self.__dict__.get("_declared")
            if declared is not None:
                self._declared = None
                self._build(*declared)
        if name not in self.__dict__:
            raise AttributeError(f"a route has no {name}")
        return self.__dict__[name]

    def _build(self, endpoint: Callable[..., Any], options: dict[str, Any]) -> None:
        methods = self.methods or set()
        expensive = any(f"{method} {self.path}" in EXPENSIVE for method in methods)
        described = {status: with_reference(response) for status, response in (options["responses"] or {}).items()}
        refused = [Depends(refuse_unknown_parameters)] if self.path.startswith("/v1/") else []
        shown = options["response_class"]
        own: dict[str, Any] = {
            "responses": described,
            "dependencies": [*refused, *(options["dependencies"] or ())],
            "generate_unique_id_function": operation_id,
            "response_class": Response if isinstance(shown, DefaultPlaceholder) else shown,
        }
        run = bounded(endpoint, expensive=expensive, watched=expensive or methods <= {"GET", "HEAD"})
        super().__init__(self.path, run, **options | own)

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


# === Schemas of the GeoJSON geometries that requests carry (RFC 7946).


# Long lists stop at their first error: a body of 1 MiB has room for 200,000 of them.
Position = Annotated[list[Number], Field(min_length=2, max_length=4), FailFast()]
Line = Annotated[list[Position], Field(min_length=2), FailFast()]
Ring = Annotated[list[Position], Field(min_length=4), FailFast()]


class _Geometry(BaseModel):
    model_config = ConfigDict(extra="ignore")  # RFC 7946, section 6.1: foreign members


class GeoLineIn(_Geometry):
    """A line."""

    type: Literal["LineString"]
    coordinates: Line


class MultiLineStringIn(_Geometry):
    """Several lines."""

    type: Literal["MultiLineString"]
    coordinates: Annotated[list[Line], Field(min_length=1), FailFast()]


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


AnyLine = Annotated[GeoLineIn | MultiLineStringIn, Field(discriminator="type")]
AnyPolygon = Annotated[PolygonIn | MultiPolygonIn, Field(discriminator="type")]
