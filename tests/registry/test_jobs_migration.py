"""Migration 0011 on rows of the revision before it: queued imports become jobs, decodes keep their ids, and back."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from app.registry.database import Database
from app.registry.decodes import DecodeFilter, get_decode, list_decodes
from app.registry.engines import acting_for
from app.registry.jobs import JobKind, list_jobs, list_startable, start_job

NOW = datetime(2026, 3, 4, 5, 6, 7, 890123, tzinfo=UTC)
LATER = datetime(2026, 3, 4, 5, 6, 9, tzinfo=UTC)
AGENCY = "019cb624-0000-7000-8000-00000000aaaa"
MARKER = "019cb624-0000-7000-8000-00000000bbbb"
_JSON = sa.JSON(none_as_null=True)
_OLDER = sa.table(
    "decodes",
    *(sa.column(name, sa.String) for name in ("id", "agency_id", "state", "kind", "holder_id", "upload_key")),
    *(sa.column(name, _JSON) for name in ("context", "result", "error")),
    *(sa.column(name, sa.DateTime(timezone=True)) for name in ("created_at", "finished_at")),
    sa.column("picture_key", sa.String), sa.column("attempts", sa.Integer), sa.column("progress", sa.Double),
    sa.column("cancel_requested", sa.Boolean),
)  # fmt: skip


@pytest.fixture
def database(tmp_path: Path, new_database_url: Callable[[Path], str]) -> Iterator[Database]:
    """A database at the revision before, with uploads of every kind in every state."""
    database = Database(new_database_url(tmp_path))
    database.open()
    database.migrate("0010")
    with database.write() as connection:
        connection.execute(
            sa.text("INSERT INTO agencies (id, name, created_at) VALUES (:id, 'one', :at)"),
            {"id": AGENCY, "at": "2026-03-04 05:06:07"},
        )
        connection.execute(sa.insert(_OLDER), [_decode(k, *values) for k, values in enumerate(DECODES)])
        _refer_to(connection, _id(0), _id(3))
    yield database
    database.close()


def _id(k: int) -> str:
    return f"019cb624-0000-7000-8000-{k:012x}"


PACKETS = {"packets": {"lane": {"most_strays": 0.3, "bridge_m": 9.0}, "freshness": {"least_interval_s": 0.5}}}
DECLARED = {"declaration": {"crs": "EPSG:4326"}, "label": "a surveyor"}
LANE = {"lane": {"doubts": ["off"], "method": "waymark"}, "report": {"doubts": "of another place"}}
FAILED = {"kind": "UnreadableUpload", "detail": "no"}
# kind, state, attempts, progress, context, result, error
DECODES: list[tuple[str, str, int, float, Any, Any, Any]] = [
    ("frame", "done", 1, 1.0, {"thermal": True}, {"readings": []}, None),
    ("archive", "done", 2, 1.0, {}, {"readings": [{"digits": "023792168411"}]}, None),
    ("archive", "queued", 0, 0.0, {}, None, None),
    ("packets", "done", 1, 1.0, PACKETS, LANE, None),
    ("trace", "running", 1, 0.5, {"trace": {}}, None, None),
    ("trace", "failed", 3, 0.5, {"trace": {}}, None, FAILED),
    ("archive", "cancelled", 1, 0.2, {}, None, None),
    ("import", "done", 1, 1.0, DECLARED, {"outcome": "stored"}, None),
    ("import", "queued", 0, 0.0, DECLARED, None, None),
    ("import", "running", 1, 0.5, DECLARED, None, None),
    ("import", "failed", 1, 0.1, DECLARED, None, FAILED),
]


def _decode(
    k: int, kind: str, state: str, attempts: int, progress: float, context: Any, result: Any, error: Any
) -> dict[str, Any]:
    return {
        "id": _id(k), "agency_id": AGENCY, "state": state, "kind": kind, "holder_id": "holder",
        "upload_key": f"uploads/{k}", "picture_key": "pictures/1" if kind == "packets" else None, "context": context,
        "result": result, "error": error, "attempts": attempts, "progress": progress,
        "cancel_requested": state == "cancelled", "created_at": NOW,
        "finished_at": LATER if state in ("done", "failed", "cancelled") else None,
    }  # fmt: skip


def _refer_to(connection: sa.Connection, frame: str, log: str) -> None:
    """Rows of other tables that refer to decodes."""
    connection.execute(
        sa.text(
            "INSERT INTO markers (id, agency_id, family, status, lon_deg, lat_deg, crs, original, localization_grade,"
            " version, created_at, updated_at, feature) VALUES (:id, :agency, 'plate', 'active', 1, 2, 'EPSG:4326',"
            " '{}', 'exact', 1, :at, :at, '')"
        ),
        {"id": MARKER, "agency": AGENCY, "at": "2026-03-04 05:06:07"},
    )
    connection.execute(
        sa.text(
            "INSERT INTO observations (decode_id, marker_id, frame, agency_id, at, what)"
            " VALUES (:decode, :marker, 0, :agency, :at, 'seen')"
        ),
        {"decode": frame, "marker": MARKER, "agency": AGENCY, "at": "2026-03-04 05:06:07"},
    )
    connection.execute(
        sa.text(
            "INSERT INTO cerpm_spans (agency_id, number, first_sequence, last_sequence, decode_id)"
            " VALUES (:agency, 7, 1, 2, :decode)"
        ),
        {"agency": AGENCY, "decode": log},
    )


def _older_rows(database: Database) -> dict[str, dict[str, Any]]:
    with database.read() as connection:
        return {row["id"]: dict(row) for row in connection.execute(sa.select(_OLDER)).mappings()}


def test_decodes_stay_and_imports_become_jobs(database: Database) -> None:
    database.migrate()
    assert database.is_ready()
    with database.read() as connection:
        found = list_decodes(connection, AGENCY, DecodeFilter(), before=None, limit=100)
        assert [row.id for row in found] == [_id(k) for k in range(6, -1, -1)]
        for k, (kind, state, attempts, progress, _context, result, error) in enumerate(DECODES[:7]):
            row = get_decode(connection, AGENCY, _id(k))
            assert (row.kind, row.state, row.attempts, row.progress) == (kind, state, attempts, progress)
            assert row.error == error
            assert row.upload_key == f"uploads/{k}"
            assert row.created_at == NOW
            assert row.finished_at == (LATER if state in ("done", "failed", "cancelled") else None)
            assert (row.result is None) == (result is None)
        imports = list_jobs(connection, AGENCY, JobKind.IMPORT, state=None, before=None, limit=100)
        assert [job.id for job in imports] == [_id(k) for k in (10, 9, 8, 7)]
        assert [job.state for job in imports] == ["failed", "running", "queued", "done"]
        assert {job.upload_key for job in imports} == {f"uploads/{k}" for k in (7, 8, 9, 10)}
        assert all(job.input == DECLARED for job in imports)
        assert [job.id for job in list_startable(connection, NOW)] == [_id(k) for k in (2, 4, 8, 9)]
        by_state = {
            state: len(list_decodes(connection, AGENCY, DecodeFilter(state=state), before=None, limit=100))
            for state in ("queued", "running", "done", "failed", "cancelled")
        }
        assert by_state == {"queued": 1, "running": 1, "done": 3, "failed": 1, "cancelled": 1}
    with database.write() as connection:
        job = start_job(connection, _id(2), NOW)
        assert job is not None
        assert (job.kind, job.holder_id, job.attempts) == ("decode", "holder", 1)
        assert start_job(connection, _id(0), NOW) is None


@pytest.mark.slow
def test_documents_have_the_new_names(database: Database) -> None:
    database.migrate()
    with database.read() as connection:
        row = get_decode(connection, AGENCY, _id(3))
        frames = get_decode(connection, AGENCY, _id(1))
    assert frames.result == {"readings": [{"family": "plate", "digits": "023792168411"}]}
    assert row.result == {"lane": {"localization_warnings": ["off"], "method": "waymark"}, "report": LANE["report"]}
    assert row.context == {
        "packets": {"lane": {"max_outlier_ratio": 0.3, "bridge_m": 9.0}, "freshness": {"min_interval_s": 0.5}}
    }


@pytest.mark.slow
def test_back_and_forth_changes_nothing(database: Database) -> None:
    before = _older_rows(database)
    database.migrate()
    database.migrate("0010")
    assert _older_rows(database) == before
    with database.read() as connection:
        assert "jobs" not in sa.inspect(connection).get_table_names()
    database.migrate()
    assert database.is_ready()


def test_what_refers_to_a_decode_still_does(database: Database) -> None:
    for revision in ("0011", "0010", "0011"):
        database.migrate(revision)
        for decode_id in (_id(0), _id(3)):
            with pytest.raises(sa.exc.IntegrityError), database.write() as connection:
                connection.execute(sa.text("DELETE FROM decodes WHERE id = :id"), {"id": decode_id})


def test_other_agencies_jobs_are_hidden(database: Database, backend: str) -> None:
    if backend != "postgresql":
        pytest.skip("SQLite has no row level security")
    database.migrate()
    for agency_id, count in ((AGENCY, 9), ("019cb624-0000-7000-8000-00000000cccc", 0)):
        with acting_for(agency_id), database.read() as connection:
            assert connection.execute(sa.text("SELECT count(*) FROM jobs")).scalar_one() == count
