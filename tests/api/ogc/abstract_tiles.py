"""Abstract tests of OGC API Tiles part 1 (20-057, annex A), and of schemas: the draft of OGC API Features part 5.

The final text of OGC API Common part 3 (23-058r2), which took over the classes of that draft, was not at hand.
"""

from __future__ import annotations

import math
from typing import Any

import jsonschema_rs
import pytest

from tests.api.ogc.abstract_filters import declares, filter_on_items, query_param
from tests.api.ogc.abstract_tests import GEOJSON, JSON, SCHEMA, SPEC, Api, abstract_test, links, not_applicable
from tests.registry.test_tiles import EXTENT, read_tile

TILES, DRAFT, COMMON = "ogcapi-tiles-1", "ogcapi-features-5", "ogcapi-common-3"
MVT = "application/vnd.mapbox-vector-tile"
REL = "http://www.opengis.net/def/rel/ogc/1.0"
MERCATOR = "http://www.opengis.net/def/crs/EPSG/0/3857"
URI = "http://www.opengis.net/def/tilematrixset/OGC/1.0/WebMercatorQuad"
TILED = ("markers", "retired_markers", "plans", "maintenance")
WORLD_M = math.pi * 6_378_137.0


# --- tiles --------------------------------------------------------------------------------------------------------


def tileset(api: Api, collection: str = "markers") -> dict[str, Any]:
    return api.document(f"/collections/{collection}/tiles/WebMercatorQuad")


def tile_url(api: Api, zoom: int, row: int, column: int, collection: str = "markers") -> str:
    """From the template of the tile set."""
    (template,) = links(tileset(api, collection), "item")
    url = template["href"].replace("{tileMatrix}", str(zoom))
    return str(url.replace("{tileRow}", str(row)).replace("{tileCol}", str(column)))


def places_m(api: Api, zoom: int, row: int, column: int, collection: str = "markers") -> dict[str, tuple[float, float]]:
    """Features of a tile, at their places in the system of the tile set by the tile matrix."""
    response = api.get(tile_url(api, zoom, row, column, collection), MVT)
    assert (response.status_code, response.headers["content-type"]) == (200, MVT)
    layer, points = read_tile(response.content)
    assert layer == collection
    (matrix,) = [
        one for one in api.document("/tileMatrixSets/WebMercatorQuad")["tileMatrices"] if one["id"] == str(zoom)
    ]
    unit_m = matrix["cellSize"] * matrix["tileWidth"] / EXTENT
    west, north = matrix["pointOfOrigin"]
    return {
        tags["id"]: (west + (column * EXTENT + x) * unit_m, north - (row * EXTENT + y) * unit_m)
        for tags, (x, y) in points
    }


@abstract_test(TILES, "/conf/core/conformance-success")
def conformance_success(api: Api) -> None:
    classes = api.document("/conformance")["conformsTo"]
    assert all(isinstance(uri, str) for uri in classes)
    assert f"{SPEC}/{TILES}/1.0/conf/core" in classes


@abstract_test(TILES, "/conf/core/tc-op")
def tc_op(api: Api) -> None:
    assert len(places_m(api, 0, 0, 0)) == len(api.features("markers"))
    assert any(path.endswith("/{tileMatrix}/{tileRow}/{tileCol}") for path, _, _ in api.operations())


def check_path_parameter(api: Api, name: str, kind: str) -> None:
    found = 0
    for path, _, parameters in api.operations():
        if "/tiles/" in path:
            (parameter,) = [one for one in parameters if one["name"] == name]
            assert (parameter["in"], parameter["required"], parameter["schema"]["type"]) == ("path", True, kind)
            found += 1
    assert found == len(TILED)


@abstract_test(TILES, "/conf/core/tc-tilematrix-definition")
def tc_tilematrix_definition(api: Api) -> None:
    check_path_parameter(api, "tileMatrix", "string")


@abstract_test(TILES, "/conf/core/tc-tilerow-definition")
def tc_tilerow_definition(api: Api) -> None:
    check_path_parameter(api, "tileRow", "integer")


@abstract_test(TILES, "/conf/core/tc-tilecol-definition")
def tc_tilecol_definition(api: Api) -> None:
    check_path_parameter(api, "tileCol", "integer")


@abstract_test(TILES, "/conf/core/tc-success", "a tile has a margin, whose features lie beside its area")
def tc_success(api: Api) -> None:
    placed = {one["id"]: one["geometry"]["coordinates"][:2] for one in api.features("markers", crs=MERCATOR)}
    zoom, side_m = 13, 2 * WORLD_M / 2**13
    x_m, y_m = placed[next(iter(placed))]
    column, row = math.floor((x_m + WORLD_M) / side_m), math.floor((WORLD_M - y_m) / side_m)
    west_m, north_m = column * side_m - WORLD_M, WORLD_M - row * side_m
    inside = {k for k, (x, y) in placed.items() if 0 <= x - west_m < side_m and 0 <= north_m - y < side_m}
    margin_m = side_m / 16
    near = {
        k
        for k, (x, y) in placed.items()
        if -margin_m <= x - west_m <= side_m + margin_m and -margin_m <= north_m - y <= side_m + margin_m
    }
    assert inside <= set(places_m(api, zoom, row, column)) <= near
    assert 0 < len(inside) < len(placed)


