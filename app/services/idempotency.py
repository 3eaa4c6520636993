"""Requests with an Idempotency-Key: the first one takes effect, repetitions get its response again."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, TypeVar

import sqlalchemy as sa

from app.errors import IdempotencyConflict
from app.registry import agencies
from app.registry.database import Database

ResponseT = TypeVar("ResponseT")


@dataclass(frozen=True, slots=True)
class IdempotencyKey:
    """A client's key, the hash of the request that it came with, and whose request it is."""

    key: str
    request_sha256: str
    # `Caller.key_id`. Other callers of the agency have other scopes, and may not see the response. Empty for the
    # server's own jobs.
    holder_id: str


class Answer:
    """The response to one request: an earlier one that is repeated, or the one that is made now.

    Attributes
    ----------
    replayed : bool
        The request was answered before under the same key; `response` is that answer.
    response : object
        JSON, as it was stored; None while there is none.
    """

    def __init__(self, earlier: Any) -> None:
        self.replayed = earlier is not None
        self.response = earlier

    def store(self, response: ResponseT) -> ResponseT:
        """Set the response that `idempotent` stores when its block ends without an error. Returns it."""
        self.response = response
        return response


@contextmanager
def idempotent(
    connection: sa.Connection, agency_id: str, key: IdempotencyKey | None, now: datetime, ttl: timedelta
) -> Iterator[Answer]:
    """Answer a request once, in the write transaction that makes the answer true.

    The block looks at `Answer.replayed` first, changes nothing if it is set, and otherwise passes its response to
    `Answer.store`. A block that stores no response, or raises an error, leaves the key unused. Without a key every
    request is a new one.

    Raises
    ------
    IdempotencyConflict
        The key was used for another request.
    """
    answer = Answer(find_response(connection, agency_id, key, now))
    yield answer
    if key is not None and not answer.replayed and answer.response is not None:
        agencies.add_response(
            connection,
            agency_id,
            key.holder_id,
            key.key,
            request_sha256=key.request_sha256,
            response=answer.response,
            now=now,
            expires_at=now + ttl,
        )


@contextmanager
def write_once(
    database: Database,
    agency_id: str,
    key: IdempotencyKey | None,
    now: datetime,
    ttl: timedelta,
    *,
    long: bool = False,
) -> Iterator[tuple[sa.Connection, Answer]]:
    """A write transaction that is as `idempotent` within."""
    with database.write(long=long) as connection, idempotent(connection, agency_id, key, now, ttl) as answer:
        yield connection, answer


def find_earlier(database: Database, agency_id: str, key: IdempotencyKey | None, now: datetime) -> Any:
    """The response that this request got before, or None: asked before work that a repetition can do without.

    Raises
    ------
    IdempotencyConflict
        The key was used for another request.
    """
    if key is None:
        return None
    with database.read() as connection:
        return find_response(connection, agency_id, key, now)


def find_response(connection: sa.Connection, agency_id: str, key: IdempotencyKey | None, now: datetime) -> Any:
    """As `find_earlier`, in a transaction that does more."""
    if key is None:
        return None
    answer = agencies.find_response(connection, agency_id, key.holder_id, key.key, now)
    if answer is None:
        return None
    if answer.request_sha256 != key.request_sha256:
        raise IdempotencyConflict(
            "this Idempotency-Key was used for a different request",
            field="Idempotency-Key",
            limit="one request a key",
            cure="use a new key for a new request",
        )
    return answer.response
