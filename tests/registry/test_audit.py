"""The audit log: what is changed behind it is found and named, on both databases."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
import sqlalchemy as sa

from app.errors import InvalidParameter, NotFound
from app.families.documents import PositionIn
from app.families.plate.plates import PlateIn
from app.registry import agencies, audit
from app.registry.audit import Author, find_head, list_entries, record, recording, version_sha256
from app.registry.database import Database
from app.services.access.access import Caller, Scope
from app.services.access.audit import AuditLog, parse_head
from app.services.markers.markers import MarkerChange, Markers

NOW = datetime(2026, 3, 4, 5, 6, 7, 120, tzinfo=UTC)


@dataclass
class Registry:
    """Two agencies with two markers each; the first marker of each has three versions. Six entries in all."""

    database: Database
    agency_ids: list[str]
    marker_ids: list[list[str]]

    def faults(self, agency: str = "one", expected: tuple[int, str] | None = None) -> list[str]:
        found = []
        for _, _, faults in AuditLog(self.database).verify(agency, expected):
            found += [f"{fault.where}: {fault.what}" for fault in faults]
        return found

    def run(self, statement: str, **values: object) -> None:
        with self.database.write() as connection:
            assert connection.execute(sa.text(statement), values).rowcount

    def head(self) -> tuple[int, str]:
        with self.database.read() as connection:
            head = find_head(connection, self.agency_ids[0])
        assert head is not None
        return head.number, head.hash


@pytest.fixture
def registry(database: Database) -> Registry:
    times = iter(NOW + timedelta(minutes=k) for k in range(100))
    markers = Markers(database, lambda: next(times))
    registry = Registry(database, [], [])
    for k, name in enumerate(("one", "two")):
        with database.write() as connection:
            agency_id = agencies.add_agency(connection, name, NOW)
        caller = Caller(agency_id, f"key of {name}", f"planner of {name}", Scope.PLANNER)
        ids = []
        for j in range(2):
            plate = PlateIn(
                position=PositionIn(lon_deg=7.5 + k + j / 10, lat_deg=1.0, height_m=3.0), reason="Straße 大道"
            )
            ids.append(str(markers.register(caller, plate)[0]["id"]))
        markers.change(caller, ids[0], MarkerChange({"status": "built"}), 1)
        place = PositionIn(lon_deg=7.50001 + k, lat_deg=1.0, horizontal_rmse_m=0.01)
        markers.change(caller, ids[0], MarkerChange({"status": "surveyed"}, place), 2)
        registry.agency_ids.append(agency_id)
        registry.marker_ids.append(sorted(ids))
    with database.write() as connection:
        record(
            connection, registry.agency_ids[0], Author("an admin"), "key.created", now=NOW, detail={"b": 1, "a": "ü"}
        )
    return registry


def test_a_history_that_nobody_touched_has_no_fault(registry: Registry) -> None:
    found = [(name, report, list(faults)) for name, report, faults in AuditLog(registry.database).verify()]
    assert [(name, faults) for name, _, faults in found] == [("one", []), ("two", [])]
    assert [(report.entries, report.versions) for _, report, _ in found] == [(5, 4), (4, 4)]
    assert found[0][1].head == registry.head()
    assert registry.faults(expected=registry.head()) == []
    with registry.database.read() as connection:
        first, *_, last = list_entries(connection, registry.agency_ids[0])
    assert first.previous_hash == "0" * 64
    assert (last.who, last.action, last.detail) == ("an admin", "key.created", {"a": "ü", "b": 1})


def test_versions_are_parsed_only_where_their_texts_differ(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    parsed: list[str] = []

    def count(agency_id: str, marker_id: str, *rest: Any) -> str:
        parsed.append(marker_id)
        return version_sha256(agency_id, marker_id, *rest)

    monkeypatch.setattr(audit, "version_sha256", count)
    assert registry.faults() == []
    assert parsed == []
    with registry.database.write() as connection:
        where = {"marker": registry.marker_ids[0][0], "version": 1}
        query = "SELECT CAST(marker AS TEXT) FROM marker_versions WHERE marker_id = :marker AND version = :version"
        text = json.dumps(json.loads(connection.execute(sa.text(query), where).scalar_one()), indent=1)
        kind = "JSON" if connection.dialect.name == "postgresql" else "TEXT"
        update = f"UPDATE marker_versions SET marker = CAST(:text AS {kind}) WHERE marker_id = :marker"
        connection.execute(sa.text(f"{update} AND version = :version"), {**where, "text": text})
    assert registry.faults() == []
    assert parsed == [where["marker"]]


def test_a_check_since_a_verified_head_covers_what_follows_it(registry: Registry) -> None:
    with registry.database.read() as connection:
        entries = list_entries(connection, registry.agency_ids[0])
    second, marker_id = entries[1], registry.marker_ids[0][0]

    def faults(number: int = second.number, sha256: str = second.hash) -> list[str]:
        ((_, report, found),) = (
            (name, report, [f"{fault.where}: {fault.what}" for fault in found])
            for name, report, found in AuditLog(registry.database).verify("one", None, {"one": (number, sha256)})
        )
        if not found:
            assert (report.since, report.entries, report.versions, report.head) == (2, 3, 2, registry.head())
        return found

    assert faults() == []
    assert faults(second.number, "0" * 64) != []
    assert faults(77, "0" * 64)[0] == "entry 77: missing, and an earlier check ended with it"
    registry.run("UPDATE audit_log SET who = 'me' WHERE agency_id = :agency AND number = 1", agency=second.agency_id)
    assert faults() == []  # as docs/history.md says
    assert registry.faults() != []
    registry.run("UPDATE marker_versions SET who = 'me' WHERE marker_id = :id AND version = 2", id=marker_id)
    assert faults() == [f"version 2 of marker {marker_id}: changed: its hash does not match its content"]
    registry.run("UPDATE audit_log SET who = 'me' WHERE agency_id = :agency AND number = 2", agency=second.agency_id)
    assert faults()[0] == "entry 2: is not the one with which an earlier check ended: check the whole history"


TAMPERED: dict[str, tuple[str, str]] = {
    "a version's marker": (
        "UPDATE marker_versions SET marker = (SELECT w.marker FROM marker_versions w WHERE w.marker_id = :marker AND "
        "w.version = 1) WHERE marker_id = :marker AND version = 2",
        "version 2 of marker {marker}: changed",
    ),
    "a version's author": (
        "UPDATE marker_versions SET who = 'me' WHERE marker_id = :marker AND version = 1",
        "version 1 of marker {marker}: changed",
    ),
    "a version's reason": (
        "UPDATE marker_versions SET why = NULL WHERE marker_id = :marker AND version = 1",
        "version 1 of marker {marker}: changed",
    ),
    "a version's kind": (
        "UPDATE marker_versions SET kind = 'correction' WHERE marker_id = :marker AND version = 3",
        "version 3 of marker {marker}: changed",
    ),
    "a version's hash": (
        "UPDATE marker_versions SET sha256 = :zeros WHERE marker_id = :marker AND version = 3",
        "the versions of markers that it wrote are not those that are there",
    ),
    "a version's entry": (
        "UPDATE marker_versions SET audit_number = 2 WHERE marker_id = :marker AND version = 3",
        "entry 4: wrote 1 versions of markers, 0 are there",
    ),
    "an unknown entry": (
        "UPDATE marker_versions SET audit_number = 77 WHERE marker_id = :marker AND version = 3",
        "version 3 of marker {marker}: names entry 77, which is missing",
    ),
    "a version between is gone": (
        "DELETE FROM marker_versions WHERE marker_id = :marker AND version = 2",
        "version 2 of marker {marker}: missing",
    ),
    "the newest version is gone": (
        "DELETE FROM marker_versions WHERE marker_id = :marker AND version = 3",
        "version 3 of marker {marker}: missing, and it is the newest",
    ),
    "the marker itself": (
        "UPDATE markers SET lat_deg = 1.5 WHERE id = :marker",
        "marker {marker}: differs from its version 3: lat_deg",
    ),
    "an entry's author": (
        "UPDATE audit_log SET who = 'me' WHERE agency_id = :agency AND number = 2",
        "entry 2: changed",
    ),
    "an entry's detail": (
        "UPDATE audit_log SET detail = '{{}}' WHERE agency_id = :agency AND number = 5",
        "entry 5: changed",
    ),
    "an entry's hash": (
        "UPDATE audit_log SET hash = :zeros WHERE agency_id = :agency AND number = 2",
        "entry 3: does not name the hash of the entry before it",
    ),
    "the first entry is gone": ("DELETE FROM audit_log WHERE agency_id = :agency AND number = 1", "entry 1: missing"),
    "entries between are gone": (
        "DELETE FROM audit_log WHERE agency_id = :agency AND number IN (2, 3)",
        "entries 2 to 3: missing",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", TAMPERED)
def test_what_was_changed_or_removed_is_named(registry: Registry, what: str) -> None:
    statement, expected = TAMPERED[what]
    values: dict[str, object] = {
        "marker": registry.marker_ids[0][0],
        "agency": registry.agency_ids[0],
        "zeros": "0" * 64,
    }
    used = {name: value for name, value in values.items() if f":{name}" in statement}
    registry.run(statement.replace("{{}}", "{}"), **used)
    found = registry.faults()
    assert any(expected.format(**values) in fault for fault in found), found
    assert registry.faults("two") == []


def test_a_change_with_a_hash_that_fits_it_is_found(registry: Registry) -> None:
    """Whoever can compute a version's hash still has to change its entry, and every entry after it."""
    from app.registry.audit import version_sha256
    from app.registry.marker_rows import marker_versions as v

    marker_id = registry.marker_ids[0][0]
    with registry.database.write() as connection:
        row = connection.execute(sa.select(v).where(v.c.marker_id == marker_id, v.c.version == 2)).mappings().one()
        marker = {**row["marker"], "lon_deg": 0.0}
        agency_id = row["agency_id"]
        sha256 = version_sha256(agency_id, marker_id, 2, row["at"], row["who"], row["why"], row["kind"], marker)
        change = sa.update(v).where(v.c.marker_id == marker_id, v.c.version == 2).values(marker=marker, sha256=sha256)
        connection.execute(change)
    assert registry.faults() == ["entry 3: the versions of markers that it wrote are not those that are there"]


