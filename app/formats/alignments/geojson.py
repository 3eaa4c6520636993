"""Roads as GeoJSON (RFC 7946): lines are lanes or their boundaries, points are events, polygons are areas to avoid."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import orjson

from app.errors import InvalidParameter, ReferenceSystemError, UnreadableUpload
from app.formats.alignments.assemble import assemble_road
from app.formats.alignments.features import RoadFeature, Shape, read_ring, read_vertices
from app.formats.alignments.geometry import AlignmentFile

_CURE = "send a FeatureCollection with the lanes as lines"
_MAX_NESTED = 10  # levels of GeometryCollections; source: chosen by hand


def read_geojson(data: bytes) -> AlignmentFile:
    """A road of a FeatureCollection, a Feature or a geometry.

    Raises
    ------
    UnreadableUpload
        It is no GeoJSON, has no line or too many vertices.
    InvalidParameter, ReferenceSystemError
        A feature cannot be used, or features have different CRSs; the message names the feature.
    """
    try:
        document = orjson.loads(data)
    except (orjson.JSONDecodeError, RecursionError) as error:
        raise _unreadable(f"it is not JSON: {error}") from error
    if not isinstance(document, dict):
        raise _unreadable("it is no object")
    found = document.get("features", [document])
    if not isinstance(found, list):
        raise _unreadable("its features are no list")
    features: list[RoadFeature] = []
    for number, feature in enumerate(found, 1):
        features += _features(feature, f"feature {number}")
    properties = document.get("properties")
    defaults = dict(properties) if isinstance(properties, dict) and "features" in document else {}
    if isinstance(document.get("name"), str):
        defaults.setdefault("name", document["name"])
    return assemble_road("geojson", features, defaults=defaults, crs=_crs(document, found, defaults), unit_m=None)


def _features(feature: Any, where: str) -> Iterator[RoadFeature]:
    if not isinstance(feature, dict):
        raise _unreadable(f"{where} is no object")
    properties = feature.get("properties")
    names = {str(k).lower(): v for k, v in properties.items()} if isinstance(properties, dict) else {}
    geometry = feature["geometry"] if feature.get("type") == "Feature" and "geometry" in feature else feature
    for shape, parts in _geometries(geometry, where):
        yield RoadFeature(where, shape, parts, names)


def _geometries(geometry: Any, where: str, level: int = 0) -> Iterator[tuple[Shape, tuple[Any, ...]]]:
    if geometry is None:
        return
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    if kind == "GeometryCollection" and isinstance(geometry.get("geometries"), list) and level < _MAX_NESTED:
        for one in geometry["geometries"]:
            yield from _geometries(one, where, level + 1)
        return
    coordinates = geometry.get("coordinates") if isinstance(geometry, dict) else None
    if not isinstance(coordinates, list) or not isinstance(kind, str):
        raise _unreadable(f"{where} has no geometry")
    many = coordinates if kind.startswith("Multi") else [coordinates]
    if not all(isinstance(part, list) for part in many):
        raise InvalidParameter(f"{where}: the coordinates are not lists", field="file", limit="RFC 7946", cure=_CURE)
    match kind.removeprefix("Multi"):
        case "LineString":
            yield Shape.LINE, tuple(read_vertices(part, where) for part in many)
        case "Point":
            yield Shape.POINT, tuple(read_vertices([point], where) for point in many)
        case "Polygon":
            yield Shape.AREA, tuple(read_ring(rings[0], where) for rings in many if rings)
        case _:
            raise _unreadable(f"{where} has a geometry of type {kind[:40]!r}")


def _crs(document: dict[str, Any], features: list[Any], defaults: dict[str, Any]) -> str | None:
    """The one CRS that the file states, as GeoJSON 2008 did and QGIS does, or as a property of the collection."""
    stated = {name for one in (document, *features) if (name := _old_crs(one)) is not None}
    if isinstance(defaults.get("crs"), str):
        stated.add(defaults["crs"])
    if len(stated) > 1:
        raise ReferenceSystemError(
            f"the file mixes the CRSs {', '.join(sorted(stated))[:200]}",
            field="crs",
            limit="one CRS for all features",
            cure="transform all features to one CRS, best EPSG:4326",
        )
    return stated.pop() if stated else None


def _old_crs(one: Any) -> str | None:
    crs = one.get("crs") if isinstance(one, dict) else None
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    return name if isinstance(name, str) else None


def _unreadable(message: str) -> UnreadableUpload:
    return UnreadableUpload(f"the GeoJSON cannot be used: {message}", field="file", limit="RFC 7946", cure=_CURE)
