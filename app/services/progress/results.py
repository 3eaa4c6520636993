"""Files that jobs make: written as blobs, sent part by part, and deleted when they have expired."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

import sqlalchemy as sa
import structlog

from app.errors import Conflict, NotFound, Unavailable
from app.registry import jobs as store
from app.registry.database import Database
from app.registry.jobs import JobKind
from app.registry.tenancy import across_agencies
from app.services.access.access import Caller
from app.services.jobs import RunningJob
from app.services.ports import Blobs, Clock
from app.services.progress.jobs import AllJobs
from app.services.staged_blobs import delete_unused, staged

KEPT = timedelta(days=7)
"""How long the file of a job is kept. Source: chosen by hand; it can be made again."""
FOLDER = "results"
FILE_KINDS = (JobKind.ARTWORK, JobKind.EXPORT)
_LOG = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class StoredFile:
    """A file to send: its name, type, size and hash, its headers, and its content part by part."""

    name: str
    media_type: str
    size_bytes: int
    sha256: str
    headers: dict[str, str]
    chunks: Iterator[bytes]


class JobFiles:
    """Files of jobs.

    Parameters
    ----------
    database, clock, blobs
    jobs : AllJobs
        Decides which jobs a caller may see.
    """

    def __init__(self, database: Database, clock: Clock, blobs: Blobs, jobs: AllJobs) -> None:
        self._database, self._clock, self._blobs, self._jobs = database, clock, blobs, jobs
        self._stopping = threading.Event()

    def finish(self, job: RunningJob, path: Path, *, name: str, media_type: str, headers: dict[str, str]) -> None:
        """Store a file, and finish its job."""
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        with staged(self._blobs) as stage:
            result = {
                "name": name,
                "media_type": media_type,
                "size_bytes": path.stat().st_size,
                "sha256": sha256,
                "headers": headers,
                "blob_key": stage.put_file(FOLDER, path),
            }
            with self._database.write() as connection:
                if not job.finish(connection, result):
                    return
            stage.keep()

    def open(self, caller: Caller, job_id: str) -> StoredFile:
        """The file of a job that is done.

        Raises
        ------
        NotFound
            There is no such job, it makes no file, or the file has expired.
        Conflict
            The job is not done.
        """
        job = self._jobs.row(caller, job_id)
        if job.kind not in FILE_KINDS:
            raise NotFound(f"a {job.kind} makes no file", field="job_id", cure="follow links.result of the job")
        if job.state != "done" or job.result is None:
            raise Conflict(
                f"the job is {job.state}", field="job_id", limit="jobs that are done",
                cure=f"GET /v1/jobs/{job_id}/events reports when it is",
            )  # fmt: skip
        if job.result.get("blob_key") is None:
            raise NotFound(
                "the file of this job has expired", field="job_id", limit=f"{KEPT.days} days", cure="ask for it again"
            )
        found = job.result
        return StoredFile(
            found["name"], found["media_type"], found["size_bytes"], found["sha256"], found["headers"],
            self._blobs.stream(found["blob_key"]),
        )  # fmt: skip

    def stop(self) -> None:
        """End a `try_to_delete_expired` that runs."""
        self._stopping.set()

    def delete_expired(self) -> int:
        """Delete files that are kept no longer; returns their number."""
        with across_agencies(), self._database.read() as connection:
            expired = store.list_ended(connection, FILE_KINDS, self._clock() - KEPT)
        deleted = 0
        for job in expired:
            if self._stopping.is_set():
                break
            key = (job.result or {}).get("blob_key")
            if key is None:
                continue
            with across_agencies(), self._database.write() as connection:
                store.replace_result(connection, job.id, {**(job.result or {}), "blob_key": None})
            delete_unused(self._blobs, [key])
            deleted += 1
        return deleted

    def try_to_delete_expired(self) -> None:
        """As `delete_expired`; a store that does not answer is tried the next time."""
        try:
            self.delete_expired()
        except (Unavailable, sa.exc.SQLAlchemyError) as error:
            _LOG.warning("expired files of jobs could not be deleted", why=str(error))
