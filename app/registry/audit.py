"""The audit log: each agency's changes as a chain of entries, each with the hash of the one before.

An entry stands for one operation. It counts the versions of markers that were written and covers them by a digest over
their hashes, so that one entry is enough for an import of a million. `check_history` finds what was changed since.

Writes come one after another on both databases (decision 0002), so nobody else appends to a chain meanwhile.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import groupby
from operator import ge, itemgetter
from typing import Any, NamedTuple

import orjson
import sqlalchemy as sa
from pydantic import JsonValue

from app.registry.bulk_load import Columns, JsonTexts
from app.registry.column_types import ID, UtcTime, fetch_all, find_one, metadata, select_rows
from app.registry.conditions import is_graded, regraded
from app.registry.marker_rows import PUBLIC, marker_versions, markers

# what changed an agency's part of the registry: a chain, each entry with the hash of the one before (audit.py)
audit_log = sa.Table(
    "audit_log",
    metadata,
    sa.Column("agency_id", ID, sa.ForeignKey("agencies.id"), primary_key=True),
    sa.Column("number", sa.BigInteger, primary_key=True, autoincrement=False),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("who", sa.String(200), nullable=False),
    sa.Column("key_id", sa.String(200)),
    sa.Column("action", sa.String(40), nullable=False),
    sa.Column("subject", sa.String(200)),
    sa.Column("detail", sa.JSON(none_as_null=True)),
    sa.Column("versions", sa.BigInteger, nullable=False),
    sa.Column("digest", sa.String(64), nullable=False),
    sa.Column("previous_hash", sa.String(64), nullable=False),
    sa.Column("hash", sa.String(64), nullable=False),
)

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
        self, marker_id: str, version: int, marker: Mapping[str, object], *, kind: str, why: str | None
    ) -> dict[str, object]:
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
    marker: orjson.Fragment | Mapping[str, object],
) -> str:
    """Hash of a version: SHA-256 of these values as a JSON array with sorted keys (RFC 8259, no spaces)."""
    values = (agency_id, marker_id, version, at.astimezone(UTC), who, why, kind, marker)
    return content_sha256(values)


def content_sha256(content: object) -> str:
    """SHA-256 of a value as JSON with sorted keys."""
    return hashlib.sha256(orjson.dumps(content, option=orjson.OPT_SORT_KEYS)).hexdigest()


def entry_hash(entry: Mapping[str, object] | sa.RowMapping) -> str:
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
    detail: Mapping[str, object] | None = None,
) -> Iterator[AuditEntry]:
    """Append an entry to the agency's chain when the block ends; versions written in the block belong to it.

    Parameters
    ----------
    connection : Connection
        Of a write transaction. Blocks do not nest.
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
    detail: Mapping[str, object] | None = None,
) -> None:
    """Append an entry for a change that writes no versions of markers; parameters as `recording`."""
    with recording(connection, agency_id, author, action, now=now, subject=subject, detail=detail):
        pass


def add_versions(connection: sa.Connection, versions: list[dict[str, object]]) -> None:
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
    """Which entries of a log; what is None is not filtered by."""

    # `who`, `subject`: exactly
    who: str | None = None
    action: str | None = None  # exactly, or all that begin so, with a ``*`` at the end
    subject: str | None = None
    # `since`, `until`: at this time or later; before this time
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


# === What was changed behind the registry's back: every hash of an agency's history computed again.
#
# All walks stream: an agency of a million markers needs no more memory than one of ten. Rows are taken as tuples, and
# the JSON of a version as the text that was hashed when it was written; it is parsed only where the hash of the text
# differs. Only narrow columns are sorted: a sort of whole versions takes longer than all hashes.


_PAGE = 5_000  # rows of a walk in memory at the same time; a few megabytes
_NO_VERSIONS = hashlib.sha256().hexdigest()


@dataclass(frozen=True, slots=True)
class AuditFault:
    """Something that is not as it was written: where, and what is wrong."""

    where: str
    what: str


@dataclass(slots=True)
class ChainReport:
    """What a check went through; complete when its faults are exhausted."""

    since: int = 0  # number of the entry up to which an earlier check is relied on; 0 for a full check
    # `entries`, `versions`: how many there are
    entries: int = 0
    versions: int = 0
    head: tuple[int, str] | None = None  # number and hash of the last entry
    watch: Callable[[], None] | None = None
    """Called from time to time."""

    def count(self, entries: int = 0, versions: int = 0) -> None:
        """Count what was gone through."""
        self.entries += entries
        self.versions += versions
        if self.watch is not None and (self.entries + self.versions) % _PAGE == 0:
            self.watch()


