"""Abstract tests of OGC API Features: part 1 (17-069r4, annex A) and part 2 (18-058r1, annex A)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import lxml.html
import numpy as np
import openapi_spec_validator
import shapely
import shapely.geometry

from tests.api.ogc.abstract_tests import (
    CRS84,
    CRS84H,
    GEOJSON,
    HTML,
    JSON,
    PLACES,
    SPEC,
    Api,
    abstract_test,
    all_tests,
    check_links,
    known,
    links,
    transformer,
    vertices,
)

ONE, TWO = "ogcapi-features-1", "ogcapi-features-2"
CORE = f"{SPEC}/{ONE}/1.0/conf/core"
FORMATS = {GEOJSON, HTML}


# --- core: documents ----------------------------------------------------------------------------------------------


@abstract_test(ONE, "/conf/core/http", "HTTP 1.1; TLS is the proxy's")
def http(api: Api) -> None:
    for path, _, _ in api.operations():
        if "maintenance" not in path:
            assert api.get(api.filled_path(path)).http_version == "HTTP/1.1"


@abstract_test(ONE, "/conf/core/crs84")
def crs84(api: Api) -> None:
    for collection in api.filled():
        response = api.get(f"/collections/{collection['id']}/items")
        assert response.headers["content-crs"] in (f"<{CRS84}>", f"<{CRS84H}>")
        for feature in response.json()["features"]:
            for lon_deg, lat_deg, *_ in vertices(feature["geometry"]):
                assert 8.3 < lon_deg < 8.6
                assert 48.9 < lat_deg < 49.1
    found = {tuple(one["geometry"]["coordinates"][:2]) for one in api.features("markers", family="plate")}
    assert found == set(PLACES)


@abstract_test(ONE, "/conf/core/root-op")
def root_op(api: Api) -> None:
    root_success(api)
    assert api.get("/").status_code == 200


@abstract_test(ONE, "/conf/core/root-success")
def root_success(api: Api) -> None:
    document = api.document("/")
    check_links(document)
    assert isinstance(document["title"], str)
    assert isinstance(document["description"], str)
    page = html_of(api.get("/", HTML))
    hrefs = {href for _, _, href, _ in page.iterlinks()}
    for rel in ("service-doc", "conformance", "data"):
        assert links(document, rel), rel
        assert {link["href"] for link in links(document, rel)} <= hrefs, rel
    assert links(document, "service-desc")


@abstract_test(ONE, "/conf/core/api-definition-op")
def api_definition_op(api: Api) -> None:
    landing = api.document("/")
    for link in links(landing, "service-desc") + links(landing, "service-doc"):
        response = api.get(link["href"], link["type"])
        assert response.status_code == 200
        assert media_type(response) == link["type"].partition(";")[0]
    api_definition_success(api)


@abstract_test(ONE, "/conf/core/api-definition-success")
def api_definition_success(api: Api) -> None:
    openapi_spec_validator.validate(api.document("/api"), cls=openapi_spec_validator.OpenAPIV30SpecValidator)


@abstract_test(ONE, "/conf/core/conformance-op")
def conformance_op(api: Api) -> None:
    paths = [link["href"] for link in links(api.document("/"), "conformance")]
    assert paths
    for path in [*paths, "/conformance"]:
        assert api.get(path).status_code == 200
    conformance_success(api)


@abstract_test(ONE, "/conf/core/conformance-success")
def conformance_success(api: Api) -> None:
    classes = api.document("/conformance")["conformsTo"]
    assert isinstance(classes, list)
    assert all(isinstance(uri, str) for uri in classes)
    assert CORE in classes
    tested = {(one.standard, one.identifier.split("/")[2]) for one in all_tests() if one.run is not None}
    declared = {(uri.split("/")[4], uri.rsplit("/", 1)[1]) for uri in classes}
    assert declared == tested


@abstract_test(ONE, "/conf/core/fc-md-op")
def fc_md_op(api: Api) -> None:
    assert api.get("/collections").status_code == 200
    fc_md_success(api)


@abstract_test(ONE, "/conf/core/fc-md-success")
def fc_md_success(api: Api) -> None:
    fc_md_links(api)
    fc_md_items(api)
    document = api.document("/collections")
    assert document["crs"][0] in (CRS84, CRS84H)
    for collection in document["collections"]:
        assert collection["itemType"] == "feature"
        assert isinstance(collection["title"], str)
        assert isinstance(collection["description"], str)


@abstract_test(ONE, "/conf/core/fc-md-links")
def fc_md_links(api: Api) -> None:
    document = api.document("/collections")
    check_links(document)
    check_formats(api, document, JSON, {HTML})


@abstract_test(ONE, "/conf/core/fc-md-items")
def fc_md_items(api: Api) -> None:
    described = {one["id"] for one in api.document("/collections")["collections"]}
    served = {path.split("/")[2] for path, _, _ in api.operations() if path.endswith("/items")}
    assert described == served
    fc_md_items_links(api)
    fc_md_extent(api)
    page = html_of(api.get("/collections", HTML))
    assert all(f"{api.root}/collections/{one}" in [href for _, _, href, _ in page.iterlinks()] for one in described)


@abstract_test(ONE, "/conf/core/fc-md-items-links")
def fc_md_items_links(api: Api) -> None:
    for collection in api.document("/collections")["collections"]:
        check_links(collection)
        items = links(collection, "items")
        assert {link["type"] for link in items} == FORMATS
        for link in items:
            assert media_type(api.get(link["href"], link["type"])) == link["type"]


@abstract_test(ONE, "/conf/core/fc-md-extent")
def fc_md_extent(api: Api) -> None:
    assert {one["id"] for one in api.filled()} == {"markers", "retired_markers", "marker_lines", "alignments", "plans"}
    for collection in api.filled():
        ((west, south, east, north),) = collection["extent"]["spatial"]["bbox"]
        ((first, last),) = collection["extent"]["temporal"]["interval"]
        for feature in api.features(collection["id"]):
            for lon_deg, lat_deg, *_ in vertices(feature["geometry"]):
                assert west <= lon_deg <= east
                assert south <= lat_deg <= north
            changed = feature["properties"].get("updated_at")
            assert changed is None or moment(first) <= moment(changed) <= moment(last)


@abstract_test(ONE, "/conf/core/sfc-md-op")
def sfc_md_op(api: Api) -> None:
    for one in api.document("/collections")["collections"]:
        assert api.get(f"/collections/{one['id']}").status_code == 200
    sfc_md_success(api)


@abstract_test(ONE, "/conf/core/sfc-md-success")
def sfc_md_success(api: Api) -> None:
    for one in api.document("/collections")["collections"]:
        own = api.document(f"/collections/{one['id']}")
        for name in ("id", "title", "description", "extent", "itemType"):
            assert own.get(name) == one.get(name)
        assert all(link in own["links"] for link in one["links"])


# --- core: features -----------------------------------------------------------------------------------------------


@abstract_test(ONE, "/conf/core/fc-op")
def fc_op(api: Api) -> None:
    for collection in api.collections():
        assert api.get(f"/collections/{collection['id']}/items").status_code == 200
    everything = api.features("markers")
    half = everything[: len(everything) // 2]
    until = half[-1]["properties"]["updated_at"]
    box = (8.405, 48.9, 8.475, 49.1)
    found = api.features("markers", bbox=",".join(map(str, box)), datetime=f"../{until}")
    expected = [
        one["id"] for one in everything if in_box(one, box) and moment(one["properties"]["updated_at"]) <= moment(until)
    ]
    assert [one["id"] for one in found] == expected
    assert 0 < len(expected) < len(half)


@abstract_test(ONE, "/conf/core/fc-bbox-definition")
def fc_bbox_definition(api: Api) -> None:
    for collection in api.collections():
        parameter = api.parameter("bbox", collection["id"])
        check_definition(parameter, "array")
        assert parameter["schema"]["items"] == {"type": "number"}
        assert parameter["schema"]["oneOf"] == [{"minItems": 4, "maxItems": 4}, {"minItems": 6, "maxItems": 6}]
        assert (parameter["schema"]["minItems"], parameter["schema"]["maxItems"]) == (4, 6)  # the team engine's test


@abstract_test(ONE, "/conf/core/fc-bbox-response", "every feature has a geometry")
def fc_bbox_response(api: Api) -> None:
    for collection in api.filled():
        everything = api.features(collection["id"])
        west, south, east, north = collection["extent"]["spatial"]["bbox"][0]
        middle = (west + east) / 2
        for box in ((west, south, middle, north), (middle, south, east, north), (0.0, 0.0, 1.0, 1.0)):
            response = api.get(f"/collections/{collection['id']}/items", bbox=",".join(map(str, box)))
            assert response.headers["content-crs"] == f"<{CRS84}>"
            found = [one["id"] for one in response.json()["features"]]
            assert found == [one["id"] for one in everything if in_box(one, box)], collection["id"]
    low, high = 102.5, 106.5
    found = [one["id"] for one in api.features("markers", bbox=f"8,48,{low},9,50,{high}")]
    heights = {one["id"]: one["geometry"]["coordinates"][2:] for one in api.features("markers")}
    assert found == [name for name, height in heights.items() if not height or low <= height[0] <= high]
    assert 0 < len(found) < len(heights)


@abstract_test(ONE, "/conf/core/fc-limit-definition")
def fc_limit_definition(api: Api) -> None:
    for collection in api.collections():
        check_definition(api.parameter("limit", collection["id"]), "integer")


@abstract_test(ONE, "/conf/core/fc-limit-response")
def fc_limit_response(api: Api) -> None:
    largest = api.parameter("limit")["schema"]["maximum"]
    for collection in api.filled():
        total = len(api.features(collection["id"]))
        for limit in (1, 2, total, total + 1, largest, largest + 1):
            page = api.document(f"/collections/{collection['id']}/items", limit=limit)
            assert len(page["features"]) == min(limit, total)
    assert api.get("/collections/markers/items", limit=0).status_code == 400


@abstract_test(ONE, "/conf/core/fc-time-definition")
def fc_time_definition(api: Api) -> None:
    for collection in api.collections():
        check_definition(api.parameter("datetime", collection["id"]), "string")


@abstract_test(ONE, "/conf/core/fc-time-response", "marker_lines have no time, so datetime leaves all of them")
def fc_time_response(api: Api) -> None:
    everything = api.features("markers")
    times = sorted(one["properties"]["updated_at"] for one in everything)
    early, late = times[3], times[-4]
    for text, since, until in (
        (early, early, early),
        (f"{early}/{late}", early, late),
        (f"../{late}", None, late),
        (f"/{late}", None, late),
        (f"{early}/..", early, None),
        (f"{early}/", early, None),
        ("2001-02-03T04:05:06Z", "2001-02-03T04:05:06Z", "2001-02-03T04:05:06Z"),
    ):
        expected = [
            one["id"]
            for one in everything
            if (since is None or moment(since) <= moment(one["properties"]["updated_at"]))
            and (until is None or moment(one["properties"]["updated_at"]) <= moment(until))
        ]
        assert [one["id"] for one in api.features("markers", datetime=text)] == expected, text
    assert api.features("marker_lines", datetime="2001-02-03T04:05:06Z") == api.features("marker_lines")


@abstract_test(ONE, "/conf/core/query-param-invalid")
def query_param_invalid(api: Api) -> None:
    invalid = ({"limit": "0"}, {"limit": "ten"}, {"bbox": "1,2,3"}, {"bbox": "1,2,3,4,5"}, {"datetime": "yesterday"})
    for collection in api.collections():
        for parameters in invalid:
            assert api.get(f"/collections/{collection['id']}/items", **parameters).status_code == 400, parameters


@abstract_test(ONE, "/conf/core/query-param-unknown")
def query_param_unknown(api: Api) -> None:
    for path, _, _ in api.operations():
        if "{" not in path or "maintenance" not in path:
            assert api.get(api.filled_path(path), nonsense="1").status_code == 400, path


@abstract_test(ONE, "/conf/core/fc-response")
def fc_response(api: Api) -> None:
    for collection in api.collections():
        page = api.document(f"/collections/{collection['id']}/items")
        assert page["type"] == "FeatureCollection"
        assert all(one["type"] == "Feature" for one in page["features"])
    assert {one["properties"]["road"] for one in api.features("markers", road="A7")} == {"A7"}
    fc_links(api)


@abstract_test(ONE, "/conf/core/fc-links")
def fc_links(api: Api) -> None:
    for collection in api.collections():
        for parameters in ({}, {"limit": 1}, {"resultType": "hits"}):
            page = api.document(f"/collections/{collection['id']}/items", **parameters)
            check_links(page)
            check_formats(api, page, GEOJSON, {HTML})


@abstract_test(ONE, "/conf/core/fc-timeStamp")
def fc_time_stamp(api: Api) -> None:
    before = datetime.now(UTC)
    stamp = moment(api.document("/collections/markers/items")["timeStamp"])
    assert before - timedelta(milliseconds=1) <= stamp <= datetime.now(UTC)


@abstract_test(ONE, "/conf/core/fc-numberMatched")
def fc_number_matched(api: Api) -> None:
    boxes = (
        {},
        {"bbox": "8.405,48.9,8.455,49.1"},
        {"road": "A7"},
        {"datetime": "2001-01-01"},
        {"filter": "road > 'B'"},
    )
    for collection in api.filled():
        for parameters in boxes if collection["id"] == "markers" else boxes[:2]:
            total = len(api.features(collection["id"], **parameters))
            path = f"/collections/{collection['id']}/items"
            assert api.document(path, limit=1, count="true", **parameters)["numberMatched"] == total
            assert api.document(path, **parameters).get("numberMatched", total) == total
            assert api.document(path, resultType="hits", **parameters)["numberMatched"] == total


@abstract_test(ONE, "/conf/core/fc-numberReturned")
def fc_number_returned(api: Api) -> None:
    for collection in api.collections():
        for limit in (1, 3, 1000):
            page = api.document(f"/collections/{collection['id']}/items", limit=limit)
            assert page["numberReturned"] == len(page["features"])


@abstract_test(ONE, "/conf/core/f-op")
def f_op(api: Api) -> None:
    for url, feature in some_features(api):
        found = api.document(url)
        assert {name: found[name] for name in ("id", "geometry", "properties")} == {
            name: feature[name] for name in ("id", "geometry", "properties")
        }


@abstract_test(ONE, "/conf/core/f-success")
def f_success(api: Api) -> None:
    f_links(api)
    geojson_content(api)
    html_content(api)


@abstract_test(ONE, "/conf/core/f-links")
def f_links(api: Api) -> None:
    for url, feature in some_features(api):
        found = api.document(url)
        check_links(found)
        check_formats(api, found, GEOJSON, {HTML})
        (parent,) = links(found, "collection")
        assert api.document(parent["href"])["id"] == url.split("/")[2]
        assert feature["id"] in links(found, "self")[0]["href"]


# --- geojson, html ------------------------------------------------------------------------------------------------


@abstract_test(ONE, "/conf/geojson/definition")
def geojson_definition(api: Api) -> None:
    for path, operation, _ in api.operations():
        if "/tiles/" in path or (path.endswith("{featureId}") and "maintenance" in path):
            continue
        kind = GEOJSON if "/items" in path else JSON
        response = api.get(api.filled_path(path), kind)
        assert response.status_code == 200, path
        # a JSON document may have a media type of its own, as the API definition says
        assert media_type(response) in {kind, *map(plain, operation["responses"]["200"]["content"])} - {HTML}, path


@abstract_test(ONE, "/conf/geojson/content")
def geojson_content(api: Api) -> None:
    for collection in api.collections():
        page = api.document(f"/collections/{collection['id']}/items", GEOJSON)
        assert set(page) >= {"type", "features"}
        for feature in page["features"]:
            check_feature(feature)
    for url, feature in some_features(api):
        found = api.document(url, GEOJSON)
        check_feature(found)
        assert found["id"] == feature["id"] == url.rsplit("/", 1)[1]


@abstract_test(ONE, "/conf/html/definition", "tiles and the schema in GeoJSON have no HTML: 406")
def html_definition(api: Api) -> None:
    pages = 0
    for path, operation, _ in api.operations():
        if path.endswith("{featureId}") and "maintenance" in path:
            continue
        response = api.get(api.filled_path(path), HTML)
        offered = HTML in operation["responses"]["200"]["content"]
        assert response.status_code == (200 if offered else 406), path
        assert not offered or media_type(response) == HTML
        pages += offered
    assert pages > 30


@abstract_test(ONE, "/conf/html/content")
def html_content(api: Api) -> None:
    for path in ("/", "/conformance", "/collections", "/api", "/collections/markers"):
        html_of(api.get(path, HTML))
    for url, feature in some_features(api):
        text = html_of(api.get(url, HTML)).text_content()
        for name, value in feature["properties"].items():
            assert name in text or value is None or str(value) in text, name
    text = html_of(api.get("/collections/markers/items", HTML)).text_content()
    assert all(one["id"] in text or one["properties"]["code"] in text for one in api.features("markers"))


# --- oas30 --------------------------------------------------------------------------------------------------------


@abstract_test(ONE, "/conf/oas30/completeness")
def oas_completeness(api: Api) -> None:
    for response, operation in all_responses(api):
        described = described_response(response, operation)
        assert described is not None, (response.url, response.status_code)
        if response.status_code != 204:
            document = api.document("/api")
            if "$ref" in described:
                described = document["components"]["responses"][described["$ref"].rsplit("/", 1)[1]]
            kinds = set(map(plain, described["content"])) | {JSON}
            assert media_type(response) in kinds, (response.url, response.status_code)


@abstract_test(ONE, "/conf/oas30/exceptions-codes")
def oas_exception_codes(api: Api) -> None:
    statuses = set()
    for response, operation in all_responses(api):
        assert described_response(response, operation) is not None, (response.url, response.status_code)
        statuses.add(response.status_code)
    assert statuses >= {200, 400, 401, 404, 406}


@abstract_test(ONE, "/conf/oas30/oas-definition-1")
def oas_definition_1(api: Api) -> None:
    landing = api.document("/")
    (machine,), (human,) = links(landing, "service-desc"), links(landing, "service-doc")
    assert machine["type"] == "application/vnd.oai.openapi+json;version=3.0"
    assert api.get(machine["href"], machine["type"]).headers["content-type"] == machine["type"]
    assert human["type"] == HTML
    assert media_type(api.get(human["href"], HTML)) == HTML


@abstract_test(ONE, "/conf/oas30/oas-definition-2")
def oas_definition_2(api: Api) -> None:
    document = api.document("/api")
    assert document["openapi"].startswith("3.0.")
    openapi_spec_validator.validate(document, cls=openapi_spec_validator.OpenAPIV30SpecValidator)


SAMPLES = {
    "f": "json", "crs": CRS84, "bbox": "8,48,9,50", "bbox-crs": CRS84, "limit": "5",
    "datetime": "2020-01-01T00:00:00Z/..",
    "resultType": "hits", "count": "true", "filter": "TRUE", "filter-lang": "cql2-text", "filter-crs": CRS84,
    "groups": "true",
}  # fmt: skip


@abstract_test(ONE, "/conf/oas30/oas-impl")
def oas_impl(api: Api) -> None:
    for path, _, parameters in api.operations():
        if path.endswith("{featureId}") and "maintenance" in path:
            continue
        for parameter in parameters:
            name, kind = parameter["name"], parameter["schema"]["type"]
            if parameter["in"] == "path" or name in ("after", "earlier"):  # which the next links have
                continue
            own = "2020-01-01T00:00:00Z" if parameter["schema"].get("format") == "date-time" else "1"
            sent = {name: SAMPLES.get(name, own if kind != "string" or own != "1" else "x")}
            if name == "bbox-crs":
                sent["bbox"] = SAMPLES["bbox"]
            response = api.client.get(api.root + api.filled_path(path), params=sent)
            assert response.status_code in (200, 204), (path, sent, response.text)


@abstract_test(ONE, "/conf/oas30/security")
def oas_security(api: Api) -> None:
    document = api.document("/api")
    schemes = document["components"]["securitySchemes"]
    required = {name for requirement in document["security"] for name in requirement}
    kinds = {(scheme["type"], scheme.get("scheme") or scheme.get("name")) for scheme in schemes.values()}
    assert kinds == {("http", "bearer"), ("http", "basic"), ("apiKey", "X-API-Key")}
    assert required == set(schemes)
    key = api.client.headers["authorization"].removeprefix("Bearer ")
    with httpx.Client(trust_env=False) as stranger:
        assert stranger.get(f"{api.root}/conformance").status_code == 401
        assert stranger.get(f"{api.root}/conformance", headers={"Authorization": f"Bearer {key}"}).status_code == 200
        assert stranger.get(f"{api.root}/conformance", headers={"X-API-Key": key}).status_code == 200
        assert stranger.get(f"{api.root}/conformance", auth=("anyone", key)).status_code == 200


# --- part 2: coordinate reference systems -------------------------------------------------------------------------

OGC_URI = re.compile(r"http://www\.opengis\.net/def/crs/(OGC|EPSG)/[0-9.]+/[A-Za-z0-9]+", re.ASCII)
UNLISTED = (
    "http://www.opengis.net/def/crs/EPSG/0/5773",  # of heights only
    "http://www.opengis.net/def/crs/EPSG/0/99999",
    "http://www.opengis.net/def/crs/0/unsupported",
    "EPSG:4326",
    "",
)


@abstract_test(TWO, "/conf/crs/crs-uri")
def crs_uri(api: Api) -> None:
    document = api.document("/collections")
    for collection in document["collections"]:
        assert collection["crs"] == ["#/crs"]
        assert OGC_URI.fullmatch(collection["storageCrs"])
    for collection in [document, *api.collections()]:
        assert all(OGC_URI.fullmatch(uri) for uri in collection["crs"])
        assert len(set(collection["crs"])) == len(collection["crs"]) > 50


@abstract_test(TWO, "/conf/crs/default-crs")
def default_crs(api: Api) -> None:
    for collection in [api.document("/collections"), *api.collections()]:
        assert CRS84 in collection["crs"] or CRS84H in collection["crs"]


@abstract_test(TWO, "/conf/crs/storageCrs")
def storage_crs(api: Api) -> None:
    for collection in api.collections():
        assert collection["storageCrs"] in collection["crs"]
    for collection in api.document("/collections")["collections"]:
        assert collection["storageCrs"] in api.document("/collections")["crs"]


@abstract_test(TWO, "/conf/crs/crs-parameter", "every 50th listed system, and 12 for all collections")
def crs_parameter(api: Api) -> None:
    filled = api.filled()
    items = [f"/collections/{one['id']}/items" for one in filled]
    single = [f"{path}/{api.features(one['id'])[0]['id']}" for one, path in zip(filled, items, strict=True)]
    assert len({tuple(one["crs"]) for one in filled}) == 1
    everywhere = known(filled[0])
    for uri in dict.fromkeys([*everywhere, *filled[0]["crs"][::50]]):
        every = uri in everywhere
        for path in items + single if every else (items[0], single[0]):
            response = api.get(path, GEOJSON, crs=uri, **({"limit": 3} if path in items else {}))
            assert response.status_code == 200, response.text
            assert response.headers["content-crs"] == f"<{uri}>"
            assert response.json()["type"] in ("Feature", "FeatureCollection")


@abstract_test(TWO, "/conf/crs/crs-parameter-invalid")
def crs_parameter_invalid(api: Api) -> None:
    for collection in api.filled():
        items = f"/collections/{collection['id']}/items"
        for uri in UNLISTED:
            assert uri not in collection["crs"]
            assert api.get(items, crs=uri).status_code == 400, uri
            assert api.get(f"{items}/{api.features(collection['id'])[0]['id']}", crs=uri).status_code == 400, uri


@abstract_test(TWO, "/conf/crs/crs-parameter-default")
def crs_parameter_default(api: Api) -> None:
    for collection in api.filled():
        items = f"/collections/{collection['id']}/items"
        for path in (items, f"{items}/{api.features(collection['id'])[0]['id']}"):
            assert api.get(path).headers["content-crs"] == f"<{CRS84}>"


@abstract_test(TWO, "/conf/crs/crs-parameter-transform", "12 systems, compared with PROJ to 5 m")
def crs_parameter_transform(api: Api) -> None:
    names = ("markers", "alignments")
    for uri in known(api.document("/collections/markers")):
        for name in names:
            plain_features, found = api.features(name)[:3], api.features(name, crs=uri)[:3]
            for one, other in zip(plain_features, found, strict=True):
                expected = in_crs([v[:2] for v in vertices(one["geometry"])], uri)
                actual = np.array([v[:2] for v in vertices(other["geometry"])])
                tolerance = 5.0 if np.abs(expected).max() > 400.0 else 5e-5
                np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance, err_msg=uri)


@abstract_test(TWO, "/conf/crs/bbox-crs-parameter", "12 systems")
def bbox_crs_parameter(api: Api) -> None:
    everything = api.features("markers")
    for uri in known(api.document("/collections/markers")):
        corners = in_crs([[8.415, 48.99], [8.465, 49.05], [8.415, 49.05], [8.465, 48.99]], uri)
        low, high = corners.min(axis=0), corners.max(axis=0)
        placed = {one["id"]: in_crs([one["geometry"]["coordinates"][:2]], uri)[0] for one in everything}
        margin = (high - low) / 1000  # PROJ's operations differ by metres
        sure = {name for name, at in placed.items() if (low + margin < at).all() and (at < high - margin).all()}
        near = {name for name, at in placed.items() if (low - margin < at).all() and (at < high + margin).all()}
        box = ",".join(repr(float(side)) for side in (*low, *high))
        found = {one["id"] for one in api.features("markers", bbox=box, bbox_crs=uri)}
        assert sure <= found <= near, uri
        assert 0 < len(found) < len(everything)


@abstract_test(TWO, "/conf/crs/bbox-crs-parameter-invalid")
def bbox_crs_parameter_invalid(api: Api) -> None:
    for collection in api.collections():
        for uri in UNLISTED:
            response = api.get(f"/collections/{collection['id']}/items", bbox="8,48,9,50", bbox_crs=uri)
            assert response.status_code == 400, uri


@abstract_test(TWO, "/conf/crs/bbox-crs-parameter-default")
def bbox_crs_parameter_default(api: Api) -> None:
    for collection in api.filled():
        west, south, east, north = collection["extent"]["spatial"]["bbox"][0]
        box = f"{west},{south},{(west + east) / 2},{north}"
        found = api.features(collection["id"], bbox=box, bbox_crs=CRS84)
        assert found == api.features(collection["id"], bbox=box) != []


# --- steps --------------------------------------------------------------------------------------------------------


def moment(text: str) -> datetime:
    return datetime.fromisoformat(text)


def plain(media: str) -> str:
    return media.partition(";")[0]


def media_type(response: httpx.Response) -> str:
    return plain(response.headers["content-type"])


def in_box(feature: dict[str, Any], box: tuple[float, ...]) -> bool:
    return bool(shapely.intersects(shapely.box(*box), shapely.geometry.shape(feature["geometry"])))


def in_crs(places_deg: list[list[float]], uri: str) -> np.ndarray:
    """Places in a system, its axes in the authority's order, by PROJ."""
    first, second = transformer(uri).transform(*np.array(places_deg).T)
    return np.column_stack([first, second])


