"""Abstract tests of filters: part 3 of OGC API Features (19-079r2) and CQL2 (21-065r2), each in text and in JSON.

The test data of CQL2 are three layers of Natural Earth, which this server cannot hold. The same predicates are
evaluated on markers instead, and the expected features are computed here from the features themselves.
"""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterator
from datetime import datetime
from typing import Any

import jsonschema_rs
import shapely
import shapely.geometry

from app.api.ogc.cql2 import Reader
from app.api.ogc.query import places_in
from app.registry.conditions import Compared
from app.services.markers.features import STORAGE_CRS
from tests.api.ogc.abstract_tests import (
    GEOJSON,
    JSON,
    SCHEMA,
    SPEC,
    Api,
    abstract_test,
    known,
    links,
    not_applicable,
    transformer,
)

THREE, CQL2 = "ogcapi-features-3", "cql2"
QUERYABLES = "http://www.opengis.net/def/rel/ogc/1.0/queryables"
OWN_DATA = "on markers in place of Natural Earth"
LANGUAGES = ("cql2-text", "cql2-json")
Expression = Any  # CQL2 JSON


# --- part 3 -------------------------------------------------------------------------------------------------------


def declares(standard: str, name: str) -> Callable[[Api], None]:
    """The test get-conformance of a class."""

    def run(api: Api) -> None:
        response = api.get("/conformance", JSON)
        assert (response.status_code, response.headers["content-type"]) == (200, JSON)
        assert f"{SPEC}/{standard}/1.0/conf/{name}" in response.json()["conformsTo"]

    return run


abstract_test(THREE, "/conf/queryables/get-conformance")(declares(THREE, "queryables"))


@abstract_test(THREE, "/conf/queryables/get-queryables-uris")
def get_queryables_uris(api: Api) -> None:
    for collection in api.collections():
        response = api.client.head(f"{api.root}/collections/{collection['id']}/items", headers={"Accept": JSON})
        assert response.status_code == 200
        assert response.links[QUERYABLES]["url"] == f"{api.root}/collections/{collection['id']}/queryables"


@abstract_test(THREE, "/conf/queryables/get-queryables")
def get_queryables(api: Api) -> None:
    for collection in api.collections():
        uri = f"{api.root}/collections/{collection['id']}/queryables"
        response = api.get(uri, SCHEMA)
        assert (response.status_code, response.headers["content-type"]) == (200, SCHEMA)
        document = response.json()
        assert document["$schema"] == "https://json-schema.org/draft/2020-12/schema"
        assert (document["$id"], document["type"]) == (uri, "object")
        jsonschema_rs.meta.validate(document)
        for described in document["properties"].values():
            assert "type" in described or described["format"].startswith("geometry-")
        assert document["properties"]["geometry"]["format"] in ("geometry-point", "geometry-linestring")
        assert document["additionalProperties"] is False


abstract_test(THREE, "/conf/queryables-query-parameters/get-conformance")(
    declares(THREE, "queryables-query-parameters")
)


@abstract_test(THREE, "/conf/queryables-query-parameters/query-param", "any text is a valid value of a text")
def query_param(api: Api) -> None:
    invalid = {"number": "ten", "integer": "1.5", "date-time": "yesterday"}
    for collection in api.collections():
        path = f"/collections/{collection['id']}/items"
        everything = api.features(collection["id"])
        for name, kind in kinds(api, collection["id"]).items():
            schema = api.parameter(name, collection["id"])["schema"]
            assert schema.get("format", schema["type"]) == kind
            known = [one["properties"][name] for one in everything if one["properties"][name] is not None]
            samples: dict[str, Any] = {
                "string": "foo",
                "number": 3.14,
                "integer": 1,
                "date-time": "2022-04-14T14:48:46Z",
            }
            for value in (samples[kind], *known[-1:]):
                response = api.client.get(api.root + path, params={name: str(value)}, headers={"Accept": GEOJSON})
                assert (response.status_code, response.headers["content-type"]) == (200, GEOJSON), response.text
                expected = [one["id"] for one in everything if one["properties"][name] == value]
                assert [one["id"] for one in response.json()["features"]] == expected, (collection["id"], name)
            if kind in invalid:
                assert api.client.get(api.root + path, params={name: invalid[kind]}).status_code == 400


