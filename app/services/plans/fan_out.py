"""Many tasks of one job in the decoder processes, a limited number of them at the same time."""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from typing import Any, TypeVar

from app.errors import Unavailable
from app.services.decoder_processes import DecoderProcesses, Pending, Task

KeyT = TypeVar("KeyT")
ResultT = TypeVar("ResultT")
WAIT_S = 60.0
"""How long a job waits for a place among the tasks of the decoder processes before it is put back. [s]
Source: chosen by hand, as decodes."""


def tasks_as_done(
    processes: DecoderProcesses, tasks: Iterable[tuple[KeyT, Task[ResultT]]], in_flight: int
) -> Generator[tuple[KeyT, ResultT]]:
    """Results in the order in which they come. Those on their way are stopped where the caller goes no further.

    Parameters
    ----------
    processes : DecoderProcesses
    tasks : iterable of (key, task)
    in_flight : int
        Tasks that wait or are carried out at the same time; uploads of vehicles queue behind no more than these.
    """
    feeder = _Feeder(processes)
    pool = ThreadPoolExecutor(in_flight, thread_name_prefix="plan-tasks")
    done: queue.SimpleQueue[Future[ResultT]] = queue.SimpleQueue()  # in the order in which they ended
    try:
        futures = {pool.submit(copy_context().run, feeder.carry_out, task): key for key, task in tasks}
        for future in futures:
            future.add_done_callback(done.put)
        for _ in range(len(futures)):
            future = done.get()
            yield futures.pop(future), future.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        feeder.stop()
        pool.shutdown()


def tasks_in_order(processes: DecoderProcesses, tasks: Iterable[Task[ResultT]], in_flight: int) -> Generator[ResultT]:
    """Results in the order of the tasks; otherwise as `tasks_as_done`. Only `in_flight` results are in memory."""
    waiting: deque[Pending[ResultT]] = deque()
    try:
        for task in tasks:
            waiting.append(processes.submit(task, wait_s=WAIT_S))
            if len(waiting) >= in_flight:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        for pending in waiting:
            pending.cancel()


class _Feeder:
    """Hands tasks over from several threads, and stops those that are on their way."""

    def __init__(self, processes: DecoderProcesses) -> None:
        self._processes = processes
        self._lock = threading.Lock()
        self._running: set[Pending[Any]] = set()
        self._stopped = threading.Event()

    def carry_out(self, task: Task[ResultT]) -> ResultT:
        """Hand a task over and wait for its result."""
        if self._stopped.is_set():
            raise Unavailable("the job was stopped")
        pending = self._processes.submit(task, wait_s=WAIT_S)
        with self._lock:
            self._running.add(pending)
        if self._stopped.is_set():
            pending.cancel()
        try:
            return pending.result()
        finally:
            with self._lock:
                self._running.discard(pending)

    def stop(self) -> None:
        """Stop the tasks."""
        self._stopped.set()
        with self._lock:
            running = list(self._running)
        for pending in running:
            pending.cancel()
