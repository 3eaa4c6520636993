"""Polygons that clients search in: checked, and in the form that both databases ask."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from shapely.errors import ShapelyError

from app.errors import InvalidParameter
from app.geodesy import check_lon_lat
from app.registry.spatial import Area, Box

MAX_VERTICES = 10_000
MAX_POLYGONS = 100
_HALF_TURN_DEG = 180.0

Ring = Sequence[Sequence[float]]


def area_of(polygons: Sequence[Sequence[Ring]], field: str = "polygon") -> Area:
    """Area of polygons, each its outer ring and its holes, as GeoJSON's MultiPolygon has them.

    Raises
    ------
    InvalidParameter
        Too many vertices, rings that are open, out of range or over the antimeridian, polygons that cross themselves.
    """
    count = sum(len(ring) for polygon in polygons for ring in polygon)
    if not 4 <= count <= MAX_VERTICES or len(polygons) > MAX_POLYGONS:
        raise InvalidParameter(
            f"the polygon has {count} vertices in {len(polygons)} parts",
            field=field,
            limit=f"4 to {MAX_VERTICES} vertices in at most {MAX_POLYGONS} polygons",
            cure="simplify it, or search in its parts",
        )
    for polygon in polygons:
        if not polygon:
            raise InvalidParameter(
                "a polygon has no outer ring", field=field, limit="one ring at least", cure="leave it out"
            )
        for ring in polygon:
            _check_ring(ring, field)
    shapes = [
        shapely.Polygon([p[:2] for p in polygon[0]], [[p[:2] for p in hole] for hole in polygon[1:]])
        for polygon in polygons
    ]
    shape = shapes[0] if len(shapes) == 1 else shapely.MultiPolygon(shapes)
    if not shape.is_valid:
        raise InvalidParameter(
            f"the polygon is not simple: {shapely.is_valid_reason(shape)}",
            field=field,
            limit="rings that neither cross nor touch along a line, holes inside",
            cure="correct the place that is named, or let a GIS make the geometry valid",
        )
    return Area(shapely.to_wkb(shape, byte_order=1), tuple(Box(*part.bounds) for part in shapes))


def area_of_text(text: str, field: str = "polygon") -> Area:
    """Area of a POLYGON or MULTIPOLYGON in WKT.

    Raises
    ------
    InvalidParameter
        It is something else, or `area_of` refuses it.
    """
    try:
        with np.errstate(invalid="ignore"):  # GEOS says so of NaN
            shape: Any = shapely.from_wkt(text)
        document = json.loads(shapely.to_geojson(shapely.force_2d(shape)))
    except (ShapelyError, ValueError, TypeError) as error:
        raise _not_wkt(field) from error
    if not np.isfinite(shapely.get_coordinates(shape)).all():
        raise _not_wkt(field)
    if document["type"] == "Polygon":
        return area_of([document["coordinates"]], field)
    if document["type"] == "MultiPolygon":
        return area_of(document["coordinates"], field)
    raise _not_wkt(field)


def _not_wkt(field: str) -> InvalidParameter:
    return InvalidParameter(
        "this is not the WKT of a polygon",
        field=field,
        limit="POLYGON or MULTIPOLYGON of longitude latitude",
        cure="write POLYGON((8.4 49, 8.5 49, 8.5 49.1, 8.4 49)), or POST GeoJSON to /v1/markers/search",
    )


def _check_ring(ring: Ring, field: str) -> None:
    if len(ring) < 4 or list(ring[0][:2]) != list(ring[-1][:2]):
        raise InvalidParameter(
            "a ring is not closed",
            field=field,
            limit="four positions at least, the last is the first",
            cure="repeat the first position at the end",
        )
    for position in ring:
        check_lon_lat(position[0], position[1], field)
    if any(abs(a[0] - b[0]) > _HALF_TURN_DEG for a, b in pairwise(ring)):
        raise InvalidParameter(
            "an edge of the polygon is longer than half a turn",
            field=field,
            limit="180 deg of longitude",
            cure="cut the polygon at the antimeridian into a MultiPolygon (RFC 7946, section 3.1.9)",
        )
