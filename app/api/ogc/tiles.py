"""OGC API Tiles: points as Mapbox Vector Tiles in WebMercatorQuad, with TileJSON and a style for maps."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Annotated, NotRequired, TypedDict

from fastapi import Depends, Path, Request
from starlette.responses import Response

from app.api.http.dependencies import Caller
from app.api.http.permissions import READERS
from app.api.http.problems import problem_responses
from app.api.http.responses import file_response
from app.api.http.routes import Router
from app.api.ogc.query import OF_TILE, described, flag_parameter, known_parameters
from app.api.ogc.responses import (
    JSON,
    MAP_STYLE,
    MVT,
    BaseUrl,
    CollectionOf,
    FeaturesService,
    Offers,
    TileMatrix,
    TileMatrixSet,
    TileMatrixSets,
    TileSet,
    TileSets,
    answer,
    describe_read,
    in_own_threads,
    link,
    negotiate,
)
from app.errors import NotFound
from app.families import FAMILIES
from app.plots.map_symbols import LOOKS, symbol_name
from app.registry.features import Extent
from app.registry.tiles import MAX_ZOOM, Tile
from app.services.markers.features import MAINTENANCE_ITEMS, PLANS, Collection, FeatureCrs
from app.values import JsonObject

# === Tilesets for map libraries and QGIS: TileJSON 3.0, and a MapLibre style whose symbols show family and status.


_KINDS = {"number": "Number", "integer": "Number"}
_MARKER_LOOKS = {status: status for status in ("planned", "built", "surveyed", "active", "suspect", "retired")}
_LOOKS = {
    PLANS.id: {
        "draft": "draft", "checked": "checked", "proved": "checked", "approved": "approved", "committed": "planned",
        "built": "built", "surveyed": "surveyed",
    },
    MAINTENANCE_ITEMS.id: {"open": "suspect", "approved": "approved", "rejected": "rejected"},
}  # fmt: skip
"""Looks of the statuses that the features of a collection have; of the others, those of a marker's status."""
_SMALLEST_ZOOM, _FULL_ZOOM = 6, 13  # symbols grow between them; on a map of a motorway


class VectorLayer(TypedDict):
    """A layer of a tileset, with the kinds and meanings of its features' fields."""

    id: str
    description: str
    minzoom: int
    maxzoom: int
    fields: dict[str, str]


class TileJson(TypedDict):
    """A tileset by TileJSON 3.0.0."""

    tilejson: str
    name: str
    description: str
    version: str
    scheme: str
    tiles: list[str]
    minzoom: int
    maxzoom: int
    vector_layers: list[VectorLayer]
    bounds: NotRequired[list[float]]


def tilejson(collection: Collection, tiles_url: str, extent: Extent | None) -> TileJson:
    """Description of a tileset as TileJSON 3.0.0.

    Parameters
    ----------
    tiles_url : str
        Template of the tiles with {z}, {y} and {x}.
    extent : Extent or None
        What the features cover.
    """
    fields = {field.name: field for field in collection.fields}
    shown = {name: f"{_KINDS.get(fields[name].kind, 'String')}: {fields[name].text}" for name in collection.table.tiled}
    document: TileJson = {
        "tilejson": "3.0.0",
        "name": collection.title,
        "description": collection.text,
        "version": "1.0.0",
        "scheme": "xyz",
        "tiles": [tiles_url],
        "minzoom": 0,
        "maxzoom": MAX_ZOOM,
        "vector_layers": [
            {
                "id": collection.id,
                "description": collection.text,
                "minzoom": 0,
                "maxzoom": MAX_ZOOM,
                "fields": {"id": "String: Id of the feature", **shown},
            }
        ],
    }
    if extent is not None:
        document["bounds"] = _bounds(extent)
    return document


def map_style(collection: Collection, tiles_url: str, sprite_url: str, extent: Extent | None) -> dict[str, object]:
    """A style that draws a tileset: dots that every client can draw, and over them a symbol for each feature.

    Each family with each status is a layer of its own: QGIS 3.22 draws an icon that an expression chooses with the
    expression's last value only. There are no texts, and so no glyphs.
    """
    looks = _LOOKS.get(collection.id, _MARKER_LOOKS)
    source: dict[str, object] = {"type": "vector", "tiles": [tiles_url], "minzoom": 0, "maxzoom": MAX_ZOOM}
    document: dict[str, object] = {
        "version": 8,
        "name": collection.title,
        "sprite": sprite_url,
        "sources": {"waymark": source},
        "layers": [_dots(collection, looks), *_symbols(collection, looks)],
    }
    if extent is not None:
        west, south, east, north = source["bounds"] = _bounds(extent)
        document["center"] = [(west + east) / 2, (south + north) / 2]
    return document


def _bounds(extent: Extent) -> list[float]:
    """West, south, east, north; TileJSON has none across the antimeridian: then all longitudes."""
    west, east = (extent.west_deg, extent.east_deg) if extent.west_deg <= extent.east_deg else (-180.0, 180.0)
    return [west, extent.south_deg, east, extent.north_deg]


def _by_status(values: dict[str, str], other: str) -> list[object]:
    pairs = [part for status, value in values.items() for part in (status, value)]
    return ["match", ["get", "status"], *pairs, other]


