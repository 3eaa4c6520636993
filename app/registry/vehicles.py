"""Queries on vehicles, their keys, their uploads and calibrations. All see one agency only."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from app.errors import NotFound, StaleVersion
from app.registry.tables import api_keys, calibrations, vehicle_keys, vehicle_uploads, vehicle_versions, vehicles

Row = sa.RowMapping
_KEPT = ("id", "name", "status", "note", "profile", "version", "created_at", "updated_at")
"""What a version of a vehicle keeps: what it did is no part of it."""


def get_vehicle(connection: sa.Connection, agency_id: str, vehicle_id: str, field: str = "vehicle_id") -> Row:
    """One vehicle.

    Raises
    ------
    NotFound
        There is none with this id, or it belongs to another agency.
    """
    row = _one(connection, vehicles.c.agency_id == agency_id, vehicles.c.id == vehicle_id)
    if row is None:
        raise NotFound(f"there is no vehicle {vehicle_id}", field=field, cure="GET /v1/vehicles lists yours")
    return row


def find_named(connection: sa.Connection, agency_id: str, name: str) -> Row | None:
    """The agency's vehicle with a name."""
    return _one(connection, vehicles.c.agency_id == agency_id, vehicles.c.name == name)


def find_of_key(connection: sa.Connection, agency_id: str, key_id: str) -> Row | None:
    """The vehicle that a key speaks for."""
    held = sa.select(vehicle_keys.c.vehicle_id).where(
        vehicle_keys.c.agency_id == agency_id, vehicle_keys.c.key_id == key_id
    )
    return _one(connection, vehicles.c.agency_id == agency_id, vehicles.c.id == held.scalar_subquery())


def _one(connection: sa.Connection, *conditions: sa.ColumnElement[bool]) -> Row | None:
    return connection.execute(sa.select(vehicles).where(*conditions)).mappings().one_or_none()


def list_vehicles(
    connection: sa.Connection, agency_id: str, *, status: str | None, after: str | None, limit: int
) -> list[Row]:
    """Vehicles in the order of their ids, which is the order they were made in."""
    query = sa.select(vehicles).where(vehicles.c.agency_id == agency_id)
    if status is not None:
        query = query.where(vehicles.c.status == status)
    if after is not None:
        query = query.where(vehicles.c.id > after)
    return list(connection.execute(query.order_by(vehicles.c.id).limit(limit)).mappings())


def add_vehicle(
    connection: sa.Connection, agency_id: str, values: Mapping[str, Any], *, who: str, why: str | None
) -> Row:
    """Store a new vehicle with the first entry of its history."""
    connection.execute(sa.insert(vehicles).values(agency_id=agency_id, **values))
    return _recorded(connection, agency_id, values["id"], who=who, why=why)


def update_vehicle(
    connection: sa.Connection, agency_id: str, vehicle_id: str, changes: Mapping[str, Any], *,
    version: int, now: datetime, who: str, why: str | None,
) -> Row:  # fmt: skip
    """Change a vehicle that is still at the version the caller read, and add to its history.

    Raises
    ------
    StaleVersion
        It was changed since.
    """
    statement = (
        sa.update(vehicles)
        .where(vehicles.c.id == vehicle_id, vehicles.c.agency_id == agency_id, vehicles.c.version == version)
        .values(**changes, version=version + 1, updated_at=now)
    )
    if connection.execute(statement).rowcount != 1:
        raise StaleVersion(f"vehicle {vehicle_id} is no longer at version {version}", field="If-Match")
    return _recorded(connection, agency_id, vehicle_id, who=who, why=why)


def _recorded(connection: sa.Connection, agency_id: str, vehicle_id: str, *, who: str, why: str | None) -> Row:
    row = get_vehicle(connection, agency_id, vehicle_id)
    kept = {name: row[name].isoformat() if isinstance(row[name], datetime) else row[name] for name in _KEPT}
    connection.execute(
        sa.insert(vehicle_versions).values(
            vehicle_id=vehicle_id,
            version=row["version"],
            agency_id=agency_id,
            at=row["updated_at"],
            who=who,
            why=why,
            vehicle=kept,
        )
    )
    return row


def list_versions(
    connection: sa.Connection, agency_id: str, vehicle_id: str, *, after: int = 0, limit: int = 100
) -> list[Row]:
    """The history of a vehicle, oldest first."""
    query = (
        sa.select(vehicle_versions)
        .where(
            vehicle_versions.c.vehicle_id == vehicle_id,
            vehicle_versions.c.agency_id == agency_id,
            vehicle_versions.c.version > after,
        )
        .order_by(vehicle_versions.c.version)
        .limit(limit)
    )
    return list(connection.execute(query).mappings())


# --- keys ---------------------------------------------------------------------------------------------------------


