"""The documents that lead to features: landing page, conformance, collections, their schemas, and OpenAPI."""

from __future__ import annotations

import re
from typing import Annotated

from fastapi import Depends
from starlette.responses import Response

from app import __version__
from app.api.http.dependencies import Caller
from app.api.http.permissions import READERS, SECURITY, SECURITY_SCHEMES
from app.api.http.routes import Router
from app.api.ogc import pages
from app.api.ogc.edits import READ_ONLY
from app.api.ogc.pages import html_response
from app.api.ogc.query import OF_ITEM, ONLY_FORMAT, PARAMETERS, list_parameters, schema_type
from app.api.ogc.query import described as parameters_described
from app.api.ogc.responses import (
    GEOJSON,
    HTML,
    JSON,
    MVT,
    OPENAPI,
    QUERYABLES_REL,
    SCHEMA,
    BaseUrl,
    CollectionDocument,
    CollectionOf,
    Collections,
    Conformance,
    ExtentDocument,
    FeaturesService,
    LandingPage,
    Offers,
    answer,
    describe_read,
    link,
)
from app.api.ogc.tiles import MATRIX_SET, TILES_REL
from app.registry.conditions import GEOMETRY
from app.registry.features import Extent, Field
from app.services.markers.features import COLLECTIONS, STORAGE_CRS, Collection, list_systems
from app.values import JsonObject

# === JSON Schemas of a collection's features: as OGC API Common part 3 (OGC 23-058r2, formerly Features part 5)
# describes
#
# properties, as GeoJSON, and of what filters can ask.


SCHEMA_REL = "http://www.opengis.net/def/rel/ogc/1.0/schema"
_DRAFT = "https://json-schema.org/draft/2020-12/schema"
_COMMON = "http://www.opengis.net/spec/ogcapi-common-3/1.0/conf"
_DRAFT_5 = "http://www.opengis.net/spec/ogcapi-features-5/1.0/conf"
SCHEMA_CONFORMANCE = (
    f"{_COMMON}/schemas",
    f"{_COMMON}/advanced-property-roles",
    f"{_COMMON}/returnables-and-receivables",
    f"{_COMMON}/queryables",
    f"{_DRAFT_5}/schemas",
    f"{_DRAFT_5}/core-roles-features",
    f"{_DRAFT_5}/returnables-and-receivables",
)
"""The classes of the standard, and those of its last draft, which QGIS up to 4.0 looks for."""
_UNITS = {"deg": "deg", "m": "m", "km/h": "km/h", "1/m": "/m", "decimal year": "a"}
"""UCUM codes of units as the texts of properties name them."""
_ROLES = {"family": "type", "updated_at": "primary-instant"}
_UNIT = re.compile(r" \[([^\]]+)\]$")


def property_schema(collection: Collection, url: str) -> dict[str, object]:
    """The properties of a collection's features, independent of their format; the geometry is one of them."""
    properties: dict[str, dict[str, object]] = {
        "id": {"title": "Id of the feature", "type": "string", "readOnly": True, "x-ogc-role": "id"},
        "geometry": {
            "title": "Position" if collection.geometry == "Point" else "Course",
            "format": f"geometry-{collection.geometry.lower()}",
            "x-ogc-role": "primary-geometry",
            **({} if collection.editable else {"readOnly": True}),
        },
    }
    for field in collection.fields:
        properties[field.name] = _returnable(field, collection.editable and field.name not in READ_ONLY)
    for place, described in enumerate(properties.values(), start=1):
        described["x-ogc-propertySeq"] = place
    return {
        "$schema": _DRAFT,
        "$id": url,
        "title": collection.title,
        "description": collection.text,
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
    }


def geojson_schema(collection: Collection, url: str) -> dict[str, object]:
    """A feature as GeoJSON: GDAL takes the types of fields from it; without it, it guesses from the first page."""
    return {
        "$schema": _DRAFT,
        "$id": url,
        "title": collection.title,
        "type": "object",
        "required": ["type", "geometry", "properties"],
        "properties": {
            "type": {"type": "string", "enum": ["Feature"]},
            "id": {"type": "string"},
            "geometry": {"$ref": f"https://geojson.org/schema/{collection.geometry}.json"},
            "properties": {"type": "object", "properties": _plain(collection)},
        },
    }


def queryables(collection: Collection, url: str) -> dict[str, object]:
    """What filters can ask of a collection's features."""
    return {
        "$schema": _DRAFT,
        "$id": url,
        "title": collection.title,
        "type": "object",
        "properties": {
            GEOMETRY: {
                "title": "Position" if collection.geometry == "Point" else "Course",
                "x-ogc-role": "primary-geometry",
                "format": f"geometry-{collection.geometry.lower()}",
            },
            **_plain(collection),
        },
        "additionalProperties": False,
    }


