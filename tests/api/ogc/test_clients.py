"""The clients that agencies use: GDAL 3.12 through pyogrio, the GDAL that is installed as ogrinfo, and OWSLib."""

from __future__ import annotations

import json
import multiprocessing
import os
import subprocess
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely
from owslib.ogcapi.features import Features
from pyproj import Transformer

from app.services.access.access import Scope
from tests.api.ogc.test_features import ROW, add
from tests.conftest import LiveServer
from tests.http import WITHIN_S
from tests.machine import require_tool

pytestmark = pytest.mark.both_databases

Gdal = Callable[..., Any]


@pytest.fixture(scope="module")
def road(server: LiveServer) -> str:
    """The key of an agency with twelve markers."""
    key = str(server.app.state.use_cases.access.create_key("gis", Scope.PLANNER, label="gis"))
    with server.client(key) as client:
        for k, (lon, lat) in enumerate(ROW):
            add(client, lon, lat, road=f"A{k % 3}", measure_m=float(k), position={"height_m": 3.25})
    return key


@pytest.fixture(scope="module")
def gdal(server: LiveServer, road: str) -> Iterator[Gdal]:
    """Call pyogrio on the server, in a process of its own: GDAL waits for its answers with the interpreter locked."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:

        def call(function: Callable[..., Any], key: str = road, **options: Any) -> Any:
            keyed = {"GDAL_HTTP_AUTH": "BEARER", "GDAL_HTTP_BEARER": key, "GDAL_HTTP_TIMEOUT": "30"}
            pool.submit(pyogrio.set_gdal_config_options, keyed).result(WITHIN_S)
            if function is pyogrio.raw.read:  # it rounds milliseconds up to 1,000 and then refuses one time in 2,000
                options["datetime_as_string"] = True
            return pool.submit(function, f"OAPIF:{server.url}/ogc", **options).result(WITHIN_S)

        yield call


@pytest.mark.slow
def test_gdal_lists_the_layers(gdal: Gdal) -> None:
    assert {"markers", "retired_markers", "marker_lines"} <= set(gdal(pyogrio.list_layers)[:, 0])


def test_gdal_reads_types_from_the_schema(gdal: Gdal) -> None:
    info = gdal(pyogrio.read_info, layer="markers")
    types = dict(zip(info["fields"], info["dtypes"], strict=True))
    assert info["features"] == 12
    assert types["code"] == types["road"] == "object"
    assert types["measure_m"] == "float64"
    assert types["version"] == "int32"
    assert types["updated_at"].startswith("datetime64")


def test_gdal_reads_places_through_pages(gdal: Gdal) -> None:
    meta, _, geometry, fields = gdal(pyogrio.raw.read, layer="markers", PAGE_SIZE="5")
    points = shapely.from_wkb(geometry)
    np.testing.assert_allclose(shapely.get_coordinates(points), ROW)
    assert set(shapely.get_z(points)) == {3.25}
    assert set(fields[list(meta["fields"]).index("road")]) == {"A0", "A1", "A2"}


def test_gdal_filters(gdal: Gdal) -> None:
    assert len(gdal(pyogrio.raw.read, layer="markers", bbox=(5.05, 44.0, 5.45, 46.0))[2]) == 4
    assert len(gdal(pyogrio.raw.read, layer="markers", where="road = 'A1' AND family = 'plate'")[2]) == 4
    assert len(gdal(pyogrio.raw.read, layer="markers", where="updated_at > '2020/01/01 00:00:00'")[2]) == 12


def test_gdal_reads_a_national_system(gdal: Gdal) -> None:
    """GDAL offers the systems that every collection lists."""
    meta, _, geometry, _ = gdal(pyogrio.raw.read, layer="markers", CRS="EPSG:25831")
    assert meta["crs"] == "EPSG:25831"
    expected = Transformer.from_crs(4326, 25831, always_xy=True).transform(
        *np.transpose(ROW[:11])
    )  # 6 deg east ends the zone
    np.testing.assert_allclose(shapely.get_coordinates(shapely.from_wkb(geometry)), np.transpose(expected), atol=1.0)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857"])
def test_gdal_reads_another_reference_system(gdal: Gdal, crs: str) -> None:
    _, _, geometry, _ = gdal(pyogrio.raw.read, layer="markers", CRS=crs)
    first = shapely.get_coordinates(shapely.from_wkb(geometry))[0]
    assert first == pytest.approx((5.0, 45.0) if crs == "EPSG:4326" else (556597.454, 5621521.486), abs=1e-3)


def test_gdal_with_a_wrong_key_is_told_so(gdal: Gdal) -> None:
    with pytest.raises(pyogrio.errors.DataSourceError, match="401"):
        gdal(pyogrio.list_layers, "wrong")


def _ogrinfo(url: str, key: str, *arguments: str) -> str:
    environment = {**os.environ, "GDAL_HTTP_HEADERS": f"Authorization: Bearer {key}"}
    done = subprocess.run(
        [require_tool("ogrinfo"), "-ro", *arguments, f"OAPIF:{url}/ogc", "markers"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=WITHIN_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "ERROR" not in done.stderr, done.stderr
    return done.stdout + done.stderr


def test_ogrinfo(server: LiveServer, road: str) -> None:
    summary = _ogrinfo(server.url, road, "-so")
    assert "Feature Count: 12" in summary
    assert "Extent: (5.000000, 45.000000) - (6.100000, 45.110000)" in summary
    for field in ("code: String", "measure_m: Real", "version: Integer", "updated_at: DateTime"):
        assert field in summary
    assert _ogrinfo(server.url, road, "-al", "-where", "road = 'A1'").count("OGRFeature(") == 4
    assert _ogrinfo(server.url, road, "-al", "-spat", "5.05", "44", "5.45", "46").count("OGRFeature(") == 4


@pytest.mark.parametrize(
    ("where", "count"),
    [
        ("measure_m >= 8", 4),
        ("measure_m > 2 AND measure_m < 5", 2),
        ("road <> 'A1'", 8),
        ("road LIKE 'A_' AND NOT (road = 'A0')", 8),
        ("road IN ('A1', 'A2') OR measure_m = 0", 9),
        ("road IS NULL", 0),
    ],
)
def test_gdal_filters_by_any_expression(gdal: Gdal, where: str, count: int) -> None:
    assert len(gdal(pyogrio.raw.read, layer="markers", where=where)[2]) == count


def test_ogrinfo_leaves_filtering_to_the_server(server: LiveServer, road: str) -> None:
    told = _ogrinfo(server.url, road, "-al", "-where", "measure_m >= 8", "--debug", "on")
    assert told.count("OGRFeature(") == 4
    assert "filter=measure_m%20%3E%3D%208&filter-lang=cql-text" in told


# --- OWSLib ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def owslib(server: LiveServer, road: str, monkeypatch: pytest.MonkeyPatch) -> Features:
    monkeypatch.setattr("owslib.ogcapi.REQUEST_HEADERS", {"Accept": "application/json"})
    return Features(f"{server.url}/ogc", headers={"X-API-Key": road})


def test_owslib_finds_its_way(owslib: Features) -> None:
    assert owslib.feature_collections() == [
        "markers", "retired_markers", "marker_lines", "alignments", "plans", "maintenance",
    ]  # fmt: skip
    assert owslib.api()["openapi"] == "3.0.3"
    assert any(uri.endswith("/conf/cql2-text") for uri in owslib.conformance()["conformsTo"])
    assert owslib.collection("markers")["storageCrs"].endswith("CRS84")
    assert owslib.collection_queryables("markers")["properties"]["measure_m"]["type"] == "number"
    assert owslib.collection_schema("markers")["properties"]["geometry"]["format"] == "geometry-point"


def test_owslib_reads_and_filters(owslib: Features) -> None:
    everything = owslib.collection_items("markers", limit=5)
    assert (everything["numberMatched"], everything["numberReturned"]) == (12, 5)
    boxed = owslib.collection_items("markers", bbox=[5.05, 44, 5.45, 46])
    assert len(boxed["features"]) == 4
    assert len(owslib.collection_items("markers", datetime_="../0000-12-31T23:59:59Z")["features"]) == 0
    assert len(owslib.collection_items("markers", datetime_="0000-01-01/9999-12-31")["features"]) == 12
    assert len(owslib.collection_items("markers", filter="road = 'A1' AND measure_m > 3")["features"]) == 3
    first = boxed["features"][0]
    assert owslib.collection_item("markers", first["id"])["properties"] == first["properties"]


def test_owslib_edits(server: LiveServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("owslib.ogcapi.REQUEST_HEADERS", {"Accept": "application/json"})
    key = str(server.app.state.use_cases.access.create_key("owslib", Scope.PLANNER, label="owslib"))
    headers = {"X-API-Key": key, "Content-Type": "application/geo+json"}  # OWSLib would say text/xml
    client = Features(f"{server.url}/ogc", headers=headers)
    point = {"type": "Point", "coordinates": [12.5, 55.5]}
    feature = {"type": "Feature", "geometry": point, "properties": {"road": "E20", "measure_m": 7.0}}
    assert client.collection_item_create("markers", json.dumps(feature))
    (made,) = client.collection_items("markers")["features"]
    assert (made["geometry"], made["properties"]["road"]) == (point, "E20")
    del feature["properties"]["measure_m"]  # type: ignore[attr-defined]
    assert client.collection_item_update("markers", made["id"], json.dumps(feature))
    (replaced,) = client.collection_items("markers")["features"]
    assert (replaced["id"], replaced["properties"]["measure_m"]) == (made["id"], None)
    assert client.collection_item_delete("markers", made["id"])
    assert client.collection_items("markers")["features"] == []