abstract_test(THREE, "/conf/filter/get-conformance")(declares(THREE, "filter"))


@abstract_test(THREE, "/conf/filter/filter-param")
def filter_param(api: Api) -> None:
    for collection in api.collections():
        path = f"/collections/{collection['id']}/items"
        response = api.get(path, GEOJSON)
        assert (response.status_code, response.headers["content-type"]) == (200, GEOJSON)
        everything = response.json()["features"]
        for name in kinds(api, collection["id"]):
            for language, text, wrong in (
                ("cql2-text", f"{name} IS NULL", "THIS IS NOT A FILTER"),
                ("cql2-json", json.dumps({"op": "isNull", "args": [{"property": name}]}), '{"op": "this is not"}'),
            ):
                found = api.features(collection["id"], filter=text, filter_lang=language)
                assert found == [one for one in everything if one["properties"][name] is None]
                assert api.get(path, filter=wrong, filter_lang=language).status_code == 400


@abstract_test(THREE, "/conf/filter/filter-lang-default")
def filter_lang_default(api: Api) -> None:
    assert api.parameter("filter-lang")["schema"]["default"] == "cql2-text"
    for collection in api.collections():
        everything = api.features(collection["id"])
        for name in kinds(api, collection["id"]):
            found = api.features(collection["id"], filter=f"{name} IS NULL")
            assert found == [one for one in everything if one["properties"][name] is None]
        assert api.get(f"/collections/{collection['id']}/items", filter="THIS IS NOT A FILTER").status_code == 400


@abstract_test(THREE, "/conf/filter/expression-construction")
def expression_construction(api: Api) -> None:
    for collection in api.collections():
        document = api.document(f"/collections/{collection['id']}/queryables")
        assert document["additionalProperties"] is False
        text = "this_is_not_a_queryable IS NULL"
        assert api.get(f"/collections/{collection['id']}/items", filter=text).status_code == 400


@abstract_test(THREE, "/conf/filter/filter-crs-wgs84")
def filter_crs_wgs84(api: Api) -> None:
    for collection in api.filled():
        west, south, east, north = collection["extent"]["spatial"]["bbox"][0]
        text = f"S_INTERSECTS(geometry,BBOX({west},{south},{east},{north}))"
        assert api.features(collection["id"], filter=text) == api.features(collection["id"]) != []
        wrong = "S_INTERSECTS(geometry,BBOX(1000000,1000000,2000000,2000000))"
        assert api.get(f"/collections/{collection['id']}/items", filter=wrong).status_code == 400


@abstract_test(
    THREE, "/conf/filter/filter-crs-param", "12 systems; the box is 10 m larger, since parallels of the axes differ"
)
def filter_crs_param(api: Api) -> None:
    for collection in api.filled():
        west, south, east, north = collection["extent"]["spatial"]["bbox"][0]
        everything = [one["id"] for one in api.features(collection["id"])]
        for uri in known(collection):
            x1, y1, x2, y2 = transformer(uri).transform_bounds(west - 1e-4, south - 1e-4, east + 1e-4, north + 1e-4)
            text = f"S_INTERSECTS(geometry,BBOX({x1},{y1},{x2},{y2}))"
            found = api.features(collection["id"], filter=text, filter_crs=uri)
            assert [one["id"] for one in found] == everything, uri
        text = f"S_INTERSECTS(geometry,BBOX({west},{south},{east},{north}))"
        wrong = "http://www.opengis.net/def/crs/OGC/0/does_not_exist"
        assert api.get(f"/collections/{collection['id']}/items", filter=text, filter_crs=wrong).status_code == 400


not_applicable(THREE, "/conf/filter/get-functions", "there are no functions besides those of CQL2")
abstract_test(THREE, "/conf/features-filter/get-conformance")(declares(THREE, "features-filter"))


@abstract_test(THREE, "/conf/features-filter/get-collections")
def get_collections(api: Api) -> None:
    response = api.get("/collections", JSON)
    assert (response.status_code, response.headers["content-type"]) == (200, JSON)
    assert isinstance(response.json()["collections"], list)


@abstract_test(THREE, "/conf/features-filter/get-collection")
def get_collection(api: Api) -> None:
    for collection in api.collections():
        assert [link["href"] for link in links(collection, QUERYABLES)] == [
            f"{api.root}/collections/{collection['id']}/queryables"
        ]


