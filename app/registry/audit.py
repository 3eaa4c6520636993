"""The audit log: each agency's changes as a chain of entries, each with the hash of the one before.

An entry stands for one operation. It counts the versions of markers that were written and covers them by a digest over
their hashes, so that one entry is enough for an import of a million. `audit_check` finds what was changed since.

Writes come one after another on both databases (decision 0002), so nobody else appends to a chain meanwhile.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from operator import ge
from typing import Any, NamedTuple

import orjson
import sqlalchemy as sa
from pydantic import JsonValue

from app.registry.columns import Columns, JsonTexts
from app.registry.rows import fetch_all, find_one, select_rows
from app.registry.tables import audit_log, marker_versions

NO_ENTRY = "0" * 64
"""What the first entry of a chain names as the hash before it."""


class EntryRow(NamedTuple):
    """An entry as it is stored."""

    agency_id: str
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


_ENTRIES = select_rows(EntryRow, audit_log)


@dataclass(frozen=True, slots=True)
class Author:
    """Who makes a change: `who` is the label in histories, `key_id` the key that was used."""

    who: str
    key_id: str | None = None


@dataclass(slots=True)
class AuditEntry:
    """An entry that is being written: versions of markers are added to it in the order of their ids and numbers."""

    agency_id: str
    number: int
    at: datetime
    who: str
    versions: int = 0
    _last: tuple[str, int] = ("", 0)
    _hashes: Any = field(default_factory=hashlib.sha256)

    def version(
        self, marker_id: str, version: int, marker: Mapping[str, Any], *, kind: str, why: str | None
    ) -> dict[str, Any]:
        """A version of a marker as a row of `marker_versions`, counted and covered by this entry.

        Raises
        ------
        ValueError
            It does not come after the version before it: the digest could not be computed again.
        """
        if (marker_id, version) <= self._last:
            raise ValueError("versions of one entry are in the order of their markers' ids")
        self._last = (marker_id, version)
        text = orjson.Fragment(orjson.dumps(marker, option=orjson.OPT_SORT_KEYS))
        sha256 = version_sha256(self.agency_id, marker_id, version, self.at, self.who, why, kind, text)
        self.versions += 1
        self._hashes.update(sha256.encode())
        return {
            "marker_id": marker_id,
            "version": version,
            "agency_id": self.agency_id,
            "at": self.at,
            "who": self.who,
            "why": why,
            "kind": kind,
            "audit_number": self.number,
            "sha256": sha256,
            "marker": text,
        }

    def first_versions(
        self, ids: Sequence[str], markers: JsonTexts, *, kinds: Sequence[str], why: str | None
    ) -> Columns:
        """The first versions of many markers as columns of `marker_versions`, counted and covered by this entry.

        Parameters
        ----------
        ids : sequence of str
            UUIDs, rising.
        markers : JsonTexts
            The markers.
        kinds : sequence of str
            Kind of each version.

        Raises
        ------
        ValueError
            They do not come after the version before them.
        """
        if any(map(ge, [self._last[0], *ids], ids)):
            raise ValueError("versions of one entry are in the order of their markers' ids")
        self._last = (ids[-1], 1)
        before = orjson.dumps([self.agency_id])[:-1].decode()
        after = {
            kind: orjson.dumps([1, self.at.astimezone(UTC), self.who, why, kind])[1:-1].decode() for kind in set(kinds)
        }
        hashes = [
            hashlib.sha256(f'{before},"{marker_id}",{after[kind]},{marker}]'.encode()).hexdigest()
            for marker_id, kind, marker in zip(ids, kinds, markers, strict=True)
        ]
        self.versions += len(ids)
        self._hashes.update("".join(hashes).encode())
        same = {
            "version": 1,
            "agency_id": self.agency_id,
            "at": self.at,
            "who": self.who,
            "why": why,
            "audit_number": self.number,
        }
        return Columns.of(len(ids), same, {"marker_id": ids, "kind": kinds, "sha256": hashes, "marker": markers})

    @property
    def digest(self) -> str:
        """SHA-256 over the hashes of the versions, in the order of their markers' ids and numbers."""
        return str(self._hashes.hexdigest())


def version_sha256(
    agency_id: str,
    marker_id: str,
    version: int,
    at: datetime,
    who: str,
    why: str | None,
    kind: str,
    marker: orjson.Fragment | Mapping[str, Any],
) -> str:
    """Hash of a version: SHA-256 of these values as a JSON array with sorted keys (RFC 8259, no spaces)."""
    values = (agency_id, marker_id, version, at.astimezone(UTC), who, why, kind, marker)
    return content_sha256(values)


def content_sha256(content: Any) -> str:
    """SHA-256 of a value as JSON with sorted keys."""
    return hashlib.sha256(orjson.dumps(content, option=orjson.OPT_SORT_KEYS)).hexdigest()