@abstract_test(TILES, "/conf/core/tc-error")
def tc_error(api: Api) -> None:
    for place in ((0, 0, 1), (0, 1, 0), (3, 8, 0), (99, 0, 0)):
        assert api.get(tile_url(api, *place)).status_code == 404
    empty = api.get(tile_url(api, 10, 3, 3))
    assert (empty.status_code, empty.content) == (204, b"")


@abstract_test(TILES, "/conf/tileset/description", "there is no XML")
def tileset_description(api: Api) -> None:
    for name in TILED:
        response = api.get(f"/collections/{name}/tiles/WebMercatorQuad", JSON)
        assert (response.status_code, response.headers["content-type"]) == (200, JSON)
        document = response.json()
        assert (document["dataType"], document["crs"], document["tileMatrixSetURI"]) == ("vector", MERCATOR, URI)
        (scheme,) = links(document, f"{REL}/tiling-scheme")
        matrices = api.document(scheme["href"])
        assert matrices["uri"] == URI
        assert matrices["crs"] == MERCATOR
        for k, matrix in enumerate(matrices["tileMatrices"]):
            assert matrix["id"] == str(k)
            assert matrix["matrixWidth"] == matrix["matrixHeight"] == 2**k
            assert matrix["scaleDenominator"] == pytest.approx(559_082_264.0287178 / 2**k)  # annex D of 17-083r4
            assert matrix["pointOfOrigin"] == pytest.approx([-20_037_508.342789244, 20_037_508.342789244])
            assert matrix["cellSize"] == pytest.approx(156_543.03392804097 / 2**k)
        (template,) = links(document, "item")
        assert template["templated"] is True
        assert template["type"] == MVT
        assert all(variable in template["href"] for variable in ("{tileMatrix}", "{tileRow}", "{tileCol}"))


@abstract_test(TILES, "/conf/tilesets-list/tileset-links", "there is no XML")
def tileset_links(api: Api) -> None:
    for name in TILED:
        response = api.get(f"/collections/{name}/tiles", JSON)
        assert (response.status_code, response.headers["content-type"]) == (200, JSON)
        (one,) = response.json()["tilesets"]
        assert (one["dataType"], one["crs"], one["tileMatrixSetURI"]) == ("vector", MERCATOR, URI)
        assert links(one, f"{REL}/tiling-scheme")
        (self,) = links(one, "self")
        assert self["href"] == f"{api.root}/collections/{name}/tiles/WebMercatorQuad"
        assert api.document(self["href"]) == tileset(api, name)


@abstract_test(TILES, "/conf/geodata-tilesets/desc-links")
def desc_links(api: Api) -> None:
    for collection in api.collections():
        found = [link["href"] for link in links(collection, f"{REL}/tilesets-vector")]
        own = f"{api.root}/collections/{collection['id']}/tiles"
        assert found == ([own] if collection["id"] in TILED else [])


@abstract_test(TILES, "/conf/geodata-tilesets/operation")
def geodata_operation(api: Api) -> None:
    for name in TILED:
        assert len(api.document(f"/collections/{name}/tiles")["tilesets"]) == 1


@abstract_test(TILES, "/conf/mvt/content")
def mvt_content(api: Api) -> None:
    for name in ("markers", "retired_markers", "plans"):
        expected = {one["id"]: one["geometry"]["coordinates"] for one in api.features(name, crs=MERCATOR)}
        found = places_m(api, 0, 0, 0, name)
        assert set(found) == set(expected)
        half_m = 2 * WORLD_M / EXTENT * 0.51
        for feature, place_m in found.items():
            assert place_m == pytest.approx(expected[feature][:2], abs=half_m)
    column, row = 8578, 5621
    assert api.get(tile_url(api, 14, row, column)).status_code in (200, 204)


# --- schemas ------------------------------------------------------------------------------------------------------

KEYWORDS = {
    "$schema", "$id", "title", "description", "type", "format", "properties", "additionalProperties", "readOnly",
}  # fmt: skip


def schemas(api: Api) -> list[dict[str, Any]]:
    names = [collection["id"] for collection in api.collections()]
    return [api.document(f"/collections/{name}/{kind}") for name in names for kind in ("schema", "queryables")]


def with_role(schema: dict[str, Any], role: str) -> list[dict[str, Any]]:
    return [one for one in schema["properties"].values() if one.get("x-ogc-role") == role]


def basic_schema_inspection(api: Api) -> None:
    for schema in schemas(api):
        response = api.get(schema["$id"], SCHEMA)
        assert (response.status_code, response.headers["content-type"]) == (200, SCHEMA)
        assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
        assert schema["$id"].startswith("http")
        assert "?" not in schema["$id"]
        assert schema["type"] == "object"
        jsonschema_rs.meta.validate(schema)
        for name, one in schema["properties"].items():
            assert "type" in one or ("$ref" not in one and one["format"].startswith("geometry-"))
            assert not name.endswith("_at") or (one["type"], one["format"]) == ("string", "date-time")
            assert all(keyword in KEYWORDS or keyword.startswith("x-") for keyword in one)
        assert all(keyword in KEYWORDS or keyword.startswith("x-") for keyword in schema)