def find_holder(connection: sa.Connection, agency_id: str, key_id: str) -> str | None:
    """Who holds a key of the agency: the id that stays when it is replaced. Revoked keys speak for nobody."""
    query = sa.select(api_keys.c.holder_id).where(
        api_keys.c.agency_id == agency_id,
        api_keys.c.revoked_at.is_(None),
        sa.or_(api_keys.c.id == key_id, api_keys.c.holder_id == key_id),
    )
    return connection.execute(query.limit(1)).scalar_one_or_none()


def link_key(connection: sa.Connection, agency_id: str, key_id: str, vehicle_id: str) -> None:
    """Let a key that speaks for no vehicle speak for this one."""
    connection.execute(sa.insert(vehicle_keys).values(agency_id=agency_id, key_id=key_id, vehicle_id=vehicle_id))


def unlink_key(connection: sa.Connection, agency_id: str, key_id: str, vehicle_id: str) -> bool:
    """Let a key speak for this vehicle no longer; returns whether it did."""
    statement = sa.delete(vehicle_keys).where(
        vehicle_keys.c.agency_id == agency_id,
        vehicle_keys.c.key_id == key_id,
        vehicle_keys.c.vehicle_id == vehicle_id,
    )
    return connection.execute(statement).rowcount == 1


def list_keys(connection: sa.Connection, agency_id: str, vehicle_ids: Collection[str]) -> dict[str, list[Row]]:
    """Keys that speak for some vehicles, without the revoked ones; newest last."""
    columns = [api_keys.c[name] for name in ("id", "label", "prefix", "scope", "expires_at", "last_used_at")]
    query = (
        sa.select(vehicle_keys.c.vehicle_id, *columns)
        .join(
            api_keys,
            sa.and_(api_keys.c.holder_id == vehicle_keys.c.key_id, api_keys.c.agency_id == vehicle_keys.c.agency_id),
        )
        .where(
            vehicle_keys.c.agency_id == agency_id,
            vehicle_keys.c.vehicle_id.in_(vehicle_ids),
            api_keys.c.revoked_at.is_(None),
        )
        .order_by(api_keys.c.id)
    )
    found: dict[str, list[Row]] = {}
    for row in connection.execute(query).mappings():
        found.setdefault(row["vehicle_id"], []).append(row)
    return found


# --- uploads ------------------------------------------------------------------------------------------------------


def add_upload(
    connection: sa.Connection, agency_id: str, vehicle_id: str, decode_id: str, *, version: int, now: datetime
) -> None:
    """Count an upload, in the transaction that stores its decode."""
    connection.execute(
        sa.insert(vehicle_uploads).values(
            decode_id=decode_id, vehicle_id=vehicle_id, agency_id=agency_id, version=version
        )
    )
    seen = sa.case(
        (vehicles.c.last_seen_at > now, vehicles.c.last_seen_at), else_=sa.literal(now, vehicles.c.last_seen_at.type)
    )
    connection.execute(
        sa.update(vehicles)
        .where(vehicles.c.id == vehicle_id, vehicles.c.agency_id == agency_id)
        .values(uploads=vehicles.c.uploads + 1, last_seen_at=seen)
    )


def add_driven(connection: sa.Connection, agency_id: str, decode_id: str, driven_m: float) -> None:
    """Count what a decode found to have been driven, once; a decode without a vehicle counts for nobody."""
    own = (vehicle_uploads.c.decode_id == decode_id, vehicle_uploads.c.agency_id == agency_id)
    vehicle_id = connection.execute(
        sa.select(vehicle_uploads.c.vehicle_id).where(*own, vehicle_uploads.c.driven_m.is_(None))
    ).scalar_one_or_none()
    if vehicle_id is None:
        return
    connection.execute(sa.update(vehicle_uploads).where(*own).values(driven_m=driven_m))
    connection.execute(
        sa.update(vehicles).where(vehicles.c.id == vehicle_id).values(driven_m=vehicles.c.driven_m + driven_m)
    )


# --- calibrations -------------------------------------------------------------------------------------------------


def add_calibration(connection: sa.Connection, agency_id: str, values: Mapping[str, Any]) -> None:
    """Store a calibration."""
    connection.execute(sa.insert(calibrations).values(agency_id=agency_id, **values))


def get_calibration(
    connection: sa.Connection, agency_id: str, calibration_id: str, field: str = "calibration_id"
) -> Row:
    """One calibration.

    Raises
    ------
    NotFound
        There is none with this id, or it belongs to another agency.
    """
    query = sa.select(calibrations).where(calibrations.c.id == calibration_id, calibrations.c.agency_id == agency_id)
    row = connection.execute(query).mappings().one_or_none()
    if row is None:
        raise NotFound(f"there is no calibration {calibration_id}", field=field, cure="POST /v1/calibrations makes one")
    return row


def list_calibrations(connection: sa.Connection, agency_id: str, *, before: str | None, limit: int) -> list[Row]:
    """Calibrations, newest first."""
    query = sa.select(calibrations).where(calibrations.c.agency_id == agency_id)
    if before is not None:
        query = query.where(calibrations.c.id < before)
    return list(connection.execute(query.order_by(calibrations.c.id.desc()).limit(limit)).mappings())