def _swap(registry: Registry, table: str, key: str, columns: str, one: str, other: str) -> None:
    """Swap columns of two rows: their places, not what they say."""
    statement = f"SELECT {columns} FROM {table} WHERE {key} = :key"
    names = columns.split(", ")
    with registry.database.write() as connection:
        rows = [tuple(connection.execute(sa.text(statement.replace(":key", k))).one()) for k in (one, other)]
        for k, row in zip((one, other), reversed(rows), strict=True):
            setting = ", ".join(f"{name} = :{name}" for name in names)
            update = sa.text(f"UPDATE {table} SET {setting} WHERE {key} = {k}")
            assert connection.execute(update, dict(zip(names, row, strict=True))).rowcount == 1


def test_entries_that_changed_places_are_found(registry: Registry) -> None:
    columns = "at, who, key_id, action, subject, versions, digest, previous_hash, hash"
    key = f"agency_id = '{registry.agency_ids[0]}' AND number"
    _swap(registry, "audit_log", key, columns, "2", "3")
    found = registry.faults()
    assert {"entry 2: changed: its hash does not match its content"} <= set(found)
    assert any(fault.startswith("entry 2: does not name the hash of the entry before it") for fault in found)


def test_versions_that_changed_places_are_found(registry: Registry) -> None:
    marker_id = registry.marker_ids[0][0]
    key = f"marker_id = '{marker_id}' AND version"
    _swap(registry, "marker_versions", key, "at, who, why, kind, audit_number, sha256", "1", "2")
    found = registry.faults()
    assert f"version 1 of marker {marker_id}: changed: its hash does not match its content" in found
    assert f"version 2 of marker {marker_id}: changed: its hash does not match its content" in found


