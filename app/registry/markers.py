"""Queries on markers and their history. All but `find_code_near` see one agency only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import sqlalchemy as sa

from app.errors import NotFound, StaleVersion
from app.registry.audit import AuditEntry, add_versions
from app.registry.feature_text import feature_text
from app.registry.spatial import (
    Area,
    Box,
    box_around,
    distance_to,
    proposed_by_index,
    within_area,
    within_box,
    within_radius,
)
from app.registry.tables import marker_versions, markers
from app.registry.tenancy import seeing_every_agency

Row = sa.RowMapping
PUBLIC = [column for column in markers.c if column.name not in ("row", "agency_id", "feature")]
_UNKNOWN = dict.fromkeys(column.name for column in PUBLIC)


@dataclass(frozen=True, slots=True)
class MarkerFilter:
    """What a list of markers is narrowed to; None does not narrow."""

    box: Box | None = None
    near: tuple[float, float, float] | None = None
    digits: str | None = None
    status: str | None = None
    family: str | None = None
    area: Area | None = None
    road: str | None = None
    from_m: float | None = None
    to_m: float | None = None


def get_marker(connection: sa.Connection, agency_id: str, marker_id: str) -> Row:
    """One marker.

    Raises
    ------
    NotFound
        There is none with this id, or it belongs to another agency.
    """
    query = sa.select(*PUBLIC).where(markers.c.id == marker_id, markers.c.agency_id == agency_id)
    row = connection.execute(query).mappings().one_or_none()
    if row is None:
        raise NotFound(f"there is no marker {marker_id}", field="marker_id")
    return row


def get_markers(connection: sa.Connection, agency_id: str, marker_ids: list[str]) -> list[Row]:
    """Several markers, in the order asked for.

    Raises
    ------
    NotFound
        One is missing, or belongs to another agency.
    """
    query = sa.select(*PUBLIC).where(markers.c.agency_id == agency_id)
    found: dict[str, Row] = {}
    for start in range(0, len(marker_ids), 500):
        chunk = query.where(markers.c.id.in_(marker_ids[start : start + 500]))
        found.update({row["id"]: row for row in connection.execute(chunk).mappings()})
    missing = next((marker_id for marker_id in marker_ids if marker_id not in found), None)
    if missing is not None:
        raise NotFound(f"there is no marker {missing}", field="marker_ids")
    return [found[marker_id] for marker_id in marker_ids]


def list_markers(
    connection: sa.Connection, agency_id: str, narrowed: MarkerFilter, *, after: str | None, limit: int
) -> list[Row]:
    """Markers in the order of their ids, which is the order they were registered in."""
    query = sa.select(*PUBLIC).where(markers.c.agency_id == agency_id, *conditions_of(narrowed))
    if after is not None:
        query = query.where(markers.c.id > after)
    return list(connection.execute(query.order_by(markers.c.id).limit(limit)).mappings())


def conditions_of(narrowed: MarkerFilter) -> list[sa.ColumnElement[bool]]:
    """What a filter asks of a row."""
    conditions = []
    if narrowed.box is not None:
        conditions.append(within_box(narrowed.box))
    if narrowed.near is not None:
        conditions.append(within_radius(*narrowed.near))
    if narrowed.digits is not None:
        conditions.append(markers.c.digits == narrowed.digits)
    if narrowed.status is not None:
        conditions.append(markers.c.status == narrowed.status)
    if narrowed.family is not None:
        conditions.append(markers.c.family == narrowed.family)
    if narrowed.area is not None:
        conditions.append(within_area(narrowed.area))
    if narrowed.road is not None:
        conditions.append(markers.c.road == narrowed.road)
    if narrowed.from_m is not None:
        conditions.append(markers.c.measure_m >= narrowed.from_m)
    if narrowed.to_m is not None:
        conditions.append(markers.c.measure_m <= narrowed.to_m)
    return conditions


def list_plates_near(
    connection: sa.Connection, agency_id: str, lon_deg: float, lat_deg: float, radius_m: float, *, limit: int = 1000
) -> list[Row]:
    """The agency's plates within a radius that may be on the road: all but the retired ones, nearest first."""
    parts = box_around(lon_deg, lat_deg, radius_m).parts
    values = {"agency": agency_id, "lon": lon_deg, "lat": lat_deg, "radius": radius_m, "most": limit}
    for k, box in enumerate(parts):
        values |= {f"w{k}": box.west_deg, f"s{k}": box.south_deg, f"e{k}": box.east_deg, f"n{k}": box.north_deg}
    return list(connection.execute(_plates_near(len(parts)), values).mappings())


