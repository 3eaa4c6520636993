"""Lines that markers make along a road, for GIS clients.

Each family that makes lines has a source of them: painted lines of magnets, runs of CERPMs. A line's id is that
of its first marker.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple, Protocol, cast

import numpy as np
import sqlalchemy as sa
from pyproj import Geod

from app.errors import MalformedRequest
from app.registry.column_types import fetch_all
from app.registry.features import Field
from app.registry.marker_rows import markers
from app.registry.markers import magnets
from app.registry.spatial import Box, box_around, within_box

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
        ("marker_count", "integer", "Magnets or CERPMs of the line"),
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
    properties: dict[str, object]
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
        pinned: Mapping[str, object],
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
    pinned: Mapping[str, object] | None = None,
    after: str | None = None,
) -> Generator[Line]:
    """The agency's lines, family by family in the order of the sources.

    Only what is taken is read, and little more than the longest line is held. Close it before the transaction ends.

    Parameters
    ----------
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
    rows: Sequence[_CerpmRow | _MagnetRow],
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
    properties: dict[str, object] = {
        "family": family,
        "code": code,
        "side": side,
        "road": rows[0].road,
        "status": statuses.pop() if len(statuses) == 1 else "mixed",
        "marker_count": len(rows),
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


# === Runs of CERPMs along one side of a lane.
#
# A run is two or more CERPMs of one road and one side of the lane, in the order of their measures, no two neighbours
# more than `MAX_GAP_M` apart by measure, and none farther than their measures allow: where the measures of a road
# repeat, two runs have them. Retired ones, and those without a road or a measure, are in none.


_MOST_STRETCHED = 2.0  # [1] metres of road in a metre of measure; source: docs/roads.md, calibration
_BESIDE_M = 10.0  # [m] farther for rounded measures, and for neighbours on two boundaries of one side
_M_PER_DEG = 111_195.0  # [m/deg] on a sphere of 6371 km, the Earth's mean radius
_STREAMED = {"stream_results": True, "yield_per": 1000}


class CerpmRuns:
    """The source of runs of CERPMs, in the order of roads and measures."""

    def begins_line(self, place: LinePlace) -> bool:
        """Only a CERPM with a measure on a road can begin a run."""
        return None not in (place.road, place.measure_m)

    def read_lines(
        self,
        connection: sa.Connection,
        agency_id: str,
        *,
        box: Box | None,
        pinned: Mapping[str, object],
        after: LinePlace | None,
    ) -> Iterator[Line]:
        """Runs in the order of roads and measures."""
        for run in _runs(connection, agency_id, box, road=cast("str | None", pinned.get("road")), after=after):
            yield _line_of_run(run)

    def find_line(self, connection: sa.Connection, agency_id: str, place: LinePlace) -> Line | None:
        """The run that begins with a CERPM."""
        if not self.begins_line(place):
            return None
        with closing(_runs(connection, agency_id, None, road=place.road, first=place)) as runs:
            run = next(runs, None)
        return _line_of_run(run) if run is not None and run[0].id == place.id else None


class _CerpmRow(NamedTuple):
    """A CERPM with a measure on a road."""

    id: str
    road: str
    status: str
    lon_deg: float
    lat_deg: float
    measure_m: float
    side: str


@dataclass(slots=True)
class _Run:
    """A run that is being read; of one that is not wanted only the last row is kept."""

    is_wanted: bool
    rows: list[_CerpmRow]


def _runs(
    connection: sa.Connection,
    agency_id: str,
    box: Box | None,
    *,
    road: str | None = None,
    after: LinePlace | None = None,
    first: LinePlace | None = None,
) -> Generator[list[_CerpmRow]]:
    """Runs in the order of the roads, measures and ids of their first CERPMs: all, or from one on, or after one."""
    side = _C.spec["side"].as_string().label("side")
    listed = [
        _C.agency_id == agency_id,
        _C.family == "cerpm",
        _C.status != "retired",
        _C.road.is_not(None),
        _C.measure_m.is_not(None),
    ]
    if road is not None:
        listed.append(_C.road == road)
    query = sa.select(_C.id, _C.road, _C.status, _C.lon_deg, _C.lat_deg, _C.measure_m, side).where(*listed)
    if box is not None:
        near = sa.or_(*(within_box(part) for part in widened(box)))
        roads = connection.execute(sa.select(_C.road).where(*listed, near).distinct()).scalars().all()
        query = query.where(_C.road.in_(roads))
    begin = after or first
    if begin is not None and begin.measure_m is not None:
        # what belongs to a run that began before has a neighbour at most a gap before
        earliest = sa.tuple_(sa.literal(begin.road), sa.literal(begin.measure_m - MAX_GAP_M))
        query = query.where(sa.tuple_(_C.road, _C.measure_m) >= earliest)
    rows = connection.execute(query.order_by(_C.road, _C.measure_m, _C.id), execution_options=_STREAMED)
    with closing(rows):
        yield from _cut(map(_CerpmRow._make, rows), lambda row: _is_before(row, begin, or_at=after is not None))


def _is_before(row: _CerpmRow, begin: LinePlace | None, *, or_at: bool) -> bool:
    if begin is None or begin.measure_m is None or row.road != begin.road:
        return False
    at, limit = (row.measure_m, row.id), (begin.measure_m, begin.id)
    return at <= limit if or_at else at < limit


def _cut(rows: Iterable[_CerpmRow], is_before: Callable[[_CerpmRow], bool]) -> Iterator[list[_CerpmRow]]:
    """Runs of rows in the order of roads and measures, but those that begin before; each as soon as it is complete."""
    begun: deque[_Run] = deque()
    growing: list[_Run] = []
    for row in rows:
        growing = [run for run in growing if not _is_complete(run, row)]
        near = [(apart_m, k) for k, run in enumerate(growing) if (apart_m := _apart_m(run.rows[-1], row)) is not None]
        if near:
            run = growing[min(near)[1]]
        else:
            run = _Run(not is_before(row), [])
            growing.append(run)
            begun.append(run)
        if run.is_wanted:
            run.rows.append(row)
        else:
            run.rows = [row]
        while begun and _is_complete(begun[0], row):
            yield from _wanted(begun.popleft())
    while begun:
        yield from _wanted(begun.popleft())


def _is_complete(run: _Run, row: _CerpmRow) -> bool:
    last = run.rows[-1]
    return row.road != last.road or row.measure_m - last.measure_m > MAX_GAP_M


def _apart_m(last: _CerpmRow, row: _CerpmRow) -> float | None:
    """Distance from the last CERPM of a run to the next row; None if it is of another run. [m]"""
    if row.side != last.side:
        return None
    east_m = ((row.lon_deg - last.lon_deg + 180.0) % 360.0 - 180.0) * math.cos(math.radians(row.lat_deg)) * _M_PER_DEG
    apart_m = math.hypot(east_m, (row.lat_deg - last.lat_deg) * _M_PER_DEG)
    return apart_m if apart_m <= _MOST_STRETCHED * (row.measure_m - last.measure_m) + _BESIDE_M else None


def _wanted(run: _Run) -> Iterator[list[_CerpmRow]]:
    if run.is_wanted and len(run.rows) >= 2:
        yield run.rows


def _line_of_run(run: list[_CerpmRow]) -> Line:
    measures = (run[0].measure_m, run[-1].measure_m)
    return make_line(run[0].id, run, family="cerpm", code=None, side=run[0].side, measures=measures)


# === Painted lines of magnets.


_PAINTED = (_C.family == "magnet", _C.scheme == "line-tag", _C.status != "retired")
_MAGNET_LINES = 100
"""Number of lines whose magnets are read in one query."""


class MagnetLines:
    """The source of painted lines of magnets, in the order of their ids."""

    def begins_line(self, place: LinePlace) -> bool:
        """Any magnet marker may be a line."""
        return True

    def read_lines(
        self,
        connection: sa.Connection,
        agency_id: str,
        *,
        box: Box | None,
        pinned: Mapping[str, object],
        after: LinePlace | None,
    ) -> Iterator[Line]:
        """Lines in the order of their ids."""
        yield from _lines(connection, agency_id, box, None if after is None else after.id)

    def find_line(self, connection: sa.Connection, agency_id: str, place: LinePlace) -> Line | None:
        """The line of a marker."""
        rows = _list_magnets(connection, agency_id, _C.id == place.id)
        return _line_of(rows) if len(rows) >= 2 else None


def _lines(connection: sa.Connection, agency_id: str, box: Box | None, after: str | None) -> Iterator[Line]:
    ids = sa.select(_C.id).where(_C.agency_id == agency_id, *_PAINTED).order_by(_C.id).limit(_MAGNET_LINES)
    if box is not None:
        near = sa.or_(*(within_box(part, magnets) for part in widened(box)))
        ids = ids.where(_C.id.in_(sa.select(magnets.c.marker_id).where(magnets.c.agency_id == agency_id, near)))
    while True:
        chunk = connection.execute(ids if after is None else ids.where(_C.id > after)).scalars().all()
        if not chunk:
            return
        rows = _list_magnets(connection, agency_id, _C.id.in_(chunk))
        for _, group in groupby(rows, key=lambda row: row.id):
            if len(line := list(group)) >= 2:
                yield _line_of(line)
        after = chunk[-1]


class _MagnetRow(NamedTuple):
    """A magnet of a painted line; id, code, road and status are of the line."""

    id: str
    digits: str
    road: str | None
    status: str
    lon_deg: float
    lat_deg: float


def _list_magnets(connection: sa.Connection, agency_id: str, of_lines: sa.ColumnElement[bool]) -> list[_MagnetRow]:
    query = (
        sa.select(_C.id, _C.digits, _C.road, _C.status, magnets.c.lon_deg, magnets.c.lat_deg)
        .join(magnets, magnets.c.marker_id == _C.id)
        .where(_C.agency_id == agency_id, *_PAINTED, of_lines)
        .order_by(_C.id, magnets.c.number)
    )
    return fetch_all(connection, query, _MagnetRow)


def _line_of(rows: Sequence[_MagnetRow]) -> Line:
    first = rows[0]
    return make_line(first.id, rows, family="magnet", code=first.digits, side=None, measures=(None, None))
