"""OGC API Tiles: markers as Mapbox Vector Tiles in WebMercatorQuad."""

from __future__ import annotations

import math
import re
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from app.api.ogc.query import known_parameters
from app.api.ogc.responses import JSON, MVT, answer, base_url, caller_of, link, negotiate
from app.errors import NotFound
from app.registry.tiles import MAX_ZOOM, Tile
from app.services.feature_crs import FeatureCrs
from app.services.features import Collection, Features, get_collection

MATRIX_SET = "WebMercatorQuad"
MATRIX_SET_URI = f"http://www.opengis.net/def/tilematrixset/OGC/1.0/{MATRIX_SET}"
TILES_REL = "http://www.opengis.net/def/rel/ogc/1.0/tilesets-vector"
_SCHEME_REL = "http://www.opengis.net/def/rel/ogc/1.0/tiling-scheme"
_WORLD_M = math.pi * 6_378_137.0
_WHOLE = re.compile(r"0|[1-9][0-9]{0,8}", re.ASCII)


def list_tilesets(request: Request) -> Response:
    """The tile sets of a collection: one."""
    collection = _tiled(request)
    negotiate(request, known_parameters(request, ("f",)), JSON)
    return answer({"tilesets": [_tileset(request, collection)]})


def get_tileset(request: Request) -> Response:
    """A tile set of a collection."""
    collection = _tiled(request)
    _check_matrix_set(request)
    negotiate(request, known_parameters(request, ("f",)), JSON)
    return answer(_tileset(request, collection))


def get_tile(request: Request) -> Response:
    """A tile; 204 without features."""
    collection = _tiled(request)
    _check_matrix_set(request)
    tile = _tile(request)
    found = known_parameters(request, ("f",))
    negotiate(request, found, MVT, "application/x-protobuf", "application/octet-stream", names=("mvt", "pbf"))
    features: Features = request.app.state.features
    content = features.tile(caller_of(request), collection, tile)
    headers = {"Cache-Control": "private, no-cache"}
    if not content:
        return Response(status_code=204, headers=headers)
    return Response(content, headers=headers, media_type=MVT)


def list_matrix_sets(request: Request) -> Response:
    """The tile matrix sets: one."""
    negotiate(request, known_parameters(request, ("f",)), JSON)
    url = f"{base_url(request)}/tileMatrixSets/{MATRIX_SET}"
    links = [link(url, "self", JSON)]
    return answer({"tileMatrixSets": [{"id": MATRIX_SET, "uri": MATRIX_SET_URI, "links": links}]})


def get_matrix_set(request: Request) -> Response:
    """The tile matrix set, by its figures."""
    _check_matrix_set(request)
    negotiate(request, known_parameters(request, ("f",)), JSON)
    matrices = [
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
    return answer(
        {
            "id": MATRIX_SET,
            "uri": MATRIX_SET_URI,
            "crs": FeatureCrs.WEB_MERCATOR,
            "orderedAxes": ["X", "Y"],
            "tileMatrices": matrices,
        }
    )


def _tiled(request: Request) -> Collection:
    collection = get_collection(request.path_params["collection"])
    if not collection.has_tiles:
        raise NotFound("there are no tiles of this collection", field="collectionId", cure="ask for its items")
    return collection


def _check_matrix_set(request: Request) -> None:
    if request.path_params["matrix_set"] != MATRIX_SET:
        raise NotFound("there is no such tile matrix set", field="tileMatrixSetId", limit=MATRIX_SET)


def _tile(request: Request) -> Tile:
    texts = [str(request.path_params[name]) for name in ("zoom", "column", "row")]
    if all(_WHOLE.fullmatch(text) for text in texts):
        zoom, column, row = (int(text) for text in texts)
        if zoom <= MAX_ZOOM and max(column, row) < 2**zoom:
            return Tile(zoom, column, row)
    raise NotFound(
        "there is no such tile", field="tileMatrix", limit=f"level 0 to {MAX_ZOOM}; row, column below 2^level"
    )


def _tileset(request: Request, collection: Collection) -> dict[str, Any]:
    base = base_url(request)
    url = f"{base}/collections/{collection.id}/tiles/{MATRIX_SET}"
    template = link(f"{url}/{{tileMatrix}}/{{tileRow}}/{{tileCol}}", "item", MVT)
    return {
        "title": collection.title,
        "dataType": "vector",
        "crs": FeatureCrs.WEB_MERCATOR,
        "tileMatrixSetURI": MATRIX_SET_URI,
        "links": [
            link(url, "self", JSON),
            link(f"{base}/tileMatrixSets/{MATRIX_SET}", _SCHEME_REL, JSON),
            {**template, "templated": True},
        ],
    }