@abstract_test(THREE, "/conf/features-filter/filter-on-items")
def filter_on_items(api: Api) -> None:
    for run in (filter_param, filter_lang_default, expression_construction, filter_crs_wgs84):
        run(api)  # their responses are GeoJSON with 200, and 400


@abstract_test(THREE, "/conf/features-filter/mixing-expression")
def mixing_expression(api: Api) -> None:
    for collection in api.filled():
        west, south, east, north = collection["extent"]["spatial"]["bbox"][0]
        text = f"S_INTERSECTS(geometry,BBOX({west},{south},{east},{north}))"
        everything = api.features(collection["id"])
        assert api.features(collection["id"], filter=text, bbox=f"{west},{south},{east},{north}") == everything != []
        apart = f"{west + 5},{south},{east + 5},{north}"
        assert api.features(collection["id"], filter=text, bbox=apart) == []


# --- CQL2: in text and in JSON ------------------------------------------------------------------------------------

SAMPLES: dict[str, Any] = {
    "string": "foo", "number": 3.14, "integer": 1, "date-time": {"timestamp": "2022-04-14T14:48:46Z"},
}  # fmt: skip
GEOMETRY = {"property": "geometry"}


def compared(name: str, symbol: str, value: Any) -> Expression:
    return {"op": symbol, "args": [{"property": name}, value]}


def negated(inner: Expression) -> Expression:
    return {"op": "not", "args": [inner]}


def intersects(shape: Any) -> Expression:
    """A shape is GeoJSON, or the numbers of a box."""
    return {"op": "s_intersects", "args": [GEOMETRY, {"bbox": shape} if isinstance(shape, list) else shape]}


def geojson(wkt: str) -> Any:
    return json.loads(shapely.to_geojson(shapely.from_wkt(wkt)))


def missing(name: str) -> Expression:
    return {"op": "isNull", "args": [{"property": name}]}


def text_of(node: Expression) -> str:
    """CQL2 text of an expression."""
    match node:
        case bool():
            return str(node).lower()
        case {"op": ("and" | "or") as word, "args": parts}:
            return "(" + f" {word} ".join(map(text_of, parts)) + ")"
        case {"op": "not", "args": [inner]}:
            return f"NOT ({text_of(inner)})"
        case {"op": "isNull", "args": [{"property": name}]}:
            return f'"{name}" IS NULL'
        case {"op": "between", "args": [{"property": name}, low, high]}:
            return f"{name} between {text_of(low)} and {text_of(high)}"
        case {"op": "in", "args": [{"property": name}, values]}:
            return f"{name} IN ({', '.join(map(text_of, values))})"
        case {"op": "s_intersects", "args": [{"property": name}, {"bbox": sides}]}:
            return f"S_INTERSECTS({name},BBOX({','.join(map(str, sides))}))"
        case {"op": "s_intersects", "args": [{"property": name}, shape]}:
            return f"S_INTERSECTS({name},{shapely.to_wkt(shapely.geometry.shape(shape), rounding_precision=9)})"
        case {"op": symbol, "args": [{"property": name}, value]}:
            return f"{name} {symbol} {text_of(value)}"
        case {"timestamp": moment}:
            return f"TIMESTAMP('{moment}')"
        case str():
            return "'" + node.replace("'", "''") + "'"
    return str(node)


def holds(node: Expression, feature: dict[str, Any]) -> bool | None:
    """The value of an expression for a feature in three-valued logic, computed without the server's code."""
    properties = feature["properties"]
    match node:
        case bool():
            return node
        case {"op": "and", "args": parts}:
            found = [holds(part, feature) for part in parts]
            return False if False in found else None if None in found else True
        case {"op": "or", "args": parts}:
            found = [holds(part, feature) for part in parts]
            return True if True in found else None if None in found else False
        case {"op": "not", "args": [inner]}:
            value = holds(inner, feature)
            return None if value is None else not value
        case {"op": "isNull", "args": [{"property": name}]}:
            return name != "geometry" and properties[name] is None
        case {"op": "s_intersects", "args": [_, shape]}:
            return bool(shapely.intersects(shape_of(shape), shapely.geometry.shape(feature["geometry"])))
        case {"op": "between", "args": [{"property": name}, low, high]}:
            return None if properties[name] is None else low <= properties[name] <= high
        case {"op": "in", "args": [{"property": name}, values]}:
            known = plain(properties[name])
            return None if known is None else known in [plain(value) for value in values]
        case {"op": "like", "args": [{"property": name}, pattern]}:
            return None if properties[name] is None else like(properties[name], pattern)
        case {"op": symbol, "args": [{"property": name}, value]}:
            known, other = plain(properties[name]), plain(value)
            if known is None:
                return None
            return {"=": known == other, "<>": known != other, "<": known < other, ">": known > other,
                    "<=": known <= other, ">=": known >= other}[symbol]  # fmt: skip
    raise AssertionError(node)


