"""Blobs to which no row refers are deleted, on both databases; all others stay."""

from __future__ import annotations

import os
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from app.registry import agencies, jobs
from app.registry.column_types import metadata, new_id
from app.registry.database import Database
from app.registry.decodes import decodes
from app.registry.jobs import JobKind, new_job
from app.registry.marker_rows import markers
from app.registry.plan_states import plans
from app.registry.plans import alignments
from app.registry.public_pages import damage_reports
from app.registry.tables import BLOB_COLUMNS
from app.services.blobs import MIN_AGE, OWNERS, UnusedBlobs
from app.storage.blobs import Blobs, new_blob_key

NOW = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


@pytest.fixture
def blobs(tmp_path: Path) -> Blobs:
    made = Blobs((tmp_path / "blobs").as_uri())
    made.open()
    return made


@pytest.fixture
def unused(database: Database, blobs: Blobs) -> UnusedBlobs:
    return UnusedBlobs(database, lambda: NOW, blobs)


def put(blobs: Blobs, *, age: timedelta = MIN_AGE + timedelta(seconds=1)) -> str:
    """A blob of some age."""
    key, at_s = new_blob_key("uploads"), (NOW - age).timestamp()
    blobs.put(key, b"x")
    assert blobs.folder is not None
    os.utime(blobs.folder / key, (at_s, at_s))
    return key


def stored(blobs: Blobs) -> set[str]:
    return {key for key in blobs.list_keys() if not key.startswith(OWNERS)}


def refer(connection: sa.Connection, agency_id: str, blobs: Blobs) -> set[str]:
    """Rows of every kind that refers to blobs; returns the keys."""
    keys = [put(blobs) for _ in range(10)]
    times = {"created_at": NOW, "updated_at": NOW}
    row = {"id": new_id(NOW), "agency_id": agency_id}
    decode = {**row, "kind": "trace", "context": {}, "created_at": NOW, "upload_key": keys[0], "picture_key": keys[1]}
    connection.execute(sa.insert(decodes), decode)
    alignment = {**row, "name": "a", "source_key": keys[2], "source_sha256": "", "declaration": {}, "summary": {}}
    connection.execute(sa.insert(alignments), {**alignment, "version": 1, **times})
    plan: dict[str, Any] = {**row, "alignment_id": row["id"], "name": "p", "status": "proved", "rules": {}}
    plan |= {"document_key": keys[3], "summary": {}, "author": "x", "author_id": "x", "version": 1, **times}
    plan["proof"] = {"keys": {"report.json": keys[4], "table.csv": keys[5]}}
    connection.execute(sa.insert(plans), plan)
    new = new_job(JobKind.IMPORT, new_id(NOW), agency_id, "x", NOW, upload_key=keys[6])
    jobs.add_job(connection, new)
    new = new_job(JobKind.PACKAGE, new_id(NOW), agency_id, "x", NOW, job_input={"document_key": keys[7]})
    jobs.add_job(connection, new._replace(state="done", result={"blob_key": keys[8]}))
    marker: dict[str, Any] = {
        **row,
        "family": "plate",
        "status": "active",
        "lon_deg": 0.0,
        "lat_deg": 0.0,
        "crs": "EPSG:4326",
    }
    connection.execute(
        sa.insert(markers), {**marker, "original": {}, "localization_grade": "cm", "version": 1, **times}
    )
    report: dict[str, Any] = {**row, "marker_id": row["id"], "form_nonce": "", "kind": "other", "language": "en"}
    connection.execute(sa.insert(damage_reports), {**report, "status": "new", "photo_key": keys[9], "created_at": NOW})
    return set(keys)


def test_old_blobs_without_a_row_are_deleted(database: Database, blobs: Blobs, unused: UnusedBlobs) -> None:
    with database.write() as connection:
        used = refer(connection, agencies.add_agency(connection, "one", NOW), blobs)
    used |= {put(blobs, age=MIN_AGE - timedelta(seconds=1))}
    orphans = {put(blobs) for _ in range(3)}
    assert stored(blobs) == used | orphans
    assert unused.delete() == 3
    assert stored(blobs) == used
    assert unused.delete() == 0


def test_at_its_start_the_only_server_deletes_young_ones_too(database: Database, blobs: Blobs) -> None:
    with database.write() as connection:
        agencies.add_agency(connection, "one", NOW)
    younger = put(blobs, age=timedelta(seconds=-1))
    put(blobs, age=timedelta(seconds=1))
    only = UnusedBlobs(database, lambda: NOW, blobs, alone=True)
    assert only.delete() == 1
    assert stored(blobs) == {younger}
    put(blobs, age=timedelta(seconds=1))
    assert only.delete() == 0


def test_a_store_that_another_database_uses_is_left_alone(
    database: Database, blobs: Blobs, unused: UnusedBlobs
) -> None:
    orphan = put(blobs)
    assert unused.delete() == 0  # before the first agency exists, the database has no name
    with database.write() as connection:
        agencies.add_agency(connection, "one", NOW)
    other = f"{OWNERS}/ab/{'ab' * 16}"
    blobs.put(other, b"")
    assert unused.delete() == 0
    blobs.delete(other)
    assert unused.delete() == 1
    assert orphan not in stored(blobs)


def test_every_column_with_keys_is_known() -> None:
    named = {f"{t.name}.{c.name}" for t in metadata.sorted_tables for c in t.columns if c.name.endswith("_key")}
    assert named == {f"{column.table.name}.{column.name}" for column in BLOB_COLUMNS}
