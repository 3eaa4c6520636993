"""Finding markers: pages of a filter, the nearest to a place, and those along a line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from typing import cast

import numpy as np
from typing_extensions import Unpack

from app.errors import InvalidParameter, naming
from app.families import get_family
from app.families.documents import MarkerDocument
from app.registry import markers as store
from app.registry.database import Database
from app.registry.history import list_as_of
from app.registry.marker_rows import MarkerRow
from app.registry.markers import MarkerFilter
from app.registry.nearest import find_nearest_at_once, list_nearest
from app.registry.searches import list_places
from app.registry.spatial import distances_m
from app.roads.axis import Axis, Foot
from app.services.access.access import Caller
from app.services.markers.documents import Found, FoundMarker

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
        line : sequence of (lon_deg, lat_deg)
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
