"""The registry as it was: markers at a time, and single versions of them."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from app.errors import NotFound
from app.registry.audit import Row
from app.registry.markers import PUBLIC, MarkerFilter, conditions_of
from app.registry.spatial import covers, distance_m
from app.registry.tables import marker_versions, markers

MOST_REBUILT = 20_000
"""Markers that changed since are read one by one from their versions: a page looks at no more of them."""
_CHUNK = 500
_UNKNOWN = dict.fromkeys(column.name for column in PUBLIC)


def marker_of(version: Row) -> dict[str, Any]:
    """The marker as a version has it; columns that there were not yet are null."""
    return {**_UNKNOWN, **version["marker"]}


def get_version(connection: sa.Connection, agency_id: str, marker_id: str, version: int) -> Row:
    """One version of a marker.

    Raises
    ------
    NotFound
        There is none, or it belongs to another agency.
    """
    v = marker_versions.c
    query = sa.select(marker_versions).where(v.marker_id == marker_id, v.agency_id == agency_id, v.version == version)
    row = connection.execute(query).mappings().one_or_none()
    if row is None:
        raise NotFound(f"there is no version {version} of a marker {marker_id}", field="version")
    return row


def list_as_of(
    connection: sa.Connection, agency_id: str, narrowed: MarkerFilter, at: datetime, *, after: str | None, limit: int
) -> tuple[list[dict[str, Any]], str | None]:
    """Markers as they were at a time, in the order of their ids, and the id to continue after if there may be more.

    What did not change since is searched as it is; the others are rebuilt from their versions and then filtered. A page
    that meets too many of these is short.
    """
    query = sa.select(*PUBLIC).where(
        markers.c.agency_id == agency_id, *conditions_of(narrowed), markers.c.updated_at <= at
    )
    if after is not None:
        query = query.where(markers.c.id > after)
    rows = connection.execute(query.order_by(markers.c.id).limit(limit + 1)).mappings()
    found = [{name: row[name] for name in _UNKNOWN} for row in rows]
    upto = found[-1]["id"] if len(found) > limit else None
    rebuilt, reached = _rebuilt(connection, agency_id, narrowed, at, after=after, upto=upto, limit=limit)
    merged = sorted([*found, *rebuilt], key=lambda marker: str(marker["id"]))
    if reached is not None:
        merged = [marker for marker in merged if marker["id"] <= reached]
    page = merged[:limit]
    if len(merged) > limit:
        return page, page[-1]["id"]
    return page, reached


def _rebuilt(
    connection: sa.Connection,
    agency_id: str,
    narrowed: MarkerFilter,
    at: datetime,
    *,
    after: str | None,
    upto: str | None,
    limit: int,
) -> tuple[list[dict[str, Any]], str | None]:
    """Markers that changed since and match, and the id that was reached if there are more to look at."""
    found: list[dict[str, Any]] = []
    seen = 0
    last = after
    while True:
        ids = _changed_since(connection, agency_id, at, after=last, upto=upto)
        for marker in _states(connection, ids, at):
            if _matches(marker, narrowed):
                found.append(marker)
        seen += len(ids)
        if len(ids) < _CHUNK:
            return found, None
        last = ids[-1]
        if len(found) > limit or seen >= MOST_REBUILT:
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


def _states(connection: sa.Connection, marker_ids: list[str], at: datetime) -> Iterator[dict[str, Any]]:
    """Each marker by its last version that is not younger."""
    if not marker_ids:
        return
    v, w = marker_versions, marker_versions.alias()
    newest = sa.select(sa.func.max(w.c.version)).where(w.c.marker_id == v.c.marker_id, w.c.at <= at).scalar_subquery()
    query = sa.select(v).where(v.c.marker_id.in_(marker_ids), v.c.version == newest)
    for row in connection.execute(query).mappings():
        yield marker_of(row)


def _matches(marker: dict[str, Any], narrowed: MarkerFilter) -> bool:
    """As the conditions of a query, on a marker that was rebuilt."""
    lon_deg, lat_deg, measure_m = marker["lon_deg"], marker["lat_deg"], marker["measure_m"]
    box, near = narrowed.box, narrowed.near
    if box is not None and not any(
        part.west_deg <= lon_deg <= part.east_deg and part.south_deg <= lat_deg <= part.north_deg for part in box.parts
    ):
        return False
    if near is not None and distance_m(near[0], near[1], lon_deg, lat_deg) > near[2]:
        return False
    if narrowed.area is not None and not covers(narrowed.area, lon_deg, lat_deg):
        return False
    for name in ("digits", "status", "family", "road"):
        wanted = getattr(narrowed, name)
        if wanted is not None and marker[name] != wanted:
            return False
    if narrowed.from_m is not None and (measure_m is None or measure_m < narrowed.from_m):
        return False
    return narrowed.to_m is None or (measure_m is not None and measure_m <= narrowed.to_m)
