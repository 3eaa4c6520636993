"""Queries on markers. All but `find_code_near` see one agency only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import sqlalchemy as sa

from app.errors import NotFound, StaleVersion
from app.registry.audit import AuditEntry, add_versions
from app.registry.feature_text import feature_text
from app.registry.marker_rows import MARKERS, CodeRow, MarkerRow
from app.registry.rows import fetch_all, fetch_in, find_one, row_of, select_rows
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
from app.registry.tables import markers
from app.registry.tenancy import seeing_every_agency


@dataclass(frozen=True, slots=True)
class MarkerFilter:
    """What a list of markers is filtered to; None does not narrow."""

    box: Box | None = None
    near: tuple[float, float, float] | None = None
    digits: str | None = None
    status: str | None = None
    family: str | None = None
    area: Area | None = None
    road: str | None = None
    from_m: float | None = None
    to_m: float | None = None


def get_marker(connection: sa.Connection, agency_id: str, marker_id: str) -> MarkerRow:
    """One marker.

    Raises
    ------
    NotFound
        There is none with this id, or it belongs to another agency.
    """
    query = MARKERS.where(markers.c.id == marker_id, markers.c.agency_id == agency_id)
    row = find_one(connection, query, MarkerRow)
    if row is None:
        raise NotFound(f"there is no marker {marker_id}", field="marker_id")
    return row


def get_markers(connection: sa.Connection, agency_id: str, marker_ids: list[str]) -> list[MarkerRow]:
    """Several markers, in the order asked for.

    Raises
    ------
    NotFound
        One is missing, or belongs to another agency.
    """
    found = {row.id: row for row in find_markers(connection, agency_id, marker_ids)}
    missing = next((marker_id for marker_id in marker_ids if marker_id not in found), None)
    if missing is not None:
        raise NotFound(f"there is no marker {missing}", field="marker_ids")
    return [found[marker_id] for marker_id in marker_ids]


def find_markers(connection: sa.Connection, agency_id: str, marker_ids: list[str]) -> list[MarkerRow]:
    """Those of several markers that the agency has, in any order."""
    query = MARKERS.where(markers.c.agency_id == agency_id)
    return list(fetch_in(connection, query, MarkerRow, markers.c.id, marker_ids))


def list_markers(
    connection: sa.Connection, agency_id: str, filtered: MarkerFilter, *, after: str | None, limit: int
) -> list[MarkerRow]:
    """Markers in the order of their ids, which is the order they were registered in."""
    query = MARKERS.where(markers.c.agency_id == agency_id, *conditions_of(filtered))
    if after is not None:
        query = query.where(markers.c.id > after)
    return fetch_all(connection, query.order_by(markers.c.id).limit(limit), MarkerRow)


def conditions_of(filtered: MarkerFilter) -> list[sa.ColumnElement[bool]]:
    """What a filter asks of a row."""
    conditions = []
    if filtered.box is not None:
        conditions.append(within_box(filtered.box))
    if filtered.near is not None:
        conditions.append(within_radius(*filtered.near))
    if filtered.digits is not None:
        conditions.append(markers.c.digits == filtered.digits)
    if filtered.status is not None:
        conditions.append(markers.c.status == filtered.status)
    if filtered.family is not None:
        conditions.append(markers.c.family == filtered.family)
    if filtered.area is not None:
        conditions.append(within_area(filtered.area))
    if filtered.road is not None:
        conditions.append(markers.c.road == filtered.road)
    if filtered.from_m is not None:
        conditions.append(markers.c.measure_m >= filtered.from_m)
    if filtered.to_m is not None:
        conditions.append(markers.c.measure_m <= filtered.to_m)
    return conditions


def list_near(
    connection: sa.Connection,
    agency_id: str,
    families: tuple[str, ...],
    lon_deg: float,
    lat_deg: float,
    radius_m: float,
    *,
    limit: int = 1000,
) -> list[MarkerRow]:
    """The agency's markers of some families within a radius, all but the retired ones, nearest first."""
    parts = box_around(lon_deg, lat_deg, radius_m).parts
    values = {"agency": agency_id, "lon": lon_deg, "lat": lat_deg, "radius": radius_m, "most": limit}
    for k, box in enumerate(parts):
        values |= {f"w{k}": box.west_deg, f"s{k}": box.south_deg, f"e{k}": box.east_deg, f"n{k}": box.north_deg}
    return fetch_all(connection, _near(len(parts), families), MarkerRow, values)


@lru_cache
def _near(parts: int, families: tuple[str, ...]) -> sa.Select[Any]:
    """Statement of `list_near`, built once: every frame runs it, and building it costs more."""
    number = partial(sa.bindparam, type_=sa.Double)
    proposed = (
        proposed_by_index(markers, *(number(f"{side}{k}") for side in ("w", "s", "e", "n"))) for k in range(parts)
    )
    distance = distance_to(number("lon"), number("lat"))
    return (
        MARKERS.where(
            markers.c.agency_id == sa.bindparam("agency"),
            markers.c.family.in_(families),
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
) -> CodeRow | None:
    """A plate of any agency that carries these digits and may be on the road.

    It lies within `radius_m`, or within `mismatched_radius_m` if its digits are not those of its own position.
    """
    query = select_rows(CodeRow, markers).where(
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
        return find_one(connection, query.limit(1), CodeRow)


def find_id_code(connection: sa.Connection, digits: str, n: int) -> CodeRow | None:
    """The plate of any agency that carries, or once carried, these digits of the id scheme."""
    query = select_rows(CodeRow, markers).where(markers.c.digits == digits, markers.c.n == n, markers.c.scheme == "id")
    with seeing_every_agency(connection):
        return find_one(connection, query, CodeRow)


def add_marker(
    connection: sa.Connection, entry: AuditEntry, values: Mapping[str, Any], *, kind: str, why: str | None
) -> MarkerRow:
    """Store a new marker of the entry's agency with the first version of its history."""
    feature = feature_text(row_of(MarkerRow, values))
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
) -> MarkerRow:
    """Change a marker that is still at the version the caller read, and add to its history.

    Raises
    ------
    StaleVersion
        It was changed since.
    """
    changes = {**changes, "version": version + 1, "updated_at": entry.at}
    feature = feature_text(get_marker(connection, entry.agency_id, marker_id)._replace(**changes))
    statement = (
        sa.update(markers)
        .where(markers.c.id == marker_id, markers.c.agency_id == entry.agency_id, markers.c.version == version)
        .values(**changes, feature=feature)
    )
    if connection.execute(statement).rowcount != 1:
        raise StaleVersion(f"marker {marker_id} is no longer at version {version}", field="If-Match")
    return _recorded(connection, entry, marker_id, kind=kind, why=why)


def _recorded(connection: sa.Connection, entry: AuditEntry, marker_id: str, *, kind: str, why: str | None) -> MarkerRow:
    row = get_marker(connection, entry.agency_id, marker_id)
    add_versions(connection, [entry.version(marker_id, row.version, row._asdict(), kind=kind, why=why)])
    return row
