"""Queries on roads, their versions and the markers on them. All see one agency only."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import sqlalchemy as sa

from app.errors import NotFound, StaleVersion
from app.registry.audit import AuditEntry, add_versions
from app.registry.feature_text import feature_text
from app.registry.markers import PUBLIC
from app.registry.tables import markers, road_versions, roads

Row = sa.RowMapping
_CHUNK = 1000
_COLUMNS = [column for column in roads.c if column.name != "agency_id"]
_SHORT = [column for column in _COLUMNS if column.name not in ("parts", "calibration")]


def get_road(connection: sa.Connection, agency_id: str, road_id: str) -> Row:
    """One road.

    Raises
    ------
    NotFound
        There is none with this id, or it belongs to another agency.
    """
    query = sa.select(*_COLUMNS).where(roads.c.id == road_id, roads.c.agency_id == agency_id)
    row = connection.execute(query).mappings().one_or_none()
    if row is None:
        raise NotFound(f"there is no road {road_id}", field="road_id", cure="GET /v1/roads lists yours")
    return row


def find_road(connection: sa.Connection, agency_id: str, name: str) -> Row | None:
    """The agency's road with a name."""
    query = sa.select(*_COLUMNS).where(roads.c.agency_id == agency_id, roads.c.name == name)
    return connection.execute(query).mappings().one_or_none()


def list_roads(
    connection: sa.Connection, agency_id: str, *, name: str | None, after: str | None, limit: int
) -> list[Row]:
    """Roads without their geometry, in the order of their ids."""
    query = sa.select(*_SHORT).where(roads.c.agency_id == agency_id)
    if name is not None:
        query = query.where(roads.c.name == name)
    if after is not None:
        query = query.where(roads.c.id > after)
    return list(connection.execute(query.order_by(roads.c.id).limit(limit)).mappings())


def add_road(connection: sa.Connection, agency_id: str, values: Mapping[str, Any], *, who: str, why: str | None) -> Row:
    """Store a new road with the first entry of its history."""
    connection.execute(sa.insert(roads).values(agency_id=agency_id, **values))
    return _recorded(connection, agency_id, values["id"], who=who, why=why)


def update_road(
    connection: sa.Connection,
    agency_id: str,
    road_id: str,
    changes: Mapping[str, Any],
    *,
    version: int,
    who: str,
    why: str | None,
) -> Row:
    """Change a road that is still at the version the caller read.

    Raises
    ------
    StaleVersion
        It was changed since.
    """
    statement = (
        sa.update(roads)
        .where(roads.c.id == road_id, roads.c.agency_id == agency_id, roads.c.version == version)
        .values(**changes, version=version + 1)
    )
    if connection.execute(statement).rowcount != 1:
        raise StaleVersion(f"road {road_id} is no longer at version {version}", field="If-Match")
    return _recorded(connection, agency_id, road_id, who=who, why=why)


def _recorded(connection: sa.Connection, agency_id: str, road_id: str, *, who: str, why: str | None) -> Row:
    row = get_road(connection, agency_id, road_id)
    connection.execute(
        sa.insert(road_versions).values(
            road_id=road_id,
            version=row["version"],
            agency_id=agency_id,
            at=row["updated_at"],
            who=who,
            why=why,
            road={str(name): value for name, value in row.items()},
        )
    )
    return row


def list_versions(connection: sa.Connection, agency_id: str, road_id: str, *, after: int, limit: int) -> list[Row]:
    """The history of a road, oldest first."""
    query = sa.select(road_versions).where(
        road_versions.c.road_id == road_id, road_versions.c.agency_id == agency_id, road_versions.c.version > after
    )
    return list(connection.execute(query.order_by(road_versions.c.version).limit(limit)).mappings())


def get_version(connection: sa.Connection, agency_id: str, road_id: str, version: int) -> dict[str, Any]:
    """A road as it was at a version.

    Raises
    ------
    NotFound
        The road had no such version.
    """
    query = sa.select(road_versions.c.road).where(
        road_versions.c.road_id == road_id,
        road_versions.c.agency_id == agency_id,
        road_versions.c.version == version,
    )
    found: dict[str, Any] | None = connection.execute(query).scalar_one_or_none()
    if found is None:
        raise NotFound(f"road {road_id} has no version {version}", field="version", cure="GET its versions")
    return found


def list_on_road(
    connection: sa.Connection,
    agency_id: str,
    road: str,
    *,
    measures_m: tuple[float | None, float | None] = (None, None),
    offsets_m: tuple[float | None, float | None] = (None, None),
    after: tuple[float, str] | None = None,
    limit: int,
) -> list[Row]:
    """Markers with a measure on a road, in the order of their measures."""
    c = markers.c
    query = sa.select(*PUBLIC).where(c.agency_id == agency_id, c.road == road, c.measure_m.is_not(None))
    for column, (least, greatest) in ((c.measure_m, measures_m), (c.offset_m, offsets_m)):
        if least is not None:
            query = query.where(column >= least)
        if greatest is not None:
            query = query.where(column <= greatest)
    if after is not None:
        place = sa.tuple_(sa.literal(after[0], sa.Double), sa.literal(after[1]))
        query = query.where(c.measure_m >= after[0], sa.tuple_(c.measure_m, c.id) > place)
    return list(connection.execute(query.order_by(c.measure_m, c.id).limit(limit)).mappings())


def walk_named(connection: sa.Connection, agency_id: str, road: str) -> Iterator[list[Row]]:
    """All markers that name a road, in the order of their ids, some at a time."""
    query = sa.select(*PUBLIC).where(markers.c.agency_id == agency_id, markers.c.road == road)
    query = query.order_by(markers.c.id).limit(_CHUNK)
    after = ""
    while rows := list(connection.execute(query.where(markers.c.id > after)).mappings()):
        yield rows
        after = rows[-1]["id"]


def remeasure(
    connection: sa.Connection,
    entry: AuditEntry,
    rows: Sequence[Row],
    references: Sequence[tuple[float, float]],
    *,
    kind: str,
    why: str | None,
) -> None:
    """Give markers, in the order of their ids, new measures and offsets: a further version of each."""
    if not rows:
        return
    c = markers.c
    statement = (
        sa.update(markers)
        .where(c.id == sa.bindparam("marker"), c.agency_id == entry.agency_id)
        .values(
            measure_m=sa.bindparam("measure"),
            offset_m=sa.bindparam("offset"),
            version=c.version + 1,
            updated_at=sa.bindparam("now", entry.at, type_=c.updated_at.type),
            feature=sa.bindparam("text"),
        )
    )
    versions, values = [], []
    for row, (measure_m, offset_m) in zip(rows, references, strict=True):
        changes = {"measure_m": measure_m, "offset_m": offset_m, "version": row["version"] + 1, "updated_at": entry.at}
        marker = {**{str(name): value for name, value in row.items()}, **changes}
        values.append({"marker": row["id"], "measure": measure_m, "offset": offset_m, "now": entry.at})
        values[-1]["text"] = feature_text(marker)
        versions.append(entry.version(row["id"], row["version"] + 1, marker, kind=kind, why=why))
    connection.execute(statement, values)
    add_versions(connection, versions)
