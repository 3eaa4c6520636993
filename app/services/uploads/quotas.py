"""Quotas: how much a key and its agency may store, and how many uploads may be in progress; their documents."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Literal, NotRequired

import sqlalchemy as sa
from typing_extensions import TypedDict

from app.errors import QuotaExceeded, UploadTooLarge
from app.registry import uploads as store
from app.registry.database import Database
from app.registry.uploads import UploadRow
from app.services.access.access import Caller
from app.services.documents import ErrorDocument

# === Uploads as clients see them.


UploadState = Literal["open", "done", "refused", "expired"]


class UploadDocument(TypedDict):
    """An upload that arrives in parts. `decode_id` is that of the decode that it became.

    If the parts go to S3, the response to its start has `part_urls`: each part but the last has `part_bytes`, and is
    sent by PUT.
    """

    id: str
    state: UploadState
    method: Literal["tus", "s3-parts"]
    length: int
    received: int
    file_name: str
    created_at: datetime
    expires_at: datetime
    decode_id: NotRequired[str]
    error: NotRequired[ErrorDocument]
    part_bytes: NotRequired[int]
    part_urls: NotRequired[list[str]]


def upload_document(row: UploadRow) -> UploadDocument:
    """An upload as clients see it."""
    document: UploadDocument = {
        "id": row.id,
        "state": row.state,  # type: ignore[typeddict-item]
        "method": row.method,  # type: ignore[typeddict-item]
        "length": row.length,
        "received": row.received,
        "file_name": row.declared["file_name"],
        "created_at": row.created_at,
        "expires_at": row.expires_at,
    }
    if row.decode_id is not None:
        document["decode_id"] = row.decode_id
    if row.error is not None:
        document["error"] = row.error  # type: ignore[typeddict-item]
    return document


# === Quotas.


_VALID_S = 5.0
"""How long sums are remembered for the check before a body. [s] `count` checks exactly."""
_MAX_REMEMBERED = 10_000
_CURE = "delete open uploads with DELETE /v1/uploads/{id}, or ask the operator for a larger quota"


@dataclass(frozen=True, slots=True)
class UploadRules:
    """Limits of one upload."""

    max_bytes: int = 4 * 1024**3  # [byte] largest file
    expiry: timedelta = timedelta(hours=24)  # time from the last part until an upload that is not complete is deleted


@dataclass(frozen=True, slots=True)
class QuotaRules:
    """Limits; 0 is none."""

    # `key_bytes`, `agency_bytes`: [byte] most bytes of stored uploads, of those in progress too
    key_bytes: int = 0
    agency_bytes: int = 0
    # `key_open`, `agency_open`: most uploads in progress
    key_open: int = 0
    agency_open: int = 0


class Quotas:
    """Checks of quotas."""

    def __init__(self, database: Database, rules: QuotaRules) -> None:
        self._database, self._rules = database, rules
        self._lock = threading.Lock()
        self._remembered: dict[tuple[str, str], tuple[float, int, int]] = {}

    def is_known(self, caller: Caller) -> bool:
        """Whether `check` needs no database."""
        if not (self._rules.key_bytes or self._rules.agency_bytes):
            return True
        found = self._remembered.get((caller.agency_id, caller.key_id))
        return found is not None and found[0] > time.monotonic()

    def check(self, caller: Caller, size: int) -> None:
        """Refuse an upload of some size before it is received.

        Raises
        ------
        QuotaExceeded
        """
        if not (self._rules.key_bytes or self._rules.agency_bytes):
            return
        of_key, of_agency = self._sums(caller)
        self._compare(of_key + size, of_agency + size)

    def check_open(self, connection: sa.Connection, caller: Caller, size: int) -> None:
        """Refuse a further upload in parts, in the transaction that stores it.

        Raises
        ------
        QuotaExceeded
        """
        rules = self._rules
        of_key = store.count_open(connection, caller.agency_id, caller.key_id)
        of_agency = store.count_open(connection, caller.agency_id)
        for whose, found, limit in (("key", of_key, rules.key_open), ("agency", of_agency, rules.agency_open)):
            if limit and found.number >= limit:
                raise QuotaExceeded(
                    f"the {whose} has {found.number} uploads in progress",
                    limit=f"{limit} uploads",
                    cure="finish them or delete them with DELETE /v1/uploads/{id}",
                    retry_after_s=60,
                )
        stored = store.sum_stored(connection, caller.agency_id, caller.key_id) + of_key.bytes
        self._compare(stored + size, store.sum_stored(connection, caller.agency_id) + of_agency.bytes + size)

    def count(self, connection: sa.Connection, caller: Caller, size: int) -> None:
        """Count what is stored, in the transaction that stores it.

        Raises
        ------
        QuotaExceeded
            It is too much; the transaction is to be rolled back.
        """
        store.add_stored(connection, caller.agency_id, caller.key_id, size)
        rules = self._rules
        if rules.key_bytes or rules.agency_bytes:
            of_key = store.sum_stored(connection, caller.agency_id, caller.key_id)
            self._compare(of_key, store.sum_stored(connection, caller.agency_id))

    def _compare(self, of_key: int, of_agency: int) -> None:
        for whose, found, limit in (
            ("key", of_key, self._rules.key_bytes),
            ("agency", of_agency, self._rules.agency_bytes),
        ):
            if limit and found > limit:
                raise QuotaExceeded(
                    f"the stored uploads of the {whose} would have {found} bytes",
                    limit=f"{limit} bytes",
                    cure=_CURE,
                    retry_after_s=3600,
                )

    def _sums(self, caller: Caller) -> tuple[int, int]:
        """Bytes of the key and of the agency, not older than `_VALID_S`."""
        name, now = (caller.agency_id, caller.key_id), time.monotonic()
        found = self._remembered.get(name)
        if found is not None and found[0] > now:
            return found[1], found[2]
        with self._database.read() as connection:
            of_key = store.sum_stored(connection, caller.agency_id, caller.key_id)
            of_agency = store.sum_stored(connection, caller.agency_id)
        with self._lock:
            if len(self._remembered) >= _MAX_REMEMBERED:
                self._remembered.clear()
            self._remembered[name] = (now + _VALID_S, of_key, of_agency)
        return of_key, of_agency


def check_length(size: int, limit: int) -> None:
    """Refuse a file beyond the limit of uploads in parts.

    Raises
    ------
    UploadTooLarge
    """
    if size > limit:
        raise UploadTooLarge(
            f"the file has {size} bytes", field="Upload-Length", limit=f"{limit} bytes", cure="cut the recording"
        )
