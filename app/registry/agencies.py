"""Agencies, their keys, and Idempotency-Keys. A key is stored as the SHA-256 of its text; only its name is shown."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from datetime import datetime
from typing import NamedTuple

import sqlalchemy as sa

from app.registry import column_types
from app.registry.audit import Author, record
from app.registry.column_types import (
    ID,
    UtcTime,
    agency_column,
    fetch_all,
    find_one,
    metadata,
    new_id,
    one_of,
    select_rows,
)
from app.registry.resources import Resource

agencies = sa.Table(
    "agencies",
    metadata,
    sa.Column("id", ID, primary_key=True),
    sa.Column("name", sa.String(200), nullable=False, unique=True),
    sa.Column("created_at", UtcTime, nullable=False),
)

api_keys = sa.Table(
    "api_keys",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("holder_id", ID, nullable=False),  # keys that replace one another have the id of the first
    sa.Column("label", sa.String(200), nullable=False),
    sa.Column("prefix", sa.String(16), nullable=False),
    sa.Column("sha256", sa.String(64), nullable=False, unique=True),
    sa.Column("scope", sa.String(16), nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("expires_at", UtcTime),
    sa.Column("revoked_at", UtcTime),
    sa.Column("last_used_at", UtcTime),
    one_of("scope", column_types.SCOPES),
)

# the key that an agency's CERPMs derive theirs from, encrypted under the server's own
agency_secrets = sa.Table(
    "agency_secrets",
    metadata,
    sa.Column("agency_id", ID, sa.ForeignKey("agencies.id"), primary_key=True),
    sa.Column("wrapped", sa.LargeBinary, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
)

idempotency_keys = sa.Table(
    "idempotency_keys",
    metadata,
    sa.Column("agency_id", ID, sa.ForeignKey("agencies.id"), primary_key=True),
    sa.Column("holder_id", sa.String(200), primary_key=True, server_default=""),  # whose request; empty: a job's own
    sa.Column("key", sa.String(200), primary_key=True),
    sa.Column("request_sha256", sa.String(64), nullable=False),
    sa.Column("response", sa.JSON, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("expires_at", UtcTime, nullable=False),
    sa.Index("ix_idempotency_keys_expires_at", "expires_at"),
)


class AgencyRow(NamedTuple):
    """An agency."""

    id: str
    name: str
    created_at: datetime


class KeyRow(NamedTuple):
    """A key as it is stored, without the hash of its text."""

    id: str
    agency_id: str
    holder_id: str
    label: str
    prefix: str
    scope: str
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None
    last_used_at: datetime | None


OPERATOR = Author("the server's operator")
"""Who makes keys from the command line and at the first start."""
OPERATORS = "(operators)"
"""Name of the row of `agencies` to which the keys of operators belong, with their audit log. It is no agency: it has no
markers, and no other key or token speaks for it."""
KEYS = Resource("key", KeyRow, api_keys, cure="GET /v1/keys lists yours")
_KEY = select_rows(KeyRow, api_keys).where(
    api_keys.c.sha256 == sa.bindparam("sha256")
)  # built once: every request asks
_USED = (
    sa.update(api_keys)
    .where(
        api_keys.c.id == sa.bindparam("key_id"),
        sa.or_(api_keys.c.last_used_at.is_(None), api_keys.c.last_used_at < sa.bindparam("at")),
    )
    .values(last_used_at=sa.bindparam("at"))
)


def key_sha256(key: str) -> str:
    """What is stored of a key."""
    return hashlib.sha256(key.encode("utf-8", "surrogateescape")).hexdigest()


def find_agency(connection: sa.Connection, name: str) -> str | None:
    """Id of the agency with a name."""
    query = sa.select(agencies.c.id).where(agencies.c.name == name, agencies.c.name != OPERATORS)
    return connection.execute(query).scalar_one_or_none()


def ensure_operators(connection: sa.Connection, now: datetime) -> str:
    """Id of what the keys of operators belong to; created by the first of them."""
    query = sa.select(agencies.c.id).where(agencies.c.name == OPERATORS)
    return connection.execute(query).scalar_one_or_none() or add_agency(connection, OPERATORS, now)


def get_agency_name(connection: sa.Connection, agency_id: str) -> str:
    """Name of an agency by its id."""
    return str(connection.scalar(sa.select(agencies.c.name).where(agencies.c.id == agency_id)))


def find_first_agency(connection: sa.Connection) -> str | None:
    """Id of the oldest agency."""
    query = sa.select(agencies.c.id).where(agencies.c.name != OPERATORS).order_by(agencies.c.id).limit(1)
    return connection.execute(query).scalar_one_or_none()


def list_agencies(connection: sa.Connection) -> list[AgencyRow]:
    """All that have an audit log, by name: agencies, and the operators."""
    return fetch_all(connection, select_rows(AgencyRow, agencies).order_by(agencies.c.name), AgencyRow)


def page_agencies(connection: sa.Connection, *, after: str | None, limit: int) -> list[AgencyRow]:
    """Agencies in the order in which they were created, from the one after an id."""
    query = select_rows(AgencyRow, agencies).where(agencies.c.name != OPERATORS)
    if after is not None:
        query = query.where(agencies.c.id > after)
    return fetch_all(connection, query.order_by(agencies.c.id).limit(limit), AgencyRow)


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
    prefix: str,
    now: datetime,
    expires_at: datetime | None = None,
    holder_id: str | None = None,
    author: Author = OPERATOR,
) -> str:
    """Store a key, record it in the agency's audit log, and return its id.

    A key that takes over from another has its holder.
    """
    key_id = new_id(now)
    row: dict[str, object] = {
        "id": key_id,
        "agency_id": agency_id,
        "holder_id": holder_id or key_id,
        "label": label,
        "prefix": prefix,
        "sha256": key_sha256(key),
        "scope": scope,
        "created_at": now,
        "expires_at": expires_at,
    }
    connection.execute(sa.insert(api_keys).values(row))
    detail = {name: row[name] for name in ("holder_id", "label", "scope", "prefix")}
    detail["expires_at"] = expires_at.isoformat() if expires_at else None
    action = "key.created" if holder_id is None else "key.rotated"
    record(connection, agency_id, author, action, now=now, subject=key_id, detail=detail)
    return key_id


def find_key(connection: sa.Connection, key: str) -> KeyRow | None:
    """The stored row of a key as it was sent."""
    return find_one(connection, _KEY, KeyRow, {"sha256": key_sha256(key)})


def find_successor(connection: sa.Connection, agency_id: str, key: KeyRow) -> str | None:
    """Id of a key that took over from this one and was not revoked."""
    query = sa.select(api_keys.c.id).where(
        api_keys.c.agency_id == agency_id,
        api_keys.c.holder_id == key.holder_id,
        api_keys.c.id > key.id,
        api_keys.c.revoked_at.is_(None),
    )
    return connection.execute(query.limit(1)).scalar_one_or_none()


def has_admin_key(connection: sa.Connection, agency_id: str, *, besides: str, now: datetime) -> bool:
    """Whether the agency has a valid admin key besides one."""
    query = sa.select(api_keys.c.id).where(
        api_keys.c.agency_id == agency_id,
        api_keys.c.id != besides,
        api_keys.c.scope == "admin",
        api_keys.c.revoked_at.is_(None),
        sa.or_(api_keys.c.expires_at.is_(None), api_keys.c.expires_at > now),
    )
    return connection.execute(query.limit(1)).first() is not None


def expire_key(connection: sa.Connection, key_id: str, at: datetime) -> None:
    """Let a key end at a time."""
    connection.execute(sa.update(api_keys).where(api_keys.c.id == key_id).values(expires_at=at))


def revoke_key(connection: sa.Connection, agency_id: str, key_id: str, now: datetime, *, author: Author) -> None:
    """Revoke a key, and record it in the agency's audit log."""
    connection.execute(sa.update(api_keys).where(api_keys.c.id == key_id).values(revoked_at=now))
    record(connection, agency_id, author, "key.revoked", now=now, subject=key_id)


