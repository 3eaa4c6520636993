"""Finding markers: pages of a filter, the nearest to a place, and those along a line."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import pairwise
from typing import cast

import numpy as np
import shapely
import sqlalchemy as sa
from pyproj import CRS, Transformer
from shapely.errors import ShapelyError
from typing_extensions import Unpack

from app.errors import InvalidParameter, naming
from app.families import get_family
from app.families.documents import MarkerDocument
from app.geodesy import check_lon_lat
from app.geodesy.systems import WGS84
from app.markers.reading import MarkerRow
from app.registry import markers as store
from app.registry.database import Database
from app.registry.history import list_as_of
from app.registry.markers import MarkerFilter
from app.registry.nearest import find_nearest_at_once, list_nearest, list_places
from app.registry.spatial import Area, Box, distances_m
from app.roads.axis import Axis, Foot
from app.services.access.access import Caller
from app.services.markers.markers import Found, FoundMarker

# === Boxes that clients search in, as queries and bodies write them.


MAX_OVER_ANTIMERIDIAN_DEG = 180.0
"""Width of a box over the antimeridian. Source: RFC 7946 section 5.2 allows any; a wider one has its sides swapped."""


def parse_box(text: str) -> Box:
    """West, south, east, north as a query writes them."""
    return checked_box(*parse_numbers(text, "bbox", "west,south,east,north"))


def checked_box(west_deg: float, south_deg: float, east_deg: float, north_deg: float) -> Box:
    """A box; a west above the east spans the antimeridian.

    Raises
    ------
    InvalidParameter
        A side is out of range, the south is above the north, or the box over the antimeridian is wider than half the
        earth: its west and east are swapped.
    """
    check_lon_lat(west_deg, south_deg, field="bbox")
    check_lon_lat(east_deg, north_deg, field="bbox")
    if south_deg > north_deg:
        raise InvalidParameter(
            "bbox has its south above its north",
            field="bbox",
            limit="south <= north",
            cure="send west,south,east,north; only the longitudes may be the other way round, over the antimeridian",
        )
    if west_deg > east_deg and (width_deg := 360.0 + east_deg - west_deg) > MAX_OVER_ANTIMERIDIAN_DEG:
        raise InvalidParameter(
            f"bbox has its west above its east, so it spans {width_deg:.6g} degrees over the antimeridian",
            field="bbox",
            limit=f"{MAX_OVER_ANTIMERIDIAN_DEG:g} degrees over the antimeridian",
            cure="send west,south,east,north",
        )
    return Box(west_deg, south_deg, east_deg, north_deg)


def parse_numbers(text: str, field: str, *forms: str) -> list[float]:
    """Numbers between commas, as many as one of the forms has names; else InvalidParameter."""
    parts = text.split(",")
    if len(parts) not in [len(form.split(",")) for form in forms]:
        form = " or ".join(forms)
        raise InvalidParameter(f"{field} is {form}", field=field, limit=form, cure="separate the numbers by commas")
    try:
        return [float(part) for part in parts]
    except ValueError as error:
        raise InvalidParameter(f"{field} holds something that is not a number", field=field, limit=forms[0]) from error


# === Polygons that clients search in: checked, and in the form that both databases ask.


MAX_VERTICES = 10_000
MAX_POLYGONS = 100
MAX_WITHIN_M = 300_000.0
"""Longest distance about a geometry. [m] The projection of `area_of_shape` is exact to 0.1 % there."""
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
    _check_valid(shape, field)
    return Area(shapely.to_wkb(shape, byte_order=1), tuple(Box(*part.bounds) for part in shapes))


def area_of_shape(shape: shapely.Geometry, field: str, within_m: float = 0.0) -> Area:
    """Area of any geometry, or of all places within a distance of it.

    Raises
    ------
    InvalidParameter
        It is empty, a collection, out of range, over the antimeridian, or has too many vertices; or as `area_of`.

    Notes
    -----
    Distances are those of the azimuthal equidistant projection about the geometry's middle, exact for points and to
    0.1 % within 300 km of it; circles have 256 corners, so that 0.01 % of the distance is missing.
    """
    shape = shapely.force_2d(shape)
    points = shapely.get_coordinates(shape)
    if not len(points) or shape.geom_type == "GeometryCollection" or len(points) > MAX_VERTICES:
        raise InvalidParameter(
            f"a {shape.geom_type} with {len(points)} vertices",
            field=field,
            limit=f"points, lines or polygons with 1 to {MAX_VERTICES} vertices",
            cure="simplify it, or ask in parts",
        )
    for lon_deg, lat_deg in points.tolist():
        check_lon_lat(lon_deg, lat_deg, field)
    if within_m:
        _check_valid(shape, field)
        shape = _buffered(shape, within_m, field)
    if shape.geom_type in ("Polygon", "MultiPolygon"):
        document = json.loads(shapely.to_geojson(shape))
        return area_of([document["coordinates"]] if shape.geom_type == "Polygon" else document["coordinates"], field)
    parts = [part for part in shapely.get_parts(shape) if not part.is_empty]
    for part in parts:
        if np.abs(np.diff(shapely.get_coordinates(part)[:, 0])).max(initial=0.0) > _HALF_TURN_DEG:
            raise _over_antimeridian(field)
    boxes = [part.bounds for part in parts] if len(parts) <= MAX_POLYGONS else [shape.bounds]
    return Area(shapely.to_wkb(shape, byte_order=1), tuple(Box(*bounds) for bounds in boxes))


def _check_valid(shape: shapely.Geometry, field: str) -> None:
    if not shape.is_valid:
        raise InvalidParameter(
            f"the polygon is not simple: {shapely.is_valid_reason(shape)}",
            field=field,
            limit="rings that neither cross nor touch along a line, holes inside",
            cure="correct the place that is named, or let a GIS make the geometry valid",
        )


def _buffered(shape: shapely.Geometry, within_m: float, field: str) -> shapely.Geometry:
    if not 0 < within_m <= MAX_WITHIN_M:
        raise InvalidParameter(
            f"a distance of {within_m:g} m",
            field=field,
            limit=f"above 0, at most {MAX_WITHIN_M:g} m",
            cure="choose a shorter distance, or a box",
        )
    west, south, east, north = shape.bounds
    middle = CRS.from_dict({"proj": "aeqd", "lat_0": (south + north) / 2, "lon_0": (west + east) / 2, "datum": "WGS84"})
    there = Transformer.from_crs(WGS84, middle, always_xy=True).transform
    back = Transformer.from_crs(middle, WGS84, always_xy=True).transform
    flat = shapely.transform(shape, lambda at: np.column_stack(there(at[:, 0], at[:, 1])))
    round_m = shapely.buffer(flat, within_m, quad_segs=64)
    found = shapely.transform(round_m, lambda at: np.column_stack(back(at[:, 0], at[:, 1])))
    west, _south, east, _north = found.bounds
    if not np.isfinite(shapely.get_coordinates(found)).all() or east - west > _HALF_TURN_DEG:
        raise _over_antimeridian(field)
    return found


def _over_antimeridian(field: str) -> InvalidParameter:
    return InvalidParameter(
        "the area spans the antimeridian or a pole",
        field=field,
        limit="areas that do not",
        cure="ask for the parts on both sides, joined by OR",
    )


def area_of_text(text: str, field: str = "polygon") -> Area:
    """Area of a POLYGON or MULTIPOLYGON in WKT.

    Raises
    ------
    InvalidParameter
        It is something else, or `area_of` refuses it.
    """
    try:
        with np.errstate(invalid="ignore"):  # GEOS says so of NaN
            shape: object = shapely.from_wkt(text)
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


# === Markers of one family, picked by id or by a filter.


@dataclass(frozen=True, slots=True)
class Selection:
    """Markers by id, or all that a filter leaves."""

    marker_ids: tuple[str, ...] = ()
    filtered: MarkerFilter = field(default_factory=MarkerFilter)


def select_markers(
    connection: sa.Connection, agency_id: str, selection: Selection, family: str, *, most: int
) -> list[MarkerRow]:
    """The agency's markers of one family in a selection, 1 to `most` of them.

    Raises
    ------
    InvalidParameter
        None or too many, or one is named twice.
    NotFound
        One is missing.
    """
    count = len(selection.marker_ids)
    if count > most:
        raise _too_many(f"{count} {family}s were selected", family, most)
    if len(set(selection.marker_ids)) != count:
        raise InvalidParameter(
            f"a {family} is selected twice", field="marker_ids", limit="each id once", cure="leave repetitions out"
        )
    if selection.marker_ids:
        rows = store.get_markers(connection, agency_id, list(selection.marker_ids))
    else:
        filtered = replace(selection.filtered, family=family)
        rows = store.list_markers(connection, agency_id, filtered, after=None, limit=most + 1)
    found = [row for row in rows if row.family == family]
    if len(found) > most:
        raise _too_many(f"more than {most} {family}s were selected", family, most)
    if not found:
        raise InvalidParameter(
            f"no {family} was selected", field="marker_ids", limit=f"1 to {most} {family}s", cure="widen the filter"
        )
    return found


def _too_many(message: str, family: str, most: int) -> InvalidParameter:
    return InvalidParameter(
        message,
        field="marker_ids",
        limit=f"{most} {family}s at once",
        cure="select by a smaller box, by status, or by fewer ids",
    )


# === Finding markers.


MAX_ALONG = 20_000
MAX_LINE_M = 1_000_000.0
_STEP_M = 2_000.0
_ON_END_M = 1e-3
_FEET = 4  # of a marker beside a line: the nearest two, each perhaps as the end of one piece and the start of the next

Place = tuple[float, float]
Page = tuple[list[FoundMarker], str | None]


def marker_document(row: MarkerRow) -> MarkerDocument:
    """A marker of any family as lists show it."""
    return get_family(row.family).document(row)


class Searches:
    """Use cases that find markers, one transaction each."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def page(self, caller: Caller, filtered: MarkerFilter, *, after: str | None = None, limit: int = 100) -> Page:
        """A page in the order of ids, and the id to continue after if there are more.

        Each marker has its `distance_m` where the filter has a circle.
        """
        rows = self._database.ask(
            lambda connection: store.list_markers(connection, caller.agency_id, filtered, after=after, limit=limit + 1)
        )
        page = _documents(rows[:limit], filtered)
        return page, page[-1]["id"] if len(rows) > limit else None

    def page_as_of(
        self, caller: Caller, filtered: MarkerFilter, at: datetime, *, after: str | None = None, limit: int = 100
    ) -> Page:
        """As `page`, of the markers as they were at a time; a page may be short though there are more."""
        with self._database.read() as connection:
            rows, last = list_as_of(connection, caller.agency_id, filtered, at, after=after, limit=limit)
        return _documents(rows, filtered), last

    def nearest(
        self, caller: Caller, filtered: MarkerFilter, place: Place, count: int, within_m: float | None = None
    ) -> list[FoundMarker]:
        """The markers nearest to a place (lon_deg, lat_deg), nearest first, each with its `distance_m`."""
        asked = (caller.agency_id, filtered, *place, count, within_m)
        found = self._database.ask(lambda connection: find_nearest_at_once(connection, *asked))
        if found is None:
            with self._database.read() as connection:
                found = list_nearest(connection, *asked)
        return [_found(row, distance_m=distance) for row, distance in found]

    def along(
        self,
        caller: Caller,
        filtered: MarkerFilter,
        line: Sequence[Sequence[float]],
        corridor_m: float,
        *,
        after: tuple[float, str] | None = None,
        limit: int = 100,
    ) -> Page:
        """A page of the markers in a corridor about a line, in the order of the line.

        Each has `along`: `distance_m` from the line's start, `offset_m` to the left, and whether another part of the
        line is as near. The corridor ends square at the line's ends.

        Parameters
        ----------
        corridor_m : float
            Width of the corridor. [m]
        after : (distance_m, id), optional
            Of the last marker of the page before.

        Raises
        ------
        InvalidParameter
            The line is none, is too long, or too many markers lie along it.
        """
        axis = _axis(line)
        with self._database.read() as connection:
            circles = [(lon, lat, r + corridor_m / 2) for lon, lat, r in axis.list_circles(_STEP_M)]
            places = list_places(connection, caller.agency_id, filtered, circles, limit=MAX_ALONG + 1)
            if len(places) > MAX_ALONG:
                raise InvalidParameter(
                    f"more than {MAX_ALONG} markers lie along the line",
                    field="along",
                    limit=f"{MAX_ALONG} markers",
                    cure="send a shorter line, a narrower corridor or a filter",
                )
            feet = _order(axis, places, corridor_m / 2)
            onward = feet if after is None else [foot for foot in feet if foot[:2] > after]
            page = onward[:limit]
            rows = store.get_markers(connection, caller.agency_id, [marker_id for _, marker_id, _, _ in page])
        documents = [
            _found(row, along={"distance_m": distance, "offset_m": foot.offset_m, "ambiguous": ambiguous})
            for row, (distance, _, foot, ambiguous) in zip(rows, page, strict=True)
        ]
        more = len(onward) > limit
        return documents, f"{page[-1][0]!r},{page[-1][1]}" if more else None


