"""OGC API Tiles over HTTP, the tiles read by GDAL's own driver."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any, get_args

import cv2
import httpx
import numpy as np
import orjson
import pyogrio
import pytest
import shapely

from app.api.http.ui import STATIC
from app.families import FAMILY_NAMES
from app.markers.reading import STATUSES
from app.plots.map_symbols import SHAPES, sprite
from app.services.markers.features import COLLECTIONS
from app.services.plans.documents import PlanStatus
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


@pytest.mark.slow
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


# --- for map libraries ------------------------------------------------------------------------------------------------

TILED = [name for name, collection in COLLECTIONS.items() if collection.has_tiles]


@pytest.mark.parametrize("name", TILED)
def test_every_tileset_has_tilejson_and_a_style(client: httpx.Client, name: str) -> None:
    tileset = get(client, f"/ogc/collections/{name}/tiles/WebMercatorQuad")
    links = {link["rel"]: link for link in tileset["links"]}
    document = get(client, links["describedby"]["href"])
    assert document["tilejson"] == "3.0.0"
    (layer,) = document["vector_layers"]
    assert (layer["id"], document["minzoom"], document["maxzoom"]) == (name, 0, 24)
    response = client.get(links["stylesheet"]["href"])
    assert response.headers["content-type"] == "application/vnd.mapbox.style+json"
    style = response.json()
    assert style["version"] == 8
    assert style["sources"]["waymark"]["tiles"] == document["tiles"]
    assert {layer["source-layer"] for layer in style["layers"]} == {name}
    assert len({layer["id"] for layer in style["layers"]}) == len(style["layers"])
    own = str(client.base_url).rstrip("/")
    urls = [*document["tiles"], style["sprite"]]
    assert all(url.startswith(own) for url in urls)
    assert "glyphs" not in style
    fields = set(layer["fields"])
    for drawn in style["layers"]:
        assert {part[1] for part in _gets(drawn)} <= fields


def _gets(node: Any) -> list[list[str]]:
    if isinstance(node, dict):
        return [found for inner in node.values() for found in _gets(inner)]
    if isinstance(node, list):
        return [node] if node[:1] == ["get"] else [found for inner in node for found in _gets(inner)]
    return []


def test_tilejson_names_what_tiles_have(client: httpx.Client, tmp_path: Path) -> None:
    add(client, *ROW[0], road="A1", heading_deg=3.0)
    document = get(client, f"{TILES}/tilejson")
    (url,) = document["tiles"]
    column, row = _tile_of(*ROW[0], 9)
    response = client.get(url.format(z=9, x=column, y=row))
    assert response.status_code == 200
    _, properties = _read(response.content, tmp_path, 9, column, row)
    assert set(document["vector_layers"][0]["fields"]) == set(properties) - {"mvt_id"}
    west, south, east, north = document["bounds"]
    assert west <= ROW[0][0] <= east
    assert south <= ROW[0][1] <= north


@pytest.mark.parametrize("name", TILED)
def test_every_family_and_status_has_a_symbol(client: httpx.Client, name: str) -> None:
    style = get(client, f"/ogc/collections/{name}/tiles/WebMercatorQuad/style")
    dots, *symbols = style["layers"]
    assert dots["type"] == "circle"
    with httpx.Client(timeout=60, trust_env=False) as anonymous:  # QGIS asks for a sprite without a key
        for suffix in ("", "@2x"):
            places = anonymous.get(f"{style['sprite']}{suffix}.json").json()
            assert anonymous.get(f"{style['sprite']}{suffix}.png").headers["content-type"] == "image/png"
            assert {layer["layout"]["icon-image"] for layer in symbols} <= set(places)
    statuses = {"plans": get_args(PlanStatus), "maintenance": ("open", "approved", "rejected")}.get(name, STATUSES)
    shown = {(str(layer["filter"][1]), layer["filter"][2][2]) for layer in symbols}
    for family in FAMILY_NAMES:
        assert family in SHAPES
        for status in statuses:
            assert (str(["==", ["get", "family"], family]), status) in shown
    assert set(dots["paint"]["circle-color"][2:-1:2]) == set(statuses)


def test_the_files_of_the_sprite_are_what_the_code_draws() -> None:
    for pixel_ratio, suffix in ((1, ""), (2, "@2x")):
        picture, places = sprite(pixel_ratio)
        folder = STATIC / "sprites"
        stored = cv2.imread(str(folder / f"markers{suffix}.png"), cv2.IMREAD_UNCHANGED)
        drawn = cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA)
        assert np.array_equal(stored[..., 3], drawn[..., 3])
        assert np.array_equal(stored, drawn), "python -m app.plots.map_symbols static/sprites"
        assert orjson.loads((folder / f"markers{suffix}.json").read_bytes()) == places


def test_symbols_differ_by_more_than_colour() -> None:
    """Each status by its lightness and mark, each family by its outline: for readers who do not see colours."""
    picture, places = sprite(2)
    grey = {}
    for name, place in places.items():
        part = picture[place["y"] : place["y"] + place["height"], place["x"] : place["x"] + place["width"]]
        grey[name] = cv2.cvtColor(part[..., :3], cv2.COLOR_RGB2GRAY).astype(float) * (part[..., 3] / 255)
    names = [name for name in grey if name.partition("-")[2] in STATUSES]
    for first, second in itertools.combinations(names, 2):
        assert np.abs(grey[first] - grey[second]).mean() > 4, (first, second)


@pytest.mark.parametrize("what", ["tilejson", "style"])
def test_lines_and_other_matrix_sets_have_none(client: httpx.Client, what: str) -> None:
    assert client.get(f"/ogc/collections/marker_lines/tiles/WebMercatorQuad/{what}").status_code == 404
    assert client.get(f"/ogc/collections/markers/tiles/WorldCRS84Quad/{what}").status_code == 404
    assert client.get(f"{TILES}/{what}", params={"f": "html"}).status_code == 400
