"""The routes of /ogc. Queries are read by typed dependencies; pages and tiles have threads of their own."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import partial, wraps
from inspect import Parameter, signature
from typing import Any

from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.routing import APIRoute

from app.api.http.components import reference
from app.api.http.costs import watch_client
from app.api.http.problems import Described, problem_responses
from app.api.http.responses import file_response
from app.api.http.strict_json import StrictRoute
from app.api.ogc import documents, edits, items, tiles
from app.api.ogc.parameters import OF_ITEM, OF_ITEMS, OF_TILE, ONLY_FORMAT, PARAMETERS, described
from app.api.ogc.responses import GEOJSON, HTML, JSON, MAP_STYLE, MVT, OPENAPI, SCHEMA
from app.api.ogc.shapes import (
    CollectionDocument,
    Collections,
    Conformance,
    Feature,
    FeaturePage,
    JsonObject,
    LandingPage,
    NewFeature,
    TileMatrixSet,
    TileMatrixSets,
    TileSet,
    TileSets,
)
from app.services.request_work import counted

_ITEMS = "/ogc/collections/{collection}/items"
_ITEM = f"{_ITEMS}/{{feature}}"
_TILES = "/ogc/collections/{collection}/tiles"
_THREADS = max(2, min(os.cpu_count() or 1, 4))
_ANY_OBJECT = {"type": "object", "additionalProperties": True}
Endpoint = Callable[..., Any]


def _in_own_threads(answer: Callable[..., Response]) -> Callable[..., Awaitable[Response]]:
    """An endpoint that a few threads run: more would only wait for each other, and each for a connection."""

    @wraps(answer)
    async def endpoint(request: Request, **values: Any) -> Response:
        watch_client()
        threads: ThreadPoolExecutor = request.app.state.ogc_threads
        run = partial(copy_context().run, partial(counted, answer, **values))
        return await asyncio.get_running_loop().run_in_executor(threads, run)

    own = signature(answer, eval_str=True)
    asked = Parameter("request", Parameter.KEYWORD_ONLY, annotation=Request)
    known = [parameter.replace(kind=Parameter.KEYWORD_ONLY) for parameter in own.parameters.values()]
    endpoint.__signature__ = own.replace(parameters=[asked, *known])  # type: ignore[attr-defined]
    return endpoint


def _json(model: Any, media_type: str, *, html: bool = True) -> Described:
    """A document, which may be offered as HTML as well."""
    schema = _ANY_OBJECT if model is JsonObject else reference(model, "serialization")
    page = {HTML: {"schema": {"type": "string"}}} if html else {}
    return {200: {"description": "OK", "content": {media_type: {"schema": schema}, **page}}}


def _add_read(
    router: APIRouter,
    path: str,
    endpoint: Endpoint,
    found: Described,
    parameters: tuple[str, ...] = ONLY_FORMAT,
    name: str | None = None,
    formats: tuple[str, ...] | None = None,
) -> None:
    """A route that reads; it offers JSON, and HTML if `found` has it, unless other `formats` are named."""
    formats = formats or (("json", "html") if HTML in found[200]["content"] else ("json",))
    router.add_api_route(
        path,
        endpoint,
        name=name,
        responses={**found, **problem_responses(404, 406)},
        openapi_extra={"parameters": [described(parameter, formats) for parameter in parameters]},
    )


def _add_edit(router: APIRouter, path: str, endpoint: Endpoint, method: str, status: int) -> None:
    body = {"content": {kind: {"schema": reference(NewFeature)} for kind in edits.BODY_TYPES}, "required": True}
    router.add_api_route(
        path,
        endpoint,
        methods=[method],
        status_code=status,
        responses=problem_responses(404, 409, *(() if method == "POST" else (412,)), 415),
        openapi_extra={} if method == "DELETE" else {"requestBody": body},
    )


def _add_heads(router: APIRouter) -> None:
    """HEAD is answered as GET is, and described nowhere."""
    for route in list(router.routes):
        if isinstance(route, APIRoute) and "GET" in (route.methods or ()):
            router.add_api_route(route.path, route.endpoint, methods=["HEAD"], include_in_schema=False)


def _router() -> APIRouter:
    router = APIRouter(route_class=StrictRoute, tags=["ogc"])
    read, edit = partial(_add_read, router), partial(_add_edit, router)
    read(_ITEMS, _in_own_threads(items.list_items), _json(FeaturePage, GEOJSON), (*OF_ITEMS, *_filters()))
    read(
        f"{_TILES}/{{matrix_set}}/{{zoom}}/{{row}}/{{column}}",
        _in_own_threads(tiles.get_tile),
        {**file_response([MVT]), 204: {"description": "No features"}},
        OF_TILE,
        formats=("mvt", "pbf"),
    )
    read("/ogc", documents.landing_page, _json(LandingPage, JSON))
    read("/ogc/", documents.landing_page, _json(LandingPage, JSON), name="landing_page_with_slash")
    read("/ogc/conformance", documents.get_conformance, _json(Conformance, JSON))
    read("/ogc/api", documents.get_api, _json(JsonObject, OPENAPI.partition(";")[0]))
    read("/ogc/collections", documents.list_collections, _json(Collections, JSON))
    read("/ogc/collections/{collection}", documents.get_collection, _json(CollectionDocument, JSON))
    read("/ogc/collections/{collection}/schema", documents.get_schema, _json(JsonObject, SCHEMA))
    read(
        "/ogc/collections/{collection}/geojson-schema",
        documents.get_geojson_schema,
        _json(JsonObject, SCHEMA, html=False),
    )
    read("/ogc/collections/{collection}/queryables", documents.get_queryables, _json(JsonObject, SCHEMA))
    read(_ITEM, items.get_item, _json(Feature, GEOJSON), OF_ITEM)
    read("/ogc/tileMatrixSets", tiles.list_matrix_sets, _json(TileMatrixSets, JSON, html=False))
    read("/ogc/tileMatrixSets/{matrix_set}", tiles.get_matrix_set, _json(TileMatrixSet, JSON, html=False))
    read(_TILES, tiles.list_tilesets, _json(TileSets, JSON, html=False))
    read(f"{_TILES}/{{matrix_set}}", tiles.get_tileset, _json(TileSet, JSON, html=False))
    read(f"{_TILES}/{{matrix_set}}/tilejson", tiles.get_tilejson, _json(JsonObject, JSON, html=False))
    read(f"{_TILES}/{{matrix_set}}/style", tiles.get_map_style, _json(JsonObject, MAP_STYLE, html=False))
    edit(_ITEMS, edits.post_feature, "POST", 201)
    edit(_ITEM, edits.put_feature, "PUT", 204)
    edit(_ITEM, edits.patch_feature, "PATCH", 204)
    edit(_ITEM, edits.delete_feature, "DELETE", 204)
    for path, endpoint in ((_ITEMS, edits.list_collection_methods), (_ITEM, edits.list_feature_methods)):
        router.add_api_route(path, endpoint, methods=["OPTIONS"], responses=problem_responses(404))
    _add_heads(router)
    return router


def _filters() -> list[str]:
    return [name for name in PARAMETERS if name not in (*OF_ITEMS, *OF_TILE)]


def mount_ogc(app: FastAPI) -> None:
    """Add /ogc to an app that has its use cases in `app.state.features` and `app.state.public_url`.

    It comes first: a map view asks dozens of times, and trying all other routes takes as long as reading a page.
    """
    app.state.ogc_threads = ThreadPoolExecutor(_THREADS, "ogc")
    app.router.routes[:0] = _router().routes
