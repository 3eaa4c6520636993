"""Answering a repeated request as the first time."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import sqlalchemy as sa

from app.errors import IdempotencyConflict
from app.registry import idempotency


@dataclass(frozen=True, slots=True)
class IdempotencyKey:
    """A client's key, and the hash of the request that it came with."""

    key: str
    request_sha256: str


def find_answer(
    connection: sa.Connection, agency_id: str, key: IdempotencyKey | None, now: datetime
) -> dict[str, Any] | None:
    """The answer that this request got before, if any.

    Raises
    ------
    IdempotencyConflict
        The key was used for another request.
    """
    if key is None:
        return None
    answer = idempotency.find_answer(connection, agency_id, key.key, now)
    if answer is None:
        return None
    if answer["request_sha256"] != key.request_sha256:
        raise IdempotencyConflict(
            "this Idempotency-Key was used for a different request",
            field="Idempotency-Key",
            limit="one request a key",
            cure="use a new key for a new request",
        )
    response: dict[str, Any] = answer["response"]
    return response


def keep_answer(
    connection: sa.Connection,
    agency_id: str,
    key: IdempotencyKey | None,
    response: dict[str, Any],
    now: datetime,
    ttl: timedelta,
) -> None:
    """Remember an answer in the transaction that made it true."""
    if key is not None:
        idempotency.add_answer(
            connection,
            agency_id,
            key.key,
            request_sha256=key.request_sha256,
            response=response,
            now=now,
            expires_at=now + ttl,
        )
