"""A thread that supervises one decoder process: starts it, sends it tasks, stops it at its limits, replaces it."""

from __future__ import annotations

import multiprocessing
import queue
import shutil
import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, wait
from concurrent.futures import TimeoutError as FutureTimeout
from functools import cache
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Generic, TypeVar

import structlog

from app import tracing
from app.errors import ProcessStopped, Unavailable
from app.jobs.decoder_process import READY, READY_WITH_NETWORK, Outcome, serve_tasks
from app.jobs.fair_queue import FairQueue
from app.jobs.frame_tasks import DecodePlates
from app.jobs.process_limits import ProcessLimits, new_folder
from app.services.request_work import add_processor_time, check_deadline

T = TypeVar("T")
_START_S = 300.0
_PATIENCE_S = 300.0
_CHECK_S = 1.0
_RETRY_S = 30.0
_AGAIN_S = 0.2
_LOG = structlog.get_logger(__name__)
_PROCESSES = multiprocessing.get_context("forkserver")
"""One process loads the decoders, and the decoder processes are its forks: each starts in a part of the time."""
_PROCESSES.set_forkserver_preload(["app.jobs.forkserver_preload"])


class Pending(Generic[T]):
    """A task on its way through a decoder process.

    Parameters
    ----------
    steps : tuple of object
        Arguments of the task's steps (`app.jobs.tasks.STEPS`). One may be a Future that the caller has yet to set.
    interrupt : callable
        Stops the process that works on this, if one does.
    timeout_s : float
        Longest time in the process. [s]
    agency_id : str
    is_job : bool
        Whether it is a part of a job, for which nobody waits in a request.

    Attributes
    ----------
    used_s : float
        Time in the process so far, which works on nothing else. [s]
    """

    def __init__(
        self, steps: tuple[object, ...], interrupt: Callable[[Pending[Any]], None], timeout_s: float,
        agency_id: str = "", *, is_job: bool = False,
    ) -> None:  # fmt: skip
        self.steps = steps
        self.agency_id, self.is_job = agency_id, is_job
        self.future: Future[T] = Future()
        self.timeout_s = timeout_s
        self.stopped = False
        self.used_s = 0.0
        self.traceparent = tracing.current()
        self._interrupt = interrupt

    def result(self) -> T:
        """Wait for the result; an error in the process is raised here. The request is charged the process's time."""
        last_s = time.monotonic() + self.timeout_s + _PATIENCE_S
        try:
            while time.monotonic() < last_s:
                wait([self.future], _CHECK_S)
                if self.future.done():
                    return self.future.result()
                check_deadline()
        except CancelledError as error:
            raise _was_stopped() from error
        except Unavailable:
            self.cancel()
            raise
        finally:
            add_processor_time(self.used_s)
        self.cancel()
        raise Unavailable("no decoder process is free", cure="try again later")

    def cancel(self) -> None:
        """Stop it, also when it runs already."""
        self.stopped = True
        for argument in self.steps:
            if isinstance(argument, Future):
                argument.cancel()
        if not self.future.cancel():
            self._interrupt(self)


