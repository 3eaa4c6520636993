"""The documents and features of /ogc as HTML pages: for people who follow a link, without scripts or inline styles."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import orjson
from starlette.responses import Response

from app.api.http.ui import PAGE_HEADERS
from app.api.ogc.query import ItemsQuery
from app.api.ogc.responses import (
    GEOJSON,
    HTML,
    JSON,
    OPENAPI,
    SCHEMA,
    CollectionDocument,
    FeaturePage,
    LandingPage,
    with_query,
)
from app.api.templates import render_page
from app.services.markers.features import Collection

_KEPT_PAGES = 100
"""Earlier pages that a page can lead back to: the address of a page names them, and has a longest length."""
_CUT = "*"
_AXES = {"Point": "Position", "LineString": "Course"}


class Alternate(NamedTuple):
    """The same resource in another format."""

    href: str
    media_type: str
    text: str


class _Row(NamedTuple):
    """A feature in a table."""

    id: str
    href: str
    place: str
    values: list[str]  # of the fields of its collection


def html_response(page: str) -> Response:
    """A page, which the key's owner alone may keep, and which may load nothing but this server's files."""
    headers = PAGE_HEADERS | {"Cache-Control": "private, no-cache", "Vary": "Accept"}
    return Response(page, headers=headers, media_type=HTML)


def landing_page(base: str, document: LandingPage) -> str:
    """Where everything is."""
    links = [link for link in document["links"] if link["rel"] not in ("self", "alternate", "service-desc")]
    alternate = Alternate(f"{base}/?f=json", JSON, "JSON")
    values = {"description": document["description"], "links": links}
    return _page("landing.html", base, document["title"], alternate, None, **values)


def conformance_page(base: str, classes: Sequence[str]) -> str:
    """The conformance classes."""
    alternate = Alternate(f"{base}/conformance?f=json", JSON, "JSON")
    return _page("conformance.html", base, "Conformance classes", alternate, classes=classes)


def api_page(base: str, document: Mapping[str, Any]) -> str:
    """What the API offers GIS clients."""
    parameters = document["components"]["parameters"]
    resources = []
    for path, operations in document["paths"].items():
        operation = operations["get"]
        names = [parameters[part["$ref"].rsplit("/", 1)[1]]["name"] for part in operation["parameters"]]
        resources.append((path, operation["summary"], ", ".join(names)))
    alternate = Alternate(f"{base}/api?f=json", OPENAPI, "OpenAPI 3.0")
    values = {"description": document["info"]["description"], "resources": resources}
    return _page("api.html", base, "API", alternate, **values)


def collections_page(base: str, documents: Iterable[CollectionDocument]) -> str:
    """All collections."""
    collections = [(document, _extent(document)) for document in documents]
    alternate = Alternate(f"{base}/collections?f=json", JSON, "JSON")
    return _page("collections.html", base, "Collections", alternate, collections=collections)


def collection_page(base: str, document: CollectionDocument, collection: Collection) -> str:
    """A collection: its features, its properties, and its other resources."""
    url = f"{base}/collections/{collection.id}"
    links = [link for link in document["links"] if link["rel"] not in ("self", "items", "alternate", "describedBy")]
    return _page(
        "collection.html",
        base,
        collection.title,
        Alternate(f"{url}?f=json", JSON, "JSON"),
        [(f"{base}/collections", "Collections")],
        url=url,
        document=document,
        collection=collection,
        extent=_extent(document),
        interval=_interval(document),
        links=links,
    )


def schema_page(base: str, collection: Collection, name: str, title: str) -> str:
    """A schema of a collection: its properties."""
    url = f"{base}/collections/{collection.id}"
    alternate = Alternate(f"{url}/{name}?f=json", SCHEMA, "JSON Schema")
    return _page("schema.html", base, title, alternate, _trail(base, collection), collection=collection)


def items_page(base: str, collection: Collection, query: ItemsQuery, document: FeaturePage, after: str | None) -> str:
    """A page of features as a table, with links to the pages beside it."""
    url = f"{base}/collections/{collection.id}/items"
    matched = document.get("numberMatched")
    count = f"{document['numberReturned']} features on this page"
    of_item = [pair for pair in query.pairs if pair[0] in ("f", "crs")]
    features = [
        _Row(
            feature["id"],
            with_query(f"{url}/{feature['id']}", of_item),
            _place(feature["geometry"]),
            [_value(feature["properties"].get(field.name)) for field in collection.fields],
        )
        for feature in document["features"]
    ]
    plain = [(name, value) for name, value in query.pairs if name not in ("f", "earlier")]
    return _page(
        "items.html",
        base,
        f"Features of {collection.title}",
        Alternate(with_query(url, [*plain, ("f", "json")]), GEOJSON, "GeoJSON"),
        _trail(base, collection),
        caption=count if matched is None else f"{count}, {matched} in all",
        place=f"{_AXES[collection.geometry]} ({'lon, lat' if query.crs.is_storage else 'in the CRS of the request'})",
        collection=collection,
        features=features,
        pages=_page_links(url, query, after),
    )


def item_page(
    base: str, collection: Collection, crs: str, pairs: list[tuple[str, str]], feature: Mapping[str, Any]
) -> str:
    """One feature: its place and its properties."""
    url = f"{base}/collections/{collection.id}/items"
    plain = [(name, value) for name, value in pairs if name != "f"]
    return _page(
        "item.html",
        base,
        f"{collection.title}: {feature['id']}",
        Alternate(with_query(f"{url}/{feature['id']}", [*plain, ("f", "json")]), GEOJSON, "GeoJSON"),
        [*_trail(base, collection), (url, "Features")],
        geometry=_AXES[collection.geometry],
        place=_place(feature["geometry"], whole=True),
        crs=crs,
        properties=[(field, _value(feature["properties"].get(field.name))) for field in collection.fields],
    )


def _page_links(url: str, query: ItemsQuery, after: str | None) -> list[tuple[str, str, str]]:
    """Relation, text and address of the pages beside a page."""
    rest = [(name, value) for name, value in query.pairs if name not in ("after", "earlier")]
    before = [*query.earlier]
    links = []
    if query.after is not None:
        links.append(("first", "First page", with_query(url, rest)))
        if before != [_CUT]:
            back = [("after", before[-1])] if before else []
            kept = [("earlier", ",".join(before[:-1]))] if len(before) > 1 else []
            links.append(("prev", "Previous page", with_query(url, [*rest, *back, *kept])))
    if after is not None:
        passed = [*before, query.after] if query.after is not None else []
        if len(passed) > _KEPT_PAGES:
            passed = [_CUT, *passed[-_KEPT_PAGES:]]
        kept = [("earlier", ",".join(passed))] if passed else []
        links.append(("next", "Next page", with_query(url, [*rest, ("after", after), *kept])))
    return links


def _page(
    template: str,
    base: str,
    title: str,
    alternate: Alternate,
    trail: Sequence[tuple[str, str]] | None = (),
    **values: object,
) -> str:
    """A page; `trail` has the pages above it below the landing page, which itself has none."""
    return render_page(
        f"ogc/{template}",
        base=base,
        root=base.removesuffix("/ogc"),
        title=title,
        alternate=alternate._replace(media_type=alternate.media_type.partition(";")[0]),
        trail=None if trail is None else [(f"{base}/", "Waymark"), *trail],
        **values,
    )


def _trail(base: str, collection: Collection) -> list[tuple[str, str]]:
    return [(f"{base}/collections", "Collections"), (f"{base}/collections/{collection.id}", collection.title)]


def _extent(document: CollectionDocument) -> str:
    if "extent" not in document:
        return "no features"
    west, south, east, north = document["extent"]["spatial"]["bbox"][0]
    return f"{west:.6g} to {east:.6g} deg east, {south:.6g} to {north:.6g} deg north"


def _interval(document: CollectionDocument) -> str:
    if "extent" not in document:
        return "none"
    first, last = document["extent"]["temporal"]["interval"][0]
    return " to ".join("open" if moment is None else f"{moment:%Y-%m-%d %H:%M} UTC" for moment in (first, last))


def _place(geometry: Mapping[str, Any] | None, *, whole: bool = False) -> str:
    """Coordinates; of a line its ends, unless all are wanted."""
    if geometry is None:
        return "outside the area of this CRS"
    coordinates = geometry["coordinates"]
    if geometry["type"] == "Point":
        return ", ".join(f"{number:.10g}" for number in coordinates)
    points = [", ".join(f"{number:.10g}" for number in point) for point in coordinates]
    return "; ".join(points) if whole else f"{points[0]} to {points[-1]}"


def _value(value: object) -> str:
    if value is None:
        return ""
    return value if isinstance(value, str) else orjson.dumps(value).decode()