def _plain(collection: Collection) -> dict[str, dict[str, str]]:
    return {field.name: schema_type(field.kind) | {"title": field.text} for field in collection.fields}


def _returnable(field: Field, is_receivable: bool) -> dict[str, object]:
    described: dict[str, object] = {**schema_type(field.kind), "title": field.text}
    unit = _UNIT.search(field.text)
    if unit is not None and unit[1] in _UNITS:
        described |= {"x-ogc-unit": _UNITS[unit[1]]}
    if field.name in _ROLES:
        described["x-ogc-role"] = _ROLES[field.name]
    return described if is_receivable else described | {"readOnly": True}


# === /ogc/api by hand: the clients want OpenAPI 3.0, a literal path for each collection, and parameters named like
# fields.
#
# GDAL pushes `code = '7'` down to the server only if the path's parameters list `code`; QGIS takes its page size from
# `components.parameters.limit`.


_PROBLEM = {
    "description": "A problem document (RFC 9457)",
    "content": {"application/problem+json": {"schema": {"type": "object"}}},
}


_REFUSALS: dict[str, object] = {status: {"$ref": "#/components/responses/Problem"} for status in ("4XX", "5XX")}
_PLACE_OF_TILE = {"tileMatrix": "string", "tileRow": "integer", "tileCol": "integer"}


def api_document(base: str) -> dict[str, object]:
    """The OpenAPI document of /ogc for a server that is reached at `base`."""
    paths: dict[str, object] = {
        "/": _read("Landing page"),
        "/conformance": _read("Conformance classes"),
        "/api": _read("This document", OPENAPI),
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


def _paths(collection: Collection) -> dict[str, object]:
    url, name = f"/collections/{collection.id}", collection.title
    items = _read(f"{name}: a page", GEOJSON, list_parameters(collection))
    item = _read(f"{name}: one", GEOJSON, OF_ITEM)
    item["parameters"] = [{"$ref": "#/components/parameters/featureId"}]
    tile = f"{url}/tiles/{MATRIX_SET}/{{tileMatrix}}/{{tileRow}}/{{tileCol}}"
    return {
        **({tile: _read_tile(f"{name}: a vector tile")} if collection.has_tiles else {}),
        url: _read(name),
        f"{url}/schema": _read(f"{name}: schema", SCHEMA),
        f"{url}/geojson-schema": _read(f"{name}: schema in GeoJSON", SCHEMA, html=False),
        f"{url}/queryables": _read(f"{name}: what can be asked of the properties", SCHEMA),
        f"{url}/items": items,
        f"{url}/items/{{featureId}}": item,
    }


def _read(
    summary: str, kind: str = JSON, parameters: tuple[str, ...] = ONLY_FORMAT, *, html: bool = True
) -> dict[str, object]:
    content: dict[str, object] = {kind: {"schema": {"type": "object"}}}
    if html:
        content[HTML] = {"schema": {"type": "string"}}
    return _operation(summary, parameters, {"200": {"description": summary, "content": content}})


def _read_tile(summary: str) -> dict[str, object]:
    content = {MVT: {"schema": {"type": "string", "format": "binary"}}}
    responses: dict[str, object] = {"200": {"description": summary, "content": content}}
    responses["204"] = {"description": "No features"}
    return _operation(summary, (*_PLACE_OF_TILE, "groups"), responses)


def _operation(summary: str, parameters: tuple[str, ...], responses: dict[str, object]) -> dict[str, object]:
    return {
        "get": {
            "summary": summary,
            "parameters": [{"$ref": f"#/components/parameters/{name}"} for name in parameters],
            "responses": responses | _REFUSALS,
        }
    }


def _parameters() -> dict[str, object]:
    in_path = {"featureId": "string", **_PLACE_OF_TILE}
    return {
        **{name: _in_openapi_3_0(parameters_described(name)) for name in PARAMETERS},
        **{
            name: {"name": name, "in": "path", "required": True, "schema": {"type": kind}}
            for name, kind in in_path.items()
        },
    }


def _in_openapi_3_0(parameter: JsonObject) -> JsonObject:
    """A parameter whose schema has no examples: OpenAPI 3.0 has only one of them."""
    schema = dict(parameter["schema"])
    examples = schema.pop("examples", None)
    return parameter | {"schema": schema | ({"example": examples[0]} if examples else {})}


# === The documents that lead to features.


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
    f"{_CQL2}/basic-spatial-functions",
    f"{_CQL2}/basic-spatial-functions-plus",
    f"{_CQL2}/advanced-comparison-operators",
    f"{_TILES}/core",
    f"{_TILES}/tileset",
    f"{_TILES}/tilesets-list",
    f"{_TILES}/geodata-tilesets",
    f"{_TILES}/mvt",
    *SCHEMA_CONFORMANCE,
)


