"""Queues of jobs: the embedded server's own, what both engines have in common, and jobs submitted again."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from queue import Empty
from typing import Generic, Protocol, TypeVar

import structlog

from app.errors import Unavailable
from app.registry.engines import EVERY_AGENCY
from app.registry.jobs import JobKind, UnfinishedJob
from app.services.jobs import QUEUES, Jobs, QueueName
from app.services.ports import DeadLetters, JobQueue
from app.services.request_work import counted, working

# === A queue that several agencies share: the one that used least lately is next, however much others have waiting.


ItemT = TypeVar("ItemT")
_NO_AGENCY = ("", EVERY_AGENCY)  # work of the server itself
_REMEMBERED = 10_000  # owners that are remembered; far above the agencies of a server
_HALF_LIFE_S = 60.0  # after which half of what an owner used counts
_LATELY_S = 3600.0  # in which an owner that was served counts as one of several


@dataclass(slots=True)
class _Owner(Generic[ItemT]):
    """What waits of an owner and runs for it."""

    urgent: deque[ItemT] = field(default_factory=deque)
    jobs: deque[ItemT] = field(default_factory=deque)
    running: int = 0
    running_jobs: int = 0
    turn: int = 0  # number of its last item; 0: it had none
    served_at_s: float = 0.0
    used_s: float = 0.0  # at `used_at_s`
    used_at_s: float = 0.0

    def used_lately_s(self, now_s: float) -> float:
        return self.used_s * math.exp2((self.used_at_s - now_s) / _HALF_LIFE_S)


class FairQueue(Generic[ItemT]):
    """Items of several owners. The owner that used the least time lately is served next, with its oldest item.

    Among owners that used the same, the one whose last turn is longest ago is next. So an item waits for those of its
    own owner, but not for all that others have put before it.

    Parameters
    ----------
    at_once : int, optional
        Items of one owner between `get` and `done`. None: as many as there are.
    jobs_at_once : int, optional
        Items of one owner put as jobs between `get` and `done`, if another owner waits or was served in the last hour.
    now_s : callable
        A monotonic clock. [s]
    """

    def __init__(
        self, at_once: int | None = None, *, jobs_at_once: int | None = None,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self._at_once, self._jobs_at_once, self._now_s = at_once, jobs_at_once, now_s
        self._changed = threading.Condition()
        self._owners: dict[str, _Owner[ItemT]] = {}  # in the order of their last turns
        self._waiting: dict[str, None] = {}  # owners that have items
        self._turns = 0
        self._closed = False

    def put(self, owner: str, item: ItemT, *, is_job: bool = False) -> None:
        """Add an item behind those of its owner; a job also behind those that are none."""
        with self._changed:
            known = self._owners.setdefault(owner, _Owner())
            (known.jobs if is_job else known.urgent).append(item)
            self._waiting[owner] = None
            self._changed.notify_all()

    def get(self, timeout_s: float | None = None) -> ItemT | None:
        """Take the next item and wait for one if there is none; None once the queue is closed and empty.

        Raises
        ------
        Empty
            No item came in the time.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._closed or self._next() is not None, timeout_s):
                raise Empty
            owner = self._next()
            return None if owner is None else self._take(owner)

    def done(self, owner: str, used_s: float = 0.0, *, is_job: bool = False) -> None:
        """Record that an item of an owner is done, and the time that it used. [s]"""
        with self._changed:
            known, now_s = self._owners.setdefault(owner, _Owner()), self._now_s()
            known.running -= 1
            known.running_jobs -= is_job
            known.used_s, known.used_at_s = known.used_lately_s(now_s) + used_s, now_s
            self._changed.notify_all()

    def __len__(self) -> int:
        """Number of items that wait."""
        with self._changed:
            return sum(len(known.urgent) + len(known.jobs) for known in self._owners.values())

    def close(self) -> None:
        """Let `get` return None when no item is left that may be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _next(self) -> str | None:
        """The owner to serve; None if none has an item that may be taken."""
        now_s = self._now_s()
        ready = [owner for owner in self._waiting if self._may_serve(owner, now_s)]
        if not ready:
            return None
        return min(ready, key=lambda owner: (self._owners[owner].used_lately_s(now_s), self._owners[owner].turn))

    def _may_serve(self, owner: str, now_s: float) -> bool:
        known = self._owners[owner]
        if self._at_once is not None and known.running >= self._at_once:
            return False
        return bool(known.urgent) or (bool(known.jobs) and self._may_run_job(owner, now_s))

    def _may_run_job(self, owner: str, now_s: float) -> bool:
        if self._jobs_at_once is None or self._owners[owner].running_jobs < self._jobs_at_once:
            return True
        return not any(
            other.urgent or other.jobs or other.running or (other.turn and now_s - other.served_at_s < _LATELY_S)
            for name, other in self._owners.items()
            if name not in (owner, *_NO_AGENCY)
        )

    def _take(self, owner: str) -> ItemT:
        known = self._owners.pop(owner)
        is_job = not known.urgent
        item = (known.jobs if is_job else known.urgent).popleft()
        if not (known.urgent or known.jobs):
            del self._waiting[owner]
        self._turns += 1
        known.turn, known.served_at_s = self._turns, self._now_s()
        known.running += 1
        known.running_jobs += is_job
        self._owners[owner] = known
        if len(self._owners) > _REMEMBERED:
            idle = (name for name, other in self._owners.items() if not (other.running or other.urgent or other.jobs))
            if (oldest := next(idle, None)) is not None:
                del self._owners[oldest]
        return item


# === Jobs that nobody has are submitted again, from time to time: those of processes that died.


RESUBMIT_S = 5.0
"""How often jobs are looked for that nobody has. With the lease of a job it is the time until the job of a killed
process runs again, 20 s at most."""
_LOG = structlog.get_logger(__name__)


class Resubmission:
    """A thread that submits again what nobody has, every `RESUBMIT_S`.

    Parameters
    ----------
    resubmit : callable
        Looks for such jobs and submits them.
    """

    def __init__(self, resubmit: Callable[[], None]) -> None:
        self._resubmit = resubmit
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="jobs-resubmission", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(RESUBMIT_S):
            try:
                self._resubmit()
            except Unavailable as error:
                _LOG.warning("jobs were not looked for", why=error.message)
            except Exception:  # noqa: BLE001 - the next time may succeed
                _LOG.exception("jobs were not looked for")


# === The job queue of the embedded server: threads of its own process run the jobs, one of each agency at a time.


_RETRY_S = 2.0
ONLINE_THREADS = 4
"""Agencies whose jobs of the queue `online` run at the same time. The work is in decoder processes."""


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


# === The two engines that run jobs, as the wiring sees them: `LocalQueue` and `CeleryQueue`.


class JobEngine(JobQueue, DeadLetters, Protocol):
    """A queue of jobs that is opened and closed with the process."""

    def open(self, jobs: Jobs) -> None:
        """Start; `jobs` runs them, and lists those that wait."""

    def close(self) -> None:
        """Stop; close the decoder processes first to interrupt running jobs."""
