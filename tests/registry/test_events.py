"""Events rise in the order of commits, and an agency reads its own."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from app.registry import agencies, webhooks
from app.registry.database import Database
from app.registry.engines import acting_for

NOW = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


def test_each_agency_reads_its_own_events_in_order(database: Database) -> None:
    with database.write() as connection:
        own, other = (agencies.add_agency(connection, name, NOW) for name in ("one", "two"))
    for agency_id in (own, other):
        with acting_for(agency_id), database.write() as connection:
            for number in range(3):
                webhooks.add_event(
                    connection, agency_id, "maintenance.suspect", subject_id=f"s{number}", at=NOW, detail={"n": number}
                )
    with acting_for(own), database.read() as connection:
        found = webhooks.list_events(connection, own)
        newer = webhooks.list_events(connection, own, after=found[0].id)
        assert webhooks.newest_event(connection, own) == found[-1].id
    assert [row.subject_id for row in found] == ["s0", "s1", "s2"]
    assert [row.detail for row in newer] == [{"n": 1}, {"n": 2}]
    assert [row.id for row in found] == sorted(row.id for row in found)


def test_events_of_jobs_are_those_of_the_kinds_that_are_named(database: Database) -> None:
    with database.write() as connection:
        own = agencies.add_agency(connection, "one", NOW)
    of = {"job.done": {"job_kind": "decode"}, "job.failed": {"job_kind": "audit"}, "maintenance.suspect": {}}
    with acting_for(own), database.write() as connection:
        for kind, detail in of.items():
            webhooks.add_event(connection, own, kind, subject_id="s", at=NOW, detail=detail)
    with acting_for(own), database.read() as connection:
        seen = {
            kinds: [row.kind for row in webhooks.list_events(connection, own, job_kinds=kinds)]
            for kinds in (None, (), ("decode",))
        }
    assert seen == {None: [*of], (): ["maintenance.suspect"], ("decode",): ["job.done", "maintenance.suspect"]}


def test_nothing_that_was_rolled_back_is_an_event(database: Database) -> None:
    with database.write() as connection:
        own = agencies.add_agency(connection, "one", NOW)
    with pytest.raises(RuntimeError):
        _roll_back_an_event(database, own)
    with acting_for(own), database.read() as connection:
        assert webhooks.list_events(connection, own) == []
        assert webhooks.newest_event(connection, own) == 0


def _roll_back_an_event(database: Database, agency_id: str) -> None:
    with acting_for(agency_id), database.write() as connection:
        webhooks.add_event(connection, agency_id, "maintenance.suspect", subject_id=None, at=NOW)
        raise RuntimeError
