"""What the API returns under /ogc, typed (OGC 17-069r4, 18-058r1, 20-057; GeoJSON: RFC 7946)."""

from __future__ import annotations

from datetime import datetime
from typing import Literal, NotRequired

from pydantic import ConfigDict, JsonValue, with_config
from typing_extensions import TypedDict

JsonObject = dict[str, JsonValue]


class Link(TypedDict):
    """A link."""

    href: str
    rel: str
    type: str
    title: NotRequired[str]
    templated: NotRequired[bool]


class LandingPage(TypedDict):
    """Where everything is."""

    title: str
    description: str
    links: list[Link]


class Conformance(TypedDict):
    """The conformance classes."""

    conformsTo: list[str]


class SpatialExtent(TypedDict):
    """A box: west, south, east, north. [deg]"""

    bbox: list[list[float]]
    crs: str


class TemporalExtent(TypedDict):
    """The first and the last change."""

    interval: list[list[datetime | None]]


class ExtentDocument(TypedDict):
    """What the features of a collection cover."""

    spatial: SpatialExtent
    temporal: TemporalExtent


class CollectionDocument(TypedDict):
    """A collection of features."""

    id: str
    title: str
    description: str
    itemType: Literal["feature"]
    crs: list[str]
    storageCrs: str
    links: list[Link]
    extent: NotRequired[ExtentDocument]
    storageCrsCoordinateEpoch: NotRequired[float]


class Collections(TypedDict):
    """All collections."""

    links: list[Link]
    crs: list[str]
    collections: list[CollectionDocument]


class Geometry(TypedDict):
    """A point or a line."""

    type: Literal["Point", "LineString"]
    coordinates: list[float] | list[list[float]]


class Feature(TypedDict):
    """A feature; the schema of its collection describes its properties."""

    type: Literal["Feature"]
    id: str
    geometry: Geometry
    properties: JsonObject
    links: NotRequired[list[Link]]


class FeaturePage(TypedDict):
    """A page of features."""

    type: Literal["FeatureCollection"]
    timeStamp: datetime
    numberReturned: int
    numberMatched: NotRequired[int]
    links: list[Link]
    features: list[Feature]


_EXAMPLE: JsonObject = {
    "type": "Feature",
    "geometry": {"type": "Point", "coordinates": [114.1792, 22.3041]},
    "properties": {"family": "plate", "status": "planned", "heading_deg": 90.0},
}


@with_config(ConfigDict(json_schema_extra={"examples": [_EXAMPLE]}))
class NewFeature(TypedDict):
    """A feature that is sent: a point and flat properties."""

    type: NotRequired[Literal["Feature"]]
    id: NotRequired[str | int | None]
    geometry: NotRequired[JsonObject | None]
    properties: NotRequired[JsonObject | None]


class TileSet(TypedDict):
    """A set of vector tiles."""

    title: str
    dataType: Literal["vector"]
    crs: str
    tileMatrixSetURI: str
    links: list[Link]


class TileSets(TypedDict):
    """The tile sets of a collection."""

    tilesets: list[TileSet]


class TileMatrix(TypedDict):
    """One zoom level of a tile matrix set."""

    id: str
    scaleDenominator: float
    cellSize: float
    pointOfOrigin: list[float]
    tileWidth: int
    tileHeight: int
    matrixWidth: int
    matrixHeight: int


class TileMatrixSet(TypedDict):
    """A tile matrix set."""

    id: str
    uri: str
    crs: str
    orderedAxes: list[str]
    tileMatrices: list[TileMatrix]


class TileMatrixSetItem(TypedDict):
    """A tile matrix set in a list."""

    id: str
    uri: str
    links: list[Link]


class TileMatrixSets(TypedDict):
    """The tile matrix sets."""

    tileMatrixSets: list[TileMatrixSetItem]
