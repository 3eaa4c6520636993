"""Queries on vehicles, their keys, their uploads and calibrations. All see one agency only."""

from __future__ import annotations

from collections.abc import Collection
from datetime import datetime
from typing import Any, NamedTuple

import sqlalchemy as sa

from app.registry.agencies import api_keys
from app.registry.column_types import ID, UtcTime, agency_column, columns_of, metadata, one_of, row_maker
from app.registry.resources import Resource
from app.values import JsonObject

VEHICLE_STATUSES = ("active", "retired")

vehicles = sa.Table(
    "vehicles",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("name", sa.String(80), nullable=False),
    sa.Column("status", sa.String(16), nullable=False),
    sa.Column("note", sa.String(500)),
    sa.Column("profile", sa.JSON, nullable=False),  # the part of a decode's context that stays the same
    sa.Column("version", sa.Integer, nullable=False),
    # counted in the transaction that stores an upload or its result; they make no version
    sa.Column("uploads", sa.BigInteger, nullable=False, server_default="0"),
    sa.Column("driven_m", sa.Double, nullable=False, server_default="0"),
    sa.Column("last_seen_at", UtcTime),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
    sa.UniqueConstraint("agency_id", "name"),
    one_of("status", VEHICLE_STATUSES),
    sa.Index("ix_vehicles_agency_id_id", "agency_id", "id"),
)

vehicle_versions = sa.Table(
    "vehicle_versions",
    metadata,
    sa.Column("vehicle_id", ID, sa.ForeignKey("vehicles.id"), primary_key=True),
    sa.Column("version", sa.Integer, primary_key=True, autoincrement=False),
    agency_column(),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("who", sa.String(200), nullable=False),
    sa.Column("why", sa.String(500)),
    sa.Column("vehicle", sa.JSON, nullable=False),
)

# holders of keys that speak for a vehicle: api_keys.holder_id, which stays when a key is replaced
vehicle_keys = sa.Table(
    "vehicle_keys",
    metadata,
    sa.Column("agency_id", ID, sa.ForeignKey("agencies.id"), primary_key=True),
    sa.Column("key_id", sa.String(200), primary_key=True),
    sa.Column("vehicle_id", ID, sa.ForeignKey("vehicles.id"), nullable=False),
    sa.Index("ix_vehicle_keys_vehicle_id", "vehicle_id"),
)

vehicle_uploads = sa.Table(
    "vehicle_uploads",
    metadata,
    sa.Column("decode_id", ID, sa.ForeignKey("decodes.id"), primary_key=True),
    sa.Column("vehicle_id", ID, sa.ForeignKey("vehicles.id"), nullable=False),
    agency_column(),
    sa.Column("version", sa.Integer, nullable=False),  # of the vehicle's profile
    sa.Column("driven_m", sa.Double),  # null until the decode is done
    sa.Index("ix_vehicle_uploads_vehicle_id_decode_id", "vehicle_id", "decode_id"),
)

calibrations = sa.Table(
    "calibrations",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("who", sa.String(200), nullable=False),
    sa.Column("result", sa.JSON, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Index("ix_calibrations_agency_id_id", "agency_id", "id"),
)


class VehicleRow(NamedTuple):
    """A vehicle with what its uploads add up to."""

    id: str
    name: str
    status: str
    note: str | None
    profile: JsonObject
    version: int
    uploads: int
    driven_m: float
    last_seen_at: datetime | None
    created_at: datetime
    updated_at: datetime


class VehicleKeyRow(NamedTuple):
    """A key that speaks for a vehicle."""

    id: str
    label: str
    prefix: str
    scope: str
    expires_at: datetime | None
    last_used_at: datetime | None


class CalibrationRow(NamedTuple):
    """A calibration; `result` is JSON."""

    id: str
    who: str
    result: Any
    created_at: datetime


VEHICLES = Resource(
    "vehicle",
    VehicleRow,
    vehicles,
    cure="GET /v1/vehicles lists yours",
    versions=vehicle_versions,
    unversioned=("uploads", "driven_m", "last_seen_at"),
)
CALIBRATIONS = Resource("calibration", CalibrationRow, calibrations, cure="POST /v1/calibrations makes one")


# --- keys ---------------------------------------------------------------------------------------------------------


def find_of_key(connection: sa.Connection, agency_id: str, key_id: str) -> VehicleRow | None:
    """The vehicle that a key speaks for."""
    held = sa.select(vehicle_keys.c.vehicle_id)
    held = held.where(vehicle_keys.c.agency_id == agency_id, vehicle_keys.c.key_id == key_id)
    return VEHICLES.find(connection, agency_id, id=held.scalar_subquery())


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


def list_keys(
    connection: sa.Connection, agency_id: str, vehicle_ids: Collection[str]
) -> dict[str, list[VehicleKeyRow]]:
    """Keys that speak for some vehicles, without the revoked ones; newest last."""
    query = (
        sa.select(vehicle_keys.c.vehicle_id, *columns_of(VehicleKeyRow, api_keys))
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
    found: dict[str, list[VehicleKeyRow]] = {}
    make = row_maker(VehicleKeyRow)
    for vehicle_id, *key in connection.execute(query):
        found.setdefault(vehicle_id, []).append(make(key))
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
