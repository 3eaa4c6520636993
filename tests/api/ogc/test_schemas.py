"""The schemas of collections: OGC 23-058r2 (Common part 3, formerly Features part 5), GeoJSON, queryables."""

from __future__ import annotations

from typing import Any

import httpx
import jsonschema_rs
import pytest

from app.api.ogc.edits import READ_ONLY
from app.services.markers.features import COLLECTIONS
from tests.api.ogc.test_features import ITEMS, ROW, add, get

REL = "http://www.opengis.net/def/rel/ogc/1.0"
TYPES = {"string": str, "number": (int, float), "integer": int}


@pytest.mark.parametrize("name", COLLECTIONS)
def test_every_collection_announces_its_schema(client: httpx.Client, name: str) -> None:
    """Also one that is empty, whose geometry and fields no client could guess."""
    collection = get(client, f"/ogc/collections/{name}")
    links = {link["rel"]: link for link in collection["links"] if link["type"] == "application/schema+json"}
    assert {f"{REL}/schema", f"{REL}/queryables", "describedby"} <= set(links)
    response = client.get(links[f"{REL}/schema"]["href"], headers={"Accept": "application/schema+json"})
    assert response.headers["content-type"] == "application/schema+json"
    schema = response.json()
    assert schema["$id"] == links[f"{REL}/schema"]["href"]
    assert (schema["$schema"], schema["type"]) == ("https://json-schema.org/draft/2020-12/schema", "object")
    properties = schema["properties"]
    roles = {described.get("x-ogc-role"): name for name, described in properties.items()}
    assert (roles["id"], roles["primary-geometry"]) == ("id", "geometry")
    line = name in ("marker_lines", "alignments")
    assert properties["geometry"]["format"] == ("geometry-linestring" if line else "geometry-point")
    assert not {"type", "$ref"} & set(properties["geometry"])  # requirement /req/schemas/properties, B
    for other, described in properties.items():
        assert other == "geometry" or described["type"] in TYPES
        assert described["title"]
    assert [described["x-ogc-propertySeq"] for described in properties.values()] == list(range(1, len(properties) + 1))
    filters = get(client, f"/ogc/collections/{name}/queryables")
    assert list(filters["properties"]) == ["geometry", *(n for n in properties if n not in ("id", "geometry"))]


def test_features_are_as_the_schemas_say(client: httpx.Client) -> None:
    for lon, lat in ROW[:3]:
        add(client, lon, lat, road="A1", measure_m=7.0, heading_deg=90.0)
    logical = get(client, "/ogc/collections/markers/schema")
    validator = jsonschema_rs.validator_for(get(client, "/ogc/collections/markers/queryables"))
    for feature in get(client)["features"]:
        properties: dict[str, Any] = feature["properties"]
        assert {"id", "geometry", *properties} == set(logical["properties"])
        for name, value in properties.items():
            assert value is None or isinstance(value, TYPES[logical["properties"][name]["type"]]), name
        validator.validate({name: value for name, value in properties.items() if value is not None})
    assert logical["properties"]["measure_m"]["x-ogc-unit"] == "m"
    assert logical["properties"]["heading_deg"]["x-ogc-unit"] == "deg"
    assert logical["properties"]["updated_at"]["x-ogc-role"] == "primary-instant"


def test_what_cannot_be_edited_is_read_only(client: httpx.Client) -> None:
    properties = get(client, "/ogc/collections/markers/schema")["properties"]
    assert {name for name, described in properties.items() if described.get("readOnly")} == {"id", *READ_ONLY}
    plans = get(client, "/ogc/collections/plans/schema")["properties"]
    assert all(described["readOnly"] for described in plans.values())
    made = add(client, *ROW[0])
    for name in properties.keys() - {"id", "geometry", *READ_ONLY}:
        body = {"type": "Feature", "properties": {name: get(client, f"{ITEMS}/{made}")["properties"][name]}}
        answer = client.patch(f"{ITEMS}/{made}", json=body, headers={"Content-Type": "application/geo+json"})
        assert answer.status_code in (204, 422), answer.text  # 422: what a plate never has, e.g. a side
        assert "there is no property" not in answer.text


def test_the_classes_of_the_standard_and_of_its_draft_are_declared(client: httpx.Client) -> None:
    classes = get(client, "/ogc/conformance")["conformsTo"]
    assert len(classes) == len(set(classes))
    for prefix in ("ogcapi-common-3", "ogcapi-features-5"):  # QGIS 3.44 looks for the second
        assert f"http://www.opengis.net/spec/{prefix}/1.0/conf/schemas" in classes
        assert f"http://www.opengis.net/spec/{prefix}/1.0/conf/returnables-and-receivables" in classes
    assert "http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/html" in classes
