"""Tilesets for map libraries and QGIS: TileJSON 3.0, and a MapLibre style whose symbols show family and status."""

from __future__ import annotations

from typing import Any, NotRequired, TypedDict

from app.families import FAMILIES
from app.plots.map_symbols import LOOKS, symbol_name
from app.registry.features import Extent
from app.registry.tiles import MAX_ZOOM
from app.services.markers.features import MAINTENANCE_ITEMS, PLANS, Collection

_KINDS = {"number": "Number", "integer": "Number"}
_MARKER_LOOKS = {status: status for status in ("planned", "built", "surveyed", "active", "suspect", "retired")}
_LOOKS = {
    PLANS.id: {
        "draft": "draft", "checked": "checked", "proved": "checked", "approved": "approved", "committed": "planned",
        "built": "built", "surveyed": "surveyed",
    },
    MAINTENANCE_ITEMS.id: {"open": "suspect", "approved": "approved", "dismissed": "dismissed"},
}  # fmt: skip
"""Looks of the statuses that the features of a collection have; of the others, those of a marker's status."""
_SMALLEST_ZOOM, _FULL_ZOOM = 6, 13  # symbols grow between them; chosen by hand, on a map of a motorway


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


def map_style(collection: Collection, tiles_url: str, sprite_url: str, extent: Extent | None) -> dict[str, Any]:
    """A style that draws a tileset: dots that every client can draw, and over them a symbol for each feature.

    Each family with each status is a layer of its own: QGIS 3.22 draws an icon that an expression chooses with the
    expression's last value only. There are no texts, and so no glyphs.
    """
    looks = _LOOKS.get(collection.id, _MARKER_LOOKS)
    source: dict[str, Any] = {"type": "vector", "tiles": [tiles_url], "minzoom": 0, "maxzoom": MAX_ZOOM}
    document: dict[str, Any] = {
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


def _by_status(values: dict[str, str], other: str) -> list[Any]:
    pairs = [part for status, value in values.items() for part in (status, value)]
    return ["match", ["get", "status"], *pairs, other]


def _dots(collection: Collection, looks: dict[str, str]) -> dict[str, Any]:
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


def _symbols(collection: Collection, looks: dict[str, str]) -> list[dict[str, Any]]:
    kinds: list[tuple[str, str, list[Any]]] = [
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
