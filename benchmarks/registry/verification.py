"""Time to verify a history: so many entries, each with a version of a marker, ten versions of each marker."""

from __future__ import annotations

import time
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import sqlalchemy as sa

from app.markers.reading import MarkerRow
from app.registry.agencies import find_agency
from app.registry.audit import AuditEntry, ChainReport, audit_log, entry_hash, find_head, list_entries
from app.registry.bulk_load import load_rows
from app.registry.column_types import fetch_all
from app.registry.database import Database
from app.registry.engines import across_agencies
from app.registry.marker_rows import MARKERS, marker_versions, markers
from app.services.access.audit import AuditLog
from app.services.documents import VersionKind

if TYPE_CHECKING:
    from benchmarks.registry.__main__ import Filled

VERSIONS = 10
GOAL_S = 60.0
_AGENCY, _WHO = "roads", "benchmark"
_CHUNK = 5_000


def add_history(database: Database) -> None:
    """Give every marker of the agency `fill` made ten versions, each under an entry of its own."""
    with across_agencies(), database.write(long=True) as connection:
        agency_id = connection.execute(
            sa.text("SELECT id FROM agencies WHERE name = :name"), {"name": _AGENCY}
        ).scalar_one()
        own = sa.and_(markers.c.agency_id == agency_id, markers.c.road != "A0")
        connection.execute(sa.update(markers).where(markers.c.lat_deg > 0).values(version=VERSIONS))
        rows = fetch_all(connection, MARKERS.where(markers.c.lat_deg > 0, own | ~own).order_by(markers.c.id), MarkerRow)
        head = find_head(connection, agency_id)
        assert head is not None
        number, previous, at = head.number, head.hash, datetime.now(UTC)
        for version in range(1, VERSIONS + 1):
            for start in range(0, len(rows), _CHUNK):
                entries: list[dict[str, Any]] = []
                versions: list[dict[str, Any]] = []
                for row in rows[start : start + _CHUNK]:
                    number, at = number + 1, at + timedelta(milliseconds=1)
                    entry = AuditEntry(agency_id, number, at, _WHO)
                    marker = {**row._asdict(), "version": version}
                    versions.append(entry.version(row.id, version, marker, kind=VersionKind.CHANGE, why=None))
                    entries.append(_entry_row(entry, row.id, previous))
                    previous = entries[-1]["hash"]
                load_rows(connection, marker_versions, versions)
                load_rows(connection, audit_log, entries)


def _entry_row(entry: AuditEntry, marker_id: str, previous: str) -> dict[str, Any]:
    row = {
        "agency_id": entry.agency_id,
        "number": entry.number,
        "at": entry.at,
        "who": entry.who,
        "key_id": "benchmark",
        "action": "marker.changed",
        "subject": marker_id,
        "detail": {"fields": ["status"]},
        "versions": entry.versions,
        "digest": entry.digest,
        "previous_hash": previous,
    }
    return {**row, "hash": entry_hash(row)}


def measure_verification(filled: Filled) -> bool:
    """Print how long a full check and one of the last hundredth take; whether a full check is fast enough."""
    print("\n## Verification of the audit log\n")
    print("| database | entries | versions | full check [s] | processor of the command [s] | last 1 % [s] | goal [s] |")
    print("|---|---|---|---|---|---|---|")
    met = True
    for kind, url in filled.urls.items():
        database = Database(url)
        database.open()
        add_history(database)
        began_s, used_s = time.perf_counter(), time.process_time()
        report = _verify(database)
        full_s, used_s = time.perf_counter() - began_s, time.process_time() - used_s
        last_s = _time_of_rest(database, report.entries * 99 // 100)
        database.close()
        met &= full_s <= GOAL_S
        print(
            f"| {kind} | {report.entries:,} | {report.versions:,} | {full_s:.1f} | {used_s:.1f} | {last_s:.1f} "
            f"| {GOAL_S:.0f} |"
        )
    return met


def _time_of_rest(database: Database, number: int) -> float:
    with across_agencies(), database.read() as connection:
        agency_id = find_agency(connection, _AGENCY)
        assert agency_id is not None
        (entry,) = list_entries(connection, agency_id, after=number - 1, limit=1)
    began_s = time.perf_counter()
    _verify(database, {_AGENCY: (entry.number, entry.hash)})
    return time.perf_counter() - began_s


def _verify(database: Database, verified_heads: Mapping[str, tuple[int, str]] = MappingProxyType({})) -> ChainReport:
    with across_agencies():
        ((report, faults),) = (
            (report, list(found)) for _, report, found in AuditLog(database).verify(_AGENCY, None, verified_heads)
        )
    assert not faults, faults[:3]
    return report
