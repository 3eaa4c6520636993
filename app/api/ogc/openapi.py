"""/ogc/api by hand: the clients want OpenAPI 3.0, a literal path for each collection, and parameters named like fields.

GDAL pushes `code = '7'` down to the server only if the path's parameters list `code`; QGIS takes its page size from
`components.parameters.limit`.
"""

from __future__ import annotations

from typing import Any

from app import __version__
from app.api.http.credentials import SECURITY, SECURITY_SCHEMES
from app.api.ogc.parameters import OF_ITEM, ONLY_FORMAT, PARAMETERS, described, list_parameters
from app.api.ogc.responses import GEOJSON, JSON, SCHEMA
from app.services.markers.features import COLLECTIONS, Collection

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
            "description": "Road markers as OGC API Features. Send your key as `Authorization: Bearer KEY`, as "
            "`X-API-Key: KEY`, or as the password of HTTP Basic with any user name.",
        },
        "servers": [{"url": base}],
        "security": SECURITY,
        "paths": paths,
        "components": {
            "parameters": _parameters(),
            "responses": {"Problem": _PROBLEM},
            "securitySchemes": SECURITY_SCHEMES,
        },
    }


def _paths(collection: Collection) -> dict[str, Any]:
    url, name = f"/collections/{collection.id}", collection.title
    items = _read(f"{name}: a page", GEOJSON, list_parameters(collection))
    item = _read(f"{name}: one", GEOJSON, OF_ITEM)
    item["parameters"] = [{"$ref": "#/components/parameters/featureId"}]
    return {
        url: _read(name),
        f"{url}/schema": _read(f"{name}: schema", SCHEMA),
        f"{url}/geojson-schema": _read(f"{name}: schema in GeoJSON", SCHEMA),
        f"{url}/queryables": _read(f"{name}: what can be asked of the properties", SCHEMA),
        f"{url}/items": items,
        f"{url}/items/{{featureId}}": item,
    }


def _read(summary: str, kind: str = JSON, parameters: tuple[str, ...] = ONLY_FORMAT) -> dict[str, Any]:
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


def _parameters() -> dict[str, Any]:
    feature = {"name": "featureId", "in": "path", "required": True, "schema": {"type": "string"}}
    return {name: described(name) for name in PARAMETERS} | {"featureId": feature}
