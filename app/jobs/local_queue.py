"""The job queue of the embedded server: threads of its own process run the jobs, one of each agency at a time."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Protocol

import structlog

from app.errors import Unavailable
from app.jobs.fair_queue import FairQueue
from app.jobs.resubmission import Resubmission
from app.registry.jobs import JobKind, UnfinishedJob
from app.services.job_queues import QUEUES, QueueName
from app.services.request_work import counted, working

_LOG = structlog.get_logger(__name__)
_RETRY_S = 2.0
ONLINE_THREADS = 4
"""Agencies whose jobs of the queue `online` run at the same time. Source: by hand; the work is in decoder processes."""


class Runner(Protocol):
    """What runs jobs: `app.services.jobs.Jobs`."""

    def run_job(self, job_id: str) -> bool:
        """Run a job."""

    def list_startable(self) -> list[UnfinishedJob]:
        """Jobs that wait, and those of processes that died."""


class LocalQueue:
    """Runs jobs in this process: those of an agency one after the other, in the order they came.

    `ONLINE_THREADS` threads run the jobs of the queue `online`, each those of another agency: of those that wait, that
    of the agency which used least lately is next (`FairQueue`). Each kind of job of the other queues has a thread of
    its own, so that a proof of hours holds up no plan.

    The queue is not stored: the jobs' rows are, and those that nobody has are submitted again, at the start and from
    time to time.

    Attributes
    ----------
    charge : callable
        Called with an agency and the processor time of one of its jobs that a vehicle or a person waits for. [s]
    """

    def __init__(self) -> None:
        self.charge: Callable[[str, float], None] = _charge_nobody
        self._closing = threading.Event()
        self._lanes: dict[str, FairQueue[UnfinishedJob]] = {_lane_of(kind): FairQueue(at_once=1) for kind in QUEUES}
        self._threads: list[threading.Thread] = []
        self._lock = threading.Lock()
        self._resubmission: Resubmission | None = None
        self._known: set[str] = set()  # jobs that wait here or run

    def open(self, jobs: Runner) -> None:
        """Start the threads; jobs that nobody has come first."""
        self._resubmit(jobs)
        for name, waiting in self._lanes.items():
            for _ in range(ONLINE_THREADS if name == QueueName.ONLINE.value else 1):
                thread = threading.Thread(target=self._work, args=(waiting, jobs), name=f"jobs-{name}", daemon=True)
                thread.start()
                self._threads.append(thread)
        self._resubmission = Resubmission(lambda: self._resubmit(jobs))

    def submit(self, job_id: str, agency_id: str, kind: JobKind) -> None:
        """Have the job of an agency run."""
        with self._lock:
            if job_id in self._known:
                return
            self._known.add(job_id)
        self._lanes[_lane_of(kind)].put(agency_id, UnfinishedJob(job_id, agency_id, kind))

    def bury(self, job_id: str, kind: JobKind, reason: str) -> None:
        """Nothing: the job's row has the reason."""

    def close(self) -> None:
        """Stop after the running jobs; close the decoder processes first to interrupt those."""
        self._closing.set()
        if self._resubmission is not None:
            self._resubmission.close()
        for waiting in self._lanes.values():
            waiting.close()
        for thread in self._threads:
            thread.join()
        self._threads.clear()

    def _work(self, waiting: FairQueue[UnfinishedJob], jobs: Runner) -> None:
        while (job := waiting.get()) is not None and not self._closing.is_set():
            is_over = True
            with working(math.inf, is_job=True) as work:
                try:
                    counted(jobs.run_job, job.id)
                except Unavailable as error:
                    _LOG.warning("a job is tried again later", job_id=job.id, why=error.message)
                    self._closing.wait(_RETRY_S)
                    is_over = False
                except Exception:  # noqa: BLE001 - the next job must still run; this one is submitted again
                    _LOG.exception("a job stopped on an error", job_id=job.id)
            if QUEUES[job.kind] is QueueName.ONLINE:
                self.charge(job.agency_id, work.used_s)
            if is_over:
                with self._lock:
                    self._known.discard(job.id)
            else:
                waiting.put(job.agency_id, job)
            waiting.done(job.agency_id, work.used_s)

    def _resubmit(self, jobs: Runner) -> None:
        for job in jobs.list_startable():
            self.submit(*job)


def _charge_nobody(_agency_id: str, _used_s: float) -> None:
    """Without limits on requests there is nothing to charge."""


def _lane_of(kind: JobKind) -> str:
    """Jobs with the same answer run one after the other."""
    queue = QUEUES[kind]
    return queue.value if queue is QueueName.ONLINE else kind.value