def check_history(
    connection: sa.Connection,
    agency_id: str,
    report: ChainReport,
    expected_head: tuple[int, str] | None = None,
    verified_head: tuple[int, str] | None = None,
) -> Iterator[AuditFault]:
    """Faults of an agency's audit log, of its markers' versions, and of markers that differ from their last version.

    Parameters
    ----------
    connection : Connection
        Of a read transaction.
    report : ChainReport
        Filled on the way.
    expected_head : tuple of int and str, optional
        Number and hash of an entry as they were noted outside the database. Without it, entries and versions that were
        cut off the end together leave no trace.
    verified_head : tuple of int and str, optional
        Number and hash of an entry at which an earlier check ended without faults. Only what was written after it is
        checked, and that this entry is still there; changes of what is older are not noticed.
    """
    _plan_for_all_rows(connection)
    connection = connection.execution_options(stream_results=True, yield_per=_PAGE)
    if verified_head is not None:
        report.since, report.head = verified_head[0], verified_head
    yield from _check_log(connection, agency_id, report, expected_head)
    yield from _check_versions(connection, agency_id, report)
    yield from _check_numbers(connection, agency_id, report.since)
    yield from _check_newest(connection, agency_id, report.since)
    yield from _check_lost(connection, agency_id)


def _plan_for_all_rows(connection: sa.Connection) -> None:
    """Let PostgreSQL plan for reading all rows of a cursor, not for the first tenth, and sort in memory."""
    if connection.dialect.name == "postgresql":
        settings = {"cursor_tuple_fraction": "1.0", "work_mem": "64MB"}
        connection.execute(sa.select(*(sa.func.set_config(*setting, True) for setting in settings.items()))).all()


# --- the log ------------------------------------------------------------------------------------------------------


def _check_log(
    connection: sa.Connection, agency_id: str, report: ChainReport, expected_head: tuple[int, str] | None
) -> Iterator[AuditFault]:
    number, previous = report.head or (0, NO_ENTRY)
    if number:
        yield from _check_verified(connection, agency_id, number, previous)
    own = (audit_log.c.agency_id == agency_id, audit_log.c.number > number)
    query = select_rows(EntryRow, audit_log).where(*own).order_by(audit_log.c.number)
    covered = _covered(connection, agency_id, number)
    group = next(covered, None)
    for row in connection.execute(query):
        entry = EntryRow._make(row)
        where = f"entry {entry.number}"
        if entry.number != number + 1:
            yield AuditFault(_span("entry", "entries", number + 1, entry.number - 1), "missing")
        elif entry.previous_hash != previous:
            yield AuditFault(
                where, "does not name the hash of the entry before it: one of the two was replaced or moved"
            )
        if content_sha256(entry[:-1]) != entry.hash:
            yield AuditFault(where, "changed: its hash does not match its content")
        while group is not None and group.number < entry.number:
            yield _uncovered(group)
            group = next(covered, None)
        if group is not None and group.number == entry.number:
            yield from _compare(entry, group.count, group.digest)
            group = next(covered, None)
        else:
            yield from _compare(entry, 0, _NO_VERSIONS)
        if expected_head is not None and entry.number == expected_head[0] and entry.hash != expected_head[1]:
            yield AuditFault(where, "its hash is not the one that was expected: the history up to it was rewritten")
        number, previous = entry.number, entry.hash
        report.count(entries=1)
        report.head = (number, previous)
    while group is not None:
        yield _uncovered(group)
        group = next(covered, None)
    if expected_head is not None and number < expected_head[0]:
        yield AuditFault(f"entry {expected_head[0]}", "expected, but the log ends before it: its end was cut off")


def _check_verified(connection: sa.Connection, agency_id: str, number: int, expected_hash: str) -> Iterator[AuditFault]:
    """Whether the entry at which an earlier check ended is there as it was."""
    own = (audit_log.c.agency_id == agency_id, audit_log.c.number == number)
    found = connection.execute(select_rows(EntryRow, audit_log).where(*own)).one_or_none()
    if found is None:
        yield AuditFault(f"entry {number}", "missing, and an earlier check ended with it")
    elif content_sha256(tuple(found)[:-1]) != expected_hash:
        yield AuditFault(f"entry {number}", "is not the one with which an earlier check ended: check the whole history")


@dataclass(slots=True)
class _Group:
    """The versions that name one entry."""

    number: int
    count: int = 0
    digest: str = ""
    first: str = ""


def _covered(connection: sa.Connection, agency_id: str, since: int) -> Iterator[_Group]:
    """Versions grouped by the entry that they name, each group with its digest."""
    v = marker_versions.c
    query = (
        sa.select(v.audit_number, v.marker_id, v.version, v.sha256)
        .where(*_written_after(agency_id, since))
        .order_by(v.audit_number, v.marker_id, v.version)
    )
    for number, rows in groupby(connection.execute(query), key=itemgetter(0)):
        group, hashes = _Group(number), hashlib.sha256()
        for _, marker_id, version, sha256 in rows:
            group.first = group.first or f"version {version} of marker {marker_id}"
            group.count += 1
            hashes.update(sha256.encode())
        group.digest = hashes.hexdigest()
        yield group


def _written_after(agency_id: str, since: int) -> tuple[sa.ColumnElement[bool], ...]:
    """The agency's versions that name an entry after one."""
    v = marker_versions.c
    return (v.agency_id == agency_id, v.audit_number > since) if since else (v.agency_id == agency_id,)


