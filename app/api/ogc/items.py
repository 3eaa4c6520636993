"""Features: pages of them, and single ones."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from app.api.ogc.query import (
    ITEM_PARAMETERS,
    crs_parameter,
    items_query,
    known_parameters,
    query_pairs,
)
from app.api.ogc.responses import GEOJSON, JSON, answer, base_url, caller_of, link, negotiate, with_query
from app.services.features import LINES, Collection, Features, get_collection, no_feature

_NAMES = ("json", "geojson")
_MARKER_ID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}", re.ASCII)


def list_items(request: Request) -> Response:
    """A page of features, or how many there are."""
    collection = get_collection(request.path_params["collection"])
    asked = items_query(request, collection)
    negotiate(request, dict(query_pairs(request)), GEOJSON, JSON, names=_NAMES)
    features: Features = request.app.state.features
    caller = caller_of(request)
    if collection is LINES and asked.hits:
        return answer(_hits(features.count_lines(caller, asked.narrowed)), GEOJSON)
    if collection is LINES:
        page = features.lines(
            caller, asked.narrowed, after=asked.after, limit=asked.limit, crs=asked.crs, counted=asked.counted
        )
    elif asked.hits:
        return answer(_hits(features.count(caller, asked.narrowed)), GEOJSON)
    else:
        page = features.page(
            caller, asked.narrowed, after=asked.after, limit=asked.limit, crs=asked.crs, counted=asked.counted
        )
    document: dict[str, Any] = {
        "type": "FeatureCollection",
        "timeStamp": datetime.now(UTC),
        "numberReturned": page.returned,
    }
    if page.matched is not None:
        document["numberMatched"] = page.matched
    document["links"] = _links(request, collection, page.after)
    document["features"] = page.features
    return answer(document, GEOJSON, crs=asked.crs)


def get_item(request: Request) -> Response:
    """One feature."""
    collection = get_collection(request.path_params["collection"])
    found = known_parameters(request, ITEM_PARAMETERS)
    crs = crs_parameter(found, "crs")
    negotiate(request, found, GEOJSON, JSON, names=_NAMES)
    features: Features = request.app.state.features
    caller, wanted = caller_of(request), feature_id(request, collection)
    if collection is LINES:
        feature = features.get_line(caller, wanted, crs)
    else:
        feature = features.get(caller, collection, wanted, crs)
    url = f"{base_url(request)}/collections/{collection.id}"
    feature["links"] = [
        link(f"{url}/items/{feature['id']}", "self", GEOJSON),
        link(url, "collection", JSON),
    ]
    version = feature["properties"].get("version")
    return answer(feature, GEOJSON, crs=crs, headers={"ETag": f'"{version}"'} if version is not None else None)


def feature_id(request: Request, collection: Collection) -> str:
    """The id in the path, if it can be one.

    Raises
    ------
    NotFound
        It cannot.
    """
    given = str(request.path_params["feature"])
    if not _MARKER_ID.fullmatch(given):
        raise no_feature(collection)
    return given


def _hits(matched: int) -> dict[str, Any]:
    return {
        "type": "FeatureCollection",
        "timeStamp": datetime.now(UTC),
        "numberReturned": 0,
        "numberMatched": matched,
        "links": [],
        "features": [],
    }


def _links(request: Request, collection: Collection, after: str | None) -> list[dict[str, str]]:
    base = f"{base_url(request)}/collections/{collection.id}"
    pairs = query_pairs(request)
    links = [link(with_query(f"{base}/items", pairs), "self", GEOJSON), link(base, "collection", JSON)]
    if after is not None:
        onward = [*((name, value) for name, value in pairs if name != "after"), ("after", after)]
        links.append(link(with_query(f"{base}/items", onward), "next", GEOJSON))
    return links
