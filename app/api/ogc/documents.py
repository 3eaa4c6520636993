"""The documents that lead to features: landing page, conformance, collections and their schemas."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends
from starlette.responses import Response

from app.api.http.dependencies import Caller
from app.api.ogc.dependencies import BaseUrl, CollectionOf, FeaturesService, Offers
from app.api.ogc.openapi import api_document
from app.api.ogc.responses import GEOJSON, JSON, OPENAPI, SCHEMA, answer, link
from app.api.ogc.shapes import CollectionDocument, Collections, Conformance, ExtentDocument, LandingPage
from app.api.ogc.tiles import TILES_REL
from app.registry.features import Extent
from app.services.markers.feature_crs import STORAGE_CRS, FeatureCrs
from app.services.markers.features import COLLECTIONS, Collection

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


OffersJson = Annotated[None, Depends(Offers(JSON))]
OffersSchema = Annotated[None, Depends(Offers(SCHEMA, JSON))]
OffersOpenApi = Annotated[None, Depends(Offers(OPENAPI, JSON))]


def landing_page(_offers: OffersJson, base: BaseUrl) -> Response:
    """Where everything is."""
    links = [
        link(f"{base}/", "self", JSON, "This document"),
        link(f"{base}/api", "service-desc", OPENAPI, "The API"),
        link(f"{base}/conformance", "conformance", JSON, "Conformance classes"),
        link(f"{base}/collections", "data", JSON, "Collections"),
        link(f"{base}/tileMatrixSets", _SCHEMES_REL, JSON, "Tile matrix sets"),
    ]
    description = "The registry of machine-readable roads"
    return answer(LandingPage(title="Waymark", description=description, links=links))


def get_conformance(_offers: OffersJson) -> Response:
    """The conformance classes."""
    return answer(Conformance(conformsTo=list(CONFORMANCE)))


def get_api(_offers: OffersOpenApi, base: BaseUrl) -> Response:
    """The API as OpenAPI 3.0, written for the clients that read it."""
    return answer(api_document(base), OPENAPI)


def list_collections(_offers: OffersJson, base: BaseUrl, caller: Caller, features: FeaturesService) -> Response:
    """All collections."""
    document: Collections = {
        "links": [link(f"{base}/collections", "self", JSON), link(f"{base}/", "root", JSON)],
        "crs": list(FeatureCrs),
        "collections": [_described(found, features.extent(caller, found), base) for found in COLLECTIONS.values()],
    }
    return answer(document)


def get_collection(
    collection: CollectionOf, _offers: OffersJson, base: BaseUrl, caller: Caller, features: FeaturesService
) -> Response:
    """One collection."""
    return answer(_described(collection, features.extent(caller, collection), base))


def get_schema(collection: CollectionOf, _offers: OffersSchema, base: BaseUrl) -> Response:
    """The JSON Schema of a collection's features: without it clients guess types from the first page."""
    document = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"{base}/collections/{collection.id}/schema",
        "title": collection.title,
        "type": "object",
        "required": ["type", "geometry", "properties"],
        "properties": {
            "type": {"type": "string", "enum": ["Feature"]},
            "id": {"type": "string"},
            "geometry": {"$ref": f"https://geojson.org/schema/{collection.geometry}.json"},
            "properties": {"type": "object", "properties": _field_schemas(collection)},
        },
    }
    return answer(document, SCHEMA)


def get_queryables(collection: CollectionOf, _offers: OffersSchema, base: BaseUrl) -> Response:
    """The JSON Schema of what filters can ask of a collection's features."""
    document = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"{base}/collections/{collection.id}/queryables",
        "title": collection.title,
        "type": "object",
        "properties": _field_schemas(collection),
        "additionalProperties": False,
    }
    return answer(document, SCHEMA)


def _field_schemas(collection: Collection) -> dict[str, dict[str, str]]:
    return {field.name: schema_type(field.kind) | {"title": field.text} for field in collection.fields}


def schema_type(kind: str) -> dict[str, str]:
    """JSON Schema of a kind of property."""
    return {"type": "string", "format": "date-time"} if kind == "date-time" else {"type": kind}


def _described(found: Collection, extent: Extent | None, base: str) -> CollectionDocument:
    url = f"{base}/collections/{found.id}"
    described: CollectionDocument = {
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


def _extent_document(extent: Extent) -> ExtentDocument:
    return {
        "spatial": {
            "bbox": [[extent.west_deg, extent.south_deg, extent.east_deg, extent.north_deg]],
            "crs": STORAGE_CRS,
        },
        "temporal": {"interval": [[extent.first, extent.last]]},
    }
