"""The clients that agencies use: GDAL 3.12 through pyogrio, and the GDAL that is installed as ogrinfo."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely

from app.services.access import Scope
from tests.api.test_ogc_features import ROW, add
from tests.conftest import LiveServer

Gdal = Callable[..., Any]


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def road(server: LiveServer) -> str:
    """The key of an agency with twelve markers."""
    key = str(server.app.state.access.create_key("gis", Scope.PLANNER, label="gis"))
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
            pool.submit(pyogrio.set_gdal_config_options, keyed).result(60)
            return pool.submit(function, f"OAPIF:{server.url}/ogc", **options).result(60)

        yield call


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


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857"])
def test_gdal_reads_another_reference_system(gdal: Gdal, crs: str) -> None:
    _, _, geometry, _ = gdal(pyogrio.raw.read, layer="markers", CRS=crs)
    first = shapely.get_coordinates(shapely.from_wkb(geometry))[0]
    assert first == pytest.approx((5.0, 45.0) if crs == "EPSG:4326" else (556597.454, 5621521.486), abs=1e-3)


def test_gdal_with_a_wrong_key_is_told_so(gdal: Gdal) -> None:
    with pytest.raises(pyogrio.errors.DataSourceError, match="401"):
        gdal(pyogrio.list_layers, "wrong")


def _ogrinfo(url: str, key: str, *arguments: str) -> str:
    if shutil.which("ogrinfo") is None:
        if os.environ.get("CI"):
            pytest.fail("ogrinfo is missing; it is in gdal-bin")
        pytest.skip("needs ogrinfo, which is in gdal-bin")
    environment = {**os.environ, "GDAL_HTTP_HEADERS": f"Authorization: Bearer {key}"}
    done = subprocess.run(
        ["ogrinfo", "-ro", *arguments, f"OAPIF:{url}/ogc", "markers"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "ERROR" not in done.stderr, done.stderr
    return done.stdout


def test_ogrinfo(server: LiveServer, road: str) -> None:
    summary = _ogrinfo(server.url, road, "-so")
    assert "Feature Count: 12" in summary
    assert "Extent: (5.000000, 45.000000) - (6.100000, 45.110000)" in summary
    for field in ("code: String", "measure_m: Real", "version: Integer", "updated_at: DateTime"):
        assert field in summary
    assert _ogrinfo(server.url, road, "-al", "-where", "road = 'A1'").count("OGRFeature(") == 4
    assert _ogrinfo(server.url, road, "-al", "-spat", "5.05", "44", "5.45", "46").count("OGRFeature(") == 4