@lru_cache
def _plates_near(parts: int) -> sa.Select[Any]:
    """Statement of `list_plates_near`, built once: every frame runs it, and building it costs more."""
    number = partial(sa.bindparam, type_=sa.Double)
    proposed = (
        proposed_by_index(markers, *(number(f"{side}{k}") for side in ("w", "s", "e", "n"))) for k in range(parts)
    )
    distance = distance_to(number("lon"), number("lat"))
    return (
        sa.select(*PUBLIC)
        .where(
            markers.c.agency_id == sa.bindparam("agency"),
            markers.c.family == "plate",
            markers.c.status != "retired",
            sa.or_(*proposed),
            distance <= number("radius"),
        )
        .order_by(distance, markers.c.id)
        .limit(sa.bindparam("most", type_=sa.Integer))
    )


def find_code_near(
    connection: sa.Connection,
    digits: str,
    lon_deg: float,
    lat_deg: float,
    radius_m: float,
    *,
    mismatched_radius_m: float,
    ignoring: str | None = None,
) -> Row | None:
    """A plate of any agency that carries these digits and may be on the road.

    It lies within `radius_m`, or within `mismatched_radius_m` if its digits are not those of its own position.
    """
    query = sa.select(markers.c.id, markers.c.agency_id).where(
        markers.c.digits == digits,
        markers.c.status != "retired",
        sa.or_(
            within_radius(lon_deg, lat_deg, radius_m),
            sa.and_(markers.c.digits_match_position.is_(False), within_radius(lon_deg, lat_deg, mismatched_radius_m)),
        ),
    )
    if ignoring is not None:
        query = query.where(markers.c.id != ignoring)
    with seeing_every_agency(connection):
        return connection.execute(query.limit(1)).mappings().one_or_none()


def find_id_code(connection: sa.Connection, digits: str, n: int) -> Row | None:
    """The plate of any agency that carries, or once carried, these digits of the id scheme."""
    query = sa.select(markers.c.id, markers.c.agency_id).where(
        markers.c.digits == digits, markers.c.n == n, markers.c.scheme == "id"
    )
    with seeing_every_agency(connection):
        return connection.execute(query).mappings().one_or_none()


def add_marker(
    connection: sa.Connection, entry: AuditEntry, values: Mapping[str, Any], *, kind: str, why: str | None
) -> Row:
    """Store a new marker of the entry's agency with the first version of its history."""
    feature = feature_text({**_UNKNOWN, **values})
    connection.execute(sa.insert(markers).values(agency_id=entry.agency_id, feature=feature, **values))
    return _recorded(connection, entry, values["id"], kind=kind, why=why)


def update_marker(
    connection: sa.Connection,
    entry: AuditEntry,
    marker_id: str,
    changes: Mapping[str, Any],
    *,
    version: int,
    kind: str,
    why: str | None,
) -> Row:
    """Change a marker that is still at the version the caller read, and add to its history.

    Raises
    ------
    StaleVersion
        It was changed since.
    """
    changes = {**changes, "version": version + 1, "updated_at": entry.at}
    feature = feature_text({**get_marker(connection, entry.agency_id, marker_id), **changes})
    statement = (
        sa.update(markers)
        .where(markers.c.id == marker_id, markers.c.agency_id == entry.agency_id, markers.c.version == version)
        .values(**changes, feature=feature)
    )
    if connection.execute(statement).rowcount != 1:
        raise StaleVersion(f"marker {marker_id} is no longer at version {version}", field="If-Match")
    return _recorded(connection, entry, marker_id, kind=kind, why=why)


def list_versions(
    connection: sa.Connection, agency_id: str, marker_id: str, *, after: int = 0, limit: int = 100
) -> list[Row]:
    """The history of a marker, oldest first."""
    query = (
        sa.select(marker_versions)
        .where(
            marker_versions.c.marker_id == marker_id,
            marker_versions.c.agency_id == agency_id,
            marker_versions.c.version > after,
        )
        .order_by(marker_versions.c.version)
        .limit(limit)
    )
    return list(connection.execute(query).mappings())


def _recorded(connection: sa.Connection, entry: AuditEntry, marker_id: str, *, kind: str, why: str | None) -> Row:
    row = get_marker(connection, entry.agency_id, marker_id)
    marker = {str(name): value for name, value in row.items()}
    add_versions(connection, [entry.version(marker_id, row["version"], marker, kind=kind, why=why)])
    return row
