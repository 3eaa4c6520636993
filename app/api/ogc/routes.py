"""The routes of /ogc and pages of items. Queries are read by typed dependencies; pages and tiles have own threads."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from datetime import UTC, datetime
from functools import partial, wraps
from inspect import Parameter, signature
from typing import Any, cast

import orjson
from fastapi import APIRouter, FastAPI, Request
from fastapi import Response as FastapiResponse
from fastapi.routing import APIRoute
from starlette.responses import Response

from app.api.http.dependencies import Caller
from app.api.http.limits import watch_client
from app.api.http.problems import Described, problem_responses, reference
from app.api.http.responses import file_response
from app.api.http.strict_json import StrictRoute
from app.api.ogc import documents, edits, tiles
from app.api.ogc.pages import html_response, item_page, items_page
from app.api.ogc.query import OF_ITEM, OF_ITEMS, OF_TILE, ONLY_FORMAT, PARAMETERS, ItemsQuery, described
from app.api.ogc.responses import (
    GEOJSON,
    HTML,
    JSON,
    MAP_STYLE,
    MVT,
    OPENAPI,
    SCHEMA,
    BaseUrl,
    CollectionDocument,
    CollectionOf,
    Collections,
    Conformance,
    Feature,
    FeatureId,
    FeaturePage,
    FeaturesService,
    ItemQueryOf,
    ItemsQueryOf,
    JsonObject,
    LandingPage,
    Link,
    NewFeature,
    TileMatrixSet,
    TileMatrixSets,
    TileSet,
    TileSets,
    answer,
    link,
    with_query,
)
from app.services.request_work import counted

# === Features: pages of them, and single ones.


def list_items(
    collection: CollectionOf, query: ItemsQueryOf, base: BaseUrl, caller: Caller, features: FeaturesService
) -> Response:
    """A page of features, or how many there are."""
    if query.hits:
        hits = _hits(features.count(caller, collection, query.filtered))
        if query.is_page:
            return html_response(items_page(base, collection, query, hits, None))
        return answer(hits, GEOJSON)
    page = features.page(
        caller,
        collection,
        query.filtered,
        after=query.after,
        limit=query.limit,
        crs=query.crs,
        counted=query.counted,
    )
    document: FeaturePage = {
        "type": "FeatureCollection",
        "timeStamp": datetime.now(UTC),
        "numberReturned": page.returned,
        "links": _links(query, f"{base}/collections/{collection.id}", page.after),
        "features": cast("list[Feature]", page.features),  # JSON already, as it is stored
    }
    if page.matched is not None:
        document["numberMatched"] = page.matched
    if query.is_page:
        document["features"] = orjson.loads(orjson.dumps(page.features))
        return html_response(items_page(base, collection, query, document, page.after))
    return answer(document, GEOJSON, crs=query.crs)


def get_item(
    collection: CollectionOf,
    query: ItemQueryOf,
    feature_id: FeatureId,
    base: BaseUrl,
    caller: Caller,
    features: FeaturesService,
) -> Response:
    """One feature."""
    feature = features.get(caller, collection, feature_id, query.crs)
    url = f"{base}/collections/{collection.id}"
    document: Feature = {
        "type": "Feature",
        "id": feature["id"],
        "geometry": feature["geometry"],
        "properties": feature["properties"],
        "links": [
            link(f"{url}/items/{feature['id']}", "self", GEOJSON),
            link(f"{url}/items/{feature['id']}?f=html", "alternate", HTML, "As HTML"),
            link(url, "collection", JSON),
        ],
    }
    if query.is_page:
        return html_response(item_page(base, collection, query.crs, query.pairs, feature))
    version = feature["properties"].get("version")
    return answer(document, GEOJSON, crs=query.crs, headers={"ETag": f'"{version}"'} if version is not None else None)


def _hits(matched: int) -> FeaturePage:
    return {
        "type": "FeatureCollection",
        "timeStamp": datetime.now(UTC),
        "numberReturned": 0,
        "numberMatched": matched,
        "links": [],
        "features": [],
    }


def _links(query: ItemsQuery, url: str, after: str | None) -> list[Link]:
    rest = [(name, value) for name, value in query.pairs if name not in ("f", "earlier")]
    links = [
        link(with_query(f"{url}/items", query.pairs), "self", GEOJSON),
        link(with_query(f"{url}/items", [*rest, ("f", "html")]), "alternate", HTML, "As HTML"),
        link(url, "collection", JSON),
    ]
    if after is not None:
        onward = [*((name, value) for name, value in query.pairs if name not in ("after", "earlier")), ("after", after)]
        links.append(link(with_query(f"{url}/items", onward), "next", GEOJSON))
    return links


# === The routes of /ogc. Queries are read by typed dependencies; pages and tiles have threads of their own.


_ITEMS = "/ogc/collections/{collection}/items"
_ITEM = f"{_ITEMS}/{{feature}}"
_TILES = "/ogc/collections/{collection}/tiles"
_THREADS = max(2, min(os.cpu_count() or 1, 4))
_ANY_OBJECT = {"type": "object", "additionalProperties": True}
Endpoint = Callable[..., Any]


def _in_own_threads(answer: Callable[..., FastapiResponse]) -> Callable[..., Awaitable[FastapiResponse]]:
    """An endpoint that a few threads run: more would only wait for each other, and each for a connection."""

    @wraps(answer)
    async def endpoint(request: Request, **values: Any) -> FastapiResponse:
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
    read(_ITEMS, _in_own_threads(list_items), _json(FeaturePage, GEOJSON), (*OF_ITEMS, *_filters()))
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
    read(_ITEM, get_item, _json(Feature, GEOJSON), OF_ITEM)
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
