"""The registry as it was: markers at a time, and single versions of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import cast

import sqlalchemy as sa

from app.errors import NotFound
from app.geodesy.frames import distance_m
from app.markers.reading import MarkerRow
from app.registry.column_types import fetch_all, row_of, select_rows
from app.registry.conditions import is_graded, regraded
from app.registry.marker_rows import MARKERS, VersionRow, marker_versions, markers
from app.registry.markers import MarkerFilter, conditions_of
from app.registry.spatial import covers

MAX_REBUILT = 20_000
"""Markers that changed since are read one by one from their versions: a page looks at no more of them."""
_CHUNK = 500


def list_versions(
    connection: sa.Connection, agency_id: str, marker_id: str, *, after: int = 0, limit: int = 100
) -> list[VersionRow]:
    """The history of a marker, oldest first."""
    v = marker_versions.c
    query = select_rows(VersionRow, marker_versions).where(
        v.marker_id == marker_id, v.agency_id == agency_id, v.version > after
    )
    rows = fetch_all(connection, query.order_by(v.version).limit(limit), VersionRow)
    return [row._replace(marker=_marker_of(cast(Mapping[str, object], row.marker))) for row in rows]


def get_version(connection: sa.Connection, agency_id: str, marker_id: str, version: int) -> VersionRow:
    """One version of a marker.

    Raises
    ------
    NotFound
        There is none, or it belongs to another agency.
    """
    row = next(iter(list_versions(connection, agency_id, marker_id, after=version - 1, limit=1)), None)
    if row is None or row.version != version:
        raise NotFound(f"there is no version {version} of a marker {marker_id}", field="version")
    return row


def list_as_of(
    connection: sa.Connection, agency_id: str, filtered: MarkerFilter, at: datetime, *, after: str | None, limit: int
) -> tuple[list[MarkerRow], str | None]:
    """Markers as they were at a time, in the order of their ids, and the id to continue after if there may be more.

    What did not change since is searched as it is; the others are rebuilt from their versions and then filtered. A page
    that meets too many of these is short.
    """
    query = MARKERS.where(markers.c.agency_id == agency_id, *conditions_of(filtered), markers.c.updated_at <= at)
    if after is not None:
        query = query.where(markers.c.id > after)
    found = fetch_all(connection, query.order_by(markers.c.id).limit(limit + 1), MarkerRow)
    upto = found[-1].id if len(found) > limit else None
    rebuilt, reached = _rebuilt(connection, agency_id, filtered, at, after=after, upto=upto, limit=limit)
    merged = sorted([*found, *rebuilt], key=lambda marker: marker.id)
    if reached is not None:
        merged = [marker for marker in merged if marker.id <= reached]
    page = merged[:limit]
    if len(merged) > limit:
        return page, page[-1].id
    return page, reached


def _rebuilt(
    connection: sa.Connection,
    agency_id: str,
    filtered: MarkerFilter,
    at: datetime,
    *,
    after: str | None,
    upto: str | None,
    limit: int,
) -> tuple[list[MarkerRow], str | None]:
    """Markers that changed since and match, and the id that was reached if there are more to look at."""
    found: list[MarkerRow] = []
    seen = 0
    last = after
    while True:
        ids = _changed_since(connection, agency_id, at, after=last, upto=upto)
        for marker in _states(connection, ids, at):
            if _matches(marker, filtered):
                found.append(marker)
        seen += len(ids)
        if len(ids) < _CHUNK:
            return found, None
        last = ids[-1]
        if len(found) > limit or seen >= MAX_REBUILT:
            return found, last


def _changed_since(
    connection: sa.Connection, agency_id: str, at: datetime, *, after: str | None, upto: str | None
) -> list[str]:
    query = sa.select(markers.c.id).where(
        markers.c.agency_id == agency_id, markers.c.updated_at > at, markers.c.created_at <= at
    )
    if after is not None:
        query = query.where(markers.c.id > after)
    if upto is not None:
        query = query.where(markers.c.id <= upto)
    return list(connection.execute(query.order_by(markers.c.id).limit(_CHUNK)).scalars())


def _states(connection: sa.Connection, marker_ids: list[str], at: datetime) -> Iterator[MarkerRow]:
    """Each marker by its last version that is not younger."""
    if not marker_ids:
        return
    v, w = marker_versions, marker_versions.alias()
    newest = sa.select(sa.func.max(w.c.version)).where(w.c.marker_id == v.c.marker_id, w.c.at <= at).scalar_subquery()
    query = sa.select(v.c.marker).where(v.c.marker_id.in_(marker_ids), v.c.version == newest)
    for marker in connection.execute(query).scalars():
        yield _marker_of(marker)


def _marker_of(stored: Mapping[str, object]) -> MarkerRow:
    """The marker of a version; one from before there were grades gets its grade."""
    return row_of(MarkerRow, stored if is_graded(stored) else {**stored, **regraded(stored)})


def _matches(marker: MarkerRow, filtered: MarkerFilter) -> bool:
    """As the conditions of a query, on a marker that was rebuilt."""
    lon_deg, lat_deg, measure_m = marker.lon_deg, marker.lat_deg, marker.measure_m
    box, near = filtered.box, filtered.near
    if box is not None and not any(
        part.west_deg <= lon_deg <= part.east_deg and part.south_deg <= lat_deg <= part.north_deg for part in box.parts
    ):
        return False
    if near is not None and distance_m(near[0], near[1], lon_deg, lat_deg) > near[2]:
        return False
    if filtered.area is not None and not covers(filtered.area, lon_deg, lat_deg):
        return False
    for name in ("digits", "status", "family", "road"):
        wanted = getattr(filtered, name)
        if wanted is not None and getattr(marker, name) != wanted:
            return False
    if filtered.from_m is not None and (measure_m is None or measure_m < filtered.from_m):
        return False
    return filtered.to_m is None or (measure_m is not None and measure_m <= filtered.to_m)
