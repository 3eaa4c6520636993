"""The OpenAPI document: keys and problems are described once, for every route.

The server sends a stored copy: making the document takes seconds. `python -m tests.stored_openapi` writes the copy, and
a test compares it with the app's own document, which does not depend on settings.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.routing import APIRoute

from app.api.http.middleware import is_protected
from app.api.http.permissions import SECURITY, SECURITY_SCHEMES
from app.api.http.problems import MEDIA_TYPE, Mode, component_schemas
from app.values import JsonObject

_RESPONSES = "#/components/responses/"
STORED = Path(__file__).with_name("data") / "openapi.json"
DESCRIPTION = """The registry of machine-readable roads: coded plates, magnet tags, radio markers (CERPMs) and fiducial
signs, from the plan of a road to artwork and surveys, and to the decoded uploads and drives of vehicles.

Send your key as `Authorization: Bearer KEY`, as `X-API-Key: KEY`, or as the password of HTTP Basic with any user name.
Every error is an RFC 9457 problem document that names the field, the limit and the cure. Positions are longitude,
latitude in degrees; headings are clockwise from true north.
"""

_TAGS = {
    "access": (
        "Keys and agencies. An admin of an agency manages its keys at `/v1/keys`. The server's operator creates an"
        " agency and its first admin key with `POST /v1/agencies`, using a key that `waymark key --operator` printed on"
        " the server's machine."
    ),
    "roads": "Road axes, stations along them, and the markers beside them.",
    "imports": "Surveys and tables that become markers.",
    "markers": "Markers of every family: surveyed positions, states, history, bulk writes and searches.",
    "codebooks": "Meanings of magnet tags.",
    "artwork": "Printable plates and signs with proofs of what a camera reads, and drilling sheets of magnet tags.",
    "cerpms": "Radio markers: keys, frames, and how far they are received.",
    "plans": "Plans of a road: alignments, rules, placement, proofs, files for crews, and commits.",
    "fleet": "Vehicles, cameras and their calibrations.",
    "uploads": "Files that vehicles send: in one request, resumed, or in parts of an S3 store.",
    "decodes": "What was read in photos, videos, traces and packet logs, against the registry.",
    "drives": "Several decodes of one vehicle as one track.",
    "marker health": "Markers that vehicles found missing, moved, cloned, reversed or fading; people decide.",
    "public pages": "Pages of markers that need no key, what agencies release on them, and damage reports.",
    "reprocessing": "New versions of the decoders over stored uploads, and what they change.",
    "snapshots": "Files of the registry for vehicles that decode offline.",
    "exports": "Markers as files.",
    "ogc": "OGC API Features and Tiles, for GIS clients.",
    "jobs": "Work that goes on after the answer: state, progress, cancellation.",
    "events": "What happened, as it happens.",
    "webhooks": "Signed messages to your server when jobs end and markers become suspect.",
    "audit": "The log of all changes, chained by hashes.",
    "system": "Health of the server, and what it runs.",
}
"""The parts of the API in the order of a user's work, in which /docs shows them."""


def operation_id(route: APIRoute) -> str:
    """The id of a route's operation, which generated clients take as a name: that of the route's function."""
    return route.name


def describe(app: FastAPI) -> None:
    """Replace the app's OpenAPI document by one with keys and problems."""

    def openapi() -> JsonObject:
        if app.openapi_schema is None:
            document = get_openapi(
                title=app.title, version=app.version, description=DESCRIPTION, routes=app.routes, license_info=_LICENSE,
                tags=[{"name": name, "description": description} for name, description in _TAGS.items()],
            )  # fmt: skip
            components = document.setdefault("components", {})
            models = component_schemas(_models_of(app))  # X-Input and X-Output of what requests and responses have
            others = {name: schema for name, schema in components["schemas"].items() if f"{name}-Input" not in models}
            schemas = others | models
            for name in schemas:
                if name.endswith(("-Input", "-Output")):  # generated clients take titles as names of classes
                    schemas[name]["title"] = name.replace("-", "")
            components["schemas"] = dict(sorted(schemas.items()))  # else in the order of the first requests
            components["securitySchemes"] = SECURITY_SCHEMES
            components["responses"] = _share_problems(document)
            _require_keys(document)
            _describe_headers(document)
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]


def _models_of(app: FastAPI) -> Iterator[tuple[Any, Mode]]:
    """What the requests and responses of all routes have, besides the models that are referred to."""
    for route in app.routes:
        if isinstance(route, APIRoute):
            if route.body_field is not None:
                yield route.body_field.field_info.annotation, "validation"
            yield from ((field.field_info.annotation, "serialization") for field in route.response_fields.values())


def stored_text(document: JsonObject) -> str:
    """The document as it is stored: each value on a line, for readable differences between versions."""
    return json.dumps(document, ensure_ascii=False, indent=0, separators=(",", ":")) + "\n"


_LICENSE = {"name": "Apache-2.0", "identifier": "Apache-2.0"}


def _share_problems(document: JsonObject) -> JsonObject:
    """Move the problem responses that several operations have out of them; they refer to them by name.

    The name is `Problem` and the status; `ProblemOrPage` where browsers get a page instead.
    """
    problems = [
        (operation["responses"], status, response)
        for operations in document["paths"].values()
        for operation in operations.values()
        for status, response in operation["responses"].items()
        if MEDIA_TYPE in response.get("content", {})
    ]
    uses = Counter(json.dumps(response) for _, _, response in problems)
    shared = {}
    for responses, status, response in problems:
        if uses[json.dumps(response)] > 1:
            name = f"{'ProblemOrPage' if 'text/html' in response['content'] else 'Problem'}{status}"
            shared[name] = response
            responses[status] = {"$ref": f"{_RESPONSES}{name}"}
    return dict(sorted(shared.items()))


def _require_keys(document: JsonObject) -> None:
    for path, operations in document["paths"].items():
        if is_protected(path):
            for operation in operations.values():
                operation["security"] = SECURITY


def _describe_headers(document: JsonObject) -> None:
    """Headers are absent or texts, never null; clients must send If-Match where a route returns 428 without it."""
    for operations in document["paths"].values():
        for operation in operations.values():
            for parameter in operation.get("parameters", ()):
                if parameter["in"] == "header":
                    parameter["schema"] = {"type": "string"}
                    parameter["required"] = parameter["name"] == "If-Match" and "428" in operation["responses"]
