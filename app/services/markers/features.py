"""Markers as GIS clients read them: collections of GeoJSON features. Built from rows by hand: every map view asks."""

from __future__ import annotations

import threading
from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import islice
from typing import Any

import orjson
import shapely
import sqlalchemy as sa

from app.errors import NotFound
from app.families import FAMILIES
from app.registry import features as store
from app.registry.conditions import holds, pinned_values
from app.registry.database import Database
from app.registry.features import FIELDS, Extent, FeatureFilter, Field
from app.registry.lines import LINE_FIELDS, Line, find_line, read_lines
from app.registry.spatial import Box
from app.registry.tiles import Tile, marker_tile
from app.services.access.access import Caller
from app.services.markers.feature_crs import STORAGE_CRS, FeatureCrs
from app.services.ports import Clock

_EXTENT_AGE = timedelta(seconds=60)
_MAX_EXTENTS = 4096
_CHEAP_TO_COUNT = frozenset({"family", "code"})


@dataclass(frozen=True, slots=True)
class Collection:
    """A set of features that clients list as a layer."""

    id: str
    title: str
    text: str
    geometry: str
    editable: bool = False
    retired: bool = False
    fields: tuple[Field, ...] = FIELDS
    filters: tuple[str, ...] = tuple(field.name for field in FIELDS if field.kind != "date-time")

    @property
    def has_tiles(self) -> bool:
        """Whether there are vector tiles of it."""
        return self.geometry == "Point"


MARKERS = Collection(
    "markers",
    "Markers",
    f"{', '.join(family.title for family in FAMILIES)} that are on the road or planned: one point each.",
    "Point",
    editable=True,
)
RETIRED = Collection(
    "retired_markers", "Retired markers", "Markers that are out of use: one point each.", "Point", retired=True
)
LINES = Collection(
    "marker_lines",
    "Lines of markers",
    "Painted lines of magnets, and runs of CERPMs along one side of a lane, at most 100 m from one to the next.",
    "LineString",
    fields=LINE_FIELDS,
    filters=("family", "side", "road", "status"),
)
LINE_SOURCES = {family.name: family.lines for family in FAMILIES if family.lines is not None}
COLLECTIONS = {collection.id: collection for collection in (MARKERS, RETIRED, LINES)}


@dataclass(frozen=True, slots=True)
class Page:
    """A page of features as JSON, how many it has, the id to continue after if there are more, and how many match if
    that is known.
    """

    features: orjson.Fragment
    returned: int
    after: str | None
    matched: int | None


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