def role(api: Api) -> None:
    for schema in schemas(api):
        assert all(isinstance(one.get("x-ogc-role", ""), str) for one in schema["properties"].values())


def role_id(api: Api) -> None:
    for schema in schemas(api)[::2]:
        (one,) = with_role(schema, "id")
        assert one["type"] == "string"


def property_seq(api: Api) -> None:
    for schema in schemas(api)[::2]:
        assert all(isinstance(one["x-ogc-propertySeq"], int) for one in schema["properties"].values())


def unit(api: Api) -> None:
    found = [one for schema in schemas(api) for one in schema["properties"].values() if "x-ogc-unit" in one]
    assert {one["x-ogc-unit"] for one in found} == {"m", "deg", "km/h", "/m", "a"}  # in UCUM, c/s
    assert all(one["type"] in ("number", "integer") for one in found)


def role_primary_geometry(api: Api) -> None:
    for schema in schemas(api):
        (one,) = with_role(schema, "primary-geometry")
        assert not {"type", "$ref"} & set(one)
        assert one["format"].startswith("geometry-")


def role_primary_temporal(api: Api) -> None:
    for schema in schemas(api):
        found = with_role(schema, "primary-instant")
        assert len(found) <= 1
        assert all((one["type"], one["format"]) == ("string", "date-time") for one in found)
        assert not with_role(schema, "primary-interval") + with_role(schema, "primary-interval-start")


def role_type(api: Api) -> None:
    for schema in schemas(api):
        found = with_role(schema, "type")
        assert len(found) <= 1
        assert all(one["type"] == "string" for one in found)


def linked(rel: str, path: str) -> Any:
    def run(api: Api) -> None:
        for collection in api.collections():
            own = f"{api.root}/collections/{collection['id']}/{path}"
            assert [link["href"] for link in links(collection, f"{REL}/{rel}")] == [own]

    return run


def schema_response(api: Api) -> None:
    for run in (basic_schema_inspection, role, role_id, role_primary_geometry, role_primary_temporal, role_type):
        run(api)


def queryables_response(api: Api) -> None:
    schema_response(api)
    query_param(api)
    filter_on_items(api)


def features_are_valid(api: Api) -> None:
    for collection in api.filled():
        schema = api.document(f"/collections/{collection['id']}/schema")
        assert schema["additionalProperties"] is False
        described = schema["properties"]
        listed = api.get(f"/collections/{collection['id']}/items", GEOJSON).json()["features"]
        own = api.document(f"/collections/{collection['id']}/items/{listed[0]['id']}", GEOJSON)
        for feature in [*listed, own]:
            assert set(feature["properties"]) == set(described) - {"id", "geometry"}
            assert feature["geometry"]["type"].lower() == described["geometry"]["format"].removeprefix("geometry-")
            jsonschema_rs.validate(described["id"], feature["id"])
            for name, value in feature["properties"].items():
                if value is not None:
                    jsonschema_rs.validate(described[name], value)


CRUD = "no class of part 4 is declared; what cannot be stored is refused with 422 instead of 400"
ABSENT = "the schemas have no such keyword"
for standard in (COMMON, DRAFT):
    abstract_test(standard, "/conf/schemas/basic-schema-inspection")(basic_schema_inspection)
    abstract_test(standard, "/conf/schemas/role")(role)
    roles = "core-roles-features" if standard == DRAFT else "advanced-property-roles"
    abstract_test(standard, "/conf/schemas/role-id")(role_id)
    abstract_test(standard, "/conf/schemas/property-seq")(property_seq)
    abstract_test(standard, "/conf/schemas/unit")(unit)
    not_applicable(standard, "/conf/schemas/definition", ABSENT)
    not_applicable(standard, "/conf/schemas/nullvalues", ABSENT)
    abstract_test(standard, f"/conf/{roles}/role-primary-geometry")(role_primary_geometry)
    abstract_test(standard, f"/conf/{roles}/role-primary-temporal")(role_primary_temporal)
    abstract_test(standard, f"/conf/{roles}/role-type")(role_type)
    own = "returnables-and-receivables"
    abstract_test(standard, f"/conf/{own}/get-conformance")(declares(standard, own))
    abstract_test(standard, f"/conf/{own}/link")(linked("schema", "schema"))
    abstract_test(standard, f"/conf/{own}/op-and-response")(schema_response)
    abstract_test(standard, f"/conf/{own}/response-1", "a null is the absence of a value")(features_are_valid)
    not_applicable(standard, f"/conf/{own}/response-2", CRUD)
abstract_test(COMMON, "/conf/queryables/get-conformance")(declares(COMMON, "queryables"))
abstract_test(COMMON, "/conf/queryables/link")(linked("queryables", "queryables"))
abstract_test(COMMON, "/conf/queryables/op-and-response")(queryables_response)