def html_of(response: httpx.Response) -> Any:
    """An HTML 5 document with a language, a title and a main part."""
    assert (response.status_code, media_type(response)) == (200, HTML)
    assert response.text.lower().startswith("<!doctype html>")
    page = lxml.html.fromstring(response.text)
    assert page.get("lang")
    assert page.findtext(".//title")
    assert page.find(".//main") is not None
    return page


def check_formats(api: Api, document: dict[str, Any], own: str, others: set[str]) -> None:
    """There are links to the document itself, and to it in each other format, which return these."""
    (self,) = links(document, "self")
    alternates = links(document, "alternate")
    assert self["type"] == own
    assert {link["type"] for link in alternates} == others
    for link in (self, *alternates):
        assert media_type(api.get(link["href"], link["type"])) == link["type"]


def check_definition(parameter: dict[str, Any], kind: str) -> None:
    assert (parameter["in"], parameter["style"], parameter["explode"]) == ("query", "form", False)
    assert parameter.get("required", False) is False
    assert parameter["schema"]["type"] == kind


def check_feature(feature: dict[str, Any]) -> None:
    """A feature as RFC 7946 and featureGeoJSON.yaml have it."""
    assert feature["type"] == "Feature"
    assert isinstance(feature["id"], str)
    assert isinstance(feature["properties"], dict)
    assert feature["geometry"]["type"] in ("Point", "LineString")
    assert shapely.geometry.shape(feature["geometry"]).is_valid
    assert all(len(vertex) in (2, 3) for vertex in vertices(feature["geometry"]))