class Features:
    """Reading features, one transaction each."""

    def __init__(self, database: Database, clock: Clock) -> None:
        self._database = database
        self._clock = clock
        self._extents: dict[tuple[str, str], tuple[datetime, Extent | None]] = {}
        self._lock = threading.Lock()

    def page(
        self,
        caller: Caller,
        filtered: FeatureFilter,
        *,
        after: str | None = None,
        limit: int = 1000,
        crs: FeatureCrs = STORAGE_CRS,
        counted: bool = False,
    ) -> Page:
        """A page of features in the order of their ids, counted if that is asked for or costs little."""
        counted = counted or (after is None and _is_cheap(filtered))
        texts, matched = self._database.ask(
            lambda c: store.list_features(c, caller.agency_id, filtered, after=after, limit=limit + 1, counted=counted)
        )
        more = len(texts) > limit
        if after is None and not more:
            matched = len(texts)
        del texts[limit:]
        last = orjson.loads(texts[-1])["id"] if more else None
        if not crs.is_storage:
            texts = [orjson.dumps(_in_crs(orjson.loads(text), crs)).decode() for text in texts]
        return Page(_joined(texts), len(texts), last, matched)

    def count(self, caller: Caller, filtered: FeatureFilter) -> int:
        """How many features a filter leaves."""
        return self._database.ask(lambda connection: store.count_features(connection, caller.agency_id, filtered))

    def get(
        self, caller: Caller, collection: Collection, feature_id: str, crs: FeatureCrs = STORAGE_CRS
    ) -> dict[str, Any]:
        """One feature.

        Raises
        ------
        NotFound
            There is none with this id in the collection, or it belongs to another agency.
        """
        text = self._database.ask(
            lambda c: store.find_feature(c, caller.agency_id, feature_id, retired=collection.retired)
        )
        if text is None:
            raise no_feature(collection)
        return _in_crs(orjson.loads(text), crs)

    def lines(
        self,
        caller: Caller,
        filtered: FeatureFilter,
        *,
        after: str | None = None,
        limit: int = 1000,
        crs: FeatureCrs = STORAGE_CRS,
        counted: bool = False,
    ) -> Page:
        """A page of lines, those of magnets before runs of CERPMs, counted if that is asked for or costs nothing.

        Raises
        ------
        MalformedRequest
            There is no line to go on after.
        """
        matched: int | None = None
        with self._database.read() as connection, closing(_matching(connection, caller, filtered, after)) as lines:
            page = list(islice(lines, limit + 1))
            more = len(page) > limit
            if after is None and (counted or not more):
                matched = len(page) + sum(1 for _ in lines)
        if after is not None and counted:
            matched = self.count_lines(caller, filtered)
        del page[limit:]
        texts = [orjson.dumps(_line(line, crs)).decode() for line in page]
        return Page(_joined(texts), len(page), page[-1].id if more else None, matched)

    def count_lines(self, caller: Caller, filtered: FeatureFilter) -> int:
        """How many lines a filter leaves."""
        with self._database.read() as connection, closing(_matching(connection, caller, filtered, None)) as lines:
            return sum(1 for _ in lines)

    def get_line(self, caller: Caller, line_id: str, crs: FeatureCrs = STORAGE_CRS) -> dict[str, Any]:
        """One line.

        Raises
        ------
        NotFound
            There is none with this id, or it belongs to another agency.
        """
        with self._database.read() as connection:
            line = find_line(connection, caller.agency_id, LINE_SOURCES, line_id)
        if line is None:
            raise no_feature(LINES)
        return _line(line, crs)

    def tile(self, caller: Caller, collection: Collection, tile: Tile) -> bytes:
        """A vector tile of a collection; empty without features."""
        return self._database.ask(
            lambda c: marker_tile(c, caller.agency_id, tile, retired=collection.retired, layer=collection.id)
        )

    def extent(self, caller: Caller, collection: Collection) -> Extent | None:
        """What the agency's features cover, as it was within the last minute."""
        key, now = (caller.agency_id, collection.id), self._clock()
        with self._lock:
            known = self._extents.get(key)
        if known is not None and timedelta() <= now - known[0] < _EXTENT_AGE:
            return known[1]
        with self._database.read() as connection:
            extent = store.find_extent(connection, caller.agency_id, retired=collection.retired)
        with self._lock:
            if len(self._extents) >= _MAX_EXTENTS:
                self._extents.clear()
            self._extents[key] = (now, extent)
        return extent


def no_feature(collection: Collection) -> NotFound:
    """The same for a row that is not there and for another agency's."""
    return NotFound(f"there is no such feature in {collection.id}", field="featureId")


def _matching(connection: sa.Connection, caller: Caller, filtered: FeatureFilter, after: str | None) -> Generator[Line]:
    wanted, box = dict(filtered.equal), filtered.box
    pinned = {**pinned_values(filtered.where), **wanted}
    lines = read_lines(connection, caller.agency_id, LINE_SOURCES, box=box, pinned=pinned, after=after)
    with closing(lines):
        for line in lines:
            if (
                all(line.properties[name] == value for name, value in wanted.items())
                and (filtered.where is None or holds(filtered.where, line.properties))
                and (box is None or _crosses(line, box))
            ):
                yield line


def _crosses(line: Line, box: Box) -> bool:
    shape = shapely.LineString(line.points)
    return any(
        shape.intersects(shapely.box(part.west_deg, part.south_deg, part.east_deg, part.north_deg))
        for part in box.parts
    )


def _line(line: Line, crs: FeatureCrs) -> dict[str, Any]:
    return {
        "type": "Feature",
        "id": line.id,
        "geometry": {"type": "LineString", "coordinates": [crs.from_lon_lat(*point) for point in line.points]},
        "properties": line.properties,
    }


def _is_cheap(filtered: FeatureFilter) -> bool:
    rest = (filtered.box, filtered.heights_m, filtered.since, filtered.until, filtered.where)
    return rest == (None,) * 5 and {name for name, _ in filtered.equal} <= _CHEAP_TO_COUNT


def _joined(features: list[str]) -> orjson.Fragment:
    return orjson.Fragment(f"[{','.join(features)}]")


def _in_crs(feature: dict[str, Any], crs: FeatureCrs) -> dict[str, Any]:
    lon_deg, lat_deg, *height_m = feature["geometry"]["coordinates"]
    feature["geometry"]["coordinates"] = (*crs.from_lon_lat(lon_deg, lat_deg), *height_m)
    return feature
