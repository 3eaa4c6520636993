"""What GIS clients read: collections of GeoJSON features, and vector tiles of them.

The features of points are stored as text, and a page of them joins the texts: every map view asks for one.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import StrEnum
from functools import lru_cache
from itertools import islice
from typing import ClassVar, Generic, Protocol, TypeVar

import numpy as np
import orjson
import shapely
import sqlalchemy as sa
from pyproj.enums import TransformDirection
from pyproj.exceptions import ProjError

from app.errors import NotFound
from app.families import FAMILIES
from app.formats.exports import ExportFrame, frame_records
from app.geodesy import reference_system
from app.geodesy.place import PLATE_FIXED_EPOCH
from app.geodesy.systems import ELLIPSOID, best_effort, covers, listed_systems
from app.registry import features as store
from app.registry.audit import find_head
from app.registry.conditions import GEOMETRY, holds, pinned_values
from app.registry.database import Database
from app.registry.features import FIELDS, ON_ROAD, RETIRED, Extent, FeatureFilter, FeatureTable, Field
from app.registry.health import ITEM_FIELDS, MAINTENANCE
from app.registry.lines import LINE_FIELDS, Line, find_line, read_lines
from app.registry.markers import MarkerOrigin, find_origins
from app.registry.plan_features import LANE_FIELDS, PLAN_FIELDS, PLANNED, AlignmentLanes
from app.registry.spatial import Box
from app.registry.tiles import COARSE_ZOOM, GROUPED_ZOOM, MAX_SINGLE, FeatureGrid, Tile, feature_tile, read_grid
from app.services.access.access import Caller
from app.services.ports import Clock
from app.values import Floats, JsonObject

# === The coordinate reference systems that features can be asked for in, with the axes in the authority's order.


_RADIUS_M = 6_378_137.0
_MERCATOR_POLE_DEG = 89.999999


class FeatureCrs(StrEnum):
    """A CRS by its URI, of those that are listed. All are WGS 84, so that going from one to another loses nothing."""

    CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
    CRS84H = "http://www.opengis.net/def/crs/OGC/0/CRS84h"
    WGS84 = "http://www.opengis.net/def/crs/EPSG/0/4326"
    WEB_MERCATOR = "http://www.opengis.net/def/crs/EPSG/0/3857"

    @property
    def is_storage(self) -> bool:
        """Whether places are written as longitude and latitude."""
        return self in (FeatureCrs.CRS84, FeatureCrs.CRS84H)

    def from_lon_lat(self, lon_deg: float, lat_deg: float) -> tuple[float, float]:
        """First and second coordinate of a place."""
        if self is FeatureCrs.WGS84:
            return lat_deg, lon_deg
        if self is FeatureCrs.WEB_MERCATOR:
            lat_deg = min(max(lat_deg, -_MERCATOR_POLE_DEG), _MERCATOR_POLE_DEG)
            north = math.asinh(math.tan(math.radians(lat_deg)))
            return _RADIUS_M * math.radians(lon_deg), _RADIUS_M * north
        return lon_deg, lat_deg

    def to_lon_lat(self, first: float, second: float) -> tuple[float, float]:
        """Longitude and latitude of a place. [deg]"""
        if self is FeatureCrs.WGS84:
            return second, first
        if self is FeatureCrs.WEB_MERCATOR:
            north = min(max(second / _RADIUS_M, -20.0), 20.0)
            return math.degrees(first / _RADIUS_M), math.degrees(math.atan(math.sinh(north)))
        return first, second


STORAGE_CRS = FeatureCrs.CRS84
EPSG_URI = "http://www.opengis.net/def/crs/EPSG/0/"


@dataclass(frozen=True, slots=True)
class OtherCrs:
    """Another system of the EPSG registry; features outside its area have no geometry in it."""

    uri: str

    is_storage: ClassVar[bool] = False

    def __str__(self) -> str:
        return self.uri

    @property
    def name(self) -> str:
        """``EPSG:code``."""
        return f"EPSG:{self.uri.removeprefix(EPSG_URI)}"

    def within_area(
        self, low: tuple[float, float], high: tuple[float, float]
    ) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """A box without what lies outside the system's area, where it places nothing; None if that is all of it."""
        bounds = _area_bounds(self.name)
        if bounds is None:
            return low, high
        west, south, east, north = bounds
        first, last = ((south, west), (north, east)) if self.is_north_first else ((west, south), (east, north))
        low = max(low[0], first[0]), max(low[1], first[1])
        high = min(high[0], last[0]), min(high[1], last[1])
        return (low, high) if low[0] < high[0] and low[1] < high[1] else None

    def bounds_deg(self, low: tuple[float, float], high: tuple[float, float]) -> tuple[float, float, float, float]:
        """West, south, east and north of a box; west is greater across the antimeridian."""
        if self.is_north_first:
            low, high = low[::-1], high[::-1]
        west, south, east, north = best_effort(self.name).transform_bounds(*low, *high)
        return west, south, east, north

    @property
    def is_north_first(self) -> bool:
        """Whether the authority's first axis points to the north, and the second one to the east."""
        return [axis.direction for axis in reference_system(self.name).axis_info[:2]] == ["north", "east"]


