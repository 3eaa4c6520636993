"""The parameters of requests under /ogc in one list: /ogc/api, /openapi.json and the query's reader use it."""

from __future__ import annotations

from typing import Any, NamedTuple

from app.api.ogc.cql2 import LANGUAGES
from app.services.markers.feature_crs import STORAGE_CRS, FeatureCrs
from app.services.markers.features import COLLECTIONS, Collection

DEFAULT_LIMIT = 1000
MAX_LIMIT = 10_000
DEFAULT_HTML_LIMIT = 100
MAX_HTML_LIMIT = 1000
"""In HTML: browsers draw all rows of a table before they show one."""
_CRS = {"type": "string", "format": "uri", "enum": list(FeatureCrs), "default": STORAGE_CRS}
_NUMBERS = {"type": "array", "minItems": 4, "maxItems": 6, "items": {"type": "number"}}


class Parameter(NamedTuple):
    """A query parameter: its JSON schema, and its description."""

    schema: dict[str, Any]
    text: str


_COMMON = {
    "f": Parameter({"type": "string", "enum": ["json", "html"]}, "Format; without it the Accept header decides"),
    "crs": Parameter(_CRS, "CRS of the response, its axes in the authority's order"),
    "bbox": Parameter(_NUMBERS, "west,south,east,north; west is greater across the antimeridian"),
    "bbox-crs": Parameter(_CRS, "CRS of bbox"),
    "datetime": Parameter({"type": "string"}, "Last change: a moment, a/b, ../b or a/.."),
    "limit": Parameter(
        {"type": "integer", "minimum": 1, "maximum": MAX_LIMIT, "default": DEFAULT_LIMIT},
        "Features on a page; a number beyond the bounds is set to the nearest bound",
    ),
    "after": Parameter({"type": "string"}, "Last id of the page before; next links have it"),
    "earlier": Parameter({"type": "string"}, "Starts of the pages before, in HTML; links of pages have it"),
    "resultType": Parameter(
        {"type": "string", "enum": ["results", "hits"], "default": "results"}, "hits: only numberMatched"
    ),
    "count": Parameter({"type": "boolean", "default": False}, "numberMatched with every page"),
    "filter": Parameter({"type": "string"}, "An expression on the properties, in the language filter-lang"),
    "filter-lang": Parameter({"type": "string", "enum": LANGUAGES, "default": LANGUAGES[0]}, "Language of filter"),
    "filter-crs": Parameter(_CRS, "CRS of positions in filter; expressions have none"),
}
_OF_TILES = {
    "groups": Parameter(
        {"type": "boolean", "default": False},
        "Where a tile has too many features: the layer of groups, with their numbers, in place of single features",
    )
}
_FIELDS = {
    field.name: field
    for collection in reversed(COLLECTIONS.values())  # of equal names the first collection's description is kept
    for field in collection.fields
    if field.name in collection.filters
}
PARAMETERS = (
    _COMMON
    | _OF_TILES
    | {name: Parameter({"type": field.kind}, f"{field.text}: equal to this") for name, field in sorted(_FIELDS.items())}
)
ONLY_FORMAT = ("f",)
OF_TILE = ("f", *_OF_TILES)
OF_ITEM = ("f", "crs")
OF_ITEMS = tuple(_COMMON)


def list_parameters(collection: Collection) -> tuple[str, ...]:
    """Names of the parameters that a request for items of a collection may have."""
    return (*OF_ITEMS, *collection.filters)


def described(name: str, formats: tuple[str, ...] = ("json", "html")) -> dict[str, Any]:
    """A query parameter as OpenAPI describes it, of a route that offers some formats."""
    parameter = PARAMETERS[name]
    schema = {"type": "string", "enum": list(formats)} if name == "f" else parameter.schema
    return {
        "name": name,
        "in": "query",
        "required": False,
        "style": "form",
        "explode": False,
        "description": parameter.text,
        "schema": schema,
    }
