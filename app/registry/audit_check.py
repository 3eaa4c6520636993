"""What was changed behind the registry's back: every hash of an agency's history computed again.

Both walks stream: an agency of a million markers needs no more memory than one of ten.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import orjson
import sqlalchemy as sa

from app.registry.audit import NO_ENTRY, entry_hash, version_sha256
from app.registry.grade_columns import is_graded, regraded
from app.registry.marker_rows import PUBLIC
from app.registry.tables import audit_log, marker_versions, markers

_PAGE = 1000
_NOW = "now_"


class Fault(NamedTuple):
    """Something that is not as it was written: where, and what is wrong."""

    where: str
    what: str


@dataclass(slots=True)
class ChainReport:
    """What a check went through; complete when its faults are exhausted.

    Attributes
    ----------
    entries, versions : int
        How many there are.
    head : tuple of int and str, optional
        Number and hash of the last entry.
    """

    entries: int = 0
    versions: int = 0
    head: tuple[int, str] | None = None


def check_history(
    connection: sa.Connection, agency_id: str, report: ChainReport, expected_head: tuple[int, str] | None = None
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
    """
    connection = connection.execution_options(stream_results=True, yield_per=_PAGE)
    yield from _check_log(connection, agency_id, report, expected_head)
    yield from _check_versions(connection, agency_id, report)
    yield from _check_lost(connection, agency_id)


def _check_log(
    connection: sa.Connection, agency_id: str, report: ChainReport, expected_head: tuple[int, str] | None
) -> Iterator[Fault]:
    query = sa.select(audit_log).where(audit_log.c.agency_id == agency_id).order_by(audit_log.c.number)
    covered = _covered(connection, agency_id)
    group = next(covered, None)
    number, previous = 0, NO_ENTRY
    for entry in connection.execute(query).mappings():
        where = f"entry {entry['number']}"
        if entry["number"] != number + 1:
            yield Fault(_span("entry", "entries", number + 1, entry["number"] - 1), "missing")
        elif entry["previous_hash"] != previous:
            yield Fault(where, "does not name the hash of the entry before it: one of the two was replaced or moved")
        if entry_hash(entry) != entry["hash"]:
            yield Fault(where, "changed: its hash does not match its content")
        while group is not None and group.number < entry["number"]:
            yield _uncovered(group)
            group = next(covered, None)
        found = group if group is not None and group.number == entry["number"] else _Group(entry["number"])
        yield from _compare(entry, found)
        if group is found:
            group = next(covered, None)
        if expected_head is not None and entry["number"] == expected_head[0] and entry["hash"] != expected_head[1]:
            yield Fault(where, "its hash is not the one that was expected: the history up to it was written anew")
        number, previous = entry["number"], entry["hash"]
        report.entries += 1
        report.head = (number, previous)
    while group is not None:
        yield _uncovered(group)
        group = next(covered, None)
    if expected_head is not None and number < expected_head[0]:
        yield Fault(f"entry {expected_head[0]}", "expected, but the log ends before it: its end was cut off")


@dataclass(slots=True)
class _Group:
    """The versions that name one entry."""

    number: int
    count: int = 0
    digest: str = hashlib.sha256().hexdigest()
    first: str = ""


def _covered(connection: sa.Connection, agency_id: str) -> Iterator[_Group]:
    """Versions grouped by the entry that they name, each group with its digest."""
    v = marker_versions.c
    query = (
        sa.select(v.audit_number, v.marker_id, v.version, v.sha256)
        .where(v.agency_id == agency_id)
        .order_by(v.audit_number, v.marker_id, v.version)
    )
    group: _Group | None = None
    hashes = hashlib.sha256()
    for number, marker_id, version, sha256 in connection.execute(query):
        if group is None or number != group.number:
            if group is not None:
                group.digest = hashes.hexdigest()
                yield group
            group, hashes = _Group(number, first=f"version {version} of marker {marker_id}"), hashlib.sha256()
        group.count += 1
        hashes.update(sha256.encode())
    if group is not None:
        group.digest = hashes.hexdigest()
        yield group


def _compare(entry: sa.RowMapping, found: _Group) -> Iterator[Fault]:
    if found.count != entry["versions"]:
        what = f"wrote {entry['versions']} versions of markers, {found.count} are there"
        yield Fault(f"entry {entry['number']}", f"{what}: some were removed, added or moved")
    elif found.digest != entry["digest"]:
        yield Fault(f"entry {entry['number']}", "the versions of markers that it wrote are not those that are there")


def _uncovered(group: _Group) -> Fault:
    more = f" and {group.count - 1} more" if group.count > 1 else ""
    return Fault(f"{group.first}{more}", f"names entry {group.number}, which is missing")


def _check_versions(connection: sa.Connection, agency_id: str, report: ChainReport) -> Iterator[Fault]:
    """Each version against its hash, the number before it, and the newest against the marker as it is."""
    v = marker_versions
    current = [column.label(_NOW + column.name) for column in PUBLIC]
    query = (
        sa.select(v, *current)
        .outerjoin(markers, sa.and_(markers.c.id == v.c.marker_id, markers.c.version == v.c.version))
        .where(v.c.agency_id == agency_id)
        .order_by(v.c.marker_id, v.c.version)
    )
    marker_id, number = "", 0
    for row in connection.execute(query).mappings():
        number = number if row["marker_id"] == marker_id else 0
        marker_id = row["marker_id"]
        where = f"version {row['version']} of marker {marker_id}"
        if row["version"] != number + 1:
            yield Fault(
                f"{_span('version', 'versions', number + 1, row['version'] - 1)} of marker {marker_id}", "missing"
            )
        number = row["version"]
        report.versions += 1
        if _sha256_of(row) != row["sha256"]:
            yield Fault(where, "changed: its hash does not match its content")
        elif row[f"{_NOW}id"] is not None and (names := _differing(row)):
            yield Fault(f"marker {marker_id}", f"differs from its {where.split(' of ')[0]}: {', '.join(names)}")


def _sha256_of(row: sa.RowMapping) -> str:
    return version_sha256(
        row["agency_id"], row["marker_id"], row["version"], row["at"], row["who"], row["why"], row["kind"],
        row["marker"],
    )  # fmt: skip


def _differing(row: sa.RowMapping) -> list[str]:
    """Columns of the marker that its newest version has otherwise; a version knows the columns of its time."""
    written = row["marker"]
    if "localization_grade" in written and not is_graded(written):
        written = {**written, **regraded(written)}  # a migration did the same
    known = {name: value for name, value in written.items() if _NOW + name in row}
    now = orjson.loads(orjson.dumps({name: row[_NOW + name] for name in known}))
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