@lru_cache(maxsize=256)
def _area_bounds(name: str) -> tuple[float, float, float, float] | None:
    """Lowest easting and northing and highest ones of a system's area of use; None where that has no such bounds."""
    area = reference_system(name).area_of_use
    if area is None or area.west > area.east:
        return None
    box = area.west, max(area.south, -89.999), area.east, min(area.north, 89.999)
    try:
        bounds = best_effort(name).transform_bounds(*box, direction=TransformDirection.INVERSE)
    except ProjError:
        return None
    west, south, east, north = bounds
    return bounds if np.isfinite(bounds).all() and west < east and south < north else None


AnyCrs = FeatureCrs | OtherCrs


@lru_cache(maxsize=1)
def list_systems() -> tuple[str, ...]:
    """URIs of the systems that features are served in: those of WGS 84 first."""
    own = [str(crs) for crs in FeatureCrs]
    return (*own, *(uri for code in sorted(listed_systems()) if (uri := f"{EPSG_URI}{code}") not in own))


def in_lon_lat(shape: shapely.Geometry, crs: AnyCrs) -> shapely.Geometry:
    """A geometry of a CRS in longitude and latitude; of other systems than WGS 84 to a metre."""

    def turned(places: Floats) -> Floats:
        first, second = places.T
        if isinstance(crs, OtherCrs):
            x, y = (second, first) if crs.is_north_first else (first, second)
            return np.column_stack(best_effort(crs.name).transform(x, y))
        return np.array([crs.to_lon_lat(*place) for place in places.tolist()], np.float64).reshape(-1, 2)

    return shapely.transform(shapely.force_2d(shape), turned)


# === Collections: what clients list as layers.


class LineReader(Protocol):
    """Where the features of a collection of lines come from."""

    def read(
        self, connection: sa.Connection, agency_id: str, filtered: FeatureFilter, after: str | None
    ) -> Generator[Line]:
        """The agency's lines after one, in a fixed order; those that the filter does not leave may be among them.

        Raises
        ------
        MalformedRequest
            There is no line to go on after.
        """

    def find(self, connection: sa.Connection, agency_id: str, line_id: str) -> Line | None:
        """The line with an id."""

    def extent(self, connection: sa.Connection, agency_id: str) -> Extent | None:
        """What the lines cover."""


class MarkerLines:
    """Lines that markers make along a road."""

    def read(
        self, connection: sa.Connection, agency_id: str, filtered: FeatureFilter, after: str | None
    ) -> Generator[Line]:
        """Family by family; the times of a filter are left out."""
        pinned = {**pinned_values(filtered.where), **dict(filtered.equal)}
        return read_lines(connection, agency_id, LINE_SOURCES, box=filtered.box, pinned=pinned, after=after)

    def find(self, connection: sa.Connection, agency_id: str, line_id: str) -> Line | None:
        """By the id of its first marker."""
        return find_line(connection, agency_id, LINE_SOURCES, line_id)

    def extent(self, connection: sa.Connection, agency_id: str) -> Extent | None:
        """That of all markers."""
        return store.find_extent(connection, agency_id, ON_ROAD)