def plain(value: Any) -> Any:
    """A value to compare: times as such."""
    text = value["timestamp"] if isinstance(value, dict) else value
    if isinstance(text, str) and len(text) > 18 and text[4] == "-" and text[10:11] == "T":
        return datetime.fromisoformat(text)
    return text


def shape_of(shape: Any) -> shapely.Geometry:
    if "bbox" not in shape:
        return shapely.geometry.shape(shape)
    west, south, east, north = shape["bbox"]
    if west <= east:
        return shapely.box(west, south, east, north)
    return shapely.union_all([shapely.box(west, south, 180, north), shapely.box(-180, south, east, north)])


def like(text: str, pattern: str) -> bool:
    """Whether a text is like a pattern: the table of all pairs of their beginnings."""
    parts: list[tuple[bool, str]] = []  # whether it is a wildcard, and the character
    at = 0
    while at < len(pattern):
        escaped = pattern[at] == "\\" and at + 1 < len(pattern)
        at += escaped
        parts.append((not escaped and pattern[at] in "%_", pattern[at]))
        at += 1
    reached = {0}
    for is_wild, character in parts:
        if is_wild and character == "%":
            reached = set(range(min(reached), len(text) + 1)) if reached else set()
        else:
            reached = {k + 1 for k in reached if k < len(text) and (is_wild or text[k] == character)}
    return len(text) in reached


def evaluate(api: Api, collection: str, node: Expression) -> list[str]:
    """Ids of the features that an expression leaves, the same in both languages and as computed here."""
    everything = api.features(collection)
    expected = [one["id"] for one in everything if holds(node, one)]
    for language, text in (("cql2-text", text_of(node)), ("cql2-json", json.dumps(node))):
        found = api.features(collection, filter=text, filter_lang=language)
        assert [one["id"] for one in found] == expected, (collection, text)
    return expected


def refused(api: Api, collection: str, node: Expression) -> None:
    for language, text in (("cql2-text", text_of(node)), ("cql2-json", json.dumps(node))):
        response = api.get(f"/collections/{collection}/items", filter=text, filter_lang=language)
        assert response.status_code == 400, text


def kinds(api: Api, collection: str) -> dict[str, str]:
    """Queryables but the geometry: string, number, integer or date-time."""
    properties = api.document(f"/collections/{collection}/queryables")["properties"]
    return {name: one.get("format", one["type"]) for name, one in properties.items() if name != "geometry"}


def queryables(api: Api, *wanted: str) -> Iterator[tuple[str, str, str]]:
    """Collection, name and kind of queryables of some kinds."""
    for collection in api.collections():
        for name, kind in kinds(api, collection["id"]).items():
            if kind in wanted:
                yield collection["id"], name, kind


def logical_on(api: Api, predicates: list[Expression], number: int, shape: Callable[..., Expression]) -> None:
    """Combinations of four predicates, chosen at random."""
    chosen = random.Random(21065)
    found = [len(evaluate(api, "markers", shape(*chosen.choices(predicates, k=4)))) for _ in range(number)]
    assert len(set(found)) > 3  # they are not all alike


# --- basic CQL2 ---------------------------------------------------------------------------------------------------

MOMENT = {"timestamp": "2022-04-16T10:13:19Z"}
BASIC_NAMES = [("road", "Luxembourg"), ("road", "København"), ("measure_m", 150.0), ("check_points", 26)]


