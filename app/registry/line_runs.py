"""Lines that markers make along a road: painted lines of magnets, and runs of CERPMs.

A run is two or more CERPMs of one road and one side of the lane, in the order of their measures, no two neighbours more
than `MAX_GAP_M` apart by measure. Retired ones, and those without a road or a measure, are in none. A run's id is that
of its first CERPM.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Any

import numpy as np
import sqlalchemy as sa
from pyproj import Geod

from app.registry.features import Field
from app.registry.spatial import Box, box_around, within_box
from app.registry.tables import magnets, markers

MAX_GAP_M = 100.0
_MARGIN_M = 2 * MAX_GAP_M
_GEOD = Geod(ellps="WGS84")
_C = markers.c


LINE_FIELDS = tuple(
    Field(name, kind, sa.null(), text)
    for name, kind, text in (
        ("family", "string", "magnet or cerpm"),
        ("code", "string", "Tag of a line of magnets"),
        ("side", "string", "Side of the lane that CERPMs say they are on"),
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


def list_lines(connection: sa.Connection, agency_id: str, box: Box | None = None) -> list[Line]:
    """The agency's lines, in the order of their ids; those that are not near a box may be left out."""
    lines = [*_magnet_lines(connection, agency_id, box), *_runs(connection, agency_id, box)]
    return sorted(lines, key=lambda line: line.id)


def find_line(connection: sa.Connection, agency_id: str, line_id: str) -> Line | None:
    """The agency's line with an id. Only the road that its first marker is on is read."""
    first = sa.select(_C.lon_deg, _C.lat_deg).where(_C.agency_id == agency_id, _C.id == line_id)
    place = connection.execute(first).one_or_none()
    if place is None:
        return None
    there = Box(place.lon_deg, place.lat_deg, place.lon_deg, place.lat_deg)
    return next((line for line in list_lines(connection, agency_id, there) if line.id == line_id), None)


def _magnet_lines(connection: sa.Connection, agency_id: str, box: Box | None) -> Iterator[Line]:
    query = (
        sa.select(_C.id, _C.digits, _C.road, _C.status, magnets.c.lon_deg, magnets.c.lat_deg)
        .join(magnets, magnets.c.marker_id == _C.id)
        .where(_C.agency_id == agency_id, _C.family == "magnet", _C.scheme == "line-tag", _C.status != "retired")
        .order_by(_C.id, magnets.c.number)
    )
    if box is not None:
        near = sa.or_(*(within_box(part, magnets) for part in _widened(box)))
        query = query.where(_C.id.in_(sa.select(magnets.c.marker_id).where(magnets.c.agency_id == agency_id, near)))
    for _, group in groupby(connection.execute(query), key=lambda row: row.id):
        rows = list(group)
        if len(rows) >= 2:
            first = rows[0]
            yield _line(first.id, rows, family="magnet", code=first.digits, side=None, measures=(None, None))


def _runs(connection: sa.Connection, agency_id: str, box: Box | None) -> Iterator[Line]:
    side = _C.spec["side"].as_string().label("side")
    listed = (
        _C.agency_id == agency_id,
        _C.family == "cerpm",
        _C.status != "retired",
        _C.road.is_not(None),
        _C.measure_m.is_not(None),
    )
    query = sa.select(_C.id, _C.road, _C.status, _C.lon_deg, _C.lat_deg, _C.measure_m, side).where(*listed)
    if box is not None:
        near = sa.or_(*(within_box(part) for part in _widened(box)))
        roads = connection.execute(sa.select(_C.road).where(*listed, near).distinct()).scalars().all()
        query = query.where(_C.road.in_(roads))
    rows = connection.execute(query.order_by(_C.road, side, _C.measure_m, _C.id))
    for _, group in groupby(rows, key=lambda row: (row.road, row.side)):
        for run in _cut(list(group)):
            measures = (run[0].measure_m, run[-1].measure_m)
            yield _line(run[0].id, run, family="cerpm", code=None, side=run[0].side, measures=measures)


def _cut(rows: list[Any]) -> Iterator[list[Any]]:
    run = rows[:1]
    for before, row in pairwise(rows):
        if row.measure_m - before.measure_m > MAX_GAP_M:
            if len(run) >= 2:
                yield run
            run = []
        run.append(row)
    if len(run) >= 2:
        yield run


def _line(
    line_id: str,
    rows: list[Any],
    *,
    family: str,
    code: str | None,
    side: str | None,
    measures: tuple[float | None, float | None],
) -> Line:
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


def _widened(box: Box) -> list[Box]:
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
