"""Decoder processes: children with limits, each behind a thread and a pipe of its own, and outlived by the pool.

Agencies share them: the task of the agency that used least lately is taken next, one agency holds at most half of the
places while others want some, and its jobs leave one process to others that were there in the last hour.
"""

from __future__ import annotations

import os
import resource
import threading
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from app.errors import Unavailable
from app.jobs.decoder_process import ONE_THREAD, ProcessIdTask
from app.jobs.fair_queue import FairQueue
from app.jobs.frame_tasks import DecodePlates
from app.jobs.places import Places
from app.jobs.process_limits import ProcessLimits, delete_folders_of_the_dead
from app.jobs.supervisor import Pending, WorkerSupervisor
from app.registry.tenancy import whose_rows
from app.services.decoder_processes import Task
from app.services.decodes.trace_task import CompileTracesTask
from app.services.request_work import current_work

ResultT = TypeVar("ResultT")


class PoolState(NamedTuple):
    """Decoder processes that run and that are wanted, their memory [byte], waiting tasks, and the number of starts."""

    running: int
    wanted: int
    memory_bytes: int
    waiting: int
    starts: int


class DecodePool:
    """Decoder processes; `submit` hands them tasks.

    Parameters
    ----------
    decode : callable
        Module-level `decode_plates`; it is imported by name in each child.
    workers : int
    limits : ProcessLimits
    max_pixels : int
        Largest picture that OpenCV in a child decodes, in case the check of the header misses one. [px]
    max_waiting : int
        Largest number of tasks that wait or are carried out; more are refused as busy. An agency that has fewer than
        two is never refused.
    """

    def __init__(
        self,
        decode: DecodePlates,
        *,
        workers: int = 2,
        limits: ProcessLimits | None = None,
        max_pixels: int = 50_000_000,
        max_waiting: int = 32,
    ) -> None:
        self._decode = decode
        self._workers = workers
        self._limits = limits or ProcessLimits()
        self._max_pixels = max_pixels
        self._places = Places(max_waiting)
        self._lock = threading.Lock()
        self._tasks: FairQueue[Pending[Any]] = FairQueue(jobs_at_once=max(workers - 1, 1))
        self._supervisors: list[WorkerSupervisor] = []
        self._closed = False

    def warm(self) -> None:
        """Start the processes without waiting for them; without it the first task starts them.

        One of them compiles what decodes traces, which takes half a minute on a machine that never did: a recording
        then need not wait for it. The others load it from the disk.
        """
        with self._lock:
            self._start_supervisors()
        self.submit(CompileTracesTask())

    def open(self) -> None:
        """Start the processes and wait until one is ready.

        Raises
        ------
        Unavailable
            None could be started.
        """
        self.submit(ProcessIdTask()).result()

    def close(self) -> None:
        """Stop the processes, also in the middle of a task."""
        with self._lock:
            self._closed = True
            supervisors, self._supervisors = self._supervisors, []
        for supervisor in supervisors:
            supervisor.close()
        self._tasks.close()
        for supervisor in supervisors:
            supervisor.join()

    def is_ready(self) -> bool:
        """Whether tasks can be handed over."""
        with self._lock:
            return not self._closed and (
                not self._supervisors or any(supervisor.is_up for supervisor in self._supervisors)
            )

    def describe(self) -> PoolState:
        """What the processes do now."""
        with self._lock:
            supervisors = list(self._supervisors)
        running = [pid for supervisor in supervisors if (pid := supervisor.process_id) is not None]
        memory_bytes = sum(map(_resident_bytes, running))
        starts = sum(supervisor.starts for supervisor in supervisors)
        return PoolState(len(running), self._workers, memory_bytes, len(self._tasks), starts)

    def submit(self, task: Task[ResultT], *, wait_s: float = 0.0) -> Pending[ResultT]:
        """As `DecoderProcesses.submit`; `Unavailable` also where the pool was closed."""
        agency_id = whose_rows()
        self._places.take(agency_id, wait_s)
        timeout_s = self._limits.trace_timeout_s if task.is_long else self._limits.timeout_s
        work = current_work()
        pending: Pending[ResultT] = Pending(
            task.steps(), self._interrupt, timeout_s, agency_id, is_job=work is not None and work.is_job
        )
        pending.future.add_done_callback(lambda _future: self._places.give_back(agency_id))
        with self._lock:
            if self._closed:
                pending.future.cancel()
                raise Unavailable("the server is stopping", cure="try again in a few seconds")
            self._start_supervisors()
            self._tasks.put(agency_id, pending, is_job=pending.is_job)
        return pending

    def _interrupt(self, pending: Pending[Any]) -> None:
        for supervisor in self._supervisors:
            supervisor.interrupt(pending)

    def _start_supervisors(self) -> None:
        if self._supervisors or self._closed:
            return
        # children take these from the environment before they import numpy or OpenCV
        delete_folders_of_the_dead()
        os.environ.update(ONE_THREAD, OPENCV_IO_MAX_IMAGE_PIXELS=str(self._max_pixels))
        self._supervisors = [WorkerSupervisor(self._tasks, self._decode, self._limits) for _ in range(self._workers)]
        for supervisor in self._supervisors:
            supervisor.start()


def _resident_bytes(pid: int) -> int:
    """Resident memory of a process; 0 where it has ended or the system does not report it."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * resource.getpagesize()
    except OSError:
        return 0
