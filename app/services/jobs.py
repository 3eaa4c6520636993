"""Jobs: their queues, leases and cancellation; one place starts them and records how they ended."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from enum import StrEnum
from itertools import count
from typing import Protocol

import sqlalchemy as sa
import structlog

from app import tracing
from app.errors import ProcessStopped, StorageFull, Unavailable, WaymarkError, is_disk_full
from app.registry import jobs as leases
from app.registry import jobs as store
from app.registry.database import Database
from app.registry.engines import across_agencies, acting_for
from app.registry.jobs import JobKind, JobRow, JobState, UnfinishedJob
from app.services.documents import error_document
from app.services.ports import Clock, DeadLetters

# === The queue that each kind of job waits in, on both engines.


class QueueName(StrEnum):
    """Queues of jobs; workers can be started for some of them only."""

    ONLINE = "online"
    """A vehicle or a person waits for the result within seconds."""
    PROOF = "proof"
    """Plans and what is computed from them, up to hours."""
    ARCHIVE = "archive"
    """Work over what is stored, which gives way to all other."""


QUEUES: Mapping[JobKind, QueueName] = {
    JobKind.DECODE: QueueName.ONLINE,
    JobKind.IMPORT: QueueName.ONLINE,
    JobKind.PLAN: QueueName.PROOF,
    JobKind.PROOF: QueueName.PROOF,
    JobKind.PACKAGE: QueueName.PROOF,
    JobKind.ARTWORK: QueueName.PROOF,
    JobKind.EXPORT: QueueName.PROOF,
    JobKind.REPROCESS: QueueName.ARCHIVE,
    JobKind.DRIVE: QueueName.ONLINE,
    JobKind.AUDIT: QueueName.ARCHIVE,
}


def kinds_in(queue: QueueName) -> tuple[JobKind, ...]:
    """Kinds of the jobs that wait in a queue."""
    return tuple(kind for kind, name in QUEUES.items() if name is queue)


# === Keeps the leases of the jobs that run in this process, so that no other process starts them too.


RENEW_S = store.LEASE.total_seconds() / 3
_LOG = structlog.get_logger(__name__)
_HOST_CHARACTERS = 60  # the column has 100


class LeaseKeeper:
    """A thread that renews the leases of running jobs; it lives as long as one runs."""

    def __init__(self, database: Database, clock: Clock) -> None:
        self._database, self._clock = database, clock
        self._lock = threading.Lock()
        self._runners: set[str] = set()
        self._numbers = count(1)
        self._ended = threading.Event()

    def new_runner(self) -> str:
        """Name of a run of a job, which no other has."""
        return f"{socket.gethostname()[:_HOST_CHARACTERS]}:{os.getpid()}:{next(self._numbers)}:{os.urandom(4).hex()}"

    @contextmanager
    def keep(self, runner: str) -> Iterator[None]:
        """Renew the lease of a run until the block ends."""
        if self._database.path is not None:
            yield  # this process owns the database
            return
        with self._lock:
            self._runners.add(runner)
            if len(self._runners) == 1:
                self._ended = threading.Event()
                threading.Thread(target=self._renew, args=(self._ended,), name="job-leases", daemon=True).start()
        try:
            yield
        finally:
            with self._lock:
                self._runners.discard(runner)
                if not self._runners:
                    self._ended.set()

    def _renew(self, ended: threading.Event) -> None:
        while not ended.wait(RENEW_S):
            with self._lock:
                runners = sorted(self._runners)
            try:
                with across_agencies(), self._database.write_aside() as connection:
                    store.renew_leases(connection, runners, self._clock())
            except Unavailable as error:
                _LOG.warning("the leases of jobs were not renewed", why=error.message)


# === Jobs: one place starts them, notices that they were cancelled, and records how they ended.


MAX_ATTEMPTS = 10
"""How often a job is started; one that never ends then fails. Starts that ended because the server was stopped, or a
store was full or did not answer, are not counted: such a job waits. Kills of the server count; a file that kills its
decoder process fails its job at once. With 3, one of 179 jobs was not done after 50 kills."""


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
        keep: Callable[[sa.Connection], None] | None = None, resumable: bool = True,
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
        resumable : bool, optional
            Whether the next attempt goes on from there; if not, the part is only for those who look meanwhile.

        Raises
        ------
        JobCancelled
            Somebody asked the job to stop; nothing was kept.
        """
        with self._database.write() as connection:
            if not store.record_progress(
                connection, self.row.id, progress, steps=steps, kept=keep is not None and resumable
            ):
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

    def end(self, state: JobState, error: WaymarkError | None = None, *, dead_letter: bool = False) -> bool:
        """Record that the job ended without a result. Returns whether this was the first time."""
        document = error_document(error) if error is not None else None
        with self._database.write() as connection:
            return store.finish_job(
                connection, self.row.id, state, self._clock(), error=document, dead_letter=dead_letter
            )


