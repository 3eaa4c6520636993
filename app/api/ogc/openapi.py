"""/ogc/api by hand: the clients want OpenAPI 3.0, a literal path for each collection, and parameters named like fields.

GDAL pushes `code = '7'` down to the server only if the path's parameters list `code`; QGIS takes its page size from
`components.parameters.limit`.
"""

from __future__ import annotations

from typing import Any

from app import __version__
from app.api.ogc.cql2 import LANGUAGES
from app.api.ogc.query import DEFAULT_LIMIT, MAX_LIMIT, list_parameters
from app.api.ogc.responses import GEOJSON, JSON, SCHEMA
from app.registry.features import FIELDS_BY_NAME
from app.services.feature_crs import STORAGE_CRS, FeatureCrs
from app.services.features import COLLECTIONS, Collection

_PROBLEM = {
    "description": "A problem document (RFC 9457)",
    "content": {"application/problem+json": {"schema": {"type": "object"}}},
}


def api_document(base: str) -> dict[str, Any]:
    """The OpenAPI document of /ogc for a server that is reached at `base`."""
    paths: dict[str, Any] = {
        "/": _read("Landing page"),
        "/conformance": _read("Conformance classes"),
        "/api": _read("This document"),
        "/collections": _read("Collections"),
    }
    for collection in COLLECTIONS.values():
        paths |= _paths(collection)
    return {
        "openapi": "3.0.3",
        "info": {
            "title": "Waymark",
            "version": __version__,
            "description": "Road markers as OGC API Features. Send your key as `Authorization: Bearer KEY` or "
            "`X-API-Key: KEY`.",
        },
        "servers": [{"url": base}],
        "security": [{"bearer": []}, {"apiKey": []}],
        "paths": paths,
        "components": {
            "parameters": _parameters(),
            "responses": {"Problem": _PROBLEM},
            "securitySchemes": {
                "bearer": {"type": "http", "scheme": "bearer"},
                "apiKey": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
            },
        },
    }


def _paths(collection: Collection) -> dict[str, Any]:
    url, name = f"/collections/{collection.id}", collection.title
    items = _read(f"{name}: a page", GEOJSON, list_parameters(collection))
    item = _read(f"{name}: one", GEOJSON, ("f", "crs"))
    item["parameters"] = [{"$ref": "#/components/parameters/featureId"}]
    return {
        url: _read(name),
        f"{url}/schema": _read(f"{name}: schema", SCHEMA),
        f"{url}/queryables": _read(f"{name}: what can be asked of the properties", SCHEMA),
        f"{url}/items": items,
        f"{url}/items/{{featureId}}": item,
    }


def _read(summary: str, kind: str = JSON, parameters: tuple[str, ...] = ("f",)) -> dict[str, Any]:
    return {
        "get": {
            "summary": summary,
            "parameters": [{"$ref": f"#/components/parameters/{name}"} for name in parameters],
            "responses": {
                "200": {"description": summary, "content": {kind: {"schema": {"type": "object"}}}},
                "4XX": {"$ref": "#/components/responses/Problem"},
            },
        }
    }


def _query(name: str, schema: dict[str, Any], text: str) -> dict[str, Any]:
    return {
        "name": name,
        "in": "query",
        "required": False,
        "style": "form",
        "explode": False,
        "description": text,
        "schema": schema,
    }


def _parameters() -> dict[str, Any]:
    crs = {"type": "string", "format": "uri", "enum": list(FeatureCrs), "default": STORAGE_CRS}
    numbers = {"type": "array", "minItems": 4, "maxItems": 6, "items": {"type": "number"}}
    limit = {"type": "integer", "minimum": 1, "maximum": MAX_LIMIT, "default": DEFAULT_LIMIT}
    whole = {"type": "string", "enum": ["results", "hits"], "default": "results"}
    parameters = {
        "f": _query("f", {"type": "string", "enum": ["json"]}, "Format"),
        "crs": _query("crs", crs, "CRS of the answer, its axes in the authority's order"),
        "bbox": _query("bbox", numbers, "west,south,east,north; west is greater across the antimeridian"),
        "bbox-crs": _query("bbox-crs", crs, "CRS of bbox"),
        "datetime": _query("datetime", {"type": "string"}, "Last change: a moment, a/b, ../b or a/.."),
        "limit": _query("limit", limit, "Features on a page; what is beyond the bounds is brought back to them"),
        "after": _query("after", {"type": "string"}, "Last id of the page before; next links have it"),
        "resultType": _query("resultType", whole, "hits: only numberMatched"),
        "count": _query("count", {"type": "boolean", "default": False}, "numberMatched with every page"),
        "filter": _query("filter", {"type": "string"}, "An expression on the properties, as filter-lang says"),
        "filter-lang": _query(
            "filter-lang", {"type": "string", "enum": LANGUAGES, "default": LANGUAGES[0]}, "Language"
        ),
        "filter-crs": _query("filter-crs", crs, "CRS of places in filter, of which there are none"),
        "featureId": {"name": "featureId", "in": "path", "required": True, "schema": {"type": "string"}},
    }
    for name in sorted({name for collection in COLLECTIONS.values() for name in collection.filters}):
        if name in FIELDS_BY_NAME:
            field = FIELDS_BY_NAME[name]
            parameters[name] = _query(name, {"type": field.kind}, f"{field.text}: equal to this")
    return parameters