def some_features(api: Api) -> Iterator[tuple[str, dict[str, Any]]]:
    """Paths of features of all collections that have some, and the features in the collection."""
    for collection in api.filled():
        for feature in api.features(collection["id"])[:4]:
            yield f"/collections/{collection['id']}/items/{feature['id']}", feature


def described_response(response: httpx.Response, operation: dict[str, Any]) -> dict[str, Any] | None:
    status, responses = str(response.status_code), operation["responses"]
    found: dict[str, Any] | None = responses.get(status) or responses.get(f"{status[0]}XX")
    return found


def all_responses(api: Api) -> Iterator[tuple[httpx.Response, dict[str, Any]]]:
    """Responses of every operation: as it should be, and each way in which it refuses."""
    with httpx.Client(trust_env=False) as stranger:
        for path, operation, _ in api.operations():
            if path.endswith("{featureId}") and "maintenance" in path:
                continue
            url = api.root + api.filled_path(path)
            for kind in operation["responses"]["200"]["content"]:
                yield api.client.get(url, headers={"Accept": kind}), operation
            yield api.client.get(url, params={"nonsense": "1"}), operation
            yield api.client.get(url, headers={"Accept": "image/png"}), operation
            yield stranger.get(url), operation
            if "{featureId}" in path:
                yield api.client.get(url[:-4] + "0000"), operation
            if "/tiles/" in path:
                yield api.client.get(url.replace("/0/0/0", "/5/0/0")), operation
                yield api.client.get(url.replace("/0/0/0", "/0/1/0")), operation