@dataclass(frozen=True, slots=True)
class Collection:
    """A set of features that clients list as a layer: points of a table, or lines of a reader."""

    id: str
    title: str
    text: str
    geometry: str
    editable: bool = False
    fields: tuple[Field, ...] = FIELDS
    table: FeatureTable = ON_ROAD
    lines: LineReader | None = None
    is_audited: bool = False  # each change of them has an entry in the audit log

    @property
    def has_tiles(self) -> bool:
        """Whether there are vector tiles of it."""
        return self.lines is None


MARKERS = Collection(
    "markers",
    "Markers",
    f"{', '.join(family.title for family in FAMILIES)} that are on the road or planned: one point each.",
    "Point",
    editable=True,
    is_audited=True,
)
RETIRED_MARKERS = Collection(
    "retired_markers",
    "Retired markers",
    "Markers that are out of use: one point each.",
    "Point",
    table=RETIRED,
    is_audited=True,
)
LINES = Collection(
    "marker_lines",
    "Lines of markers",
    "Painted lines of magnets, and runs of CERPMs along one side of a lane, at most 100 m from one to the next.",
    "LineString",
    fields=LINE_FIELDS,
    lines=MarkerLines(),
    is_audited=True,
)
ALIGNMENTS = Collection(
    "alignments",
    "Roads for plans",
    "Lanes of the alignments that plans are made for: the centre line of each, with width, speed and curvature.",
    "LineString",
    fields=LANE_FIELDS,
    lines=AlignmentLanes(),
)
PLANS = Collection(
    "plans",
    "Plans",
    "Markers as they are placed in plans, one point each: those of plans that are not committed are in no registry.",
    "Point",
    fields=PLAN_FIELDS,
    table=PLANNED,
)
MAINTENANCE_ITEMS = Collection(
    "maintenance",
    "Maintenance",
    "Faults of markers that vehicles show, one point each, with what people decided on them.",
    "Point",
    fields=ITEM_FIELDS,
    table=MAINTENANCE,
)
LINE_SOURCES = {family.name: family.lines for family in FAMILIES if family.lines is not None}
COLLECTIONS = {
    collection.id: collection for collection in (MARKERS, RETIRED_MARKERS, LINES, ALIGNMENTS, PLANS, MAINTENANCE_ITEMS)
}


def get_collection(collection_id: str) -> Collection:
    """The collection with an id.

    Raises
    ------
    NotFound
        There is none.
    """
    found = COLLECTIONS.get(collection_id)
    if found is None:
        raise NotFound("there is no such collection", field="collectionId", limit=", ".join(COLLECTIONS))
    return found


# === What takes a pass over all features of an agency: kept for a while.


_KEPT_FOR, _KEPT_UNCHANGED_FOR = timedelta(seconds=60), timedelta(hours=1)
_MAX_EXTENTS = 4096
_MAX_GRIDS = 64  # of some MB
Kept = TypeVar("Kept")


@dataclass(frozen=True, slots=True)
class _Overview(Generic[Kept]):
    """What all features of a collection gave, when, and the number of the agency's newest audit entry before."""

    value: Kept
    at: datetime
    audit_number: int


class _Overviews(Generic[Kept]):
    """What takes a pass over all features, kept for a minute, and for an hour while no marker changes."""

    def __init__(self, database: Database, clock: Clock, most: int) -> None:
        self._database = database
        self._clock = clock
        self._most = most
        self._finding: dict[tuple[str, str], threading.Lock] = {}
        self._kept: dict[tuple[str, str], _Overview[Kept]] = {}
        self._lock = threading.Lock()

    def get(self, caller: Caller, collection: Collection, find: Callable[[], Kept]) -> Kept:
        """What is kept, or what is found now."""
        key = (caller.agency_id, collection.id)
        with self._lock:
            finding = self._finding.setdefault(key, threading.Lock())
        with finding:  # a map asks for several tiles at once: the first request finds it, the others wait
            now = self._clock()
            with self._lock:
                known = self._kept.get(key)
            if known is not None and timedelta() <= now - known.at < _KEPT_FOR:
                return known.value
            number = self._audit_number(caller)
            unchanged = known is not None and collection.is_audited and number == known.audit_number
            if known is not None and unchanged and timedelta() <= now - known.at < _KEPT_UNCHANGED_FOR:
                return known.value
            value = find()
            with self._lock:
                if len(self._kept) >= self._most:
                    self._kept.clear()
                self._kept[key] = _Overview(value, now, number)
        return value

    def _audit_number(self, caller: Caller) -> int:
        head = self._database.ask(lambda connection: find_head(connection, caller.agency_id))
        return 0 if head is None else head.number


