"""OGC API Features: pages of features, and single ones."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import cast

import orjson
from starlette.responses import Response

from app.api.http.dependencies import Caller
from app.api.http.permissions import READERS
from app.api.http.routes import Router
from app.api.ogc.pages import html_response, item_page, items_page
from app.api.ogc.query import OF_ITEM, OF_ITEMS, OF_TILE, PARAMETERS, ItemsQuery
from app.api.ogc.responses import (
    GEOJSON,
    HTML,
    JSON,
    QUERYABLES_REL,
    SCHEMA,
    BaseUrl,
    CollectionOf,
    Feature,
    FeatureId,
    FeaturePage,
    FeaturesService,
    ItemQueryOf,
    ItemsQueryOf,
    Link,
    answer,
    describe_read,
    in_own_threads,
    link,
    with_query,
)
from app.services.access.access import Caller as CallerValue
from app.services.markers.features import Collection, Features

router = Router("/ogc/collections/{collection}/items", "ogc")
_FILTERS = [name for name in PARAMETERS if name not in (*OF_ITEMS, *OF_TILE)]


@router.get("", READERS, **describe_read(FeaturePage, GEOJSON, parameters=(*OF_ITEMS, *_FILTERS)))
@in_own_threads
def list_items(
    collection: CollectionOf, query: ItemsQueryOf, base: BaseUrl, caller: Caller, features: FeaturesService
) -> Response:
    """List the features of a collection.

    A page of them, or with `resultType=hits` how many there are.
    """
    queryables = f'<{base}/collections/{collection.id}/queryables>; rel="{QUERYABLES_REL}"; type="{SCHEMA}"'
    response = _list_items(collection, query, base, caller, features)
    response.headers["Link"] = queryables
    return response


def _list_items(
    collection: Collection, query: ItemsQuery, base: str, caller: CallerValue, features: Features
) -> Response:
    if query.hits:
        links = _links(query, f"{base}/collections/{collection.id}", None)
        hits = _hits(features.count(caller, collection, query.filtered), links)
        if query.is_page:
            return html_response(items_page(base, collection, query, hits, None))
        return answer(hits, GEOJSON, crs=query.crs)
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


@router.get("/{feature}", READERS, **describe_read(Feature, GEOJSON, parameters=OF_ITEM))
def get_item(
    collection: CollectionOf,
    query: ItemQueryOf,
    feature_id: FeatureId,
    base: BaseUrl,
    caller: Caller,
    features: FeaturesService,
) -> Response:
    """Get a feature."""
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
        return html_response(item_page(base, collection, str(query.crs), query.pairs, feature))
    version = feature["properties"].get("version")
    return answer(document, GEOJSON, crs=query.crs, headers={"ETag": f'"{version}"'} if version is not None else None)


def _hits(matched: int, links: list[Link]) -> FeaturePage:
    return {
        "type": "FeatureCollection",
        "timeStamp": datetime.now(UTC),
        "numberReturned": 0,
        "numberMatched": matched,
        "links": links,
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
