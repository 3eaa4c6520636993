"""What every answer under /ogc has in common: media types, absolute links, and who may see what."""

from __future__ import annotations

import asyncio
import os
import re
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass
from datetime import datetime
from functools import partial, wraps
from typing import Annotated, Any, Literal, NotRequired, ParamSpec
from urllib.parse import urlencode

import orjson
from fastapi import Depends, Path
from fastapi import Request as FastapiRequest
from pydantic import ConfigDict, with_config
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from typing_extensions import TypedDict

from app.api.http.dependencies import use_case
from app.api.http.limits import watch_client
from app.api.http.problems import Described, problem_responses, reference
from app.api.ogc.query import (
    OF_ITEM,
    ONLY_FORMAT,
    ItemsQuery,
    crs_parameter,
    described,
    items_query,
    known_parameters,
    query_pairs,
    refuse,
)
from app.errors import InvalidParameter
from app.services.markers.features import AnyCrs, Collection, Features, get_collection, no_feature
from app.services.request_work import counted
from app.values import JsonObject

# === What the API returns under /ogc, typed (OGC 17-069r4, 18-058r1, 20-057; GeoJSON: RFC 7946).


Asked = ParamSpec("Asked")


class Link(TypedDict):
    """A link."""

    href: str
    rel: str
    type: str
    title: NotRequired[str]
    templated: NotRequired[bool]


class LandingPage(TypedDict):
    """Where everything is."""

    title: str
    description: str
    links: list[Link]


class Conformance(TypedDict):
    """The conformance classes."""

    conformsTo: list[str]


class SpatialExtent(TypedDict):
    """A box: west, south, east, north. [deg]"""

    bbox: list[list[float]]
    crs: str


class TemporalExtent(TypedDict):
    """The first and the last change."""

    interval: list[list[datetime | None]]


class ExtentDocument(TypedDict):
    """What the features of a collection cover."""

    spatial: SpatialExtent
    temporal: TemporalExtent


class CollectionDocument(TypedDict):
    """A collection of features."""

    id: str
    title: str
    description: str
    itemType: Literal["feature"]
    crs: list[str]
    storageCrs: str
    links: list[Link]
    extent: NotRequired[ExtentDocument]
    storageCrsCoordinateEpoch: NotRequired[float]


class Collections(TypedDict):
    """All collections."""

    links: list[Link]
    crs: list[str]
    collections: list[CollectionDocument]


class Geometry(TypedDict):
    """A point or a line."""

    type: Literal["Point", "LineString"]
    coordinates: list[float] | list[list[float]]


class Feature(TypedDict):
    """A feature; the schema of its collection describes its properties."""

    type: Literal["Feature"]
    id: str
    geometry: Geometry | None  # None outside the area of the CRS
    properties: JsonObject
    links: NotRequired[list[Link]]


class FeaturePage(TypedDict):
    """A page of features."""

    type: Literal["FeatureCollection"]
    timeStamp: datetime
    numberReturned: int
    numberMatched: NotRequired[int]
    links: list[Link]
    features: list[Feature]


_EXAMPLE: JsonObject = {
    "type": "Feature",
    "geometry": {"type": "Point", "coordinates": [114.1792, 22.3041]},
    "properties": {"family": "plate", "status": "planned", "heading_deg": 90.0},
}


@with_config(ConfigDict(json_schema_extra={"examples": [_EXAMPLE]}))
class NewFeature(TypedDict):
    """A feature that is sent: a point and flat properties."""

    type: NotRequired[Literal["Feature"]]
    id: NotRequired[str | int | None]
    geometry: NotRequired[JsonObject | None]
    properties: NotRequired[JsonObject | None]


class TileSet(TypedDict):
    """A set of vector tiles."""

    title: str
    dataType: Literal["vector"]
    crs: str
    tileMatrixSetURI: str
    links: list[Link]


class TileSets(TypedDict):
    """The tile sets of a collection."""

    tilesets: list[TileSet]


class TileMatrix(TypedDict):
    """One zoom level of a tile matrix set."""

    id: str
    scaleDenominator: float
    cellSize: float
    pointOfOrigin: list[float]
    tileWidth: int
    tileHeight: int
    matrixWidth: int
    matrixHeight: int


class TileMatrixSet(TypedDict):
    """A tile matrix set."""

    id: str
    uri: str
    crs: str
    orderedAxes: list[str]
    tileMatrices: list[TileMatrix]


class TileMatrixSetItem(TypedDict):
    """A tile matrix set in a list."""

    id: str
    uri: str
    links: list[Link]


class TileMatrixSets(TypedDict):
    """The tile matrix sets."""

    tileMatrixSets: list[TileMatrixSetItem]


# === What every answer under /ogc has in common.


