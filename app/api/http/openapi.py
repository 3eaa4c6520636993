"""The OpenAPI document: keys and problems are described once, for every route."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.routing import APIRoute

from app.api.http.components import component_schemas
from app.api.http.middleware import is_protected

DESCRIPTION = """The registry of machine-readable roads: coded plates, from a coordinate to a plate to print
to a decoded frame, and magnet tags, from a meaning to holes to drill.

Send your key as `Authorization: Bearer KEY` or `X-API-Key: KEY`. Every error is an RFC 9457 problem document that names
the field, the limit and the cure. Positions are longitude, latitude in degrees; headings are clockwise from true north.
"""


def operation_id(route: APIRoute) -> str:
    """The id of a route's operation, which generated clients take as a name: that of the route's function."""
    return route.name


def describe(app: FastAPI) -> None:
    """Replace the app's OpenAPI document by one with keys and problems."""

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = get_openapi(
                title=app.title, version=app.version, description=DESCRIPTION, routes=app.routes, license_info=_LICENSE
            )
            components = document.setdefault("components", {})
            components.setdefault("schemas", {}).update(component_schemas())
            components["securitySchemes"] = {
                "bearer": {"type": "http", "scheme": "bearer"},
                "apiKey": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
            }
            _require_keys(document)
            _describe_headers(document)
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]


_LICENSE = {"name": "Apache-2.0", "identifier": "Apache-2.0"}


def _require_keys(document: dict[str, Any]) -> None:
    for path, operations in document["paths"].items():
        if is_protected(path):
            for operation in operations.values():
                operation["security"] = [{"bearer": []}, {"apiKey": []}]


def _describe_headers(document: dict[str, Any]) -> None:
    """Headers are absent or texts, never null; clients must send If-Match where a route returns 428 without it."""
    for operations in document["paths"].values():
        for operation in operations.values():
            for parameter in operation.get("parameters", ()):
                if parameter["in"] == "header":
                    parameter["schema"] = {"type": "string"}
                    parameter["required"] = parameter["name"] == "If-Match" and "428" in operation["responses"]
