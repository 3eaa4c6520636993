"""Lines that markers make along a road, for GIS clients.

Each family that makes lines has a source of them: painted lines of magnets (`magnet_lines`), runs of CERPMs
(`cerpm_runs`). A line's id is that of its first marker.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import sqlalchemy as sa
from pyproj import Geod

from app.errors import MalformedRequest
from app.registry.features import Field
from app.registry.spatial import Box, box_around
from app.registry.tables import markers

MAX_GAP_M = 100.0
"""Neighbours in a run of CERPMs are at most so far apart by measure. [m]"""
_MARGIN_M = 2 * MAX_GAP_M
_GEOD = Geod(ellps="WGS84")
_C = markers.c


LINE_FIELDS = tuple(
    Field(name, kind, sa.null(), text)
    for name, kind, text in (
        ("family", "string", "magnet or cerpm"),
        ("code", "string", "Tag of a line of magnets"),
        ("side", "string", "Side of the lane that the CERPMs are on"),
        ("road", "string", "Road's name or number"),
        ("status", "string", "Status of the markers, mixed if they differ"),
        ("count", "integer", "Magnets or CERPMs of the line"),
        ("spacing_m", "number", "Median distance from one to the next [m]"),
        ("longest_gap_m", "number", "Longest distance from one to the next [m]"),
        ("length_m", "number", "From the first to the last, along the line [m]"),
        ("from_measure_m", "number", "Chainage of the first CERPM [m]"),
        ("to_measure_m", "number", "Chainage of the last CERPM [m]"),
    )
)


@dataclass(frozen=True, slots=True)
class Line:
    """A line of markers: its id, its properties, and its points as longitude and latitude [deg]."""

    id: str
    properties: dict[str, Any]
    points: list[tuple[float, float]]


class LinePlace(NamedTuple):
    """A marker that a line begins with, or that a page of lines ended with."""

    id: str
    family: str
    road: str | None
    measure_m: float | None


class LineSource(Protocol):
    """Where the lines of one family come from."""

    def begins_line(self, place: LinePlace) -> bool:
        """Whether a marker of the family can be a line's first one, or could be before it was retired."""

    def read_lines(
        self,
        connection: sa.Connection,
        agency_id: str,
        *,
        box: Box | None,
        pinned: Mapping[str, Any],
        after: LinePlace | None,
    ) -> Iterator[Line]:
        """The agency's lines in a fixed order, from the one after a place on."""

    def find_line(self, connection: sa.Connection, agency_id: str, place: LinePlace) -> Line | None:
        """The line that begins with a marker."""


def read_lines(
    connection: sa.Connection,
    agency_id: str,
    sources: Mapping[str, LineSource],
    *,
    box: Box | None = None,
    pinned: Mapping[str, Any] | None = None,
    after: str | None = None,
) -> Generator[Line]:
    """The agency's lines, family by family in the order of the sources.

    Only what is taken is read, and little more than the longest line is held. Close it before the transaction ends.

    Parameters
    ----------
    connection, agency_id
    sources : mapping of str to LineSource
        By the name of the family.
    box : Box, optional
        Lines that are not near it may be left out.
    pinned : mapping of str to value, optional
        Lines whose `family` or `road` is another may be left out.
    after : str, optional
        Id of the line to go on after.

    Raises
    ------
    MalformedRequest
        There is no marker to go on after, or it is on no road any more.
    """
    pinned = pinned or {}
    place = None if after is None else _find_place(connection, agency_id, after)
    if after is not None and (
        place is None or place.family not in sources or not sources[place.family].begins_line(place)
    ):
        raise MalformedRequest(
            "there is no line to go on after", field="after", limit="the id of a line", cure="begin with the first page"
        )
    names = list(sources)
    first = 0 if place is None else names.index(place.family)
    for number, name in enumerate(names[first:], first):
        if pinned.get("family", name) == name:
            begin = place if number == first else None
            yield from sources[name].read_lines(connection, agency_id, box=box, pinned=pinned, after=begin)


def find_line(
    connection: sa.Connection, agency_id: str, sources: Mapping[str, LineSource], line_id: str
) -> Line | None:
    """The agency's line with an id."""
    place = _find_place(connection, agency_id, line_id)
    if place is None or place.family not in sources:
        return None
    return sources[place.family].find_line(connection, agency_id, place)


def _find_place(connection: sa.Connection, agency_id: str, marker_id: str) -> LinePlace | None:
    query = sa.select(_C.id, _C.family, _C.road, _C.measure_m).where(_C.agency_id == agency_id, _C.id == marker_id)
    row = connection.execute(query).one_or_none()
    return None if row is None else LinePlace._make(row)


def make_line(
    line_id: str,
    rows: Sequence[Any],
    *,
    family: str,
    code: str | None,
    side: str | None,
    measures: tuple[float | None, float | None],
) -> Line:
    """A line through the places of rows, with its properties."""
    points = [(row.lon_deg, row.lat_deg) for row in rows]
    gaps_m = np.array(_GEOD.line_lengths([lon for lon, _ in points], [lat for _, lat in points]))
    statuses = {row.status for row in rows}
    properties = {
        "family": family,
        "code": code,
        "side": side,
        "road": rows[0].road,
        "status": statuses.pop() if len(statuses) == 1 else "mixed",
        "count": len(rows),
        "spacing_m": round(float(np.median(gaps_m)), 3),
        "longest_gap_m": round(float(gaps_m.max()), 3),
        "length_m": round(float(gaps_m.sum()), 3),
        "from_measure_m": measures[0],
        "to_measure_m": measures[1],
    }
    return Line(line_id, properties, points)


def widened(box: Box) -> list[Box]:
    """The box with a margin: neither end of a piece of line that crosses it lies farther out."""
    widened = []
    for part in box.parts:
        corners = [
            box_around(lon, lat, _MARGIN_M)
            for lon in (part.west_deg, part.east_deg)
            for lat in (part.south_deg, part.north_deg)
        ]
        lat = (min(c.south_deg for c in corners), max(c.north_deg for c in corners))
        reach = max((c.east_deg - c.west_deg) % 360.0 for c in corners) / 2 or 180.0
        west, east = max(part.west_deg - reach, -180.0), min(part.east_deg + reach, 180.0)
        widened.append(Box(west, max(lat[0], -90.0), east, min(lat[1], 90.0)))
    return widened