def basic_predicates(api: Api) -> list[Expression]:
    """Those of the table in the annex, on properties of markers."""
    times = sorted(one["properties"]["updated_at"] for one in api.features("markers"))
    pairs = [*BASIC_NAMES, ("updated_at", {"timestamp": times[5]}), ("updated_at", MOMENT)]
    compare = [compared(name, symbol, value) for name, value in pairs for symbol in ("=", ">=", ">", "<=", "<", "<>")]
    nulls = [missing(name) for name in ("road", "measure_m", "check_points", "updated_at", "survey_method")]
    return [*compare, *nulls, *map(negated, nulls)]


@abstract_test(CQL2, "/conf/basic-cql2/basic-test")
def basic_test(api: Api) -> None:
    for collection in api.collections():
        found = kinds(api, collection["id"])
        assert found
        assert set(found.values()) <= {"string", "number", "integer", "date-time"}


@abstract_test(CQL2, "/conf/basic-cql2/comparison")
def comparison(api: Api) -> None:
    for collection, name, kind in queryables(api, "string", "number", "integer", "date-time"):
        sets = {
            symbol: set(evaluate(api, collection, compared(name, symbol, SAMPLES[kind])))
            for symbol in ("=", "<>", ">", "<", ">=", "<=")
        }
        for one, other in (("=", "<>"), (">", "<="), ("<", ">=")):
            assert not sets[one] & sets[other], (collection, name)


@abstract_test(CQL2, "/conf/basic-cql2/is-null")
def is_null(api: Api) -> None:
    for collection in api.collections():
        for name in ("geometry", *kinds(api, collection["id"])):
            none = evaluate(api, collection["id"], missing(name))
            some = evaluate(api, collection["id"], negated(missing(name)))
            assert not set(none) & set(some)
            text = api.features(collection["id"], filter=f"{name} is not null")
            assert [one["id"] for one in text] == some


@abstract_test(CQL2, "/conf/basic-cql2/boolean")
def boolean(api: Api) -> None:
    for collection in api.collections():
        evaluate(api, collection["id"], True)
        assert evaluate(api, collection["id"], False) == []


@abstract_test(CQL2, "/conf/basic-cql2/test-data", OWN_DATA)
def basic_test_data(api: Api) -> None:
    found = [len(evaluate(api, "markers", predicate)) for predicate in basic_predicates(api)]
    assert len(set(found)) > 5


@abstract_test(CQL2, "/conf/basic-cql2/logical", OWN_DATA)
def basic_logical(api: Api) -> None:
    def shape(p1: Expression, p2: Expression, p3: Expression, p4: Expression) -> Expression:
        first = {"op": "and", "args": [negated(p2), p1]}
        last = negated({"op": "or", "args": [p1, p4]})
        return {"op": "or", "args": [first, {"op": "and", "args": [p3, p4]}, last]}

    logical_on(api, basic_predicates(api), 80, shape)


# --- advanced comparison operators --------------------------------------------------------------------------------


def advanced_predicates(api: Api) -> list[Expression]:
    times = sorted(one["properties"]["updated_at"] for one in api.features("markers"))
    own = [
        compared("road", "like", "K_l%"),
        {"op": "between", "args": [{"property": "measure_m"}, 100, 300]},
        {"op": "in", "args": [{"property": "road"}, ["Kiel", "kobenhavn", "A7", "athens", "foo"]]},
        {"op": "in", "args": [{"property": "measure_m"}, [50, 150, 151, 250.5, 350]]},
        {"op": "in", "args": [{"property": "updated_at"}, [{"timestamp": times[4]}, MOMENT]]},
    ]
    return [*own, *map(negated, own)]


def advanced_shape(p1: Expression, p2: Expression, p3: Expression, p4: Expression) -> Expression:
    first, second = {"op": "and", "args": [negated(p1), p2]}, {"op": "and", "args": [p3, negated(p4)]}
    return {"op": "or", "args": [first, second, negated({"op": "and", "args": [p1, p4]})]}


@abstract_test(CQL2, "/conf/advanced-comparison-operators/like")
def like_test(api: Api) -> None:
    for collection, name, _ in queryables(api, "string"):
        sets = {
            p: evaluate(api, collection, compared(name, "like", p)) for p in ("%", "_%", "", "%%", r"\%\_", r"\\%\\_")
        }
        assert not set(sets["_%"]) & set(sets[""])
        assert sets["%"] == sets["%%"]