# === Reading features.


Answer = TypeVar("Answer")


@dataclass(frozen=True, slots=True)
class Page:
    """A page of features."""

    features: orjson.Fragment  # a JSON array
    returned: int
    after: str | None  # the id to continue after, if there are more
    matched: int | None  # how many features match, if that is known


class Features:
    """Reading features of collections, one transaction each."""

    def __init__(self, database: Database, clock: Clock) -> None:
        self._database = database
        self._extents = _Overviews[Extent | None](database, clock, _MAX_EXTENTS)
        self._grids = _Overviews[FeatureGrid](database, clock, _MAX_GRIDS)

    def page(
        self,
        caller: Caller,
        collection: Collection,
        filtered: FeatureFilter,
        *,
        after: str | None = None,
        limit: int = 1000,
        crs: AnyCrs = STORAGE_CRS,
        counted: bool = False,
    ) -> Page:
        """A page of features in a fixed order, counted if that is asked for or costs little.

        Raises
        ------
        MalformedRequest
            There is no line to go on after.
        """
        agency_id, is_first = caller.agency_id, after is None
        if collection.lines is not None:
            return self._page_of_lines(agency_id, collection.lines, filtered, after, limit, crs, counted)
        counted = counted or (is_first and _is_cheap(filtered))
        texts, matched = self._ask(
            collection.table,
            lambda c: store.list_features(c, agency_id, filtered, after=after, limit=limit + 1, counted=counted),
        )
        has_more = len(texts) > limit
        if is_first and not has_more:
            matched = len(texts)
        del texts[limit:]
        last = orjson.loads(texts[-1])["id"] if has_more else None
        if not crs.is_storage:
            found = self._in_crs(agency_id, collection, [orjson.loads(text) for text in texts], crs)
            texts = [orjson.dumps(feature).decode() for feature in found]
        return Page(_joined(texts), len(texts), last, matched)

    def _page_of_lines(
        self,
        agency_id: str,
        lines: LineReader,
        filtered: FeatureFilter,
        after: str | None,
        limit: int,
        crs: AnyCrs,
        counted: bool,
    ) -> Page:
        """Lines are found one by one, so that a first page is counted by going on to the last one."""
        matched: int | None = None
        with self._database.read() as connection:
            with closing(_matching(connection, agency_id, lines, filtered, after)) as found:
                page = list(islice(found, limit + 1))
                has_more = len(page) > limit
                if after is None and (counted or not has_more):
                    matched = len(page) + sum(1 for _ in found)
            if after is not None and counted:
                matched = _count_lines(connection, agency_id, lines, filtered)
        del page[limit:]
        texts = [orjson.dumps(feature).decode() for feature in _in_crs([_line(line) for line in page], crs, {})]
        return Page(_joined(texts), len(page), page[-1].id if has_more else None, matched)

    def count(self, caller: Caller, collection: Collection, filtered: FeatureFilter) -> int:
        """How many features a filter leaves."""
        agency_id = caller.agency_id
        if collection.lines is not None:
            with self._database.read() as connection:
                return _count_lines(connection, agency_id, collection.lines, filtered)
        return self._ask(collection.table, lambda c: store.count_features(c, agency_id, filtered))

    def get(self, caller: Caller, collection: Collection, feature_id: str, crs: AnyCrs = STORAGE_CRS) -> JsonObject:
        """One feature.

        Raises
        ------
        NotFound
            There is none with this id in the collection, or it belongs to another agency.
        """
        agency_id, table = caller.agency_id, collection.table
        if collection.lines is not None:
            with self._database.read() as connection:
                line = collection.lines.find(connection, agency_id, feature_id)
            if line is None:
                raise no_feature(collection)
            return _in_crs([_line(line)], crs, {})[0]
        text = self._ask(table, lambda c: store.find_feature(c, agency_id, feature_id, table))
        if text is None:
            raise no_feature(collection)
        return self._in_crs(agency_id, collection, [orjson.loads(text)], crs)[0]

    def _in_crs(
        self, agency_id: str, collection: Collection, features: list[JsonObject], crs: AnyCrs
    ) -> list[JsonObject]:
        """Features of points in a CRS; markers that came in it come back as they came."""
        origins: dict[str, MarkerOrigin] = {}
        if isinstance(crs, OtherCrs) and collection.table.plans is None:
            ids = [str(feature["id"]) for feature in features]
            with self._database.read() as connection:
                origins = find_origins(connection, agency_id, ids)
        return _in_crs(features, crs, origins)

    def extent(self, caller: Caller, collection: Collection) -> Extent | None:
        """What the agency's features cover, as it was within the last minute."""
        return self._extents.get(caller, collection, lambda: self._find_extent(caller.agency_id, collection))

    def _find_extent(self, agency_id: str, collection: Collection) -> Extent | None:
        with self._database.read() as connection:
            if collection.lines is not None:
                return collection.lines.extent(connection, agency_id)
            return store.find_extent(connection, agency_id, collection.table)

    def tile(self, caller: Caller, collection: Collection, tile: Tile) -> bytes:
        """A vector tile of a collection; empty without features."""
        agency_id, table = caller.agency_id, collection.table
        return self._ask(table, lambda c: feature_tile(c, agency_id, tile, table, layer=collection.id))

    def grouped_tile(self, caller: Caller, collection: Collection, tile: Tile) -> bytes:
        """A vector tile with groups in place of too many features, as they were within the last minute.

        There is no margin around it, so that no feature is on two tiles.
        """
        agency_id, table = caller.agency_id, collection.table
        if tile.zoom <= GROUPED_ZOOM:
            grid = self._grids.get(
                caller, collection, lambda: self._ask(table, lambda c: read_grid(c, agency_id, table, zoom=COARSE_ZOOM))
            )
            if grid.count_on(tile) > MAX_SINGLE:
                if tile.zoom > COARSE_ZOOM:
                    grid = self._ask(table, lambda c: read_grid(c, agency_id, table, zoom=tile.zoom, on=tile))
                return grid.write(tile, f"{collection.id}_groups")
        return self._ask(table, lambda c: feature_tile(c, agency_id, tile, table, layer=collection.id, margin_px=0))

    def _ask(self, table: FeatureTable, question: Callable[[sa.Connection], Answer]) -> Answer:
        """The result of a question; one about plans takes two statements, which see the same snapshot."""
        if table.plans is None:
            return self._database.ask(question)
        with self._database.read() as connection:
            return question(connection)