def entry_hash(entry: Mapping[str, Any] | sa.RowMapping) -> str:
    """Hash of an entry: SHA-256 of all its other columns as a JSON array, the hash before it among them."""
    values = [entry[column.name] for column in audit_log.c if column.name != "hash"]
    return content_sha256(values)


@contextmanager
def recording(
    connection: sa.Connection,
    agency_id: str,
    author: Author,
    action: str,
    *,
    now: datetime,
    subject: str | None = None,
    detail: Mapping[str, Any] | None = None,
) -> Iterator[AuditEntry]:
    """Append an entry to the agency's chain when the block ends; versions written in the block belong to it.

    Parameters
    ----------
    connection : Connection
        Of a write transaction. Blocks do not nest.
    author : Author
    action : str
        What was done, e.g. ``marker.registered``.
    subject : str, optional
        Id or name of what it was done to.
    detail : mapping, optional
        Further details as JSON; never a secret.
    """
    head = find_head(connection, agency_id)
    number, previous = (head.number + 1, head.hash) if head is not None else (1, NO_ENTRY)
    now = now.astimezone(UTC)
    entry = AuditEntry(agency_id, number, now, author.who)
    yield entry
    row = {
        "agency_id": agency_id,
        "number": number,
        "at": now,
        "who": author.who,
        "key_id": author.key_id,
        "action": action,
        "subject": subject,
        "detail": dict(detail) if detail is not None else None,
        "versions": entry.versions,
        "digest": entry.digest,
        "previous_hash": previous,
    }
    connection.execute(sa.insert(audit_log).values(**row, hash=entry_hash(row)))


def record(
    connection: sa.Connection,
    agency_id: str,
    author: Author,
    action: str,
    *,
    now: datetime,
    subject: str | None = None,
    detail: Mapping[str, Any] | None = None,
) -> None:
    """Append an entry for a change that writes no versions of markers; parameters as `recording`."""
    with recording(connection, agency_id, author, action, now=now, subject=subject, detail=detail):
        pass


def add_versions(connection: sa.Connection, versions: list[dict[str, Any]]) -> None:
    """Store rows that `AuditEntry.version` made."""
    connection.execute(sa.insert(marker_versions), versions)


def find_head(connection: sa.Connection, agency_id: str) -> EntryRow | None:
    """The newest entry of the agency's chain."""
    query = _ENTRIES.where(audit_log.c.agency_id == agency_id).order_by(audit_log.c.number.desc()).limit(1)
    return find_one(connection, query, EntryRow)


def count_history(connection: sa.Connection, agency_id: str) -> int:
    """Number of entries of the agency's chain and of versions of its markers."""
    counts = [
        sa.select(sa.func.count()).select_from(table).where(table.c.agency_id == agency_id).scalar_subquery()
        for table in (audit_log, marker_versions)
    ]
    return int(connection.execute(sa.select(counts[0] + counts[1])).scalar_one())


@dataclass(frozen=True, slots=True)
class EntryFilter:
    """Which entries of a log; what is None is not filtered by.

    Attributes
    ----------
    who, subject : str, optional
        Exactly.
    action : str, optional
        Exactly, or all that begin so, with a ``*`` at the end.
    since, until : datetime, optional
        At this time or later; before this time.
    """

    who: str | None = None
    action: str | None = None
    subject: str | None = None
    since: datetime | None = None
    until: datetime | None = None

    def conditions(self) -> list[sa.ColumnElement[bool]]:
        """The filter in SQL."""
        found: list[sa.ColumnElement[bool]] = []
        if self.who is not None:
            found.append(audit_log.c.who == self.who)
        if self.subject is not None:
            found.append(audit_log.c.subject == self.subject)
        if self.action is not None and self.action.endswith("*"):
            found.append(audit_log.c.action.startswith(self.action[:-1], autoescape=True))
        elif self.action is not None:
            found.append(audit_log.c.action == self.action)
        if self.since is not None:
            found.append(audit_log.c.at >= self.since.astimezone(UTC))
        if self.until is not None:
            found.append(audit_log.c.at < self.until.astimezone(UTC))
        return found


def list_entries(
    connection: sa.Connection,
    agency_id: str,
    *,
    after: int = 0,
    before: int | None = None,
    limit: int = 100,
    wanted: EntryFilter | None = None,
) -> list[EntryRow]:
    """Entries of the agency's chain after a number, oldest first; or those before a number, newest first."""
    query = _ENTRIES.where(audit_log.c.agency_id == agency_id)
    if wanted is not None:
        query = query.where(*wanted.conditions())
    number = audit_log.c.number
    query = (
        query.where(number > after).order_by(number)
        if before is None
        else query.where(number < before).order_by(number.desc())
    )
    return fetch_all(connection, query.limit(limit), EntryRow)