def test_what_moved_to_another_agency_is_found(registry: Registry) -> None:
    one, two = registry.agency_ids
    marker_id = registry.marker_ids[0][1]
    registry.run("UPDATE marker_versions SET agency_id = :two WHERE marker_id = :marker", two=two, marker=marker_id)
    assert any("wrote 1 versions of markers, 0 are there" in fault for fault in registry.faults())
    assert f"version 1 of marker {marker_id}: missing, and it is the newest" in registry.faults()
    assert f"version 1 of marker {marker_id}: changed: its hash does not match its content" in registry.faults("two")
    registry.run("UPDATE marker_versions SET agency_id = :one WHERE marker_id = :marker", one=one, marker=marker_id)
    assert registry.faults() == registry.faults("two") == []
    registry.run("UPDATE audit_log SET agency_id = :two WHERE agency_id = :one AND number = 5", one=one, two=two)
    assert "entry 5: changed: its hash does not match its content" in registry.faults("two")


@pytest.mark.slow
def test_logs_that_two_agencies_swapped_are_found(registry: Registry) -> None:
    one, two = registry.agency_ids
    with registry.database.write() as connection:
        spare = agencies.add_agency(connection, "spare", NOW)
    for source, target in ((one, spare), (two, one), (spare, two)):
        for table in ("audit_log", "marker_versions"):
            registry.run(f"UPDATE {table} SET agency_id = :t WHERE agency_id = :s", s=source, t=target)
    assert "entry 1: changed: its hash does not match its content" in registry.faults("one")
    assert "entry 1: changed: its hash does not match its content" in registry.faults("two")