class WorkerSupervisor(threading.Thread):
    """Runs tasks one after the other in a process of its own.

    Parameters
    ----------
    tasks : FairQueue of Pending
        Shared with the other supervisors; they end when it is closed.
    decode : callable
        `decode_plates`, imported by name in the process.
    limits : ProcessLimits
    """

    def __init__(self, tasks: FairQueue[Pending[Any]], decode: DecodePlates, limits: ProcessLimits) -> None:
        super().__init__(name="decoder-supervisor", daemon=True)
        self._tasks = tasks
        self._decode = decode
        self._limits = limits
        self._lock = threading.Lock()
        self._process: BaseProcess | None = None
        self._connection: Connection | None = None
        self._folder: Path | None = None
        self._current: Pending[Any] | None = None
        self._closing = False
        self._failed_at: float | None = None
        self.starts = 0

    @property
    def process_id(self) -> int | None:
        """Of its process, if that runs."""
        with self._lock:
            return self._process.pid if self._process is not None and self._process.is_alive() else None

    @property
    def is_up(self) -> bool:
        """Whether its process runs or is being started."""
        with self._lock:
            return self._failed_at is None and (self._process is None or self._process.is_alive())

    def interrupt(self, pending: Pending[Any]) -> None:
        """Kill the process if it works on this task."""
        with self._lock:
            if self._current is pending and self._process is not None:
                self._process.kill()

    def close(self) -> None:
        """Kill the process and refuse further tasks; the thread ends with the queue."""
        with self._lock:
            self._closing = True
            if self._process is not None:
                self._process.kill()

    def run(self) -> None:
        """Serve until the queue is closed and empty."""
        self._start_early()
        while True:
            try:
                pending = self._tasks.get(_CHECK_S)
            except queue.Empty:
                self._start_early()
                continue
            if pending is None:
                break
            answer: Any = None
            error: BaseException | None = None
            is_wanted = pending.future.set_running_or_notify_cancel()
            if is_wanted:
                try:
                    answer = self._run_in_process(pending)
                except BaseException as raised:  # noqa: BLE001 - raised again where the task is waited for
                    error = raised
            self._tasks.done(pending.agency_id, pending.used_s, is_job=pending.is_job)
            if is_wanted:
                pending.future.set_result(answer) if error is None else pending.future.set_exception(error)
        self._drop()

    # --- one task ---------------------------------------------------------------------------------------------------

    def _run_in_process(self, pending: Pending[Any]) -> Any:
        """Run a task; once more in a new process if this one dies or runs short, which need not be the task's fault."""
        failure: BaseException | None = None
        for _attempt in range(2):
            connection = self._connection if self._is_alive() else self._start()
            if connection is None:
                raise Unavailable("no decoder process could be started", cure="try again in a few seconds")
            try:
                outcome, answer = self._exchange(connection, pending)
            except (EOFError, OSError):
                self._drop()
                if self._closing or pending.stopped:
                    raise _was_stopped() from None
                continue
            if outcome is Outcome.DONE:
                return answer
            if outcome is Outcome.FAILED:
                raise answer
            self._drop()
            failure = answer
        raise failure or ProcessStopped(
            "the work was interrupted: the decoder process ended before it was done with the file, twice",
            field="file",
            cure="send it again; if that fails too, send it in smaller parts, and report it as a defect",
        )

    def _exchange(self, connection: Connection, pending: Pending[Any]) -> tuple[Outcome, Any]:
        with self._lock:
            if self._closing or pending.stopped:
                raise _was_stopped()
            self._current = pending
        started_s = time.monotonic()
        try:
            for number, step in enumerate(pending.steps, 1):
                argument = self._wait_for(step) if isinstance(step, Future) else step
                connection.send((argument, number == len(pending.steps)))
            if connection.poll(pending.timeout_s):
                outcome, result, times_ns = connection.recv()
                for (name, *between), step in zip(times_ns, pending.steps, strict=True):
                    tracing.record(name, pending.traceparent, tuple(between), task=type(step).__name__)
                return outcome, result
        finally:
            pending.used_s += time.monotonic() - started_s
            with self._lock:
                self._current = None
        self._drop()
        raise ProcessStopped(
            "reading the file took too long and was stopped",
            field="file",
            limit=f"{pending.timeout_s:g} s a file",
            cure="send it in smaller parts: a shorter recording, fewer rows; if it is short, report it as a defect",
        )

    def _wait_for(self, argument: Future[Any]) -> Any:
        try:
            return argument.result(self._limits.timeout_s)
        except (CancelledError, FutureTimeout) as error:
            self._drop()  # it is in the middle of the task
            raise _was_stopped() from error

    # --- the process ------------------------------------------------------------------------------------------------

    def _is_alive(self) -> bool:
        return self._process is not None and self._process.is_alive()

    def _start_early(self) -> None:
        """Have a process ready before a task needs it; if none starts, try again every `_RETRY_S`."""
        if self._closing or self._is_alive():
            return
        if self._failed_at is None or time.monotonic() - self._failed_at > _RETRY_S:
            self._start()

    def _start(self) -> Connection | None:
        """Start a process and wait until it is warm; once more if the process that it is a fork of was just ending."""
        for _attempt in range(2):
            if self._closing:
                return None
            if (connection := self._try_to_start()) is not None:
                return connection
            time.sleep(_AGAIN_S)
        self._failed_at = time.monotonic()
        if not self._closing:
            _LOG.error("a decoder process did not start")
        return None

    def _try_to_start(self) -> Connection | None:
        self._drop()
        ours, theirs = _PROCESSES.Pipe()
        folder = self._folder = new_folder()
        arguments = (theirs, self._decode, self._limits, folder)
        process = _PROCESSES.Process(target=serve_tasks, args=arguments, daemon=True)
        try:
            process.start()
            theirs.close()
            with self._lock:
                self._process, self._connection = process, ours
                if self._closing:
                    process.kill()
            if ours.poll(_START_S) and (said := ours.recv()) in (READY, READY_WITH_NETWORK):
                self._failed_at = None
                self.starts += 1
                if said == READY_WITH_NETWORK:
                    _warn_of_network()
                return ours
        except (EOFError, OSError):
            pass
        self._drop()
        return None

    def _drop(self) -> None:
        """Kill the process, if there is one."""
        with self._lock:
            process, connection, folder = self._process, self._connection, self._folder
            self._process = self._connection = self._folder = None
        if connection is not None:
            connection.close()
        if process is not None:
            process.kill()
            process.join()
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


@cache
def _warn_of_network() -> None:
    _LOG.warning("decoder processes can reach the network: the kernel of this machine filters no system calls")


def _was_stopped() -> Unavailable:
    return Unavailable("the decoder process was stopped", cure="try again in a few seconds")