@abstract_test(CQL2, "/conf/advanced-comparison-operators/between")
def between(api: Api) -> None:
    for collection, name, _ in queryables(api, "number", "integer"):
        evaluate(api, collection, {"op": "between", "args": [{"property": name}, 0, 100]})
        assert evaluate(api, collection, {"op": "between", "args": [{"property": name}, 100.0, 1.0]}) == []


@abstract_test(CQL2, "/conf/advanced-comparison-operators/in")
def in_list(api: Api) -> None:
    times = [{"timestamp": "2022-04-14T14:52:56Z"}, {"timestamp": "2022-04-14T15:52:56Z"}]
    values = {"string": ["foo", "bar"], "number": [1, 2, 3], "integer": [1, 2, 3], "date-time": times}
    for collection, name, kind in queryables(api, *values):
        evaluate(api, collection, {"op": "in", "args": [{"property": name}, values[kind]]})
        if kind == "date-time":
            text = f"{name} in ('2022-04-14T14:52:56Z', '2022-04-14T15:52:56Z')"
            assert api.features(collection, filter=text) == []


@abstract_test(CQL2, "/conf/advanced-comparison-operators/test-data", OWN_DATA)
def advanced_test_data(api: Api) -> None:
    assert all(evaluate(api, "markers", predicate) for predicate in advanced_predicates(api))
    text = "road NOT LIKE 'K_l%' AND measure_m not between 100 and 300 and road NOT IN ('A7')"
    everything = api.features("markers")
    expected = [
        one["id"]
        for one in everything
        if (name := one["properties"]["road"]) is not None
        and not (name[0] == "K" and name[2:3] == "l")
        and (at_m := one["properties"]["measure_m"]) is not None
        and not 100 <= at_m <= 300
        and name != "A7"
    ]
    assert [one["id"] for one in api.features("markers", filter=text)] == expected != []


@abstract_test(CQL2, "/conf/advanced-comparison-operators/logical")
def advanced_logical(api: Api) -> None:
    logical_on(api, [*basic_predicates(api), *advanced_predicates(api)], 20, advanced_shape)


# --- spatial functions --------------------------------------------------------------------------------------------

RING = "-180 -90, -90 -90, -90 90, -180 90, -180 -90"
HOLE = "-120 -50, -100 -50, -100 -40, -120 -40, -120 -50"


def spatial_predicates() -> list[Expression]:
    """Boxes and points about the data, as the annex has them about countries."""
    left, right = intersects([8.395, 48.9, 8.435, 49.1]), intersects([8.425, 49.003, 8.475, 49.1])
    return [
        left,
        intersects([150, -90, -150, 90]),
        intersects([8.445, 48.9, -172, 90]),
        intersects(geojson("POINT(8.42 49.008)")),
        {"op": "and", "args": [left, right]},
        {"op": "and", "args": [left, negated(right)]},
        {"op": "or", "args": [left, right]},
        intersects([-180, -90, 0, 90]),
    ]


def plus_predicates() -> list[Expression]:
    triangle = "8.395 48.99, 8.47 48.99, 8.47 49.01, 8.395 48.99"
    hole = "8.44 48.995, 8.46 48.995, 8.46 49.002, 8.44 48.995"
    polygon = intersects(geojson(f"POLYGON(({triangle}), ({hole}))"))
    other = intersects(geojson("POLYGON((8.4 49.003, 8.6 49.003, 8.6 49.02, 8.4 49.02, 8.4 49.003))"))
    return [
        intersects(geojson("LINESTRING(8.40 49.0, 8.44 49.016)")),
        intersects(geojson("MULTILINESTRING((8.40 49.0, 8.44 49.016), (8.45 48.9, 8.45 49.1))")),
        intersects(geojson("MULTIPOINT(8.41 49.004, 8.45 49.0, 0 0)")),
        polygon,
        intersects(geojson(f"MULTIPOLYGON((({triangle}), ({hole})), ((8.48 49, 8.6 49, 8.6 49.1, 8.48 49)))")),
        intersects(geojson("GEOMETRYCOLLECTION(POINT(8.42 49.008), POLYGON((8.48 49, 8.6 49, 8.6 49.1, 8.48 49)))")),
        {"op": "or", "args": [polygon, other]},
        {"op": "and", "args": [polygon, negated(other)]},
    ]


