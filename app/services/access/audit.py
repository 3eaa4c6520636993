"""The audit log: who appends to it, and how an agency reads it; what the API returns about it and about keys."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from datetime import datetime
from types import MappingProxyType
from typing import Annotated

import sqlalchemy as sa
from pydantic import Field, JsonValue
from typing_extensions import TypedDict

from app.errors import InvalidParameter, NotFound
from app.registry import agencies
from app.registry import audit as store
from app.registry.audit import AuditFault, Author, ChainReport, EntryFilter, check_history
from app.registry.database import Database
from app.services.access.access import Caller, Scope
from app.services.documents import document_of

# === What the API returns about keys and the audit log.


MAX_FAULTS = 1000
"""Faults that the result of a verification lists; all are counted."""


class KeyDocument(TypedDict):
    """A key, without its text. Keys that replace one another have the same `holder_id`."""

    id: str
    holder_id: str
    label: str
    scope: Scope
    prefix: Annotated[str, Field(description="The first characters of the key.")]
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None
    last_used_at: Annotated[datetime | None, Field(description="To the minute.")]
    valid: bool


class NewKeyDocument(KeyDocument):
    """A key with its text, which is shown only in this response."""

    key: str


class KeyPage(TypedDict):
    """A page of keys; the Link header leads to the next one."""

    items: list[KeyDocument]


class VerificationResult(TypedDict):
    """What was gone through, and what is not as it was written."""

    entries: Annotated[int, Field(description="Entries of the log.")]
    versions: Annotated[int, Field(description="Versions of markers.")]
    head: Annotated[str | None, Field(description="NUMBER:HASH of the last entry; keep it elsewhere.")]
    fault_count: int
    faults: Annotated[list[AuditFault], Field(description=f"The first {MAX_FAULTS}.")]


class AgencyDocument(TypedDict):
    """An agency."""

    id: str
    name: str
    created_at: datetime


class NewAgencyDocument(AgencyDocument):
    """An agency with its first key. The key's text is shown only in this response, and where the request is repeated
    with its Idempotency-Key."""

    admin_key: NewKeyDocument


class AgencyPage(TypedDict):
    """A page of agencies, oldest first; the Link header leads to the next one."""

    items: list[AgencyDocument]


class AuditHead(TypedDict):
    """The newest entry of a log. Compare it with a copy that is stored elsewhere: a log that was cut differs."""

    number: int
    hash: str


class AuditEntryDocument(TypedDict):
    """One operation, with the hash of the entry before it."""

    number: int
    at: datetime
    who: str
    key_id: str | None
    action: str
    subject: str | None
    detail: dict[str, JsonValue] | None
    versions: int
    digest: str
    previous_hash: str
    hash: str


class AuditPage(TypedDict):
    """A page of the log, oldest first, and its head."""

    items: list[AuditEntryDocument]
    head: AuditHead | None


# === The audit log.


_NUMBER = re.compile(r"[1-9][0-9]{0,14}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


def author_of(caller: Caller) -> Author:
    """Whom the history names for what a caller does."""
    return Author(caller.label, caller.key_id)


def log_change(
    connection: sa.Connection,
    caller: Caller,
    action: str,
    *,
    now: datetime,
    subject: str | None = None,
    document: Mapping[str, object] | None = None,
    **detail: object,
) -> None:
    """Append an entry for a change that writes no versions of markers.

    Parameters
    ----------
    connection : Connection
        Of the transaction that makes the change.
    action, subject : str
        What was done, and the id or name of what it was done to.
    document : mapping, optional
        What it is now; its hash goes into the log.
    **detail
        Further details; never a secret.
    """
    if document is not None:
        detail["sha256"] = store.content_sha256(document)
    store.record(connection, caller.agency_id, author_of(caller), action, now=now, subject=subject, detail=detail)


class AuditLog:
    """Reading an agency's chain of changes."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def page(
        self,
        caller: Caller,
        *,
        after: int = 0,
        before: int | None = None,
        limit: int = 100,
        wanted: EntryFilter | None = None,
    ) -> tuple[AuditPage, int | None]:
        """A page of entries with the log's head: oldest first, or newest first where `before` is given.

        Returns
        -------
        page : AuditPage
        last : int or None
            Number to continue after, or before; None if there are no more.
        """
        with self._database.read() as connection:
            rows = store.list_entries(
                connection, caller.agency_id, after=after, before=before, limit=limit + 1, wanted=wanted
            )
            head = store.find_head(connection, caller.agency_id)
        page = AuditPage(
            items=[document_of(AuditEntryDocument, row) for row in rows[:limit]],
            head=document_of(AuditHead, head) if head is not None else None,
        )
        return page, rows[limit - 1].number if len(rows) > limit else None

    def verify(
        self,
        agency: str | None = None,
        expected_head: tuple[int, str] | None = None,
        verified_heads: Mapping[str, tuple[int, str]] = MappingProxyType({}),
    ) -> Iterator[tuple[str, ChainReport, Iterator[AuditFault]]]:
        """For each agency, or the one of this name: its name, what was gone through, and the faults as they are found.

        Parameters
        ----------
        expected_head : tuple of int and str, optional
            Number and hash of an entry that the log must contain.
        verified_heads : mapping of str to (int, str), optional
            By the name of the agency, the entry at which an earlier check ended: only what follows it is checked.

        Raises
        ------
        NotFound
            There is no agency of this name.
        """
        with self._database.read(long=True) as connection:
            found = [row for row in agencies.list_agencies(connection) if agency in (None, row.name)]
            if agency is not None and not found:
                raise NotFound(f"there is no agency {agency[:80]!r}", field="agency")
            for row in found:
                report = ChainReport()
                verified = verified_heads.get(row.name)
                yield row.name, report, check_history(connection, row.id, report, expected_head, verified)


def parse_head(text: str) -> tuple[int, str]:
    """An entry's number and hash, written NUMBER:HASH.

    Raises
    ------
    InvalidParameter
        It is written otherwise.
    """
    number, _, digest = text.partition(":")
    if not (_NUMBER.fullmatch(number) and _SHA256.fullmatch(digest)):
        raise InvalidParameter(
            f"{text[:90]!r} is no head of a log", field="expect-head", limit="NUMBER:HASH", cure="as verify prints it"
        )
    return int(number), digest