class JobHandler(Protocol):
    """Carries out the jobs of one kind."""

    def run(self, job: RunningJob) -> None:
        """Do the work, and call `RunningJob.finish` in the transaction that stores its result.

        It may be called again after a crash, and by two workers at the same time: only the first `finish` counts.
        """


class Jobs:
    """Runs queued jobs."""

    def __init__(
        self,
        database: Database,
        clock: Clock,
        handlers: Mapping[JobKind, JobHandler],
        dead_letters: DeadLetters | None = None,
        max_attempts: int = MAX_ATTEMPTS,
    ) -> None:
        self._database, self._clock = database, clock
        self._handlers = handlers
        self._dead_letters = dead_letters
        self._max_attempts = max_attempts
        self._leases = LeaseKeeper(database, clock)

    def run_job(self, job_id: str) -> bool:
        """Run a queued job. It may be called again and at the same time: the effect happens once.

        Returns
        -------
        bool
            Whether it ran: not if it is finished or gone, or if another process runs it.

        Raises
        ------
        Unavailable
            The decoder processes or the stores do not answer; the job waits and can be run again.
        """
        runner = self._leases.new_runner()
        with across_agencies(), self._database.write() as connection:
            row = leases.start_job(connection, job_id, self._clock(), runner)
        return self._run_started(row, runner)

    def run_next(self, kinds: Sequence[JobKind]) -> bool:
        """Run the job of some kinds whose turn it is: agencies take turns. As `run_job` otherwise."""
        runner = self._leases.new_runner()
        with across_agencies(), self._database.write() as connection:
            now = self._clock()
            found = leases.list_next(connection, kinds, now)
            row = leases.start_job(connection, found[0].id, now, runner) if found else None
        return self._run_started(row, runner)

    def list_startable(self) -> list[UnfinishedJob]:
        """The jobs that wait, and those of processes that died."""
        with across_agencies(), self._database.read() as connection:
            return leases.list_startable(connection, self._clock())

    @contextmanager
    def counted(self) -> Iterator[dict[JobKind, int] | None]:
        """Numbers of jobs that wait or were left by processes that died; None while another process counts them."""
        with across_agencies(), self._database.read() as connection:
            alone = leases.is_only_one(connection)
            yield leases.count_startable(connection, self._clock()) if alone else None

    def _run_started(self, row: JobRow | None, runner: str) -> bool:
        if row is None:
            return False
        with (
            structlog.contextvars.bound_contextvars(job_id=row.id, kind=row.kind),
            tracing.span("job", parent=self._traceparent(row), job_id=row.id, kind=row.kind),
            acting_for(row.agency_id),
            self._leases.keep(runner),
        ):
            began_s = time.perf_counter()
            try:
                self._run(RunningJob(self._database, self._clock, row), runner)
            finally:
                _LOG.info("job", agency=row.agency_id, ms=round(1e3 * (time.perf_counter() - began_s), 2))
        return True

    def _traceparent(self, row: JobRow) -> str | None:
        """The context of the span that made a job; not asked for where nothing is recorded."""
        if not tracing.is_on():
            return None
        with acting_for(row.agency_id), self._database.read() as connection:
            return store.find_traceparent(connection, row.id)

    def _run(self, job: RunningJob, runner: str) -> None:
        if job.row.cancel_requested:
            job.end("cancelled")
            return
        if job.row.attempts > self._max_attempts:
            self._bury(job, _too_many_attempts(self._max_attempts))
            return
        try:
            self._handlers[JobKind(job.row.kind)].run(job)
        except JobCancelled:
            job.end("cancelled")
        except Unavailable:
            self._return(job, runner)
            raise
        except ProcessStopped as error:
            self._bury(job, error)
        except WaymarkError as error:
            job.end("failed", error)
        except Exception as error:
            if is_disk_full(error):
                self._return(job, runner)
                raise StorageFull("the folder for temporary files") from error
            # a defect must not leave a job that runs for ever
            _LOG.exception("a job failed on a defect")
            job.end("failed", WaymarkError("the job failed on a defect of the server; its log has the details"))

    def _bury(self, job: RunningJob, error: WaymarkError) -> None:
        """Fail a job that stopped its processes."""
        if job.end("failed", error, dead_letter=True):
            _LOG.warning("a job stopped its process", why=error.message)
            if self._dead_letters is not None:
                self._dead_letters.bury(job.row.id, JobKind(job.row.kind), error.message)

    def _return(self, job: RunningJob, runner: str) -> None:
        with suppress(Unavailable), self._database.write() as connection:
            leases.return_job(connection, job.row.id, runner, self._clock())


def _too_many_attempts(attempts: int) -> WaymarkError:
    return ProcessStopped(
        "the job was interrupted each time: the server or its processes ended before it was done",
        limit=f"{attempts} attempts",
        cure="send it again; if that fails too, send it in smaller parts",
    )