JSON = "application/json"
GEOJSON = "application/geo+json"
SCHEMA = "application/schema+json"
QUERYABLES_REL = "http://www.opengis.net/def/rel/ogc/1.0/queryables"
OPENAPI = "application/vnd.oai.openapi+json;version=3.0"
HTML = "text/html"
MVT = "application/vnd.mapbox-vector-tile"
MAP_STYLE = "application/vnd.mapbox.style+json"
_OPTIONS = orjson.OPT_NAIVE_UTC | orjson.OPT_UTC_Z
_QUALITY = re.compile(r"0(\.[0-9]{0,3})?|1(\.0{0,3})?", re.ASCII)
_HOST = re.compile(r"[A-Za-z0-9.\-]+(:[0-9]{1,5})?|\[[0-9A-Fa-f:.]+\](:[0-9]{1,5})?", re.ASCII)
_PREFIX = re.compile(r"(/[A-Za-z0-9._~\-]+)*/?", re.ASCII)


def base_url(request: Request) -> str:
    """Where the client reaches /ogc: as the deployment says, or as the proxy or the client says."""
    configured: str = request.app.state.public_url
    if configured:
        return f"{configured}/ogc"
    headers = request.headers
    scheme = _first(headers.get("x-forwarded-proto"))
    scheme = scheme if scheme in ("http", "https") else request.url.scheme
    host = _first(headers.get("x-forwarded-host")) or headers.get("host", "")
    prefix = _first(headers.get("x-forwarded-prefix"))
    if not _HOST.fullmatch(host):
        host = request.url.netloc
    if not _PREFIX.fullmatch(prefix):
        prefix = ""
    return f"{scheme}://{host}{prefix.rstrip('/')}/ogc"


def _first(header: str | None) -> str:
    return (header or "").partition(",")[0].strip()


def link(href: str, rel: str, kind: str, title: str | None = None) -> Link:
    """A link."""
    made: Link = {"href": href, "rel": rel, "type": kind}
    if title is not None:
        made["title"] = title
    return made


def with_query(url: str, pairs: list[tuple[str, str]]) -> str:
    """A URL with parameters."""
    return f"{url}?{urlencode(pairs)}" if pairs else url


def negotiate(
    request: Request, form: str | None, *kinds: str, names: tuple[str, ...] = ("json",), html: bool = False
) -> bool:
    """Whether the client is to get HTML. A client that wants none of these media types is refused.

    Parameters
    ----------
    form : str or None
        The parameter `f`; it wins over the Accept header.
    kinds : str
        Media types of the document, the first of which any client gets that accepts everything.
    names : tuple of str
        What `f` may name besides html.
    html : bool
        Whether there is a page as well.

    Raises
    ------
    MalformedRequest
        `f` names another format.
    HTTPException
        406: the Accept header names others only.
    """
    names = (*names, "html") if html else names
    if form is not None:
        if form not in names:
            refuse("f", "this format is not offered", ", ".join(names))
        return form == "html"
    accepted = request.headers.get("accept")
    if accepted is None:
        return False
    wanted = _weights(accepted)
    anything = max(wanted.get("*/*", 0.0), wanted.get("application/*", 0.0))
    document = max((wanted.get(kind.partition(";")[0], anything) for kind in kinds), default=0.0)
    page = max(wanted.get(name, 0.0) for name in (HTML, "text/*")) if html else 0.0
    if max(document, page) == 0.0:
        raise HTTPException(406, f"this is sent as {', '.join((*kinds, HTML) if html else kinds)}")
    return page > document


def _weights(accepted: str) -> dict[str, float]:
    """The quality of each media type of an Accept header (RFC 9110, 12.5.1); one that cannot be read is 1."""
    found: dict[str, float] = {}
    for part in accepted.lower().split(","):
        kind, *parameters = (piece.strip() for piece in part.split(";"))
        quality = next((text[2:].strip() for text in parameters if text.startswith("q=")), "1")
        found[kind] = float(quality) if _QUALITY.fullmatch(quality) else 1.0
    return found


def answer(
    content: object,
    kind: str = JSON,
    *,
    status: int = 200,
    crs: AnyCrs | None = None,
    headers: dict[str, str] | None = None,
) -> Response:
    """A JSON document, as the key's owner alone may keep it."""
    sent = {"Cache-Control": "private, no-cache", **(headers or {})}
    if crs is not None:
        sent["Content-Crs"] = f"<{crs}>"
    return Response(orjson.dumps(content, option=_OPTIONS), status, sent, media_type=kind)


# === How routes under /ogc are described, and the threads of the costly ones.


_THREADS = ThreadPoolExecutor(max(2, min(os.cpu_count() or 1, 4)), "ogc")
"""For pages and tiles: more threads would only wait for each other, and each for a connection."""


class ReadDescription(TypedDict):
    """Arguments of a route that reads."""

    responses: Described
    openapi_extra: dict[str, object]


