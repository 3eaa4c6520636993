"""Jobs: one place starts them, notices that they were cancelled, and records how they ended."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Protocol

import sqlalchemy as sa
import structlog

from app.errors import StorageFull, Unavailable, UnreadableUpload, WaymarkError, is_disk_full
from app.registry import jobs as store
from app.registry.database import Database
from app.registry.jobs import JobKind, JobRow, JobState
from app.registry.tenancy import across_agencies, acting_for
from app.services.error_documents import error_document
from app.services.ports import Clock

MAX_ATTEMPTS = 10
"""How often a job is started; one that never ends then fails. Starts that ended because the server was stopped, or a
store was full or did not answer, are not counted: such a job waits. Kills of the server count; a file that kills its
decoder process fails its job at once. Source: chosen by hand; with 3, one of 179 jobs was not done after 50 kills."""
_LOG = structlog.get_logger(__name__)


class JobCancelled(Exception):
    """Somebody asked the job to stop."""


class RunningJob:
    """A job between its start and its end.

    Attributes
    ----------
    row : JobRow
        As it was when the job was started.
    """

    def __init__(self, database: Database, clock: Clock, row: JobRow) -> None:
        self._database, self._clock = database, clock
        self.row = row

    def report_progress(
        self, progress: float, *, steps: tuple[int, int] | None = None,
        keep: Callable[[sa.Connection], None] | None = None,
    ) -> None:  # fmt: skip
        """Record how far the job is.

        Parameters
        ----------
        progress : float
            From 0 to 1.
        steps : (int, int), optional
            Steps that are done, and all.
        keep : callable, optional
            Stores a part of the result in the same transaction, so that the next attempt goes on from there. A job
            that gets on is never given up for its number of attempts.

        Raises
        ------
        JobCancelled
            Somebody asked the job to stop; nothing was kept.
        """
        with self._database.write() as connection:
            if not store.record_progress(connection, self.row.id, progress, steps=steps, kept=keep is not None):
                raise JobCancelled
            if keep is not None:
                keep(connection)

    def finish(
        self, connection: sa.Connection, result: Mapping[str, object] | None = None, *, subject_id: str | None = None
    ) -> bool:
        """Record that the job is done, in the transaction that stores its result, and the row that it has made.

        Returns whether this was the first time: if not, another worker has finished the job, and nothing more may be
        stored.
        """
        return store.finish_job(connection, self.row.id, "done", self._clock(), result=result, subject_id=subject_id)

    def end(self, state: JobState, error: WaymarkError | None = None) -> None:
        """Record that the job ended without a result."""
        document = error_document(error) if error is not None else None
        with self._database.write() as connection:
            store.finish_job(connection, self.row.id, state, self._clock(), error=document)


class JobHandler(Protocol):
    """Carries out the jobs of one kind."""

    def run(self, job: RunningJob) -> None:
        """Do the work, and call `RunningJob.finish` in the transaction that stores its result.

        It may be called again after a crash, and by two workers at the same time: only the first `finish` counts.
        """


class Jobs:
    """Runs queued jobs.

    Parameters
    ----------
    database : Database
    clock : Clock
    handlers : mapping of JobKind to JobHandler
    max_attempts : int, optional
    """

    def __init__(
        self,
        database: Database,
        clock: Clock,
        handlers: Mapping[JobKind, JobHandler],
        max_attempts: int = MAX_ATTEMPTS,
    ) -> None:
        self._database, self._clock = database, clock
        self._handlers = handlers
        self._max_attempts = max_attempts

    def run_job(self, job_id: str) -> None:
        """Run a queued job. It may be called again and at the same time: the effect happens once.

        Raises
        ------
        Unavailable
            The decoder processes or the stores do not answer; the job stays unfinished and can be run again.
        """
        with across_agencies(), self._database.write() as connection:
            row = store.start_job(connection, job_id)
        if row is not None:
            with acting_for(row.agency_id):
                self._run(RunningJob(self._database, self._clock, row))

    def list_unfinished(self, kinds: Sequence[JobKind] = tuple(JobKind)) -> list[tuple[str, str]]:
        """Ids and agencies of the jobs of some kinds that an earlier process left unfinished."""
        with across_agencies(), self._database.read() as connection:
            return store.list_unfinished(connection, kinds)

    def _run(self, job: RunningJob) -> None:
        if job.row.attempts > self._max_attempts:
            job.end("failed", _too_many_attempts(self._max_attempts))
            return
        try:
            self._handlers[JobKind(job.row.kind)].run(job)
        except JobCancelled:
            job.end("cancelled")
        except Unavailable:
            self._return_attempt(job)
            raise
        except WaymarkError as error:
            job.end("failed", error)
        except Exception as error:
            if is_disk_full(error):
                self._return_attempt(job)
                raise StorageFull("the folder for temporary files") from error
            # a defect must not leave a job that runs for ever
            _LOG.exception("a job failed on a defect", job_id=job.row.id, kind=job.row.kind)
            job.end("failed", WaymarkError("the job failed on a defect of the server; its log has the details"))

    def _return_attempt(self, job: RunningJob) -> None:
        with suppress(Unavailable), self._database.write() as connection:
            store.return_attempt(connection, job.row.id)


def _too_many_attempts(attempts: int) -> WaymarkError:
    return UnreadableUpload(
        "the job was started again and again and never finished",
        field="file",
        limit=f"{attempts} attempts",
        cure="send the upload in smaller parts",
    )
