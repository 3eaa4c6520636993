"""The job queue of the embedded server: threads of its own process run the jobs, of each agency in turn."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable

import structlog

from app.errors import Unavailable
from app.jobs.fair_queue import FairQueue

_LOG = structlog.get_logger(__name__)
_RETRY_S = 2.0


class LocalQueue:
    """Runs jobs in this process: those of an agency in the order they came, agencies in turn (`FairQueue`).

    The queue is not stored: the jobs' rows are, and `open` is given those that an earlier process left unfinished.

    Parameters
    ----------
    threads : int
        Jobs that run at the same time.
    """

    def __init__(self, threads: int = 1) -> None:
        self._waiting: FairQueue[tuple[str, str]] = FairQueue()
        self._closing = threading.Event()
        self._count = threads
        self._threads: list[threading.Thread] = []

    def open(self, run_job: Callable[[str], None], unfinished: Iterable[tuple[str, str]] = ()) -> None:
        """Start the threads; unfinished jobs, each with its agency, come first."""
        for job_id, agency_id in unfinished:
            self.submit(job_id, agency_id)
        for number in range(self._count):
            thread = threading.Thread(target=self._work, args=(run_job,), name=f"jobs-{number}", daemon=True)
            thread.start()
            self._threads.append(thread)

    def submit(self, job_id: str, agency_id: str) -> None:
        """Have the job of an agency run."""
        self._waiting.put(agency_id, (job_id, agency_id))

    def close(self) -> None:
        """Stop after the running jobs; close the decoder processes first to interrupt those."""
        self._closing.set()
        self._waiting.close()
        for thread in self._threads:
            thread.join()
        self._threads.clear()

    def _work(self, run_job: Callable[[str], None]) -> None:
        while (taken := self._waiting.get()) is not None and not self._closing.is_set():
            job_id, agency_id = taken
            try:
                run_job(job_id)
            except Unavailable as error:
                _LOG.warning("a job is tried again later", job_id=job_id, why=error.message)
                if not self._closing.wait(_RETRY_S):
                    self.submit(job_id, agency_id)
            except Exception:  # noqa: BLE001 - the next job must still run; this one is run again at the next start
                _LOG.exception("a job stopped on an error", job_id=job_id)