def no_feature(collection: Collection) -> NotFound:
    """The same for a row that is not there and for another agency's."""
    return NotFound(f"there is no such feature in {collection.id}", field="featureId")


# === Features as they are written: points as they are stored, lines as they are found.


def _matching(
    connection: sa.Connection, agency_id: str, lines: LineReader, filtered: FeatureFilter, after: str | None
) -> Generator[Line]:
    """The lines that a filter leaves; the reader leaves out only those that it need not read."""
    wanted, box = dict(filtered.equal), filtered.box
    with closing(lines.read(connection, agency_id, filtered, after)) as found:
        for line in found:
            if (
                all(line.properties[name] == value for name, value in wanted.items())
                and (filtered.where is None or holds(filtered.where, _values_of(line)))
                and (box is None or _crosses(line, box))
            ):
                yield line


def _values_of(line: Line) -> Mapping[str, object]:
    return {**line.properties, GEOMETRY: shapely.LineString(line.points)}


def _count_lines(connection: sa.Connection, agency_id: str, lines: LineReader, filtered: FeatureFilter) -> int:
    with closing(_matching(connection, agency_id, lines, filtered, None)) as found:
        return sum(1 for _ in found)


def _crosses(line: Line, box: Box) -> bool:
    shape = shapely.LineString(line.points)
    return any(
        shape.intersects(shapely.box(part.west_deg, part.south_deg, part.east_deg, part.north_deg))
        for part in box.parts
    )