def describe_read(
    model: type, media_type: str = JSON, *, html: bool = True, parameters: tuple[str, ...] = ONLY_FORMAT
) -> ReadDescription:
    """Describe a route that returns a document, unless it has no `html` as a page, too.

    Parameters
    ----------
    parameters : tuple of str
        Names of its query parameters.
    """
    is_open = model is JsonObject
    schema = {"type": "object", "additionalProperties": True} if is_open else reference(model, "serialization")
    content = {media_type: {"schema": schema}, **({HTML: {"schema": {"type": "string"}}} if html else {})}
    formats = ("json", "html") if html else ("json",)
    return {
        "responses": {200: {"description": "OK", "content": content}, **problem_responses(404, 406)},
        "openapi_extra": {"parameters": [described(name, formats) for name in parameters]},
    }


def in_own_threads(endpoint: Callable[Asked, Response]) -> Callable[Asked, Coroutine[Any, Any, Response]]:
    """An endpoint that runs in the threads for pages and tiles."""

    @wraps(endpoint)
    async def run(*values: Asked.args, **named: Asked.kwargs) -> Response:
        watch_client()
        context, call = copy_context(), partial(endpoint, *values, **named)
        return await asyncio.get_running_loop().run_in_executor(_THREADS, lambda: context.run(counted, call))

    return run


# === What the routes of /ogc ask for, as FastAPI dependencies: the collection, the feature, the query, the base URL.


_GEOJSON_NAMES = ("json", "geojson")
_FEATURE_ID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}(\.[0-9]{5,7})?", re.ASCII)


async def get_named_collection(
    collection: Annotated[str, Path(description="Id of the collection.")],
) -> Collection:
    """The collection that the path names."""
    return get_collection(collection)


CollectionOf = Annotated[Collection, Depends(get_named_collection)]


async def get_editable_collection(collection: CollectionOf) -> Collection:
    """The collection that the path names, if clients may edit it.

    Raises
    ------
    InvalidParameter
        It is read only.
    """
    if not collection.editable:
        raise InvalidParameter("this collection is read only", field="collectionId", limit="markers can be edited")
    return collection


async def get_feature_id(
    collection: CollectionOf, feature: Annotated[str, Path(description="Id of the feature.")]
) -> str:
    """The feature's id in the path.

    Raises
    ------
    NotFound
        No feature has such an id.
    """
    if not _FEATURE_ID.fullmatch(feature):
        raise no_feature(collection)
    return feature


async def get_items_query(request: FastapiRequest, collection: CollectionOf) -> ItemsQuery:
    """The query of a request for items, whose client takes GeoJSON or HTML."""
    pairs = query_pairs(request)
    form = next((value for name, value in pairs if name == "f"), None)
    is_page = negotiate(request, form, GEOJSON, JSON, names=_GEOJSON_NAMES, html=True)
    return items_query(pairs, collection, is_page=is_page)


@dataclass(frozen=True, slots=True)
class ItemQuery:
    """What a request for one item asks for: parameters as they were sent, the CRS, and whether it wants HTML."""

    pairs: list[tuple[str, str]]
    crs: AnyCrs
    is_page: bool


async def get_item_query(request: FastapiRequest, _collection: CollectionOf) -> ItemQuery:
    """The query of a request for one item, whose client takes GeoJSON or HTML."""
    found = known_parameters(request, OF_ITEM)
    crs = crs_parameter(found, "crs")
    is_page = negotiate(request, found.get("f"), GEOJSON, JSON, names=_GEOJSON_NAMES, html=True)
    return ItemQuery(list(found.items()), crs, is_page)


async def refuse_parameters(request: FastapiRequest) -> None:
    """Refuse every query parameter."""
    known_parameters(request, ())


class Offers:
    """A dependency: whether a client gets HTML.

    It refuses clients that take none of the offered media types, and parameters other than `f`.
    """

    def __init__(self, *kinds: str, names: tuple[str, ...] = ("json",), html: bool = False) -> None:
        self._kinds = kinds
        self._names = names
        self._html = html

    async def __call__(self, request: FastapiRequest) -> bool:
        """Check one request."""
        form = known_parameters(request, ONLY_FORMAT).get("f")
        return negotiate(request, form, *self._kinds, names=self._names, html=self._html)


async def get_base_url(request: FastapiRequest) -> str:
    """The URL at which the client reaches /ogc."""
    return base_url(request)


EditableCollection = Annotated[Collection, Depends(get_editable_collection)]
FeatureId = Annotated[str, Depends(get_feature_id)]
FeaturesService = Annotated[Features, use_case(lambda cases: cases.features)]
ItemsQueryOf = Annotated[ItemsQuery, Depends(get_items_query)]
ItemQueryOf = Annotated[ItemQuery, Depends(get_item_query)]
BaseUrl = Annotated[str, Depends(get_base_url)]