router = Router("/ogc", "ogc")
IsPage = Annotated[bool, Depends(Offers(JSON, html=True))]
IsSchemaPage = Annotated[bool, Depends(Offers(SCHEMA, JSON, html=True))]
OffersSchema = Annotated[bool, Depends(Offers(SCHEMA, JSON))]
IsApiPage = Annotated[bool, Depends(Offers(OPENAPI, JSON, html=True))]


@router.get("", READERS, **describe_read(LandingPage))
@router.get("/", READERS, name="landing_page_with_slash", **describe_read(LandingPage))
def landing_page(is_page: IsPage, base: BaseUrl) -> Response:
    """Get the landing page.

    It links to everything else.
    """
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


@router.get("/conformance", READERS, **describe_read(Conformance))
def get_conformance(is_page: IsPage, base: BaseUrl) -> Response:
    """List the conformance classes."""
    if is_page:
        return html_response(pages.conformance_page(base, CONFORMANCE))
    return answer(Conformance(conformsTo=list(CONFORMANCE)))


@router.get("/api", READERS, **describe_read(JsonObject, OPENAPI.partition(";")[0]))
def get_api(is_page: IsApiPage, base: BaseUrl) -> Response:
    """Get the OpenAPI 3.0 document of the OGC API.

    It is written for the clients that read it.
    """
    document = api_document(base)
    return html_response(pages.api_page(base, document)) if is_page else answer(document, OPENAPI)


@router.get("/collections", READERS, **describe_read(Collections))
def list_collections(is_page: IsPage, base: BaseUrl, caller: Caller, features: FeaturesService) -> Response:
    """List the collections."""
    found = [
        _described(collection, features.extent(caller, collection), base, ["#/crs"])
        for collection in COLLECTIONS.values()
    ]
    if is_page:
        return html_response(pages.collections_page(base, found))
    document: Collections = {
        "links": [
            link(f"{base}/collections", "self", JSON),
            link(f"{base}/collections?f=html", "alternate", HTML, "This document as HTML"),
            link(f"{base}/", "root", JSON),
        ],
        "crs": list(list_systems()),
        "collections": found,
    }
    return answer(document)


@router.get("/collections/{collection}", READERS, **describe_read(CollectionDocument))
def get_collection(
    collection: CollectionOf, is_page: IsPage, base: BaseUrl, caller: Caller, features: FeaturesService
) -> Response:
    """Get a collection."""
    document = _described(collection, features.extent(caller, collection), base, list(list_systems()))
    return html_response(pages.collection_page(base, document, collection)) if is_page else answer(document)


@router.get("/collections/{collection}/schema", READERS, **describe_read(JsonObject, SCHEMA))
def get_schema(collection: CollectionOf, is_page: IsSchemaPage, base: BaseUrl) -> Response:
    """Get the schema of a collection's properties.

    JSON Schema with the roles of OGC API Common part 3.
    """
    if is_page:
        return html_response(pages.schema_page(base, collection, "schema", f"Properties of {collection.title}"))
    return answer(property_schema(collection, f"{base}/collections/{collection.id}/schema"), SCHEMA)


@router.get("/collections/{collection}/geojson-schema", READERS, **describe_read(JsonObject, SCHEMA, html=False))
def get_geojson_schema(collection: CollectionOf, _offers: OffersSchema, base: BaseUrl) -> Response:
    """Get the schema of a collection's features in GeoJSON."""
    return answer(geojson_schema(collection, f"{base}/collections/{collection.id}/geojson-schema"), SCHEMA)


@router.get("/collections/{collection}/queryables", READERS, **describe_read(JsonObject, SCHEMA))
def get_queryables(collection: CollectionOf, is_page: IsSchemaPage, base: BaseUrl) -> Response:
    """Get the properties that filters of a collection can use.

    As JSON Schema.
    """
    if is_page:
        title = f"What filters can ask of {collection.title}"
        return html_response(pages.schema_page(base, collection, "queryables", title))
    return answer(queryables(collection, f"{base}/collections/{collection.id}/queryables"), SCHEMA)


def _described(found: Collection, extent: Extent | None, base: str, systems: list[str]) -> CollectionDocument:
    url = f"{base}/collections/{found.id}"
    described: CollectionDocument = {
        "id": found.id,
        "title": found.title,
        "description": found.text,
        "itemType": "feature",
        "crs": systems,
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
