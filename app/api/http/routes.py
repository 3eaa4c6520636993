"""Routes: functions say who may use them and what they cost; JSON bodies are read strictly."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Coroutine, Iterable
from functools import partial
from threading import RLock
from typing import Any, TypedDict, TypeVar, Unpack

from fastapi import Depends, Request, Response
from fastapi.routing import APIRoute
from pydantic import TypeAdapter
from starlette.routing import BaseRoute, Mount, compile_path, get_name

from app.api.http.dependencies import refuse_unknown_parameters
from app.api.http.limits import bounded
from app.api.http.openapi import operation_id
from app.api.http.permissions import PUBLIC, Allowed
from app.api.http.problems import Described, with_reference
from app.api.http.strict_json import in_thread_if_large, read_body
from app.errors import UnsupportedUpload
from app.values import JsonObject

EndpointT = TypeVar("EndpointT", bound=Callable[..., Any])
_BUILD = RLock()


class RouteOptions(TypedDict, total=False):
    """What a route may have besides its path and its scopes."""

    expensive: bool
    """Its largest request takes over a second. Source: `python -m benchmarks.abuse`."""
    status_code: int
    responses: Described
    response_class: type[Response]
    openapi_extra: JsonObject
    include_in_schema: bool
    name: str


class StrictRoute(APIRoute):
    """A route whose endpoint is `bounded`, and whose JSON body goes through `parse_json`: a large one in a thread.

    Routes below /v1 refuse query parameters that they do not know. A route is built, its dependencies analysed and the
    models of its body compiled, when it is first used: by a request, or when the OpenAPI document is made. All routes
    together take a fifth of the time of a start. The schemas of its responses are made for the OpenAPI document only.
    The first line of the endpoint's docstring is the summary of the operation, the rest its description.

    Parameters
    ----------
    scopes : frozenset of Scope
        Who may use it.
    """

    def __init__(
        self,
        method: str,
        path: str,
        endpoint: Callable[..., Any],
        *,
        scopes: Allowed,
        tags: list[str],
        options: RouteOptions,
    ) -> None:
        self.scopes = scopes
        self.is_expensive = options.get("expensive", False)
        self.path, self.endpoint = path, endpoint
        self.name = options.get("name") or get_name(endpoint)
        self.methods = {method}
        self.tags = list(tags)
        self.path_regex, self.path_format, self.param_convertors = compile_path(path)
        self._options: RouteOptions | None = options

    def __getattr__(self, name: str) -> Any:
        """Build the route: this is called for attributes that it does not have yet."""
        with _BUILD:
            options = self.__dict__.get("_options")
            if options is not None:
                self._options = None
                self._build(self.endpoint, options)
        if name not in self.__dict__:
            raise AttributeError(f"a route has no {name}")
        return self.__dict__[name]

    def _build(self, endpoint: Callable[..., Any], options: RouteOptions) -> None:
        methods = self.methods or set()
        responses = options.get("responses", {})
        super().__init__(
            self.path,
            bounded(endpoint, expensive=self.is_expensive, watched=self.is_expensive or methods <= {"GET", "HEAD"}),
            methods=methods,
            name=self.name,
            tags=[*self.tags],
            status_code=options.get("status_code"),
            responses={status: with_reference(response) for status, response in responses.items()},
            response_class=options.get("response_class", Response),
            dependencies=[Depends(refuse_unknown_parameters)] if self.path.startswith("/v1/") else [],
            openapi_extra=options.get("openapi_extra"),
            include_in_schema=options.get("include_in_schema", True),
            generate_unique_id_function=operation_id,
        )
        self.summary, self.description = _texts_of(endpoint)

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Handle the request with a strict reader of its body."""
        handler = super().get_route_handler()
        if self.body_field is None:
            return handler
        model = self.body_field.field_info.annotation
        assert model is not None
        read = partial(read_body, TypeAdapter(model))

        async def handle(request: Request) -> Response:
            body = await request.body()
            if body:
                _check_media_type(request)
                # FastAPI takes what is there for the parsed body, and a valid model for a valid body
                request._json = await in_thread_if_large(len(body), partial(read, body))
            return await handler(request)

        return handle


class Router:
    """Routes below a prefix.

    Parameters
    ----------
    prefix : str
        Begin of their paths.
    tag : str, optional
        The part of the API that they belong to.
    """

    def __init__(self, prefix: str, tag: str | None = None) -> None:
        self._prefix = prefix
        self._tags = [tag] if tag is not None else []
        self.routes: list[StrictRoute] = []

    def get(self, path: str, scopes: Allowed, **options: Unpack[RouteOptions]) -> Callable[[EndpointT], EndpointT]:
        """Add a route for GET."""
        return self._add("GET", path, scopes, options)

    def head(self, path: str, scopes: Allowed, **options: Unpack[RouteOptions]) -> Callable[[EndpointT], EndpointT]:
        """Add a route for HEAD."""
        return self._add("HEAD", path, scopes, options)

    def options(self, path: str, scopes: Allowed, **options: Unpack[RouteOptions]) -> Callable[[EndpointT], EndpointT]:
        """Add a route for OPTIONS."""
        return self._add("OPTIONS", path, scopes, options)

    def post(self, path: str, scopes: Allowed, **options: Unpack[RouteOptions]) -> Callable[[EndpointT], EndpointT]:
        """Add a route for POST."""
        return self._add("POST", path, scopes, options)

    def put(self, path: str, scopes: Allowed, **options: Unpack[RouteOptions]) -> Callable[[EndpointT], EndpointT]:
        """Add a route for PUT."""
        return self._add("PUT", path, scopes, options)

    def patch(self, path: str, scopes: Allowed, **options: Unpack[RouteOptions]) -> Callable[[EndpointT], EndpointT]:
        """Add a route for PATCH."""
        return self._add("PATCH", path, scopes, options)

    def delete(self, path: str, scopes: Allowed, **options: Unpack[RouteOptions]) -> Callable[[EndpointT], EndpointT]:
        """Add a route for DELETE."""
        return self._add("DELETE", path, scopes, options)

    def _add(self, method: str, path: str, scopes: Allowed, options: RouteOptions) -> Callable[[EndpointT], EndpointT]:
        def add(endpoint: EndpointT) -> EndpointT:
            path_ = self._prefix + path
            self.routes.append(StrictRoute(method, path_, endpoint, scopes=scopes, tags=self._tags, options=options))
            return endpoint

        return add


def permissions_of(routes: Iterable[BaseRoute]) -> dict[str, Allowed]:
    """Who may use which route, by method and path template, e.g. ``GET /v1/markers/{marker_id}``.

    Mounted files are public. HEAD is left out: it is treated as GET. Other kinds of routes are left out, too, and so
    refused to everybody.
    """
    table: dict[str, Allowed] = {}
    for route in routes:
        if isinstance(route, StrictRoute):
            table |= {f"{method} {route.path}": route.scopes for method in route.methods or () if method != "HEAD"}
        elif isinstance(route, Mount):
            table[f"GET {route.path}"] = PUBLIC
    return table


def _texts_of(endpoint: Callable[..., object]) -> tuple[str, str]:
    """Summary and description of an operation, from the docstring of its endpoint."""
    summary, _, description = (inspect.getdoc(endpoint) or "").partition("\n")
    return summary.removesuffix("."), description.strip()


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
