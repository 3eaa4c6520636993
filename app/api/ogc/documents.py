"""The documents that lead to features: landing page, conformance, collections and their schemas."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends
from starlette.responses import Response

from app.api.http.dependencies import Caller
from app.api.ogc import pages
from app.api.ogc.dependencies import BaseUrl, CollectionOf, FeaturesService, Offers
from app.api.ogc.openapi import api_document
from app.api.ogc.pages import html_response
from app.api.ogc.responses import GEOJSON, HTML, JSON, OPENAPI, SCHEMA, answer, link
from app.api.ogc.schemas import (
    QUERYABLES_REL,
    SCHEMA_CONFORMANCE,
    SCHEMA_REL,
    geojson_schema,
    property_schema,
    queryables,
)
from app.api.ogc.shapes import CollectionDocument, Collections, Conformance, ExtentDocument, LandingPage
from app.api.ogc.tiles import TILES_REL
from app.registry.features import Extent
from app.services.markers.feature_crs import STORAGE_CRS, FeatureCrs
from app.services.markers.features import COLLECTIONS, Collection

_SCHEMES_REL = "http://www.opengis.net/def/rel/ogc/1.0/tiling-schemes"
_FEATURES = "http://www.opengis.net/spec/ogcapi-features"
_FILTER = "http://www.opengis.net/spec/ogcapi-features-3/1.0/conf"
_CQL2 = "http://www.opengis.net/spec/cql2/1.0/conf"
_TILES = "http://www.opengis.net/spec/ogcapi-tiles-1/1.0/conf"
CONFORMANCE = (
    f"{_FEATURES}-1/1.0/conf/core",
    f"{_FEATURES}-1/1.0/conf/oas30",
    f"{_FEATURES}-1/1.0/conf/geojson",
    f"{_FEATURES}-1/1.0/conf/html",
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
    *SCHEMA_CONFORMANCE,
)


IsPage = Annotated[bool, Depends(Offers(JSON, html=True))]
IsSchemaPage = Annotated[bool, Depends(Offers(SCHEMA, JSON, html=True))]
OffersSchema = Annotated[bool, Depends(Offers(SCHEMA, JSON))]
IsApiPage = Annotated[bool, Depends(Offers(OPENAPI, JSON, html=True))]


def landing_page(is_page: IsPage, base: BaseUrl) -> Response:
    """Where everything is."""
    links = [
        link(f"{base}/", "self", JSON, "This document"),
        link(f"{base}/?f=html", "alternate", HTML, "This document as HTML"),
        link(f"{base}/api", "service-desc", OPENAPI, "The API for programs"),
        link(f"{base}/api?f=html", "service-doc", HTML, "The API for people"),
        link(f"{base}/conformance", "conformance", JSON, "Conformance classes"),
        link(f"{base}/collections", "data", JSON, "Collections"),
        link(f"{base}/tileMatrixSets", _SCHEMES_REL, JSON, "Tile matrix sets"),
    ]
    description = "The registry of machine-readable roads"
    document = LandingPage(title="Waymark", description=description, links=links)
    return html_response(pages.landing_page(base, document)) if is_page else answer(document)


def get_conformance(is_page: IsPage, base: BaseUrl) -> Response:
    """The conformance classes."""
    if is_page:
        return html_response(pages.conformance_page(base, CONFORMANCE))
    return answer(Conformance(conformsTo=list(CONFORMANCE)))


def get_api(is_page: IsApiPage, base: BaseUrl) -> Response:
    """The API as OpenAPI 3.0, written for the clients that read it."""
    document = api_document(base)
    return html_response(pages.api_page(base, document)) if is_page else answer(document, OPENAPI)


def list_collections(is_page: IsPage, base: BaseUrl, caller: Caller, features: FeaturesService) -> Response:
    """All collections."""
    found = [_described(collection, features.extent(caller, collection), base) for collection in COLLECTIONS.values()]
    if is_page:
        return html_response(pages.collections_page(base, found))
    document: Collections = {
        "links": [
            link(f"{base}/collections", "self", JSON),
            link(f"{base}/collections?f=html", "alternate", HTML, "This document as HTML"),
            link(f"{base}/", "root", JSON),
        ],
        "crs": list(FeatureCrs),
        "collections": found,
    }
    return answer(document)


def get_collection(
    collection: CollectionOf, is_page: IsPage, base: BaseUrl, caller: Caller, features: FeaturesService
) -> Response:
    """One collection."""
    document = _described(collection, features.extent(caller, collection), base)
    return html_response(pages.collection_page(base, document, collection)) if is_page else answer(document)


def get_schema(collection: CollectionOf, is_page: IsSchemaPage, base: BaseUrl) -> Response:
    """The properties of a collection's features, as JSON Schema with the roles of OGC API Common part 3."""
    if is_page:
        return html_response(pages.schema_page(base, collection, "schema", f"Properties of {collection.title}"))
    return answer(property_schema(collection, f"{base}/collections/{collection.id}/schema"), SCHEMA)


def get_geojson_schema(collection: CollectionOf, _offers: OffersSchema, base: BaseUrl) -> Response:
    """The JSON Schema of a collection's features in GeoJSON."""
    return answer(geojson_schema(collection, f"{base}/collections/{collection.id}/geojson-schema"), SCHEMA)


def get_queryables(collection: CollectionOf, is_page: IsSchemaPage, base: BaseUrl) -> Response:
    """The JSON Schema of what filters can ask of a collection's features."""
    if is_page:
        title = f"What filters can ask of {collection.title}"
        return html_response(pages.schema_page(base, collection, "queryables", title))
    return answer(queryables(collection, f"{base}/collections/{collection.id}/queryables"), SCHEMA)


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
            link(f"{url}?f=html", "alternate", HTML, "This document as HTML"),
            link(f"{url}/items", "items", GEOJSON, found.title),
            link(f"{url}/items?f=html", "items", HTML, f"{found.title} as HTML"),
            *([link(f"{url}/tiles", TILES_REL, JSON, "Vector tiles")] if found.has_tiles else []),
            link(f"{url}/schema", SCHEMA_REL, SCHEMA, "Properties of the features"),
            link(f"{url}/geojson-schema", "describedby", SCHEMA, "Schema of the features in GeoJSON"),
            link(f"{url}/queryables", QUERYABLES_REL, SCHEMA, "What filters can ask"),
            link(f"{url}/geojson-schema", "describedBy", SCHEMA, "Schema in GeoJSON, for older clients"),
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
