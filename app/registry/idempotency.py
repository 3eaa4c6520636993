"""Answers that were given under an Idempotency-Key."""

from __future__ import annotations

from datetime import datetime
from typing import Any, NamedTuple

import sqlalchemy as sa

from app.registry.rows import find_one, select_rows
from app.registry.tables import idempotency_keys


class ResponseRow(NamedTuple):
    """An answer, and the hash of the request that it was given to."""

    request_sha256: str
    response: Any


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
    response: dict[str, Any],
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
