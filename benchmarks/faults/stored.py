"""What is stored, read from the database and the folder without the server."""

from __future__ import annotations

import hashlib
from datetime import timedelta
from pathlib import Path

import sqlalchemy as sa

from app.registry.blob_references import blob_references
from app.registry.database import Database
from app.registry.tables import decodes, jobs, markers
from app.registry.tenancy import across_agencies
from app.services.access.audit import AuditLog
from app.services.unused_blobs import MIN_AGE, OWNERS, UnusedBlobs
from app.storage.blobs import Blobs
from app.wiring import utc_now
from benchmarks.faults.writers import Acknowledged


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
        lost = [f"marker {found}" for found in acknowledged.markers - ids]
        for decode_id, sha256 in acknowledged.uploads.items():
            key = keys.get(decode_id)
            if key is None or hashlib.sha256(self.blobs.get(key)).hexdigest() != sha256:
                lost.append(f"upload of {decode_id}")
        return lost

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
