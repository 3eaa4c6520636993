"""CQL2 filters over HTTP, in text and JSON: the same rows on both databases, and nothing that gets past the parser."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
import shapely.geometry
from pyproj import Transformer

from app.api.ogc.cql2 import Reader
from app.api.ogc.query import places_in
from app.registry.conditions import GEOMETRY, Compared, Joined, Not, holds
from app.registry.features import FIELDS
from app.services.access.access import Scope
from app.services.markers.features import STORAGE_CRS
from tests.api.ogc.test_features import ITEMS, add, get
from tests.conftest import LiveServer

pytestmark = pytest.mark.both_databases

SQUARE = "POLYGON((5.1 44.9, 5.3 44.9, 5.3 45.1, 5.1 45.1, 5.1 44.9))"
# road, measure_m, status
ROWS = [
    ("A1", 0.0, "planned"),
    ("A10", 250.5, "planned"),
    ("a1", 500.0, "active"),
    ("O'Hare *[x]", 750.0, "active"),
    ("50%_\\", None, "planned"),
    (None, 1000.0, "active"),
]


@pytest.fixture(scope="module")
def roads(server: LiveServer) -> Iterator[httpx.Client]:
    """A client of an agency with the rows above."""
    with server.agency("filtering", Scope.PLANNER) as client:
        for k, (road, measure_m, status) in enumerate(ROWS):
            add(client, 5.0 + 0.1 * k, 45.0, road=road, measure_m=measure_m, status=status)
        yield client


def _found(client: httpx.Client, expression: Any, language: str | None = None) -> list[int]:
    """Numbers of the rows that a filter leaves."""
    text = expression if isinstance(expression, str) else json.dumps(expression)
    named = {} if language is None else {"filter-lang": language}
    page = get(client, ITEMS, filter=text, limit=100, **named)
    counted = get(client, ITEMS, filter=text, resultType="hits", **named)
    assert counted["numberMatched"] == len(page["features"])
    return [round((feature["geometry"]["coordinates"][0] - 5.0) * 10) for feature in page["features"]]


TEXTS = {
    "road = 'A1'": [0],
    "'A1' = road": [0],
    "road <> 'A1'": [1, 2, 3, 4],
    "\"road\" = 'O''Hare *[x]'": [3],
    "measure_m > 250.5": [2, 3, 5],
    "measure_m >= 2.505e2": [1, 2, 3, 5],
    "0 >= measure_m": [0],
    "measure_m BETWEEN 200 AND 600": [1, 2],
    "measure_m NOT BETWEEN 200 AND 600": [0, 3, 5],
    "road < 'O'": [0, 1, 4],
    "road > 'Z'": [2],
    "road LIKE 'A1%'": [0, 1],
    "road LIKE 'A1_'": [1],
    "road like '%*[%'": [3],
    r"road LIKE '50\%\_%'": [4],
    r"road LIKE '%\\'": [4],
    "road NOT LIKE 'A%'": [2, 3, 4],
    "road LIKE '*'": [],
    "road IN ('A1', 'a1', 'b')": [0, 2],
    "road not in ('A1', 'a1')": [1, 3, 4],
    "road IS NULL": [5],
    "measure_m IS NOT NULL": [0, 1, 2, 3, 5],
    "TRUE": [0, 1, 2, 3, 4, 5],
    "NOT TRUE": [],
    "FALSE OR road = 'A1'": [0],
    "NOT (road = 'A1' OR status = 'active')": [1, 4],
    "NOT NOT road = 'A1'": [0],
    "status = 'active' AND (measure_m < 600 OR road IS NULL)": [2, 5],
    "road = 'A1' OR road = 'a1' AND status = 'planned'": [0],
    "version = 1 AND family='plate'": [0, 1, 2, 3, 4, 5],
    "version = 1.5": [],
    "updated_at > TIMESTAMP('2020-01-01T00:00:00Z')": [0, 1, 2, 3, 4, 5],
    "updated_at < DATE('2020-01-01')": [],
    "updated_at >= '0000-01-01T00:00:00Z' AND updated_at < '9999-12-31T23:59:59Z'": [0, 1, 2, 3, 4, 5],
    "road = 'Å' OR road = ''' OR 1=1 --'": [],
    f"S_INTERSECTS(geometry, {SQUARE})": [1, 2, 3],
    f"S_WITHIN(geometry, {SQUARE})": [2],
    f"within(geom, {SQUARE})": [2],
    f"S_DISJOINT(geometry, {SQUARE})": [0, 4, 5],
    f"NOT S_INTERSECTS({SQUARE}, geometry) AND status = 'active'": [5],
    "S_INTERSECTS(geometry, BBOX(5.05, 44, 5.35, 46))": [1, 2, 3],
    "INTERSECTS(geom, POINT Z (5.2 45 7))": [2],
    "S_INTERSECTS(geometry, MULTIPOINT((5.2 45), (5.4 45), (0 0)))": [2, 4],
    "S_INTERSECTS(geometry, LINESTRING(4.95 45, 5.15 45))": [0, 1],
    "S_INTERSECTS(geometry, GEOMETRYCOLLECTION(POINT(5.5 45), POLYGON((5 44, 5.15 44, 5.15 46, 5 46, 5 44))))": [
        0,
        1,
        5,
    ],
    "S_DISJOINT(geom, GEOMETRYCOLLECTION(POINT Z(5.1 45 3), GEOMETRYCOLLECTION(LINESTRING(5 45, 5.1 45))))": [
        2,
        3,
        4,
        5,
    ],
    "S_INTERSECTS(geometry, MULTILINESTRING((-180 -45, 0 -45), (0 45, 180 45)))": [0, 1, 2, 3, 4, 5],
    "S_INTERSECTS(geometry, BBOX(-180, -90, 180, 90))": [0, 1, 2, 3, 4, 5],
    "S_INTERSECTS(geometry, BBOX(170, -90, -170, 90))": [],
    "S_INTERSECTS(geometry, BBOX(5.3, 45, 5.3, 45))": [3],
    "S_INTERSECTS(geometry, BBOX(5.05, 44, 0, 5.35, 46, 10))": [1, 2, 3],
    "geometry IS NULL": [],
    "geom IS NOT NULL": [0, 1, 2, 3, 4, 5],
    r"road = 'O\'Hare *[x]'": [3],
    r"road = '50%_\\'": [4],
    r"road = 'A\t1' OR road LIKE 'A\n%'": [],
    "S_DWITHIN(geometry, POINT(5.2 45), 7.9, 'km')": [1, 2, 3],
    "DWITHIN(geometry, POINT(5.2 45), 7870, meters)": [2],
    "S_DWITHIN(geometry, LINESTRING(5.0 45.05, 5.1 45.05), 6000, 'm') OR road = 'a1'": [0, 1, 2],
}


@pytest.mark.parametrize("expression", TEXTS)
def test_text(roads: httpx.Client, expression: str) -> None:
    assert _found(roads, expression) == TEXTS[expression]
    assert _found(roads, expression, "cql-text") == TEXTS[expression]


def _road(symbol: str, value: Any) -> dict[str, Any]:
    return {"op": symbol, "args": [{"property": "road"}, value]}


RING = [[5.1, 44.9], [5.3, 44.9], [5.3, 45.1], [5.1, 45.1], [5.1, 44.9]]
JSONS: list[tuple[Any, list[int]]] = [
    (_road("=", "A1"), [0]),
    ({"op": "<", "args": [500, {"property": "measure_m"}]}, [3, 5]),
    ({"op": "not", "args": [_road("like", "A%")]}, [2, 3, 4]),
    ({"op": "isNull", "args": [{"property": "road"}]}, [5]),
    (_road("in", ["A1", "a1"]), [0, 2]),
    ({"op": "between", "args": [{"property": "measure_m"}, 200, 600]}, [1, 2]),
    ({"op": "and", "args": [_road("<>", "x"), {"op": "or", "args": [_road("=", "A1"), _road("=", "a1")]}]}, [0, 2]),
    ({"op": ">", "args": [{"property": "updated_at"}, {"timestamp": "2020-01-01T00:00:00Z"}]}, [0, 1, 2, 3, 4, 5]),
    (True, [0, 1, 2, 3, 4, 5]),
    ({"op": "s_intersects", "args": [{"property": "geometry"}, {"bbox": [5.05, 44, 5.35, 46]}]}, [1, 2, 3]),
    ({"op": "s_within", "args": [{"property": "geometry"}, {"type": "Polygon", "coordinates": [RING]}]}, [2]),
    ({"op": "s_disjoint", "args": [{"type": "Polygon", "coordinates": [RING]}, {"property": "geometry"}]}, [0, 4, 5]),
    (
        {"op": "s_dwithin", "args": [{"property": "geometry"}, {"type": "Point", "coordinates": [5.2, 45]}, 7.9, "km"]},
        [1, 2, 3],
    ),
]


@pytest.mark.parametrize(("expression", "expected"), JSONS, ids=str)
def test_json(roads: httpx.Client, expression: Any, expected: list[int]) -> None:
    text = json.dumps(expression)
    assert _found(roads, text, "cql2-json") == expected


def test_a_filter_narrows_beside_everything_else(roads: httpx.Client) -> None:
    page = get(roads, ITEMS, filter="measure_m >= 0", bbox="5.05,44,5.35,46", status="active", limit=1, count="true")
    assert (page["numberMatched"], page["numberReturned"]) == (2, 1)
    onward = next(link["href"] for link in page["links"] if link["rel"] == "next")
    assert roads.get(onward).json()["features"][0]["properties"]["road"] == "O'Hare *[x]"


def _deep(depth: int) -> Any:
    return {"op": "not", "args": [_deep(depth - 1)]} if depth else True


BAD_TEXTS = (
    *("", " ", "road", "road =", "= 'A1'", "road = 'A1", "road = A1", "road == 'A1'", "road = 'A1' AND"),
    *("(road = 'A1'", "road = 'A1')", "road = 'A1'; DROP TABLE markers", "road = 'A1' -- x", "agency_id = 'x'"),
    *("id = 'x'", "markers.road = 'x'", "road = 5", "measure_m = 'x'", "measure_m = 1e999", "measure_m = NaN"),
    *("measure_m LIKE 'x'", "road IN ()", "road IS 'x'", "updated_at > 'yesterday'", "updated_at = TIMESTAMP(5)"),
    *("updated_at > TIMESTAMP('2020-13-01T00:00:00Z')", "lower(road) = 'a1'", "road = road", "1 = 1"),
    *("road = 'A1' OR OR road = 'x'", "NOT " * 10 + "x", "\"\" = 'x'"),
    *("S_INTERSECTS(road, POINT(0 0))", "S_INTERSECTS(geometry, geometry)", "S_INTERSECTS(geometry, POINT(0))"),
    *("S_INTERSECTS(geometry, BBOX(5, 44, 10, 6, 46, 5))", "S_INTERSECTS(geometry, BBOX(5, 44, 6, 46, 7))"),
    *("S_INTERSECTS(geometry, BBOX(1e6, 1e6, 2e6, 2e6))", "geometry = 'x'", "geometry BETWEEN 1 AND 2"),
    *("S_INTERSECTS(geometry, POINT(200 0))", "S_INTERSECTS(geometry, POLYGON((0 0, 1 1, 0 1, 1 0, 0 0)))"),
    *(
        "S_WITHIN(POINT(0 0), geometry)",
        "S_DWITHIN(geometry, POINT(0 0))",
        "S_DWITHIN(geometry, POINT(0 0), 5, 'parsecs')",
    ),
    *(
        "S_DWITHIN(geometry, POINT(0 0), -5, 'm')",
        "S_DWITHIN(geometry, POINT(0 0), 1e7, 'm')",
        "S_INTERSECTS(geometry, POINT",
    ),
    *(
        "S_TOUCHES(geometry, POINT(0 0))",
        "S_INTERSECTS(geometry, BBOX(5, 44, 4, 46))",
        "S_INTERSECTS(geometry, POINT EMPTY)",
    ),
    *("S_WITHIN(geometry, GEOMETRYCOLLECTION(POINT(0 0)))", "S_DWITHIN(geometry, POINT(179.99 0), 9000, 'm')"),
    " OR ".join([f"S_INTERSECTS(geometry, {SQUARE})"] * 21),
    *(f"{'(' * 30}TRUE{')' * 30}", " OR ".join(["version = 1"] * 201), f"version = {'9' * 400}"),
)
BAD_JSONS = (
    *("", "[]", "5", "null", "{", '{"op": "=", "args": []}', '{"op": "=", "args": "x"}', '{"op": {}, "args": [1]}'),
    '{"op": "=", "args": [{"property": "agency_id"}, "x"]}',
    '{"op": "=", "args": [{"property": ["road"]}, "x"]}',
    '{"op": "=", "args": [{"property": "road"}, null]}',
    '{"op": "=", "args": [{"property": "road"}, {"a": 1}]}',
    '{"op": "=", "args": [{"property": "measure_m"}, NaN]}',
    '{"op": "=", "args": [{"property": "measure_m"}, 1e999]}',
    '{"op": "=", "args": [{"property": "measure_m"}, true]}',
    '{"op": "in", "args": [{"property": "road"}, []]}',
    '{"op": "and", "args": [true]}',
    '{"op": "=", "op": "=", "args": []}',
    '{"op": "=", "args": [{"property": "road"}, "\\ud800"]}',
    '{"op": "like", "args": [{"property": "road"}, 5]}',
    '{"op": "cql2-json", "args": [{"property": "road"}, "x"]}',
    json.dumps(_deep(25)),
    '{"op": "s_intersects", "args": [{"property": "geometry"}, {"type": "Point", "coordinates": ["a", 1]}]}',
    '{"op": "s_intersects", "args": [{"property": "geometry"}, {"type": "Circle"}]}',
    '{"op": "s_intersects", "args": [{"property": "geometry"}, {"bbox": [1, 2, true, 4]}]}',
    '{"op": "s_intersects", "args": [{"property": "geometry"}, {"bbox": [1, 2]}, 5]}',
    '{"op": "s_dwithin", "args": [{"property": "geometry"}, {"bbox": [1, 2, 3, 4]}, "5", "m"]}',
)
BAD = [
    *((text, None) for text in BAD_TEXTS),
    *((text, "cql2-json") for text in BAD_JSONS),
    ("TRUE", "sql"),
    ("TRUE", "CQL2-TEXT"),
]


@pytest.mark.parametrize(("expression", "language"), BAD, ids=lambda value: str(value)[:40])
def test_what_cannot_be_read_is_refused(roads: httpx.Client, expression: str, language: str | None) -> None:
    named = {} if language is None else {"filter-lang": language}
    response = roads.get(ITEMS, params={"filter": expression, **named})
    assert response.status_code == 400, response.text
    assert response.json()["errors"][0]["field"] in ("filter", "filter-lang")
    assert response.json()["errors"][0]["limit"]


def test_patterns_are_limited_and_the_refusal_has_the_limit_and_the_cure(roads: httpx.Client) -> None:
    patterns = [f"road LIKE '%{k}%a%b%'" for k in range(21)]
    assert roads.get(ITEMS, params={"filter": " OR ".join(patterns[:20])}).status_code == 200
    answer = roads.get(ITEMS, params={"filter": " OR ".join(f"NOT ({pattern})" for pattern in patterns)})
    assert answer.status_code == 400
    error = answer.json()["errors"][0]
    assert (error["field"], error["limit"]) == ("filter", "20 of them")
    assert "IN or =" in error["cure"]


@pytest.mark.parametrize("expression", [text for text in TEXTS if "updated_at" not in text])
def test_values_in_hand_are_filtered_as_both_databases_do(roads: httpx.Client, expression: str) -> None:
    """Lines are put together before they are filtered, so no database does it."""
    kinds = {field.name: field.kind for field in FIELDS}
    reader = Reader(kinds, _no_time, float, places_in(STORAGE_CRS))
    condition = reader.read(expression, "cql2-text")
    rows = get(roads, ITEMS, limit=100)["features"]
    found = [
        round((row["geometry"]["coordinates"][0] - 5.0) * 10)
        for row in rows
        if holds(condition, {**row["properties"], GEOMETRY: shapely.geometry.shape(row["geometry"])})
    ]
    assert found == TEXTS[expression]


@pytest.mark.parametrize(
    ("crs", "place"),
    [("EPSG/0/3857", "578861.35 5621521.49"), ("EPSG/0/4326", "45 5.2"), ("EPSG/0/25831", "673393.7 4985304.9")],
)
def test_geometries_may_be_in_another_system(roads: httpx.Client, crs: str, place: str) -> None:
    uri = f"http://www.opengis.net/def/crs/{crs}"
    named = {"filter": f"S_DWITHIN(geometry, POINT({place}), 30, 'm')", "filter-crs": uri}
    page = get(roads, ITEMS, **named)
    assert [round((one["geometry"]["coordinates"][0] - 5.0) * 10) for one in page["features"]] == [2]


@pytest.mark.parametrize(
    ("expression", "language", "name"),
    [
        ("CASEI(road) = 'a1'", "cql2-text", "CASEI"),
        ("road = casei('a1')", "cql2-text", "CASEI"),
        ("S_TOUCHES(geometry, POINT(0 0))", "cql2-text", "S_TOUCHES"),
        ("S_INTERSECTS(ST_Buffer(geometry, 5), POINT(0 0))", "cql2-text", "ST_BUFFER"),
        ('{"op": "=", "args": [{"property": "road"}, {"op": "casei", "args": ["a1"]}]}', "cql2-json", "CASEI"),
    ],
)
def test_an_unknown_function_is_named_beside_the_known_ones(
    roads: httpx.Client, expression: str, language: str, name: str
) -> None:
    response = roads.get(ITEMS, params={"filter": expression, "filter-lang": language})
    assert response.status_code == 400
    error = response.json()["errors"][0]
    assert error["detail"] == f"there is no function {name}"
    assert error["limit"] == "S_INTERSECTS, S_WITHIN, S_DISJOINT, S_DWITHIN"


def test_boxes_with_heights_leave_out_what_is_above_and_below(client: httpx.Client) -> None:
    low, none = add(client, 3.0, 30.0, position={"height_m": 5.0}), add(client, 3.1, 30.0)
    high = add(client, 3.2, 30.0, position={"height_m": 50.0})
    for box, expected in (("2, 29, 0, 4, 31, 10", [low, none]), ("2, 29, 40, 4, 31, 60", [none, high])):
        page = get(client, ITEMS, filter=f"S_INTERSECTS(geometry, BBOX({box}))")
        assert [one["id"] for one in page["features"]] == expected
        sides = [float(side) for side in box.split(",")]
        as_json = {"op": "s_intersects", "args": [{"property": "geometry"}, {"bbox": sides}]}
        page = get(client, ITEMS, filter=json.dumps(as_json), **{"filter-lang": "cql2-json"})
        assert [one["id"] for one in page["features"]] == expected
        assert [one["id"] for one in get(client, ITEMS, bbox=box.replace(" ", ""))["features"]] == expected
    for name in ("maintenance", "plans", "marker_lines"):
        assert get(client, f"/ogc/collections/{name}/items", bbox="2,29,0,4,31,10")["features"] == []


def test_a_box_in_another_system_has_its_edges(client: httpx.Client) -> None:
    """Three degrees from the central meridian of UTM zone 32, north of the grid is 2.3 degrees off."""
    inside, outside = add(client, 11.98, 50.0), add(client, 11.98, 50.4)
    crs = "http://www.opengis.net/def/crs/EPSG/0/25832"
    east, north = Transformer.from_crs(4326, 25832, always_xy=True).transform(11.98, 50.0)
    sides = (
        east - 100,
        north - 100,
        east + 100,
        north + 50_000,
    )  # the second one is 600 m to the west of the grid's north
    assert get(client, ITEMS, filter="TRUE")["numberMatched"] == 2
    boxed = get(client, ITEMS, bbox=",".join(map(str, sides)), **{"bbox-crs": crs})
    assert [one["id"] for one in boxed["features"]] == [inside], outside
    text = f"S_INTERSECTS(geometry, BBOX({', '.join(map(str, sides))}))"
    filtered = get(client, ITEMS, filter=text, **{"filter-crs": crs})
    assert [one["id"] for one in filtered["features"]] == [inside]


def test_lines_are_filtered_by_their_course(roads: httpx.Client) -> None:
    answer = roads.get("/ogc/collections/marker_lines/items", params={"filter": f"S_INTERSECTS(geometry, {SQUARE})"})
    assert answer.status_code == 200, answer.text


def _no_time(text: str) -> Any:
    raise AssertionError(text)


@pytest.mark.parametrize(
    ("pattern", "text", "expected"),
    [
        ("%", "", True), ("_", "", False), ("", "", True), ("", "a", False), ("a%b%c", "aXbXbc", True),
        ("a%b%c", "aXbXcd", False), ("%%_", "a", True), ("\\%", "%", True), ("\\%", "a", False), ("\\_%", "_a", True),
        ("%a", "aaab", False), ("A", "a", False), ("a\nb", "a\nb", True), ("%a%" * 50, "a" * 49, False),
        ("%a" * 60 + "b", "a" * 200, False),
    ],
)  # fmt: skip
def test_patterns(pattern: str, text: str, expected: bool) -> None:
    assert holds(Compared("road", "like", pattern), {"road": text}) is expected


def test_what_is_unknown_stays_unknown() -> None:
    known, unknown = Compared("n", "=", 1.0), Compared("road", "=", "A")
    values = {"n": 1, "road": None}
    assert holds(Not(unknown), values) is None
    assert holds(Joined(True, (known, unknown)), values) is None
    assert holds(Joined(False, (known, unknown)), values) is True
    assert holds(Joined(True, (Not(known), unknown)), values) is False
    assert holds(Joined(False, (Not(known), unknown)), values) is None


def test_queryables_and_conformance_say_so(roads: httpx.Client) -> None:
    document = get(roads, "/ogc/collections/markers/queryables")
    assert document["properties"]["geometry"]["format"] == "geometry-point"
    assert document["properties"]["measure_m"]["type"] == "number"
    assert document["properties"]["updated_at"]["format"] == "date-time"
    asked = get(roads, "/ogc/collections/marker_lines/queryables")["properties"]
    assert asked["marker_count"] == {"type": "integer", "title": "Magnets or CERPMs of the line"}
    assert {"family", "side", "road", "status", "length_m", "longest_gap_m"} < set(asked)
    conformance = get(roads, "/ogc/conformance")["conformsTo"]
    for ending in ("conf/filter", "conf/features-filter", "conf/cql2-text", "conf/cql2-json", "conf/basic-cql2"):
        assert any(uri.endswith(ending) for uri in conformance), ending
    languages = get(roads, "/ogc/api")["components"]["parameters"]["filter-lang"]["schema"]["enum"]
    assert languages == ["cql2-text", "cql2-json", "cql-text"]