def _compare(entry: EntryRow, count: int, digest: str) -> Iterator[AuditFault]:
    if count != entry.versions:
        what = f"wrote {entry.versions} versions of markers, {count} are there"
        yield AuditFault(f"entry {entry.number}", f"{what}: some were removed, added or moved")
    elif digest != entry.digest:
        yield AuditFault(f"entry {entry.number}", "the versions of markers that it wrote are not those that are there")


def _uncovered(group: _Group) -> AuditFault:
    more = f" and {group.count - 1} more" if group.count > 1 else ""
    return AuditFault(f"{group.first}{more}", f"names entry {group.number}, which is missing")


# --- versions -----------------------------------------------------------------------------------------------------


class _Version(NamedTuple):
    """A version as it was hashed, its marker as the text of JSON."""

    agency_id: str
    marker_id: str
    version: int
    at: datetime
    who: str
    why: str | None
    kind: str
    text: str
    sha256: str

    @property
    def is_as_written(self) -> bool:
        """Whether its hash is the one of its content."""
        start = orjson.dumps(self[:7])
        if hashlib.sha256(b"%b,%b]" % (start[:-1], self.text.encode())).hexdigest() == self.sha256:
            return True
        try:
            marker = orjson.loads(self.text)
        except orjson.JSONDecodeError:
            return False
        return version_sha256(*self[:7], marker) == self.sha256  # the same JSON, written in another way


_V = marker_versions.c
_VERSION = (*(_V[name] for name in _Version._fields[:7]), sa.cast(_V.marker, sa.Text).label("text"), _V.sha256)


def _check_versions(connection: sa.Connection, agency_id: str, report: ChainReport) -> Iterator[AuditFault]:
    """Each version against its hash."""
    for row in connection.execute(sa.select(*_VERSION).where(*_written_after(agency_id, report.since))):
        version = _Version._make(row)
        report.count(versions=1)
        if not version.is_as_written:
            where = f"version {version.version} of marker {version.marker_id}"
            yield AuditFault(where, "changed: its hash does not match its content")


def _check_numbers(connection: sa.Connection, agency_id: str, since: int) -> Iterator[AuditFault]:
    """Whether each version follows on the one before it."""
    before = marker_versions.alias("before")
    last = (
        sa.select(sa.func.max(before.c.version))
        .where(before.c.marker_id == _V.marker_id, before.c.version < _V.version, before.c.agency_id == _V.agency_id)
        .scalar_subquery()
    )
    is_next = sa.and_(
        before.c.marker_id == _V.marker_id, before.c.version == _V.version - 1, before.c.agency_id == _V.agency_id
    )
    query = (
        sa.select(_V.marker_id, _V.version, sa.func.coalesce(last, 0))
        .where(*_written_after(agency_id, since), _V.version > 1, ~sa.exists().where(is_next))
        .order_by(_V.marker_id, _V.version)
    )
    for marker_id, version, last_before in connection.execute(query):
        yield AuditFault(
            f"{_span('version', 'versions', last_before + 1, version - 1)} of marker {marker_id}", "missing"
        )


def _check_newest(connection: sa.Connection, agency_id: str, since: int) -> Iterator[AuditFault]:
    """Each marker as it is against its newest version."""
    query = (
        sa.select(*_VERSION, *PUBLIC)
        .join(markers, sa.and_(markers.c.id == _V.marker_id, markers.c.version == _V.version))
        .where(*_written_after(agency_id, since))
    )
    names, count = [str(column.name) for column in PUBLIC], len(_Version._fields)
    for row in connection.execute(query):
        now = dict(zip(names, row[count:], strict=True))
        version = _Version._make(row[:count])
        if orjson.dumps(now, option=orjson.OPT_SORT_KEYS).decode() == version.text or not version.is_as_written:
            continue
        if differing := _differing(now, orjson.loads(version.text)):
            what = f"differs from its version {version.version}: {', '.join(differing)}"
            yield AuditFault(f"marker {version.marker_id}", what)


def _differing(now: dict[str, object], marker: dict[str, object]) -> list[str]:
    """Columns of the marker that its newest version has otherwise; a version knows the columns of its time."""
    if "localization_grade" in marker and not is_graded(marker):
        marker = {**marker, **regraded(marker)}  # a migration did the same
    known = {name: value for name, value in marker.items() if name in now}
    now = orjson.loads(orjson.dumps({name: now[name] for name in known}))
    return [] if now == known else [name for name in known if now[name] != known[name]]


def _check_lost(connection: sa.Connection, agency_id: str) -> Iterator[AuditFault]:
    """Markers whose newest version is not there."""
    v = marker_versions.c
    same = sa.and_(v.marker_id == markers.c.id, v.version == markers.c.version, v.agency_id == markers.c.agency_id)
    query = (
        sa.select(markers.c.id, markers.c.version)
        .outerjoin(marker_versions, same)
        .where(markers.c.agency_id == agency_id, v.marker_id.is_(None))
        .order_by(markers.c.id)
    )
    for marker_id, version in connection.execute(query):
        yield AuditFault(f"version {version} of marker {marker_id}", "missing, and it is the newest")


def _span(one: str, many: str, first: int, last: int) -> str:
    return f"{one} {first}" if first >= last else f"{many} {first} to {last}"