def _found(row: MarkerRow, **members: Unpack[Found]) -> FoundMarker:
    """A marker with what the search adds to it."""
    return cast(FoundMarker, {**marker_document(row), **members})


def _documents(rows: Sequence[MarkerRow], filtered: MarkerFilter) -> list[FoundMarker]:
    page = [_found(row) for row in rows]
    if filtered.near is not None and page:
        lon, lat = np.array([(row.lon_deg, row.lat_deg) for row in rows]).T
        for document, distance in zip(page, distances_m(*filtered.near[:2], lon, lat).tolist(), strict=True):
            document["distance_m"] = distance
    return page


def circle(filtered: MarkerFilter, place: Place, radius_m: float) -> MarkerFilter:
    """A filter that is also a circle."""
    return replace(filtered, near=(*place, radius_m))


def _axis(line: Sequence[Sequence[float]]) -> Axis:
    try:
        return Axis([line], MAX_LINE_M)
    except InvalidParameter as error:
        error.field = "along.geometry"
        raise


def _order(
    axis: Axis, places: Sequence[tuple[str, float, float]], half_m: float
) -> list[tuple[float, str, Foot, bool]]:
    """Distance along, id, foot and ambiguity of the places in the corridor, in the order of the line."""
    lon, lat = np.array([p[1] for p in places]), np.array([p[2] for p in places])
    with naming("along"):
        located = axis.locate(lon, lat, half_m, max_feet=_FEET)
    found = []
    for place, feet in zip(places, located, strict=True):
        if feet and abs(feet[0].beyond_m) <= _ON_END_M:
            ambiguous = len(feet) > 1 and feet[1].distance_m - feet[0].distance_m < 1.0
            found.append((feet[0].chainage_m, place[0], feet[0], ambiguous))
    return sorted(found, key=lambda item: item[:2])
