"""Agencies and their keys. A key is stored as the SHA-256 of its text; only its first characters can be shown again."""

from __future__ import annotations

import hashlib
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from app.registry.ids import new_id
from app.registry.tables import agencies, api_keys

Row = sa.RowMapping
_KEY = sa.select(api_keys).where(api_keys.c.sha256 == sa.bindparam("sha256"))  # built once: every request asks


def key_sha256(key: str) -> str:
    """What is stored of a key."""
    return hashlib.sha256(key.encode("utf-8", "surrogateescape")).hexdigest()


def find_agency(connection: sa.Connection, name: str) -> str | None:
    """Id of the agency with a name."""
    return connection.execute(sa.select(agencies.c.id).where(agencies.c.name == name)).scalar_one_or_none()


def find_first_agency(connection: sa.Connection) -> str | None:
    """Id of the oldest agency."""
    return connection.execute(sa.select(agencies.c.id).order_by(agencies.c.id).limit(1)).scalar_one_or_none()


def list_agencies(connection: sa.Connection) -> list[Row]:
    """Ids and names of all agencies, by name."""
    return list(connection.execute(sa.select(agencies.c.id, agencies.c.name).order_by(agencies.c.name)).mappings())


def add_agency(connection: sa.Connection, name: str, now: datetime) -> str:
    """Create an agency and return its id."""
    agency_id = new_id(now)
    connection.execute(sa.insert(agencies).values(id=agency_id, name=name, created_at=now))
    return agency_id


def add_key(
    connection: sa.Connection,
    key: str,
    *,
    agency_id: str,
    scope: str,
    label: str,
    now: datetime,
    expires_at: datetime | None = None,
) -> str:
    """Store a key and return its id."""
    key_id = new_id(now)
    row: dict[str, Any] = {
        "id": key_id,
        "holder_id": key_id,
        "agency_id": agency_id,
        "label": label,
        "prefix": key[:8],
        "sha256": key_sha256(key),
        "scope": scope,
        "created_at": now,
        "expires_at": expires_at,
    }
    connection.execute(sa.insert(api_keys).values(row))
    return key_id


def find_key(connection: sa.Connection, key: str) -> Row | None:
    """The stored row of a key as it was sent."""
    return connection.execute(_KEY, {"sha256": key_sha256(key)}).mappings().one_or_none()


def touch_key(connection: sa.Connection, key_id: str, now: datetime) -> None:
    """Remember when a key was last used."""
    connection.execute(sa.update(api_keys).where(api_keys.c.id == key_id).values(last_used_at=now))


def revoke_keys_labelled(connection: sa.Connection, label: str, now: datetime) -> None:
    """Revoke every key with a label."""
    connection.execute(
        sa.update(api_keys).where(api_keys.c.label == label, api_keys.c.revoked_at.is_(None)).values(revoked_at=now)
    )


def restore_key(connection: sa.Connection, key_id: str) -> None:
    """Make a revoked key valid again."""
    connection.execute(sa.update(api_keys).where(api_keys.c.id == key_id).values(revoked_at=None))
