"""The abstract tests of the OGC standards whose classes /ogc/conformance declares, in one list, and what they run on.

The tests are functions of an `Api` in the modules of `MODULES`, each under the identifier of its abstract test.
`test_abstract_tests.py` runs them; the table in docs/ogc.md is what `python -m tests.api.ogc.abstract_tests` prints.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import httpx
from pyproj import Transformer
from pyproj.aoi import AreaOfInterest

from tests.api.ogc.test_features import add
from tests.api.plans.test_plans import road, send_road
from tests.http import created

MODULES = ("abstract_features", "abstract_filters", "abstract_tiles")
HTML, JSON, GEOJSON, SCHEMA = "text/html", "application/json", "application/geo+json", "application/schema+json"
CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
CRS84H = "http://www.opengis.net/def/crs/OGC/0/CRS84h"
SPEC = "http://www.opengis.net/spec"


class Api:
    """The API under test, as the client of an agency sees it; paths begin after /ogc."""

    def __init__(self, client: httpx.Client) -> None:
        self.client = client
        self.root = f"{client.base_url}".rstrip("/") + "/ogc"

    def get(self, path: str, accept: str | None = None, **parameters: Any) -> httpx.Response:
        """A response; a path may be a whole URL."""
        named = {
            name.replace("_", "-") if name.endswith(("_crs", "_lang")) else name: v for name, v in parameters.items()
        }
        url = path if path.startswith("http") else self.root + path
        return self.client.get(url, params=named or None, headers={"Accept": accept} if accept else {})

    def document(self, path: str, accept: str | None = None, **parameters: Any) -> dict[str, Any]:
        """The JSON of a response with status 200."""
        response = self.get(path, accept, **parameters)
        assert response.status_code == 200, response.text
        assert "json" in response.headers["content-type"]
        return dict(response.json())

    def collections(self) -> list[dict[str, Any]]:
        """The collections, each as its own resource describes it."""
        return [self.document(f"/collections/{one['id']}") for one in self.document("/collections")["collections"]]

    def filled(self) -> list[dict[str, Any]]:
        """The collections with features."""
        return [one for one in self.collections() if "extent" in one]

    def features(self, collection: str, **parameters: Any) -> list[dict[str, Any]]:
        """All features of a collection that a query leaves."""
        return list(self.document(f"/collections/{collection}/items", limit=10_000, **parameters)["features"])

    def operations(self) -> Iterator[tuple[str, dict[str, Any], list[dict[str, Any]]]]:
        """Path, operation and resolved parameters of each GET in the API definition."""
        document = self.document("/api")
        for path, operations in document["paths"].items():
            operation = operations["get"]
            names = [parameter["$ref"].rsplit("/", 1)[1] for parameter in operation["parameters"]]
            yield path, operation, [document["components"]["parameters"][name] for name in names]

    def filled_path(self, path: str) -> str:
        """A path of the API definition with values for its variables, of a collection with features."""
        collection = path.split("/")[2] if path.count("/") > 1 else ""
        if "{featureId}" in path:
            path = path.replace("{featureId}", self.features(collection)[0]["id"])
        return path.replace("{tileMatrix}", "0").replace("{tileRow}", "0").replace("{tileCol}", "0")

    def parameter(self, name: str, collection: str = "markers") -> dict[str, Any]:
        """A query parameter of the items of a collection, as the API definition has it."""
        for path, _, parameters in self.operations():
            if path == f"/collections/{collection}/items":
                return next(parameter for parameter in parameters if parameter["name"] == name)
        raise AssertionError(f"there is no path of items of {collection}")


@dataclass(frozen=True, slots=True)
class AbstractTest:
    """An abstract test and its result: `run` passes or, with a reason, is not applicable."""

    standard: str  # as the URIs of its classes have it
    identifier: str
    run: Callable[[Api], None] | None = None
    reason: str = ""

    @property
    def result(self) -> str:
        """What the table says."""
        return "pass" if self.run is not None else "not applicable"


TESTS: list[AbstractTest] = []
Run = Callable[[Api], None]


def abstract_test(standard: str, identifier: str, note: str = "") -> Callable[[Run], Run]:
    """A function that runs an abstract test of a standard; the note stands beside its result."""

    def register(run: Run) -> Run:
        TESTS.append(AbstractTest(standard, identifier, run, note))
        return run

    return register


def not_applicable(standard: str, identifier: str, reason: str) -> None:
    """An abstract test that does not apply to this server."""
    TESTS.append(AbstractTest(standard, identifier, None, reason))


def all_tests() -> list[AbstractTest]:
    """The tests of all modules, in the order of the standards."""
    for name in MODULES:
        importlib.import_module(f"tests.api.ogc.{name}")
    return TESTS


def table() -> str:
    """The results as the table of docs/ogc.md."""
    lines = ["| standard | abstract test | result | note |", "|---|---|---|---|"]
    lines += [f"| {one.standard} | `{one.identifier}` | {one.result} | {one.reason} |" for one in all_tests()]
    return "\n".join(lines)


ROADS = ["København", "Köln", "Kiel", "A7", "a7", "O'Hare", "50%_\\", "Luxembourg", None, "foo", "Ålborg", "A70"]
PLACES = [(8.40 + 0.01 * k, 49.0 + 0.004 * (k % 5)) for k in range(len(ROADS))]


def fill(client: httpx.Client) -> None:
    """Markers with and without heights, roads and measures; retired ones, a run of CERPMs, an alignment and a plan."""
    for k, ((lon_deg, lat_deg), name) in enumerate(zip(PLACES, ROADS, strict=True)):
        position: dict[str, Any] = {"height_m": 100.0 + k} if k % 2 else {}
        if k % 3 == 0:
            position |= {"survey_method": "rtk", "horizontal_rmse_m": 0.01 * (k + 1), "check_points": 20 + k}
        measure_m = 50.0 * k if k % 4 else None
        status = "active" if k < 6 else "planned"
        add(client, lon_deg, lat_deg, position=position, road=name, measure_m=measure_m, status=status)
    for k, measure_m in enumerate((0.0, 5.0, 10.0)):
        position = {"lon_deg": 8.45 + 1e-4 * k, "lat_deg": 49.02}
        body = {"family": "cerpm", "position": position, "side": "left", "road": "A8", "measure_m": measure_m}
        created(client, "/v1/markers", **body)
    for k in range(2):
        marker = add(client, 8.5, 49.03 + 0.01 * k)
        change = {"status": "retired", "reason": "resurfaced"}
        assert client.patch(f"/v1/markers/{marker}", json=change, headers={"If-Match": '"1"'}).status_code == 200
    sent = send_road(client, road(8.42, 49.01, length_m=200.0), name="Ring")
    assert sent.status_code == 201, sent.text
    rules = {"version": 1, "plates": {"spacing_m": 100}, "lines": {}}
    created(client, "/v1/plans", name="Ring", alignment_id=sent.json()["id"], rules=rules)


def vertices(geometry: dict[str, Any]) -> list[list[float]]:
    """The positions of a point or a line."""
    return [geometry["coordinates"]] if geometry["type"] == "Point" else list(geometry["coordinates"])


def links(document: dict[str, Any], rel: str) -> list[dict[str, Any]]:
    """The links of a document with a relation."""
    return [link for link in document["links"] if link["rel"] == rel]


def check_links(document: dict[str, Any]) -> None:
    """All links have a relation and a type."""
    assert document["links"]
    for link in document["links"]:
        assert all(link[name] for name in ("href", "rel", "type")), link


KNOWN = ("CRS84", "CRS84h", "4326", "3857", "3034", "3035", "4258", "25832", "32632", "31467", "3044", "3395")


def known(collection: dict[str, Any]) -> list[str]:
    """The listed systems that are compared with PROJ, which takes seconds to prepare each."""
    found = [uri for uri in collection["crs"] if uri.rsplit("/", 1)[1] in KNOWN]
    assert len(found) == len(KNOWN)
    return found


@functools.cache
def transformer(uri: str) -> Transformer:
    """From longitude and latitude to a system, its axes in the authority's order, by PROJ."""
    name = f"EPSG:{uri.rsplit('/', 1)[1]}" if "/EPSG/" in uri else "OGC:CRS84"
    return Transformer.from_crs("OGC:CRS84", name, area_of_interest=AreaOfInterest(8.3, 48.9, 8.6, 49.1))


if __name__ == "__main__":
    print(importlib.import_module("tests.api.ogc.abstract_tests").table())  # the list that the modules fill
