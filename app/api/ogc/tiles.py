"""OGC API Tiles: points as Mapbox Vector Tiles in WebMercatorQuad."""

from __future__ import annotations

import math
import re
from typing import Annotated

from fastapi import Depends, Path, Request
from starlette.responses import Response

from app.api.http.dependencies import Caller
from app.api.ogc.dependencies import BaseUrl, CollectionOf, FeaturesService, Offers
from app.api.ogc.map_style import map_style, tilejson
from app.api.ogc.parameters import OF_TILE
from app.api.ogc.query import flag_parameter, known_parameters
from app.api.ogc.responses import JSON, MAP_STYLE, MVT, answer, link, negotiate
from app.api.ogc.shapes import TileMatrix, TileMatrixSet, TileMatrixSets, TileSet, TileSets
from app.errors import NotFound
from app.registry.tiles import MAX_ZOOM, Tile
from app.services.markers.feature_crs import FeatureCrs
from app.services.markers.features import Collection

MATRIX_SET = "WebMercatorQuad"
MATRIX_SET_URI = f"http://www.opengis.net/def/tilematrixset/OGC/1.0/{MATRIX_SET}"
TILES_REL = "http://www.opengis.net/def/rel/ogc/1.0/tilesets-vector"
_SCHEME_REL = "http://www.opengis.net/def/rel/ogc/1.0/tiling-scheme"
_WORLD_M = math.pi * 6_378_137.0
_WHOLE = re.compile(r"0|[1-9][0-9]{0,8}", re.ASCII)
TileNumber = Annotated[str, Path(description="A whole number, from 0.")]


async def get_tiled_collection(collection: CollectionOf) -> Collection:
    """The collection that the path names, if there are tiles of it.

    Raises
    ------
    NotFound
        There are none.
    """
    if not collection.has_tiles:
        raise NotFound("there are no tiles of this collection", field="collectionId", cure="ask for its items")
    return collection


async def check_matrix_set(matrix_set: Annotated[str, Path(description=f"{MATRIX_SET} is the only one.")]) -> None:
    """Refuse other tile matrix sets.

    Raises
    ------
    NotFound
        The path names another one.
    """
    if matrix_set != MATRIX_SET:
        raise NotFound("there is no such tile matrix set", field="tileMatrixSetId", limit=MATRIX_SET)


async def get_tile_place(zoom: TileNumber, row: TileNumber, column: TileNumber) -> Tile:
    """The tile that the path names.

    Raises
    ------
    NotFound
        It is beyond the tile matrix set.
    """
    if all(_WHOLE.fullmatch(text) for text in (zoom, column, row)):
        tile = Tile(int(zoom), int(column), int(row))
        if tile.zoom <= MAX_ZOOM and max(tile.column, tile.row) < 2**tile.zoom:
            return tile
    raise NotFound(
        "there is no such tile", field="tileMatrix", limit=f"level 0 to {MAX_ZOOM}; row, column below 2^level"
    )


async def get_groups(request: Request) -> bool:
    """Whether a client, which takes vector tiles, wants groups in place of too many features."""
    found = known_parameters(request, OF_TILE)
    kinds = (MVT, "application/x-protobuf", "application/octet-stream")
    negotiate(request, found.get("f"), *kinds, names=("mvt", "pbf"))
    return flag_parameter(found, "groups")


Tiled = Annotated[Collection, Depends(get_tiled_collection)]
MatrixSet = Annotated[None, Depends(check_matrix_set)]
TilePlace = Annotated[Tile, Depends(get_tile_place)]
Groups = Annotated[bool, Depends(get_groups)]
OffersJson = Annotated[bool, Depends(Offers(JSON))]
OffersStyle = Annotated[bool, Depends(Offers(MAP_STYLE, JSON))]


def list_tilesets(collection: Tiled, _offers: OffersJson, base: BaseUrl) -> Response:
    """The tile sets of a collection: one."""
    return answer(TileSets(tilesets=[_tileset(base, collection)]))