@abstract_test(CQL2, "/conf/basic-spatial-functions/s_intersects")
def s_intersects(api: Api) -> None:
    for collection in api.collections():
        name = collection["id"]
        assert evaluate(api, name, intersects([-180, -90, 180, 90])) == [one["id"] for one in api.features(name)]
        evaluate(api, name, intersects(geojson("POINT(7.02 49.92)")))
        refused(api, name, intersects(geojson("POINT(90 180)")))
        both = [intersects([-180, -90, -90, 90]), intersects([90, -90, 180, 90])]
        assert evaluate(api, name, {"op": "and", "args": both}) == []


@abstract_test(CQL2, "/conf/basic-spatial-functions/test-data", OWN_DATA)
def spatial_test_data(api: Api) -> None:
    for name in ("markers", "plans", "marker_lines", "alignments"):
        found = [len(evaluate(api, name, predicate)) for predicate in spatial_predicates()]
        assert len(set(found)) > (4 if name == "markers" else 1)


@abstract_test(CQL2, "/conf/basic-spatial-functions/logical")
def spatial_logical(api: Api) -> None:
    logical_on(api, [*spatial_predicates(), *basic_predicates(api)], 20, advanced_shape)


@abstract_test(CQL2, "/conf/basic-spatial-functions-plus/s_intersects")
def s_intersects_plus(api: Api) -> None:
    world = f"(({RING}), ({HOLE}))"
    square = "((0 0, 10 0, 10 10, 0 10, 0 0))"
    for collection in api.collections():
        refused(api, collection["id"], intersects(geojson("MULTIPOINT(7.02 49.92, 90 180)")))
        for wkt in (
            "LINESTRING(-180 -45, 0 -45)",
            "MULTILINESTRING((-180 -45, 0 -45), (0 45, 180 45))",
            f"POLYGON{world}",
            f"MULTIPOLYGON({world}, {square})",
            f"GEOMETRYCOLLECTION(POINT(7.02 49.92), POLYGON{square})",
        ):
            evaluate(api, collection["id"], intersects(geojson(wkt)))
            text = f"S_INTERSECTS(geometry,{wkt})"
            assert api.get(f"/collections/{collection['id']}/items", filter=text).status_code == 200


@abstract_test(CQL2, "/conf/basic-spatial-functions-plus/test-data", OWN_DATA)
def plus_test_data(api: Api) -> None:
    for name in ("markers", "plans", "marker_lines", "alignments"):
        found = [len(evaluate(api, name, predicate)) for predicate in plus_predicates()]
        assert len(set(found)) > (4 if name == "markers" else 1)


# --- the languages ------------------------------------------------------------------------------------------------


@abstract_test(CQL2, "/conf/cql2-text/validate", "all tests above and below are run in text")
def text_validate(api: Api) -> None:
    for run in (is_null, boolean, between, s_intersects):
        run(api)


@abstract_test(CQL2, "/conf/cql2-text/escaping")
def text_escaping(api: Api) -> None:
    (quoted,) = [one["id"] for one in api.features("markers") if one["properties"]["road"] == "O'Hare"]
    for text in ("road = 'O''Hare'", r"road = 'O\'Hare'", r"road LIKE 'O\'H%'", "road LIKE 'O''H%'"):
        assert [one["id"] for one in api.features("markers", filter=text)] == [quoted], text
    (last,) = [one["id"] for one in api.features("markers") if one["properties"]["road"] == "50%_\\"]
    assert [one["id"] for one in api.features("markers", filter=r"road = '50%_\\'")] == [last]
    reader = Reader({"road": "string"}, datetime.fromisoformat, float, places_in(STORAGE_CRS))
    found = reader.read(r"road = '\a\b\t\n\v\f\r\''''", "cql2-text")  # no property of a marker can hold these
    assert found == Compared("road", "=", "\a\b\t\n\v\f\r''")
    for text in (r"road = '\a\b\t\n\v\f\r'", r"road LIKE '\a%\r'"):
        assert api.features("markers", filter=text) == []


@abstract_test(CQL2, "/conf/cql2-json/validate", "all tests above are run in JSON")
def json_validate(api: Api) -> None:
    for run in (is_null, boolean, between, s_intersects):
        run(api)
