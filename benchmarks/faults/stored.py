"""What is stored, read from the database and the folder without the server."""

from __future__ import annotations

import hashlib
from datetime import timedelta
from pathlib import Path

import sqlalchemy as sa

from app.registry.database import Database
from app.registry.decodes import decodes
from app.registry.engines import across_agencies
from app.registry.jobs import UNFINISHED, jobs
from app.registry.marker_rows import markers
from app.registry.plan_features import planned_markers
from app.registry.plan_states import plan_markers
from app.registry.tables import blob_references
from app.services.access.audit import AuditLog
from app.services.blobs import MIN_AGE, OWNERS, UnusedBlobs
from app.services.ports import utc_now
from app.storage.blobs import Blobs
from benchmarks.faults.writers import IMPORT_ROAD, IMPORT_ROWS, Acknowledged


class Stored:
    """The data of a server.

    Parameters
    ----------
    folder : Path
        Its data folder.
    database_url : str, optional
        Empty: an SQLite file in the folder.
    """

    def __init__(self, folder: Path, database_url: str = "") -> None:
        self.database = Database(database_url or f"sqlite:///{folder / 'waymark.sqlite3'}")
        self.blobs = Blobs((folder / "blobs").resolve().as_uri())
        self.blobs.open()

    def list_lost(self, acknowledged: Acknowledged) -> list[str]:
        """Acknowledged writes that are not there, or not as they were sent."""
        with across_agencies(), self.database.read() as connection:
            ids = set(connection.execute(sa.select(markers.c.id)).scalars())
            keys = {row.id: row.upload_key for row in connection.execute(sa.select(decodes.c.id, decodes.c.upload_key))}
            known_jobs = set(connection.execute(sa.select(jobs.c.id)).scalars())
            committed = _count_by(connection, plan_markers.c.plan_id)
        lost = [f"marker {found}" for found in acknowledged.markers - ids]
        for decode_id, sha256 in acknowledged.uploads.items():
            key = keys.get(decode_id)
            if key is None or hashlib.sha256(self.blobs.get(key)).hexdigest() != sha256:
                lost.append(f"upload of {decode_id}")
        lost += [f"import {found}" for found in acknowledged.imports.keys() - known_jobs]
        lost += [f"plan {found}" for found, number in acknowledged.plans.items() if committed.get(found) != number]
        return lost

    def list_partial(self) -> list[str]:
        """Surveys and committed plans of which some markers are stored and others are not, or some twice.

        The plans have plates only: each planned marker becomes one.
        """
        with across_agencies(), self.database.read() as connection:
            imported = _count_by(connection, markers.c.road, markers.c.road.startswith(IMPORT_ROAD))
            committed = _count_by(connection, plan_markers.c.plan_id)
            planned = _count_by(connection, planned_markers.c.plan_id)
        return [
            *(f"{road}: {number} of {IMPORT_ROWS}" for road, number in imported.items() if number != IMPORT_ROWS),
            *(f"plan {plan}: {number} of {planned.get(plan)}" for plan, number in committed.items()
              if number != planned.get(plan)),
        ]  # fmt: skip

    def list_without_blob(self) -> list[str]:
        """Keys of blobs that a row refers to and that are not there."""
        with across_agencies(), self.database.read() as connection:
            used = set(blob_references(connection))
        return sorted(used - set(self.blobs.list_keys()))

    def list_unfinished(self) -> set[str]:
        """Ids of the jobs that wait or run."""
        with across_agencies(), self.database.read() as connection:
            return set(connection.execute(sa.select(jobs.c.id).where(jobs.c.state.in_(UNFINISHED))).scalars())

    def list_running(self) -> set[tuple[str, str]]:
        """Ids of the running jobs, and the name of each run: another start has another."""
        query = sa.select(jobs.c.id, jobs.c.runner).where(jobs.c.state == "running")
        with across_agencies(), self.database.read() as connection:
            return {(row.id, row.runner) for row in connection.execute(query)}

    def list_failed(self) -> list[str]:
        """Failed jobs with their reasons."""
        query = sa.select(jobs.c.id, jobs.c.kind, jobs.c.error).where(jobs.c.state == "failed")
        with across_agencies(), self.database.read() as connection:
            return [f"{row.kind} {row.id}: {row.error}" for row in connection.execute(query)]

    def count_markers(self) -> int:
        """Number of markers."""
        with across_agencies(), self.database.read() as connection:
            return connection.execute(sa.select(sa.func.count()).select_from(markers)).scalar_one()

    def count_jobs(self, *states: str) -> int:
        """Number of jobs in some states."""
        query = sa.select(sa.func.count()).select_from(jobs).where(jobs.c.state.in_(states))
        with across_agencies(), self.database.read() as connection:
            return connection.execute(query).scalar_one()

    def list_faults(self) -> list[str]:
        """Faults of the audit log."""
        with across_agencies():
            return [str(fault) for _, _, faults in AuditLog(self.database).verify() for fault in faults]

    def delete_unused(self) -> tuple[int, int, int]:
        """As the server does a day later; the numbers of unused blobs, of all before, and of unused ones that stay."""
        before = self._list_blobs()
        deleted = UnusedBlobs(self.database, lambda: utc_now() + MIN_AGE + timedelta(days=1), self.blobs).delete()
        with across_agencies(), self.database.read() as connection:
            used = set(blob_references(connection))
        return deleted, len(before), len(self._list_blobs() - used)

    def _list_blobs(self) -> set[str]:
        return {key for key in self.blobs.list_keys() if not key.startswith(OWNERS)}


def _count_by(connection: sa.Connection, column: sa.Column[str], *conditions: sa.ColumnElement[bool]) -> dict[str, int]:
    query = sa.select(column, sa.func.count()).where(*conditions).group_by(column)
    return {str(name): int(number) for name, number in connection.execute(query)}
