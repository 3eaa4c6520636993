"""Runs of CERPMs along one side of a lane.

A run is two or more CERPMs of one road and one side of the lane, in the order of their measures, no two neighbours more
than `MAX_GAP_M` apart by measure. Retired ones, and those without a road or a measure, are in none.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from app.registry.lines import MAX_GAP_M, Line, LinePlace, make_line, widened
from app.registry.spatial import Box, within_box
from app.registry.tables import markers

_C = markers.c
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
        pinned: Mapping[str, Any],
        after: LinePlace | None,
    ) -> Iterator[Line]:
        """Runs in the order of roads and measures."""
        for run in _runs(connection, agency_id, box, road=pinned.get("road"), after=after):
            yield _line_of_run(run)

    def find_line(self, connection: sa.Connection, agency_id: str, place: LinePlace) -> Line | None:
        """The run that begins with a CERPM."""
        if not self.begins_line(place):
            return None
        with closing(_runs(connection, agency_id, None, road=place.road, first=place)) as runs:
            run = next(runs, None)
        return _line_of_run(run) if run is not None and run[0].id == place.id else None


@dataclass(slots=True)
class _Run:
    """A run that is being read; of one that is not wanted only the last row is kept."""

    is_wanted: bool
    rows: list[Any]


def _runs(
    connection: sa.Connection,
    agency_id: str,
    box: Box | None,
    *,
    road: str | None = None,
    after: Any = None,
    first: Any = None,
) -> Generator[list[Any]]:
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
    if begin is not None:  # what belongs to a run that began before has a neighbour at most a gap before
        earliest = sa.tuple_(sa.literal(begin.road), sa.literal(begin.measure_m - MAX_GAP_M))
        query = query.where(sa.tuple_(_C.road, _C.measure_m) >= earliest)
    rows = connection.execute(query.order_by(_C.road, _C.measure_m, _C.id), execution_options=_STREAMED)
    with closing(rows):
        yield from _cut(rows, lambda row: _is_before(row, begin, or_at=after is not None))


def _is_before(row: Any, begin: Any, *, or_at: bool) -> bool:
    if begin is None or row.road != begin.road:
        return False
    at, limit = (row.measure_m, row.id), (begin.measure_m, begin.id)
    return bool(at <= limit if or_at else at < limit)


def _cut(rows: Iterable[Any], is_before: Callable[[Any], bool]) -> Iterator[list[Any]]:
    """Runs of rows in the order of roads and measures, but those that begin before; each as soon as it is complete."""
    begun: deque[_Run] = deque()
    growing: dict[str, _Run] = {}
    road = None
    for row in rows:
        if row.road != road:
            road = row.road
            growing.clear()
        run = growing.get(row.side)
        if run is None or row.measure_m - run.rows[-1].measure_m > MAX_GAP_M:
            run = growing[row.side] = _Run(not is_before(row), [])
            begun.append(run)
        if run.is_wanted:
            run.rows.append(row)
        else:
            run.rows = [row]
        while begun and _is_complete(begun[0], growing, row):
            yield from _wanted(begun.popleft())
    while begun:
        yield from _wanted(begun.popleft())


def _is_complete(run: _Run, growing: Mapping[str, _Run], row: Any) -> bool:
    last = run.rows[-1]
    return growing.get(last.side) is not run or row.measure_m - last.measure_m > MAX_GAP_M


def _wanted(run: _Run) -> Iterator[list[Any]]:
    if run.is_wanted and len(run.rows) >= 2:
        yield run.rows


def _line_of_run(run: list[Any]) -> Line:
    measures = (run[0].measure_m, run[-1].measure_m)
    return make_line(run[0].id, run, family="cerpm", code=None, side=run[0].side, measures=measures)
