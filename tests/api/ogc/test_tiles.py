"""OGC API Tiles over HTTP, the tiles read by GDAL's own driver."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pyogrio
import pytest
import shapely

from tests.api.ogc.test_features import ROW, add, get
from tests.conftest import LiveServer

pytestmark = pytest.mark.both_databases

TILES = "/ogc/collections/markers/tiles/WebMercatorQuad"


def _tile_of(lon_deg: float, lat_deg: float, zoom: int) -> tuple[int, int]:
    down = (1 - math.asinh(math.tan(math.radians(lat_deg))) / math.pi) / 2
    return math.floor((lon_deg + 180) / 360 * 2**zoom), math.floor(down * 2**zoom)


def _read(content: bytes, folder: Path, zoom: int, column: int, row: int) -> tuple[np.ndarray, dict[str, Any]]:
    """Places in EPSG:3857 and properties, as GDAL reads them."""
    file = folder / "tile.pbf"
    file.write_bytes(content)
    meta, _, geometry, fields = pyogrio.raw.read(file, X=str(column), Y=str(row), Z=str(zoom), CLIP="NO")
    return shapely.get_coordinates(shapely.from_wkb(geometry)), dict(zip(meta["fields"], fields, strict=True))


@pytest.mark.parametrize("zoom", [0, 2, 8, 14])
def test_gdal_finds_every_marker_where_it_is(client: httpx.Client, tmp_path: Path, zoom: int) -> None:
    names = [add(client, lon, lat, road=f"Å{k % 3}", heading_deg=float(k)) for k, (lon, lat) in enumerate(ROW)]
    column, row = _tile_of(*ROW[3], zoom)
    response = client.get(f"{TILES}/{zoom}/{row}/{column}")
    assert response.status_code == 200
    assert response.headers["content-type"] == "application/vnd.mapbox-vector-tile"
    places, properties = _read(response.content, tmp_path, zoom, column, row)
    shown = {name: k for k, name in enumerate(properties["id"])}
    k = shown[names[3]]
    page = get(client, f"/ogc/collections/markers/items/{names[3]}", crs="http://www.opengis.net/def/crs/EPSG/0/3857")
    half_px_m = 40_075_016.7 / 2**zoom / 4096 * 0.51
    assert places[k] == pytest.approx(page["geometry"]["coordinates"], abs=half_px_m)
    assert {name: properties[name][k] for name in ("family", "road", "heading_deg", "code")} == {
        name: page["properties"][name] for name in ("family", "road", "heading_deg", "code")
    }
    if zoom <= 2:
        assert set(shown) == set(names)


def test_a_tile_without_markers_is_empty(client: httpx.Client) -> None:
    response = client.get(f"{TILES}/10/3/3")
    assert (response.status_code, response.content) == (204, b"")


def test_one_agency_never_sees_anothers_on_tiles(server: LiveServer, client: httpx.Client) -> None:
    add(client, *ROW[0])
    assert client.get(f"{TILES}/0/0/0").status_code == 200
    with server.agency("strangers to tiles") as stranger:
        assert stranger.get(f"{TILES}/0/0/0").status_code == 204


@pytest.mark.parametrize(
    "tile", ["0/0/1", "25/0/0", "x/0/0", "1/-1/0", "1/00/0", "1/1.5/0", f"{'9' * 24}/0/0", "3/8/0"]
)
def test_tiles_that_are_not_there(client: httpx.Client, tile: str) -> None:
    response = client.get(f"{TILES}/{tile}")
    assert response.status_code == 404
    assert response.headers["content-type"] == "application/problem+json"


def test_the_matrix_set_is_that_of_the_standard(client: httpx.Client) -> None:
    matrices = get(client, "/ogc/tileMatrixSets/WebMercatorQuad")["tileMatrices"]
    assert matrices[0]["scaleDenominator"] == pytest.approx(559082264.028717, rel=1e-9)  # OGC 17-083r4, annex D.1
    assert matrices[0]["pointOfOrigin"] == pytest.approx([-20037508.3427892, 20037508.3427892])
    assert (matrices[18]["matrixWidth"], matrices[18]["cellSize"]) == (262144, pytest.approx(0.597164283559817))
    assert client.get(f"{TILES.rsplit('/', 1)[0]}/WorldCRS84Quad/0/0/0").status_code == 404
    assert client.get(f"{TILES}/0/0/0?f=png").status_code == 400
