"""Surveys as GeoJSON (RFC 7946)."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain, islice
from typing import Any

import numpy as np
import orjson

from app.errors import UnreadableUpload
from app.formats.surveys.table import MAX_COLUMNS, MAX_ROWS, Fault, Faults, SourceTable

_CURE = "send a FeatureCollection of points"


def read_geojson(data: bytes) -> SourceTable:
    """Points of a FeatureCollection, with their properties as columns.

    Raises
    ------
    UnreadableUpload
        It is no JSON, no FeatureCollection, or has too many features or names.
    """
    try:
        document = orjson.loads(data)
    except (orjson.JSONDecodeError, RecursionError) as error:
        raise UnreadableUpload(f"not JSON: {error}", field="file", limit="RFC 8259", cure=_CURE) from error
    features = document.get("features") if isinstance(document, dict) else None
    if not isinstance(features, list) or document.get("type") != "FeatureCollection":
        raise UnreadableUpload("no FeatureCollection", field="file", limit="RFC 7946", cure=_CURE)
    features = list(islice(chain.from_iterable(map(_single_points, features)), MAX_ROWS + 1))
    if len(features) > MAX_ROWS:
        raise UnreadableUpload("too many points", field="file", limit=f"{MAX_ROWS} points", cure="cut the file")
    faults: list[Fault] = []
    points = np.full((3, len(features)), np.nan)
    names: dict[str, None] = {}
    for index, feature in enumerate(features):
        coordinates = _coordinates(feature)
        if coordinates is None:
            faults.append(
                Fault(index + 1, "geometry", "no_point", "the feature is no point with finite numbers", _CURE)
            )
        else:
            points[: len(coordinates), index] = coordinates
        names.update(dict.fromkeys(_properties(feature)))
        if len(names) > MAX_COLUMNS:
            raise UnreadableUpload("too many names", field="file", limit=f"{MAX_COLUMNS} properties", cure=_CURE)
    columns = tuple([_plain(_properties(feature).get(name)) for feature in features] for name in names)
    crs = _old_crs(document)
    return SourceTable(
        "geojson", tuple(names), columns, (points[0], points[1], points[2]), crs=crs, faults=Faults(faults)
    )


def _coordinates(feature: Any) -> list[float] | None:
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    if not isinstance(geometry, dict) or geometry.get("type") != "Point":
        return None
    found = geometry.get("coordinates")
    if not isinstance(found, list) or not 2 <= len(found) <= 3:
        return None
    if any(isinstance(v, bool) or not isinstance(v, int | float) or abs(v) > 1e12 for v in found):
        return None
    return found


def _single_points(feature: Any) -> Iterable[Any]:
    """One feature for each point of a multipoint, with the properties of all."""
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    if not isinstance(geometry, dict) or geometry.get("type") != "MultiPoint":
        return [feature]
    places = geometry.get("coordinates")
    if not isinstance(places, list):
        return [feature]
    return ({**feature, "geometry": {"type": "Point", "coordinates": place}} for place in places)


def _properties(feature: Any) -> dict[str, Any]:
    found = feature.get("properties") if isinstance(feature, dict) else None
    return found if isinstance(found, dict) else {}


def _plain(value: Any) -> Any:
    return value if value is None or isinstance(value, str | int | float) else str(value)[:200]


def _old_crs(document: dict[str, Any]) -> str | None:
    """The CRS of GeoJSON 2008, which QGIS and others still write."""
    crs = document.get("crs")
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    return name if isinstance(name, str) else None