def get_tileset(collection: Tiled, _matrix_set: MatrixSet, _offers: OffersJson, base: BaseUrl) -> Response:
    """A tile set of a collection."""
    return answer(_tileset(base, collection))


def get_tilejson(
    collection: Tiled, _matrix_set: MatrixSet, _offers: OffersJson, base: BaseUrl, caller: Caller,
    features: FeaturesService,
) -> Response:  # fmt: skip
    """A tile set of a collection as TileJSON 3.0."""
    return answer(tilejson(collection, _template(base, collection), features.extent(caller, collection)))


def get_map_style(
    collection: Tiled, _matrix_set: MatrixSet, _offers: OffersStyle, base: BaseUrl, caller: Caller,
    features: FeaturesService,
) -> Response:  # fmt: skip
    """A MapLibre style of a tile set: symbols by family and status."""
    sprite_url = f"{base.removesuffix('/ogc')}/static/sprites/markers"
    extent = features.extent(caller, collection)
    return answer(map_style(collection, _template(base, collection), sprite_url, extent), MAP_STYLE)


def get_tile(
    collection: Tiled,
    _matrix_set: MatrixSet,
    tile: TilePlace,
    groups: Groups,
    caller: Caller,
    features: FeaturesService,
) -> Response:
    """A tile; 204 without features."""
    content = (features.grouped_tile if groups else features.tile)(caller, collection, tile)
    headers = {"Cache-Control": "private, no-cache"}
    if not content:
        return Response(status_code=204, headers=headers)
    return Response(content, headers=headers, media_type=MVT)


def list_matrix_sets(_offers: OffersJson, base: BaseUrl) -> Response:
    """The tile matrix sets: one."""
    links = [link(f"{base}/tileMatrixSets/{MATRIX_SET}", "self", JSON)]
    return answer(TileMatrixSets(tileMatrixSets=[{"id": MATRIX_SET, "uri": MATRIX_SET_URI, "links": links}]))


def get_matrix_set(_matrix_set: MatrixSet, _offers: OffersJson) -> Response:
    """The tile matrix set, by its figures."""
    matrices: list[TileMatrix] = [
        {
            "id": str(zoom),
            "scaleDenominator": 2 * _WORLD_M / 256 / 0.00028 / 2**zoom,
            "cellSize": 2 * _WORLD_M / 256 / 2**zoom,
            "pointOfOrigin": [-_WORLD_M, _WORLD_M],
            "tileWidth": 256,
            "tileHeight": 256,
            "matrixWidth": 2**zoom,
            "matrixHeight": 2**zoom,
        }
        for zoom in range(MAX_ZOOM + 1)
    ]
    document: TileMatrixSet = {
        "id": MATRIX_SET,
        "uri": MATRIX_SET_URI,
        "crs": FeatureCrs.WEB_MERCATOR,
        "orderedAxes": ["X", "Y"],
        "tileMatrices": matrices,
    }
    return answer(document)


def _template(base: str, collection: Collection) -> str:
    return f"{base}/collections/{collection.id}/tiles/{MATRIX_SET}/{{z}}/{{y}}/{{x}}"


def _tileset(base: str, collection: Collection) -> TileSet:
    url = f"{base}/collections/{collection.id}/tiles/{MATRIX_SET}"
    template = link(f"{url}/{{tileMatrix}}/{{tileRow}}/{{tileCol}}", "item", MVT)
    template["templated"] = True
    return {
        "title": collection.title,
        "dataType": "vector",
        "crs": FeatureCrs.WEB_MERCATOR,
        "tileMatrixSetURI": MATRIX_SET_URI,
        "links": [
            link(url, "self", JSON),
            link(f"{base}/tileMatrixSets/{MATRIX_SET}", _SCHEME_REL, JSON),
            template,
            link(f"{url}/tilejson", "describedby", JSON, "TileJSON 3.0"),
            link(f"{url}/style", "stylesheet", MAP_STYLE, "MapLibre style"),
        ],
    }