def write_uses(connection: sa.Connection, uses: Mapping[str, datetime]) -> None:
    """Remember when keys were last used."""
    connection.execute(_USED, [{"key_id": key_id, "at": at} for key_id, at in uses.items()])


def revoke_keys_labelled(connection: sa.Connection, label: str, now: datetime) -> None:
    """Revoke every key with a label."""
    connection.execute(
        sa.update(api_keys).where(api_keys.c.label == label, api_keys.c.revoked_at.is_(None)).values(revoked_at=now)
    )


def restore_key(connection: sa.Connection, key_id: str) -> None:
    """Make a revoked key valid again."""
    connection.execute(sa.update(api_keys).where(api_keys.c.id == key_id).values(revoked_at=None))


# === Answers that were given under an Idempotency-Key.


class ResponseRow(NamedTuple):
    """An answer, and the hash of the request that it was given to."""

    request_sha256: str
    response: object


def find_response(
    connection: sa.Connection, agency_id: str, holder_id: str, key: str, now: datetime
) -> ResponseRow | None:
    """The answer that this holder was given under this key, unless it has expired."""
    query = select_rows(ResponseRow, idempotency_keys).where(
        idempotency_keys.c.agency_id == agency_id,
        idempotency_keys.c.holder_id == holder_id,
        idempotency_keys.c.key == key,
        idempotency_keys.c.expires_at > now,
    )
    return find_one(connection, query, ResponseRow)


def add_response(
    connection: sa.Connection,
    agency_id: str,
    holder_id: str,
    key: str,
    *,
    request_sha256: str,
    response: dict[str, object],
    now: datetime,
    expires_at: datetime,
) -> None:
    """Remember an answer, and forget all that have expired."""
    connection.execute(sa.delete(idempotency_keys).where(idempotency_keys.c.expires_at <= now))
    connection.execute(
        sa.insert(idempotency_keys).values(
            agency_id=agency_id,
            holder_id=holder_id,
            key=key,
            request_sha256=request_sha256,
            response=response,
            created_at=now,
            expires_at=expires_at,
        )
    )
