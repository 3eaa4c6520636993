"""What was changed behind the registry's back: every hash of an agency's history computed again.

All walks stream: an agency of a million markers needs no more memory than one of ten. Rows are taken as tuples, and the
JSON of a version as the text that was hashed when it was written; it is parsed only where the hash of the text differs.
Only narrow columns are sorted: a sort of whole versions takes longer than all hashes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from itertools import groupby
from operator import itemgetter
from typing import Any, NamedTuple

import orjson
import sqlalchemy as sa

from app.registry.audit import NO_ENTRY, EntryRow, content_sha256, version_sha256
from app.registry.grade_columns import is_graded, regraded
from app.registry.marker_rows import PUBLIC
from app.registry.rows import select_rows
from app.registry.tables import audit_log, marker_versions, markers

_PAGE = 5_000  # rows of a walk in memory at the same time; source: by hand, a few megabytes
_NO_VERSIONS = hashlib.sha256().hexdigest()


class Fault(NamedTuple):
    """Something that is not as it was written: where, and what is wrong."""

    where: str
    what: str


@dataclass(slots=True)
class ChainReport:
    """What a check went through; complete when its faults are exhausted.

    Attributes
    ----------
    since : int
        Number of the entry up to which an earlier check is relied on; 0 for a full check.
    entries, versions : int
        How many there are.
    head : tuple of int and str, optional
        Number and hash of the last entry.
    """

    since: int = 0
    entries: int = 0
    versions: int = 0
    head: tuple[int, str] | None = None
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
) -> Iterator[Fault]:
    """Faults of an agency's audit log, of its markers' versions, and of markers that differ from their last version.

    Parameters
    ----------
    connection : Connection
        Of a read transaction.
    agency_id : str
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
) -> Iterator[Fault]:
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
            yield Fault(_span("entry", "entries", number + 1, entry.number - 1), "missing")
        elif entry.previous_hash != previous:
            yield Fault(where, "does not name the hash of the entry before it: one of the two was replaced or moved")
        if content_sha256(entry[:-1]) != entry.hash:
            yield Fault(where, "changed: its hash does not match its content")
        while group is not None and group.number < entry.number:
            yield _uncovered(group)
            group = next(covered, None)
        if group is not None and group.number == entry.number:
            yield from _compare(entry, group.count, group.digest)
            group = next(covered, None)
        else:
            yield from _compare(entry, 0, _NO_VERSIONS)
        if expected_head is not None and entry.number == expected_head[0] and entry.hash != expected_head[1]:
            yield Fault(where, "its hash is not the one that was expected: the history up to it was written anew")
        number, previous = entry.number, entry.hash
        report.count(entries=1)
        report.head = (number, previous)
    while group is not None:
        yield _uncovered(group)
        group = next(covered, None)
    if expected_head is not None and number < expected_head[0]:
        yield Fault(f"entry {expected_head[0]}", "expected, but the log ends before it: its end was cut off")


def _check_verified(connection: sa.Connection, agency_id: str, number: int, expected_hash: str) -> Iterator[Fault]:
    """Whether the entry at which an earlier check ended is there as it was."""
    own = (audit_log.c.agency_id == agency_id, audit_log.c.number == number)
    found = connection.execute(select_rows(EntryRow, audit_log).where(*own)).one_or_none()
    if found is None:
        yield Fault(f"entry {number}", "missing, and an earlier check ended with it")
    elif content_sha256(tuple(found)[:-1]) != expected_hash:
        yield Fault(f"entry {number}", "is not the one with which an earlier check ended: check the whole history")


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


def _compare(entry: EntryRow, count: int, digest: str) -> Iterator[Fault]:
    if count != entry.versions:
        what = f"wrote {entry.versions} versions of markers, {count} are there"
        yield Fault(f"entry {entry.number}", f"{what}: some were removed, added or moved")
    elif digest != entry.digest:
        yield Fault(f"entry {entry.number}", "the versions of markers that it wrote are not those that are there")


def _uncovered(group: _Group) -> Fault:
    more = f" and {group.count - 1} more" if group.count > 1 else ""
    return Fault(f"{group.first}{more}", f"names entry {group.number}, which is missing")


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
_VERSION = (
    *(_V[name] for name in _Version._fields[:7]), sa.cast(_V.marker, sa.Text).label("text"), _V.sha256
)  # fmt: skip


def _check_versions(connection: sa.Connection, agency_id: str, report: ChainReport) -> Iterator[Fault]:
    """Each version against its hash."""
    for row in connection.execute(sa.select(*_VERSION).where(*_written_after(agency_id, report.since))):
        version = _Version._make(row)
        report.count(versions=1)
        if not version.is_as_written:
            where = f"version {version.version} of marker {version.marker_id}"
            yield Fault(where, "changed: its hash does not match its content")


def _check_numbers(connection: sa.Connection, agency_id: str, since: int) -> Iterator[Fault]:
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
        yield Fault(f"{_span('version', 'versions', last_before + 1, version - 1)} of marker {marker_id}", "missing")


def _check_newest(connection: sa.Connection, agency_id: str, since: int) -> Iterator[Fault]:
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
            yield Fault(f"marker {version.marker_id}", what)


def _differing(now: dict[str, Any], marker: dict[str, Any]) -> list[str]:
    """Columns of the marker that its newest version has otherwise; a version knows the columns of its time."""
    if "localization_grade" in marker and not is_graded(marker):
        marker = {**marker, **regraded(marker)}  # a migration did the same
    known = {name: value for name, value in marker.items() if name in now}
    now = orjson.loads(orjson.dumps({name: now[name] for name in known}))
    return [] if now == known else [name for name in known if now[name] != known[name]]


def _check_lost(connection: sa.Connection, agency_id: str) -> Iterator[Fault]:
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
        yield Fault(f"version {version} of marker {marker_id}", "missing, and it is the newest")


def _span(one: str, many: str, first: int, last: int) -> str:
    return f"{one} {first}" if first >= last else f"{many} {first} to {last}"
