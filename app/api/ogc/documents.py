"""The documents that lead to features: landing page, conformance, collections and their schemas."""

from __future__ import annotations

from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from app.api.ogc.openapi import api_document
from app.api.ogc.query import known_parameters
from app.api.ogc.responses import GEOJSON, JSON, OPENAPI, SCHEMA, answer, base_url, caller_of, link, negotiate
from app.api.ogc.tiles import TILES_REL
from app.registry.features import Extent
from app.services.feature_crs import STORAGE_CRS, FeatureCrs
from app.services.features import COLLECTIONS, Collection, Features, get_collection

_OFFERED = ("f",)
_SCHEMES_REL = "http://www.opengis.net/def/rel/ogc/1.0/tiling-schemes"
_FEATURES = "http://www.opengis.net/spec/ogcapi-features"
_FILTER = "http://www.opengis.net/spec/ogcapi-features-3/1.0/conf"
_CQL2 = "http://www.opengis.net/spec/cql2/1.0/conf"
QUERYABLES_REL = "http://www.opengis.net/def/rel/ogc/1.0/queryables"
_TILES = "http://www.opengis.net/spec/ogcapi-tiles-1/1.0/conf"
CONFORMANCE = (
    f"{_FEATURES}-1/1.0/conf/core",
    f"{_FEATURES}-1/1.0/conf/oas30",
    f"{_FEATURES}-1/1.0/conf/geojson",
    f"{_FEATURES}-2/1.0/conf/crs",
    f"{_FILTER}/queryables",
    f"{_FILTER}/queryables-query-parameters",
    f"{_FILTER}/filter",
    f"{_FILTER}/features-filter",
    f"{_CQL2}/cql2-text",
    f"{_CQL2}/cql2-json",
    f"{_CQL2}/basic-cql2",
    f"{_CQL2}/advanced-comparison-operators",
    f"{_TILES}/core",
    f"{_TILES}/tileset",
    f"{_TILES}/tilesets-list",
    f"{_TILES}/geodata-tilesets",
    f"{_TILES}/mvt",
)


def landing_page(request: Request) -> Response:
    """Where everything is."""
    found = known_parameters(request, _OFFERED)
    negotiate(request, found, JSON)
    base = base_url(request)
    links = [
        link(f"{base}/", "self", JSON, "This document"),
        link(f"{base}/api", "service-desc", OPENAPI, "The API"),
        link(f"{base}/conformance", "conformance", JSON, "Conformance classes"),
        link(f"{base}/collections", "data", JSON, "Collections"),
        link(f"{base}/tileMatrixSets", _SCHEMES_REL, JSON, "Tile matrix sets"),
    ]
    return answer({"title": "Waymark", "description": "The registry of machine-readable roads", "links": links})


def conformance(request: Request) -> Response:
    """What the clients may expect."""
    negotiate(request, known_parameters(request, _OFFERED), JSON)
    return answer({"conformsTo": CONFORMANCE})


def api(request: Request) -> Response:
    """The API as OpenAPI 3.0, written for the clients that read it."""
    negotiate(request, known_parameters(request, _OFFERED), OPENAPI, JSON)
    return answer(api_document(base_url(request)), OPENAPI)


def collections(request: Request) -> Response:
    """All collections."""
    negotiate(request, known_parameters(request, _OFFERED), JSON)
    base = base_url(request)
    found = [_described(request, collection, base) for collection in COLLECTIONS.values()]
    links = [link(f"{base}/collections", "self", JSON), link(f"{base}/", "root", JSON)]
    return answer({"links": links, "crs": list(FeatureCrs), "collections": found})


def collection(request: Request) -> Response:
    """One collection."""
    found = get_collection(request.path_params["collection"])
    negotiate(request, known_parameters(request, _OFFERED), JSON)
    return answer(_described(request, found, base_url(request)))


def schema(request: Request) -> Response:
    """The JSON Schema of a collection's features: without it clients guess types from the first page."""
    found = get_collection(request.path_params["collection"])
    negotiate(request, known_parameters(request, _OFFERED), SCHEMA, JSON)
    base = base_url(request)
    properties = {field.name: schema_type(field.kind) | {"title": field.text} for field in found.fields}
    document = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"{base}/collections/{found.id}/schema",
        "title": found.title,
        "type": "object",
        "required": ["type", "geometry", "properties"],
        "properties": {
            "type": {"type": "string", "enum": ["Feature"]},
            "id": {"type": "string"},
            "geometry": {"$ref": f"https://geojson.org/schema/{found.geometry}.json"},
            "properties": {"type": "object", "properties": properties},
        },
    }
    return answer(document, SCHEMA)


def queryables(request: Request) -> Response:
    """The JSON Schema of what filters can ask of a collection's features."""
    found = get_collection(request.path_params["collection"])
    negotiate(request, known_parameters(request, _OFFERED), SCHEMA, JSON)
    document = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"{base_url(request)}/collections/{found.id}/queryables",
        "title": found.title,
        "type": "object",
        "properties": {field.name: schema_type(field.kind) | {"title": field.text} for field in found.fields},
        "additionalProperties": False,
    }
    return answer(document, SCHEMA)


def schema_type(kind: str) -> dict[str, Any]:
    """JSON Schema of a kind of property."""
    return {"type": "string", "format": "date-time"} if kind == "date-time" else {"type": kind}


def _described(request: Request, found: Collection, base: str) -> dict[str, Any]:
    features: Features = request.app.state.features
    extent = features.extent(caller_of(request), found)
    url = f"{base}/collections/{found.id}"
    described: dict[str, Any] = {
        "id": found.id,
        "title": found.title,
        "description": found.text,
        "itemType": "feature",
        "crs": list(FeatureCrs),
        "storageCrs": STORAGE_CRS,
        "links": [
            link(url, "self", JSON),
            link(f"{url}/items", "items", GEOJSON, found.title),
            *([link(f"{url}/tiles", TILES_REL, JSON, "Vector tiles")] if found.has_tiles else []),
            link(f"{url}/schema", "describedby", SCHEMA, "Schema of the features"),
            link(f"{url}/queryables", QUERYABLES_REL, SCHEMA, "What filters can ask"),
            link(f"{url}/schema", "describedBy", SCHEMA, "Schema of the features, for older clients"),
        ],
    }
    if extent is not None:
        described["extent"] = _extent_document(extent)
        if extent.epoch is not None:
            described["storageCrsCoordinateEpoch"] = extent.epoch
    return described


def _extent_document(extent: Extent) -> dict[str, Any]:
    return {
        "spatial": {
            "bbox": [[extent.west_deg, extent.south_deg, extent.east_deg, extent.north_deg]],
            "crs": STORAGE_CRS,
        },
        "temporal": {"interval": [[extent.first, extent.last]]},
    }