def _line(line: Line) -> JsonObject:
    return {
        "type": "Feature",
        "id": line.id,
        "geometry": {"type": "LineString", "coordinates": list(line.points)},
        "properties": line.properties,
    }


def _is_cheap(filtered: FeatureFilter) -> bool:
    rest = (filtered.box, filtered.heights_m, filtered.since, filtered.until, filtered.where)
    return rest == (None,) * 5 and {name for name, _ in filtered.equal} <= filtered.table.cheap_to_count


def _joined(features: list[str]) -> orjson.Fragment:
    return orjson.Fragment(f"[{','.join(features)}]")


def _in_crs(features: Sequence[JsonObject], crs: AnyCrs, origins: Mapping[str, MarkerOrigin]) -> list[JsonObject]:
    """Features with their coordinates in a CRS; those that it does not reach have no geometry."""
    parts = [_vertices(feature) for feature in features]
    vertices = [vertex for part in parts for vertex in part]
    if isinstance(crs, OtherCrs):
        placed = _in_other_crs(features, parts, crs, origins)
    else:
        placed = [(*crs.from_lon_lat(lon_deg, lat_deg), *up) for lon_deg, lat_deg, *up in vertices]
    rest = iter(placed)
    for feature, part in zip(features, parts, strict=True):
        own = list(islice(rest, len(part)))
        is_point = feature["geometry"]["type"] == "Point"
        geometry = {**feature["geometry"], "coordinates": own[0] if is_point else own}
        feature["geometry"] = None if None in own else geometry
    return list(features)


def _vertices(feature: JsonObject) -> list[Sequence[float]]:
    geometry = feature["geometry"]
    return [geometry["coordinates"]] if geometry["type"] == "Point" else geometry["coordinates"]


def _in_other_crs(
    features: Sequence[JsonObject],
    parts: Sequence[Sequence[Sequence[float]]],
    crs: OtherCrs,
    origins: Mapping[str, MarkerOrigin],
) -> list[tuple[float, ...] | None]:
    """Each vertex in the order of the authority's axes; None where it lies outside the system's area.

    Without an epoch, that of plate-fixed systems is assumed.
    """
    records: list[JsonObject] = []
    for feature, part in zip(features, parts, strict=True):
        known = origins.get(str(feature["id"]), MarkerOrigin("OGC:CRS84", None, 0.0))
        same = {
            "vertical_datum": ELLIPSOID, "epoch": feature["properties"].get("epoch") or PLATE_FIXED_EPOCH,
            "origin_crs": known.crs, "origin_realization": known.realization,
            "transform_accuracy_m": known.transform_accuracy_m,
        }  # fmt: skip
        for lon_deg, lat_deg, *up in part:
            records.append({"lon_deg": lon_deg, "lat_deg": lat_deg, "height_m": up[0] if up else None, **same})
    framed, _ = frame_records(records, ExportFrame(crs.name, vertical_datum=ELLIPSOID, needs_heights=False))
    _place_roughly(framed, crs)
    order = ("y", "x") if crs.is_north_first else ("x", "y")
    return [
        None if record["x"] is None
        else (*(record[name] for name in order), *([] if record["z_m"] is None else [record["z_m"]]))
        for record in framed
    ]  # fmt: skip


def _place_roughly(framed: Sequence[JsonObject], crs: OtherCrs) -> None:
    """Places by PROJ's best operation, where none states its accuracy; maps need no better ones."""
    lost = [record for record in framed if record["x"] is None]
    if not lost:
        return
    lon, lat = (np.array([record[name] for record in lost], np.float64) for name in ("lon_deg", "lat_deg"))
    x, y = best_effort(crs.name).transform(lon, lat, direction=TransformDirection.INVERSE)
    inside = covers(reference_system(crs.name).area_of_use, lon, lat) & np.isfinite(x) & np.isfinite(y)
    for record, is_inside, first, second in zip(lost, inside, x.tolist(), y.tolist(), strict=True):
        if is_inside:
            record.update(x=first, y=second)
