"""OGC API Features over HTTP: pages, filters, reference systems, and what is refused."""

from __future__ import annotations

from typing import Any
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest
from pyproj import Transformer

from app.services.access.access import Scope
from tests.conftest import ADMIN_KEY, LiveServer

pytestmark = pytest.mark.both_databases

ITEMS = "/ogc/collections/markers/items"
CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
WGS84 = "http://www.opengis.net/def/crs/EPSG/0/4326"
MERCATOR = "http://www.opengis.net/def/crs/EPSG/0/3857"
ROW = [(5.0 + 0.1 * k, 45.0 + 0.01 * k) for k in range(12)]


def add(client: httpx.Client, lon_deg: float, lat_deg: float, **members: Any) -> str:
    position = {"lon_deg": lon_deg, "lat_deg": lat_deg, **members.pop("position", {})}
    response = client.post("/v1/markers", json={"position": position, "code": {"scheme": "id"}, **members})
    assert response.status_code == 201, response.text
    return str(response.json()["id"])


def get(client: httpx.Client, path: str = ITEMS, **parameters: Any) -> dict[str, Any]:
    response = client.get(path, params=parameters)
    assert response.status_code == 200, response.text
    return dict(response.json())


def ids(page: dict[str, Any]) -> list[str]:
    assert page["numberReturned"] == len(page["features"])
    return [feature["id"] for feature in page["features"]]


@pytest.fixture
def row(client: httpx.Client) -> list[str]:
    return [add(client, lon, lat, road=f"A{k % 3}") for k, (lon, lat) in enumerate(ROW)]


# --- documents ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_every_link_leads_somewhere_with_its_type(client: httpx.Client, row: list[str]) -> None:
    seen: set[str] = set()
    todo = [f"{client.base_url}/ogc/"]
    while todo:
        url = todo.pop()
        seen.add(url)
        document = client.get(url).json()
        nested = [link for member in document.get("collections", []) for link in member["links"]]
        for link in [*document.get("links", []), *nested]:
            response = client.get(link["href"], headers={"Accept": link["type"]})
            assert response.status_code == 200, link
            assert response.headers["content-type"].startswith(link["type"].partition(";")[0]), link
            if link["href"] not in seen and "json" in link["type"] and urlsplit(link["href"]).path.startswith("/ogc"):
                todo.append(link["href"])
    assert any(url.endswith("/schema") for url in seen)


def test_a_collection_says_what_clients_need(client: httpx.Client, row: list[str]) -> None:
    collection = get(client, "/ogc/collections/markers")
    west, south, east, north = collection["extent"]["spatial"]["bbox"][0]
    assert (west, south, east, north) == pytest.approx((5.0, 45.0, 6.1, 45.11))
    assert collection["storageCrs"] == CRS84
    assert collection["storageCrs"] in collection["crs"]
    assert "storageCrsCoordinateEpoch" not in collection  # the markers state none


def test_one_epoch_of_all_markers_is_published(client: httpx.Client) -> None:
    for lon in (1.0, 2.0):
        add(client, lon, 40.0, position={"epoch": 2025.5, "realization": "ITRF2014"})
    assert get(client, "/ogc/collections/markers")["storageCrsCoordinateEpoch"] == 2025.5


def test_the_schema_names_every_property(client: httpx.Client, row: list[str]) -> None:
    schema = get(client, "/ogc/collections/markers/geojson-schema")
    feature = get(client, f"{ITEMS}/{row[0]}")
    properties = schema["properties"]["properties"]["properties"]
    assert list(properties) == list(feature["properties"])
    assert {kind["type"] for kind in properties.values()} == {"string", "number", "integer"}


def test_the_api_document_is_what_gdal_and_qgis_can_use(client: httpx.Client) -> None:
    document = get(client, "/ogc/api")
    assert document["openapi"] == "3.0.3"
    assert document["components"]["parameters"]["limit"]["schema"]["maximum"] == 10_000
    references = document["paths"][ITEMS.removeprefix("/ogc")]["get"]["parameters"]
    named = [document["components"]["parameters"][ref["$ref"].rsplit("/", 1)[1]] for ref in references]
    for parameter in named:
        assert (parameter["style"], parameter["explode"]) == ("form", False)
    assert {"code", "road", "family", "resultType"} <= {parameter["name"] for parameter in named}