def test_an_end_that_was_cut_off_needs_a_head_that_was_kept(registry: Registry) -> None:
    """Honestly: without a head from outside, a log whose last entries are gone is a shorter log without a fault."""
    kept = registry.head()
    registry.run("DELETE FROM audit_log WHERE agency_id = :agency AND number = 5", agency=registry.agency_ids[0])
    assert registry.faults() == []
    assert registry.faults(expected=kept) == ["entry 5: expected, but the log ends before it: its end was cut off"]


def test_a_history_that_was_written_anew_needs_a_head_that_was_kept(registry: Registry) -> None:
    kept = registry.head()
    one = registry.agency_ids[0]
    registry.run("DELETE FROM audit_log WHERE agency_id = :agency AND number = 5", agency=one)
    with registry.database.write() as connection:
        record(connection, one, Author("an admin"), "key.created", now=NOW, detail={"b": 1, "a": "u"})
    assert registry.faults() == []
    (found,) = registry.faults(expected=kept)
    assert found.startswith("entry 5: its hash is not the one that was expected")


def test_a_log_may_have_grown_since_its_head_was_kept(registry: Registry) -> None:
    kept = registry.head()
    with registry.database.write() as connection:
        record(connection, registry.agency_ids[0], Author("an admin"), "key.revoked", now=NOW)
    assert registry.faults(expected=kept) == []
    assert registry.head()[0] == kept[0] + 1


def test_nothing_is_logged_of_what_fails(registry: Registry) -> None:
    before = registry.head()
    with (
        pytest.raises(RuntimeError),
        registry.database.write() as connection,
        recording(connection, registry.agency_ids[0], Author("me"), "marker.changed", now=NOW),
    ):
        raise RuntimeError
    assert registry.head() == before


def test_a_head_is_a_number_and_a_hash() -> None:
    assert parse_head(f"12:{'ab' * 32}") == (12, "ab" * 32)
    for wrong in (
        "",
        "12",
        "0:" + "a" * 64,
        "1:" + "A" * 64,
        "1:" + "a" * 63,
        "٣:" + "a" * 64,
        "9" * 40 + ":" + "a" * 64,
    ):
        with pytest.raises(InvalidParameter, match="no head"):
            parse_head(wrong)


def test_an_unknown_agency(registry: Registry) -> None:
    with pytest.raises(NotFound):
        registry.faults("three")


def test_versions_of_an_entry_come_in_order(registry: Registry) -> None:
    make: Callable[..., object]
    with registry.database.write() as connection:
        with recording(connection, registry.agency_ids[0], Author("me"), "test", now=NOW) as entry:
            make = entry.version
            make("b", 1, {}, kind="change", why=None)
            with pytest.raises(ValueError, match="in the order"):
                make("a", 1, {}, kind="change", why=None)
        connection.rollback()
