"""The documents and features of /ogc as HTML pages: for people who follow a link, without scripts or inline styles."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any, NamedTuple, TypeAlias

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
from app.services.markers.features import Collection

# === HTML by functions: every text is escaped, unless it is the result of one of them.


_VOID = ("link", "meta")


class Markup(str):
    """A text that is HTML already."""

    __slots__ = ()


Content: TypeAlias = "str | Iterable[str] | None"


def element(name: str, /, *content: Content, **attributes: str | None) -> Markup:
    """An element.

    Parameters
    ----------
    name : str
    content : str, or iterable of str
        Texts, which are escaped, and elements. None is left out.
    attributes : str
        Their values, escaped. ``class_`` stands for ``class``, ``aria_label`` for ``aria-label``; None is left out.
    """
    given = "".join(
        f' {attribute.rstrip("_").replace("_", "-")}="{escape(value)}"'
        for attribute, value in attributes.items()
        if value is not None
    )
    if name in _VOID:
        return Markup(f"<{name}{given}>")
    return Markup(f"<{name}{given}>{joined(content)}</{name}>")


def joined(content: Iterable[Content]) -> Markup:
    """Texts and elements one after the other."""
    pieces: list[str] = []
    for part in content:
        if part is None:
            continue
        for text in (part,) if isinstance(part, str) else part:
            pieces.append(text if isinstance(text, Markup) else escape(text))
    return Markup("".join(pieces))


def anchor(href: str, text: str, **attributes: str | None) -> Markup:
    """A link."""
    return element("a", text, href=href, **attributes)


def table(caption: str, columns: Iterable[Content], rows: Iterable[Iterable[Content]], **attributes: str) -> Markup:
    """A table whose first column names its rows, in a region that scrolls by keyboard as well where it is too wide."""
    head = element("tr", (element("th", column, scope="col") for column in columns))
    body = (
        element("tr", (element("td" if k else "th", cell, scope=None if k else "row") for k, cell in enumerate(row)))
        for row in rows
    )
    made = element("table", element("caption", caption), element("thead", head), element("tbody", body), **attributes)
    return element("div", made, class_="wide", role="region", aria_label=caption, tabindex="0")


# === The documents and features of /ogc as HTML pages.


_KEPT_PAGES = 100
"""Earlier pages that a page can lead back to: the address of a page names them, and has a longest length."""
_CUT = "*"
_AXES = {"Point": ("Position", "positions"), "LineString": ("Course", "courses")}


class Alternate(NamedTuple):
    """The same resource in another format."""

    href: str
    kind: str
    text: str


def html_response(page: Markup) -> Response:
    """A page, which the key's owner alone may keep, and which may load nothing but this server's files."""
    headers = PAGE_HEADERS | {"Cache-Control": "private, no-cache", "Vary": "Accept"}
    return Response(f"<!doctype html>\n{page}\n", headers=headers, media_type=HTML)


def landing_page(base: str, document: LandingPage) -> Markup:
    """Where everything is."""
    links = [
        element("li", anchor(link["href"], link.get("title", link["rel"])))
        for link in document["links"]
        if link["rel"] not in ("self", "alternate", "service-desc")
    ]
    lead = element("p", document["description"], ". This is an OGC API for geographic information systems.")
    body = joined(
        (lead, element("ul", links, class_="links"), element("p", anchor(_root(base) + "/docs", "All of the API")))
    )
    return _page(base, document["title"], body, [Alternate(f"{base}/?f=json", JSON, "JSON")], None)


def conformance_page(base: str, classes: Sequence[str]) -> Markup:
    """The conformance classes."""
    body = element("ul", (element("li", element("code", uri)) for uri in classes))
    return _page(base, "Conformance classes", body, [Alternate(f"{base}/conformance?f=json", JSON, "JSON")])


def api_page(base: str, document: Mapping[str, Any]) -> Markup:
    """What the API offers GIS clients."""
    rows = (
        (element("code", path), operations["get"]["summary"], _parameter_names(document, operations["get"]))
        for path, operations in document["paths"].items()
    )
    body = joined(
        (element("p", document["info"]["description"]), table("Resources", ("Path", "What", "Parameters"), rows))
    )
    return _page(base, "API", body, [Alternate(f"{base}/api?f=json", OPENAPI, "OpenAPI 3.0")])


def _parameter_names(document: Mapping[str, Any], operation: Mapping[str, Any]) -> str:
    known = document["components"]["parameters"]
    return ", ".join(known[part["$ref"].rsplit("/", 1)[1]]["name"] for part in operation["parameters"])


def collections_page(base: str, documents: Iterable[CollectionDocument]) -> Markup:
    """All collections."""
    rows = (
        (
            anchor(f"{base}/collections/{found['id']}", found["title"]),
            found["description"],
            _extent(found),
            anchor(f"{base}/collections/{found['id']}/items", f"Features of {found['title']}"),
        )
        for found in documents
    )
    body = table("Collections", ("Collection", "What it contains", "Extent", "Features"), rows)
    return _page(base, "Collections", body, [Alternate(f"{base}/collections?f=json", JSON, "JSON")])


def collection_page(base: str, document: CollectionDocument, collection: Collection) -> Markup:
    """A collection: its features, its properties, and its other resources."""
    url = f"{base}/collections/{collection.id}"
    shown = [link for link in document["links"] if link["rel"] not in ("self", "items", "alternate", "describedBy")]
    facts = {
        "Extent": _extent(document),
        "Last change": _interval(document),
        "Stored in": element("code", document["storageCrs"]),
        "Offered in": joined(element("code", uri, class_="row") for uri in document["crs"]),
    }
    body = joined(
        (
            element("p", document["description"]),
            element("p", anchor(f"{url}/items", "Show the features", class_="button")),
            _facts(facts),
            _fields_table(collection),
            element("h2", "Further resources"),
            element("ul", (element("li", anchor(link["href"], link.get("title", link["rel"]))) for link in shown)),
        )
    )
    trail = [(f"{base}/collections", "Collections")]
    return _page(base, collection.title, body, [Alternate(f"{url}?f=json", JSON, "JSON")], trail)


def schema_page(base: str, collection: Collection, name: str, title: str) -> Markup:
    """A schema of a collection: its properties."""
    url = f"{base}/collections/{collection.id}"
    trail = [(f"{base}/collections", "Collections"), (url, collection.title)]
    alternates = [Alternate(f"{url}/{name}?f=json", SCHEMA, "JSON Schema")]
    return _page(base, title, _fields_table(collection), alternates, trail)


def items_page(
    base: str, collection: Collection, query: ItemsQuery, document: FeaturePage, after: str | None
) -> Markup:
    """A page of features as a table, with links to the pages beside it."""
    url = f"{base}/collections/{collection.id}/items"
    features = document["features"]
    matched = document.get("numberMatched")
    count = f"{document['numberReturned']} features on this page"
    caption = count if matched is None else f"{count}, {matched} in all"
    names = [field.name for field in collection.fields]
    rows = (
        (
            anchor(with_query(f"{url}/{feature['id']}", _crs_pairs(query)), feature["id"]),
            _place(feature["geometry"]),
            *(_value(feature["properties"].get(name)) for name in names),
        )
        for feature in features
    )
    heads = (element("span", field.name, title=field.text) for field in collection.fields)
    axes = f"{_AXES[collection.geometry][0]} ({'lon, lat' if query.crs.is_storage else 'in the CRS of the request'})"
    nav = _page_links(url, query, after)
    found = (
        table(caption, ("Id", axes, *heads), rows, class_="features")
        if features
        else element("p", "There are no such features.")
    )
    plain = [(name, value) for name, value in query.pairs if name not in ("f", "earlier")]
    alternates = [Alternate(with_query(url, [*plain, ("f", "json")]), GEOJSON, "GeoJSON")]
    trail = [(f"{base}/collections", "Collections"), (f"{base}/collections/{collection.id}", collection.title)]
    return _page(base, f"Features of {collection.title}", joined((nav, found, nav)), alternates, trail)


def item_page(
    base: str, collection: Collection, crs: str, pairs: list[tuple[str, str]], feature: Mapping[str, Any]
) -> Markup:
    """One feature: its place and its properties."""
    url = f"{base}/collections/{collection.id}"
    spot = table(
        _AXES[collection.geometry][0],
        ("Coordinates", "CRS"),
        [(_place(feature["geometry"], whole=True), element("code", crs))],
    )
    rows = ((field.name, _value(feature["properties"].get(field.name)), field.text) for field in collection.fields)
    body = joined((spot, table("Properties", ("Property", "Value", "Meaning"), rows)))
    plain = [(name, value) for name, value in pairs if name != "f"]
    alternates = [Alternate(with_query(f"{url}/items/{feature['id']}", [*plain, ("f", "json")]), GEOJSON, "GeoJSON")]
    trail = [
        (f"{base}/collections", "Collections"),
        (url, collection.title),
        (f"{url}/items", "Features"),
    ]
    return _page(base, f"{collection.title}: {feature['id']}", body, alternates, trail)


def _page_links(url: str, query: ItemsQuery, after: str | None) -> Markup | None:
    rest = [(name, value) for name, value in query.pairs if name not in ("after", "earlier")]
    before = [*query.earlier]
    links: list[Markup] = []
    if query.after is not None:
        links.append(anchor(with_query(url, rest), "First page", rel="first"))
        if before != [_CUT]:
            back = [("after", before[-1])] if before else []
            kept = [("earlier", ",".join(before[:-1]))] if len(before) > 1 else []
            links.append(anchor(with_query(url, [*rest, *back, *kept]), "Previous page", rel="prev"))
    if after is not None:
        passed = [*before, query.after] if query.after is not None else []
        if len(passed) > _KEPT_PAGES:
            passed = [_CUT, *passed[-_KEPT_PAGES:]]
        kept = [("earlier", ",".join(passed))] if passed else []
        links.append(anchor(with_query(url, [*rest, ("after", after), *kept]), "Next page", rel="next"))
    if not links:
        return None
    return element("nav", element("ul", (element("li", link) for link in links)), class_="pages", aria_label="Pages")


# --- parts ----------------------------------------------------------------------------------------------------------


def _page(
    base: str, title: str, body: Content, alternates: list[Alternate], trail: Sequence[tuple[str, str]] | None = ()
) -> Markup:
    """A page; `trail` has the pages above it below the landing page, which itself has none."""
    crumbs = [element("li", anchor(href, text)) for href, text in ((f"{base}/", "Waymark"), *(trail or ()))]
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", title if trail is None else f"{title} - Waymark"),
        element("link", rel="icon", href=f"{_root(base)}/static/favicon.svg", type="image/svg+xml"),
        element("link", rel="stylesheet", href=f"{_root(base)}/static/ogc.css"),
        *(element("link", rel="alternate", type=kind.partition(";")[0], href=href) for href, kind, _ in alternates),
    )
    formats = element(
        "p", "Also as: ", (anchor(href, text, type=kind.partition(";")[0]) for href, kind, text in alternates)
    )
    nav = None if trail is None else element("nav", element("ol", crumbs), class_="trail", aria_label="Breadcrumb")
    return element(
        "html",
        head,
        element(
            "body",
            anchor("#content", "Skip to the content", class_="skip"),
            element("header", nav, element("h1", title)),
            element("main", body, id="content", tabindex="-1"),
            element("footer", formats),
        ),
        lang="en",
    )


def _root(base: str) -> str:
    return base.removesuffix("/ogc")


def _crs_pairs(query: ItemsQuery) -> list[tuple[str, str]]:
    return [pair for pair in query.pairs if pair[0] in ("f", "crs")]


def _fields_table(collection: Collection) -> Markup:
    rows = ((element("code", field.name), field.kind, field.text) for field in collection.fields)
    return table("Properties", ("Name", "Type", "Meaning"), rows)


def _facts(facts: Mapping[str, Content]) -> Markup:
    return element("dl", (joined((element("dt", name), element("dd", fact))) for name, fact in facts.items()))


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


def _place(geometry: Mapping[str, Any], *, whole: bool = False) -> str:
    """Coordinates; of a line its ends, unless all are wanted."""
    coordinates = geometry["coordinates"]
    if geometry["type"] == "Point":
        return ", ".join(f"{number:.10g}" for number in coordinates)
    points = [", ".join(f"{number:.10g}" for number in point) for point in coordinates]
    return "; ".join(points) if whole else f"{points[0]} to {points[-1]}"


def _value(value: Any) -> str:
    if value is None:
        return ""
    return value if isinstance(value, str) else orjson.dumps(value).decode()