def test_links_follow_the_proxy(client: httpx.Client, row: list[str]) -> None:
    headers = {"X-Forwarded-Proto": "https", "X-Forwarded-Host": "roads.example:8443", "X-Forwarded-Prefix": "/way"}
    page = client.get(f"{ITEMS}?limit=1", headers=headers).json()
    for link in page["links"]:
        assert link["href"].startswith("https://roads.example:8443/way/ogc/collections/markers")
    for bad in ("evil host", "x/y", "a@b", "%00"):
        headers = {"X-Forwarded-Host": bad}
        assert (
            client.get(f"{ITEMS}?limit=1", headers=headers).json()["links"][0]["href"].startswith(str(client.base_url))
        )


# --- pages --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("limit", [1, 5, 12, 13])
def test_next_links_lead_through_every_feature_once(client: httpx.Client, row: list[str], limit: int) -> None:
    url, found, pages = f"{ITEMS}?limit={limit}&bbox=0,40,10,50&crs={MERCATOR}", [], 0
    while url:
        page = client.get(url).json()
        found += ids(page)
        pages += 1
        onward = [link["href"] for link in page["links"] if link["rel"] == "next"]
        url = onward[0] if onward else ""
        if url:
            assert {"limit", "bbox", "crs", "after"} == set(parse_qs(urlsplit(url).query))
    assert found == row
    assert pages == -(-12 // limit)


def test_a_limit_above_the_maximum_is_the_maximum(client: httpx.Client, row: list[str]) -> None:
    assert ids(get(client, limit=10**9)) == row
    assert ids(get(client, limit="9" * 24)) == row


@pytest.mark.parametrize("limit", ["0", "-1", "00", "1.5", "", "all", "+3", "1e2"])
def test_a_limit_below_one_is_refused(client: httpx.Client, row: list[str], limit: str) -> None:
    response = client.get(ITEMS, params={"limit": limit})
    assert response.status_code == 400
    assert response.json()["field"] == "limit"


def test_the_count_is_there_when_it_is_cheap_or_asked_for(client: httpx.Client, row: list[str]) -> None:
    assert get(client, limit=2)["numberMatched"] == 12
    assert get(client, limit=100, bbox="5.05,40,5.35,50")["numberMatched"] == 3
    assert "numberMatched" not in get(client, limit=2, bbox="5.05,40,5.35,50")
    assert get(client, limit=2, bbox="5.05,40,5.35,50", count="true")["numberMatched"] == 3
    hits = get(client, resultType="hits", road="A1")
    assert (hits["numberMatched"], hits["features"]) == (4, [])


def test_head_and_formats(client: httpx.Client, row: list[str]) -> None:
    response = client.head(ITEMS)
    assert response.status_code == 200
    assert response.headers["content-type"] == "application/geo+json"
    assert not response.content
    assert client.get(ITEMS, params={"f": "json"}).status_code == 200
    for accept, kind in (
        (None, "application/geo+json"),
        ("*/*", "application/geo+json"),
        ("application/geo+json", "application/geo+json"),
        ("application/json, text/html;q=0.9", "application/geo+json"),
        ("application/geo+json, text/html", "application/geo+json"),
        ("text/html;q=0.5, */*;q=0.8", "application/geo+json"),
        ("application/*", "application/geo+json"),
        ("text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8", "text/html; charset=utf-8"),
        ("text/html", "text/html; charset=utf-8"),
        ("text/*;q=wrong", "text/html; charset=utf-8"),
        ("application/gml+xml", None),
        ("application/geo+json;q=0", None),
    ):
        response = client.get(ITEMS, headers={"Accept": accept} if accept else {})
        assert response.status_code == (200 if kind else 406), accept
        assert kind is None or response.headers["content-type"] == kind, accept
    assert client.get("/ogc/tileMatrixSets", headers={"Accept": "text/html"}).status_code == 406
    for path in (ITEMS, "/ogc", "/ogc/tileMatrixSets"):
        assert client.get(path, params={"f": "gml"}).status_code == 400


# --- filters ------------------------------------------------------------------------------------------------------


def test_properties_filter(client: httpx.Client, row: list[str]) -> None:
    code = get(client, f"{ITEMS}/{row[4]}")["properties"]["code"]
    assert ids(get(client, code=code)) == [row[4]]
    assert ids(get(client, road="A2")) == row[2::3]
    assert ids(get(client, road="A2", bbox="5,45,5.55,46", family="plate", version="1")) == [row[2], row[5]]
    assert ids(get(client, family="magnet")) == []
    assert ids(get(client, measure_m="3.5")) == []


def test_boxes_in_every_reference_system(client: httpx.Client, row: list[str]) -> None:
    west, south, east, north = 5.05, 44.9, 5.45, 45.2
    mercator = Transformer.from_crs(4326, 3857, always_xy=True).transform
    boxes = {
        CRS84: (west, south, east, north),
        WGS84: (south, west, north, east),
        MERCATOR: (*mercator(west, south), *mercator(east, north)),
    }
    for crs, box in boxes.items():
        assert ids(get(client, bbox=",".join(map(str, box)), **{"bbox-crs": crs})) == row[1:5], crs
        page = client.get(ITEMS, params={"crs": crs})
        assert page.headers["content-crs"] == f"<{crs}>"
        first = page.json()["features"][1]["geometry"]["coordinates"]
        lon, lat = ROW[1]
        expected = {CRS84: (lon, lat), WGS84: (lat, lon), MERCATOR: mercator(lon, lat)}[crs]
        assert first == pytest.approx(expected, abs=1e-6)


def test_boxes_across_the_antimeridian_and_beyond_the_world(client: httpx.Client) -> None:
    west, east = add(client, 179.9, 10.0), add(client, -179.9, 10.0)
    middle = add(client, 0.0, 10.0)
    assert ids(get(client, bbox="179,0,-179,20")) == [west, east]
    assert ids(get(client, bbox="179,0,181,20")) == [west, east]
    assert ids(get(client, bbox="-181,0,-179,20")) == [west, east]
    assert ids(get(client, bbox="-179,0,179,20")) == [middle]
    assert ids(get(client, bbox="-400,-120,400,120")) == [west, east, middle]


def test_heights(client: httpx.Client) -> None:
    low, none = add(client, 3.0, 30.0, position={"height_m": 5.0}), add(client, 3.1, 30.0)
    high = add(client, 3.2, 30.0, position={"height_m": 50.0})
    assert ids(get(client, bbox="2,29,0,4,31,10")) == [low, none]
    assert ids(get(client, bbox="2,29,4,31")) == [low, none, high]
    assert get(client, f"{ITEMS}/{high}")["geometry"] == {"type": "Point", "coordinates": [3.2, 30.0, 50.0]}


def test_times(client: httpx.Client, row: list[str]) -> None:
    for text, count in {
        "0000-01-01T00:00:00Z/9999-12-31T23:59:59Z": 12,
        "../9999-12-31T23:59:59-14:00": 12,
        "2020-01-01/..": 12,
        "2020-01-01T00:00:00+02:00/": 12,
        "/0000-12-31": 0,
        "../2020-01-01": 0,
        "2020-02-29": 0,
        "2016-12-31T23:59:60Z": 0,
        "0001-01-01T00:00:00+14:00/..": 12,
    }.items():
        assert len(get(client, datetime=text)["features"]) == count, text
    moment = get(client, f"{ITEMS}/{row[0]}")["properties"]["updated_at"]
    assert row[0] in ids(get(client, datetime=moment))
    assert row[0] in ids(get(client, datetime=moment[:19] + "Z"))  # GDAL leaves the fraction out
    assert row[0] in ids(get(client, datetime=moment[:10]))


def test_any_system_of_the_registry_is_served(client: httpx.Client) -> None:
    """A marker that came in a national system comes back as it came; axes are in the authority's order."""
    sent = {"easting_m": 458_123.4567, "northing_m": 5_428_765.4321, "crs": "EPSG:25832", "realization": "ETRF2000"}
    position = {**sent, "epoch": 2026.4, "height_m": 130.0, "horizontal_rmse_m": 0.01, "vertical_datum": "ellipsoid"}
    body = {"family": "cerpm", "position": position, "side": "left", "road": "A8"}
    made = client.post("/v1/markers", json=body)
    assert made.status_code == 201, made.text
    uri = "http://www.opengis.net/def/crs/EPSG/0/"
    answer = client.get(ITEMS, params={"crs": f"{uri}25832", "road": "A8"})
    assert answer.headers["content-crs"] == f"<{uri}25832>"
    (feature,) = answer.json()["features"]
    assert feature["geometry"]["coordinates"] == pytest.approx([458_123.4567, 5_428_765.4321, 130.0], abs=1e-4)
    url = f"{ITEMS}/{feature['id']}"
    north_first = client.get(url, params={"crs": f"{uri}31467"}).json()["geometry"]["coordinates"]
    assert north_first[0] > 5e6 > north_first[1]
    lat_first = client.get(url, params={"crs": f"{uri}4258"}).json()["geometry"]["coordinates"]
    assert lat_first[:2] == pytest.approx([49.010, 8.427], abs=1e-3)
    page = client.get(url, params={"crs": f"{uri}25832", "f": "html"}).text
    assert "458123" in page.replace(",", "").replace(" ", "")
    far = client.get(url, params={"crs": f"{uri}2326"})
    assert (far.status_code, far.json()["geometry"]) == (200, None), "outside the area of the system"
    inside = {"bbox": "458100,5428700,458200,5428800", "bbox-crs": f"{uri}25832", "road": "A8"}
    assert len(client.get(ITEMS, params=inside).json()["features"]) == 1
    outside = inside | {"bbox": "458200,5428700,458300,5428800"}
    assert client.get(ITEMS, params=outside).json()["features"] == []


@pytest.mark.parametrize(
    ("code", "box"),
    [
        (25832, "-5000000,-10000000,10000000,10000000"),
        (32632, "0,0,1000000,10000000"),
        (3035, "0,0,9000000,9000000"),
        (5041, "0,0,4500000,4500000"),
        (3413, "-5000000,-5000000,5000000,5000000"),
    ],
)
def test_boxes_over_much_of_the_earth(client: httpx.Client, code: int, box: str) -> None:
    for lat_deg in (49.0, 70.0):
        position = {"lon_deg": 8.4, "lat_deg": lat_deg}
        made = client.post("/v1/markers", json={"family": "cerpm", "position": position, "road": "box"})
        assert made.status_code == 201, made.text
    sent = {"bbox": box, "bbox-crs": f"http://www.opengis.net/def/crs/EPSG/0/{code}", "road": "box"}
    answer = client.get(ITEMS, params=sent)
    assert answer.status_code == 200, answer.text
    found = {round(feature["geometry"]["coordinates"][1]) for feature in answer.json()["features"]}
    assert 70 in found
    assert (49 in found) == (code != 5041)


BAD = [
    "nonsense=1",
    "limit=ten",
    "limit=1.5",
    "limit=",
    "limit=1&limit=2",
    "bbox=",
    "bbox=1,2,3",
    "bbox=1,2,3,4,5",
    "bbox=1,2,3,4,5,6,7,8,9",
    "bbox=nan,0,1,1",
    "bbox=0,0,inf,1",
    "bbox=0,0,1e400,1",
    "bbox=0,10,1,5",
    "bbox=0,0,9,1,1,1",
    "bbox=a,b,c,d",
    "bbox=%00,0,1,1",
    "bbox=١,0,2,1",
    "bbox=1_0,0,20,1",
    "bbox-crs=" + CRS84,
    "bbox=0,0,1,1&bbox-crs=EPSG:4326",
    "crs=http://www.opengis.net/def/crs/EPSG/0/99999",
    "crs=http://www.opengis.net/def/crs/EPSG/0/5703",
    "crs=EPSG:25832",
    "bbox=0,0,1,1&bbox-crs=http://www.opengis.net/def/crs/EPSG/0/5703",
    "crs=",
    "datetime=",
    "datetime=../..",
    "datetime=a/b",
    "datetime=2026-13-01",
    "datetime=2026-02-30",
    "datetime=2026-01-02/2026-01-01",
    "datetime=2026-01-01/2026-01-02/2026-01-03",
    "datetime=2026-01-01T25:00:00Z",
    "datetime=2026-01-01T00:00:00%2B99:00",
    "datetime=99999-01-01",
    "resultType=some",
    "count=1",
    "after=%00",
    "after=" + "x" * 400,
    "road=%00",
    "road=%ED%A0%80",
    "road=%FF",
    "measure_m=ten",
    "measure_m=NaN",
    "version=1.5",
    "version=" + "9" * 24,
    "f=xml",
    "&".join(f"x{k}=1" for k in range(200)),
    "road=" + "x" * 10_000,
]


@pytest.mark.parametrize("query", BAD, ids=[text[:40] for text in BAD])
def test_bad_queries_are_400(client: httpx.Client, query: str) -> None:
    response = client.get(f"{ITEMS}?{query}")
    assert response.status_code == 400, response.text
    assert response.headers["content-type"] == "application/problem+json"
    assert response.json()["limit"]


def test_large_numbers_are_no_fault(client: httpx.Client, row: list[str]) -> None:
    assert ids(get(client, measure_m="9" * 24)) == []
    assert ids(get(client, bbox=f"-{'9' * 24},-{'9' * 24},{'9' * 24},{'9' * 24}")) == row
    assert ids(get(client, bbox="-1e300,-1e300,1e300,1e300", **{"bbox-crs": MERCATOR})) == row


# --- owners -------------------------------------------------------------------------------------------------------


def test_one_agency_never_sees_anothers(server: LiveServer, client: httpx.Client, row: list[str]) -> None:
    with server.agency("strangers to the row") as stranger:
        assert ids(get(stranger)) == []
        assert get(stranger, resultType="hits")["numberMatched"] == 0
        assert "extent" not in get(stranger, "/ogc/collections/markers")
        theirs, none = (stranger.get(f"{ITEMS}/{one}") for one in (row[0], row[0][:-4] + "0000"))
        for response in (theirs, none):
            assert response.status_code == 404
        bodies = [
            {name: value for name, value in response.json().items() if name not in ("instance", "request_id")}
            for response in (theirs, none)
        ]
        assert bodies[0] == bodies[1]


def test_features_need_a_key(server: LiveServer) -> None:
    with server.client(None) as anonymous:
        for path in ("/ogc", "/ogc/", "/ogc/api", ITEMS, "/ogc/nothing"):
            assert anonymous.get(path).status_code == 401, path
        assert anonymous.get(ITEMS, headers={"X-API-Key": ADMIN_KEY}).status_code == 200
    with server.agency("lookers", Scope.VIEWER) as reader:
        assert reader.get(ITEMS).status_code == 200


def test_retired_markers_are_a_collection_of_their_own(client: httpx.Client, row: list[str]) -> None:
    change = {"status": "retired", "reason": "resurfaced"}
    assert client.patch(f"/v1/markers/{row[3]}", json=change, headers={"If-Match": '"1"'}).status_code == 200
    assert row[3] not in ids(get(client))
    assert ids(get(client, "/ogc/collections/retired_markers/items")) == [row[3]]
    assert client.get(f"{ITEMS}/{row[3]}").status_code == 404


@pytest.mark.parametrize("path", ["/ogc/collections/nothing", f"{ITEMS}/x", f"{ITEMS}/%00", f"{ITEMS}/%ED%A0%80"])
def test_what_is_not_there(client: httpx.Client, path: str) -> None:
    response = client.get(path)
    assert response.status_code == 404
    assert response.headers["content-type"] == "application/problem+json"