def _dots(collection: Collection, looks: dict[str, str]) -> dict[str, object]:
    colours = {status: "#{:02x}{:02x}{:02x}".format(*_visible(look)) for status, look in looks.items()}
    return {
        "id": "Dots",
        "type": "circle",
        "source": "waymark",
        "source-layer": collection.id,
        "paint": {
            "circle-radius": 2.5,
            "circle-color": _by_status(colours, "#263238"),
            "circle-stroke-color": "#ffffff",
            "circle-stroke-width": 0.5,
        },
    }


def _visible(look: str) -> tuple[int, int, int]:
    """The colour of a dot: that of the outline where the fill is white."""
    fill, outline, _ = LOOKS[look]
    return outline if fill == (255, 255, 255) else fill


def _symbols(collection: Collection, looks: dict[str, str]) -> list[dict[str, object]]:
    kinds: list[tuple[str, str, Sequence[object]]] = [
        (family.name, family.title, ["==", ["get", "family"], family.name]) for family in FAMILIES
    ]
    if collection.id == MAINTENANCE_ITEMS.id:  # what is not registered has no family
        none = ["all", *(["!=", ["get", "family"], family.name] for family in FAMILIES)]
        kinds.append(("other", "Of no family", none))
    return [
        {
            "id": f"{title}: {status}",
            "type": "symbol",
            "source": "waymark",
            "source-layer": collection.id,
            "filter": ["all", condition, ["==", ["get", "status"], status]],
            "layout": {
                "icon-image": symbol_name(family, look),
                "icon-size": ["interpolate", ["linear"], ["zoom"], _SMALLEST_ZOOM, 0.4, _FULL_ZOOM, 1],
                "icon-allow-overlap": True,
                "icon-ignore-placement": True,
            },
        }
        for family, title, condition in kinds
        for status, look in looks.items()
    ]


# === OGC API Tiles.


router = Router("/ogc", "ogc")
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


@router.get(
    "/collections/{collection}/tiles/{matrix_set}/{zoom}/{row}/{column}",
    READERS,
    responses={**file_response([MVT]), 204: {"description": "No features"}, **problem_responses(404, 406)},
    openapi_extra={"parameters": [described(name, ("mvt", "pbf")) for name in OF_TILE]},
)
@in_own_threads
def get_tile(
    collection: Tiled,
    _matrix_set: MatrixSet,
    tile: TilePlace,
    groups: Groups,
    caller: Caller,
    features: FeaturesService,
) -> Response:
    """Get a vector tile of a collection.

    204 without features.
    """
    content = (features.grouped_tile if groups else features.tile)(caller, collection, tile)
    headers = {"Cache-Control": "private, no-cache"}
    if not content:
        return Response(status_code=204, headers=headers)
    return Response(content, headers=headers, media_type=MVT)


@router.get("/collections/{collection}/tiles", READERS, **describe_read(TileSets, html=False))
def list_tilesets(collection: Tiled, _offers: OffersJson, base: BaseUrl) -> Response:
    """List the tile sets of a collection.

    There is one.
    """
    return answer(TileSets(tilesets=[_tileset(base, collection)]))


@router.get("/collections/{collection}/tiles/{matrix_set}", READERS, **describe_read(TileSet, html=False))
def get_tileset(collection: Tiled, _matrix_set: MatrixSet, _offers: OffersJson, base: BaseUrl) -> Response:
    """Get a tile set of a collection."""
    return answer(_tileset(base, collection))


@router.get("/collections/{collection}/tiles/{matrix_set}/tilejson", READERS, **describe_read(JsonObject, html=False))
def get_tilejson(
    collection: Tiled,
    _matrix_set: MatrixSet,
    _offers: OffersJson,
    base: BaseUrl,
    caller: Caller,
    features: FeaturesService,
) -> Response:
    """Get a tile set of a collection as TileJSON 3.0."""
    return answer(tilejson(collection, _template(base, collection), features.extent(caller, collection)))


@router.get(
    "/collections/{collection}/tiles/{matrix_set}/style", READERS, **describe_read(JsonObject, MAP_STYLE, html=False)
)
def get_map_style(
    collection: Tiled,
    _matrix_set: MatrixSet,
    _offers: OffersStyle,
    base: BaseUrl,
    caller: Caller,
    features: FeaturesService,
) -> Response:
    """Get a MapLibre style of a tile set.

    It has symbols by family and status.
    """
    sprite_url = f"{base.removesuffix('/ogc')}/static/sprites/markers"
    extent = features.extent(caller, collection)
    return answer(map_style(collection, _template(base, collection), sprite_url, extent), MAP_STYLE)


@router.get("/tileMatrixSets", READERS, **describe_read(TileMatrixSets, html=False))
def list_matrix_sets(_offers: OffersJson, base: BaseUrl) -> Response:
    """List the tile matrix sets.

    There is one.
    """
    links = [link(f"{base}/tileMatrixSets/{MATRIX_SET}", "self", JSON)]
    return answer(TileMatrixSets(tileMatrixSets=[{"id": MATRIX_SET, "uri": MATRIX_SET_URI, "links": links}]))


@router.get("/tileMatrixSets/{matrix_set}", READERS, **describe_read(TileMatrixSet, html=False))
def get_matrix_set(_matrix_set: MatrixSet, _offers: OffersJson) -> Response:
    """Get a tile matrix set."""
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
