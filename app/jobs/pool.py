"""Decoder processes: children with limits, each behind a thread and a pipe of its own, and outlived by the pool.

Agencies share them: the task of the agency that used least lately is taken next, one agency holds at most half of the
places while others want some, and its jobs leave one process to others that were there in the last hour.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import resource
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, wait
from concurrent.futures import TimeoutError as FutureTimeout
from functools import cache
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar, TypeVarTuple

import structlog

from app import tracing
from app.decoding.frames import DecodePlates
from app.errors import ProcessStopped, Unavailable
from app.jobs.decoder_process import (
    ONE_THREAD,
    READY,
    READY_WITH_NETWORK,
    Outcome,
    Placeholder,
    ProcessLimits,
    delete_folders_of_the_dead,
    new_folder,
    process_id,
    serve_tasks,
)
from app.jobs.queues import FairQueue
from app.registry.engines import EVERY_AGENCY, whose_rows
from app.services.decoder_tasks import is_long_task
from app.services.decodes.trace_tasks import compile_traces
from app.services.request_work import add_processor_time, check_deadline, current_work

# === Places of tasks in the decoder processes or before them: no agency takes all of them from the others.


_CERTAIN = 2  # places that an agency gets also where others hold all; one that runs and the next


class Places:
    """Places that agencies share.

    An agency gets a place while any is free, but more than half of them only while no other agency holds or waits for
    one. Its first two are certain, so that a server whose places are all taken by one agency still serves another.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._changed = threading.Condition()
        self._held: Counter[str] = Counter()
        self._waiting: Counter[str] = Counter()

    def take(self, agency_id: str, wait_s: float = 0.0) -> None:
        """Take a place.

        Parameters
        ----------
        agency_id : str
            Or `EVERY_AGENCY` or an empty text for work of the server itself, which has no certain places.
        wait_s : float
            How long to wait for one. [s]

        Raises
        ------
        Unavailable
            None is free for this agency.
        """
        with self._changed:
            self._waiting[agency_id] += 1
            try:
                if not self._changed.wait_for(lambda: self._is_free(agency_id), wait_s):
                    raise self._busy(agency_id)
                self._held[agency_id] += 1
            finally:
                _decrease(self._waiting, agency_id)

    def give_back(self, agency_id: str) -> None:
        """Give a place back."""
        with self._changed:
            _decrease(self._held, agency_id)
            self._changed.notify_all()

    def _is_free(self, agency_id: str) -> bool:
        own, is_agency = self._held[agency_id], agency_id not in ("", EVERY_AGENCY)
        if is_agency and own < _CERTAIN:
            return True
        if self._held.total() >= self._count:
            return False
        is_shared = any(other != agency_id for other in (*self._held, *self._waiting) if self._wants(other))
        return not (is_agency and is_shared and own >= self._count // 2)

    def _wants(self, agency_id: str) -> bool:
        return self._held[agency_id] > 0 or self._waiting[agency_id] > 0

    def _busy(self, agency_id: str) -> Unavailable:
        own = self._held[agency_id]
        return Unavailable(
            f"every decoder process is busy; {own} tasks of this agency wait or are carried out",
            limit=f"{self._count} tasks, and {self._count // 2} of one agency while others send some",
            cure="try again in a few seconds",
        )


def _decrease(counter: Counter[str], agency_id: str) -> None:
    counter[agency_id] -= 1
    if not counter[agency_id]:
        del counter[agency_id]


# === A thread that supervises one decoder process: starts it, sends it tasks, stops it at its limits, replaces it.


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
    arguments : tuple of object
        One may be a Future that the caller has yet to set.
    interrupt : callable
        Stops the process that works on this, if one does.
    timeout_s : float
        Longest time in the process. [s]
    is_job : bool
        Whether it is a part of a job, for which nobody waits in a request.

    Attributes
    ----------
    used_s : float
        Time in the process so far, which works on nothing else. [s]
    """

    def __init__(
        self,
        task: Callable[..., T],
        arguments: tuple[object, ...],
        interrupt: Callable[[Pending[Any]], None],
        timeout_s: float,
        agency_id: str = "",
        *,
        is_job: bool = False,
    ) -> None:
        self.task, self.arguments = task, arguments
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
        for argument in self.arguments:
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
            late = [argument for argument in pending.arguments if isinstance(argument, Future)]
            sent = [Placeholder.LATE if isinstance(argument, Future) else argument for argument in pending.arguments]
            connection.send((pending.task, sent))
            for argument in late:
                connection.send(self._wait_for(argument))
            if connection.poll(pending.timeout_s):
                outcome, result, times_ns = connection.recv()
                tracing.record(pending.task.__name__, pending.traceparent, times_ns)
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


# === Decoder processes.


ArgumentsT = TypeVarTuple("ArgumentsT")
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
        self.submit(compile_traces)

    def open(self) -> None:
        """Start the processes and wait until one is ready.

        Raises
        ------
        Unavailable
            None could be started.
        """
        self.run(process_id)

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

    def submit(
        self, task: Callable[[*ArgumentsT], ResultT], *arguments: *ArgumentsT, wait_s: float = 0.0
    ) -> Pending[ResultT]:
        """As `DecoderProcesses.submit`; `Unavailable` also where the pool was closed."""
        agency_id = whose_rows()
        self._places.take(agency_id, wait_s)
        timeout_s = self._limits.trace_timeout_s if is_long_task(task) else self._limits.timeout_s
        work = current_work()
        pending: Pending[ResultT] = Pending(
            task, arguments, self._interrupt, timeout_s, agency_id, is_job=work is not None and work.is_job
        )
        pending.future.add_done_callback(lambda _future: self._places.give_back(agency_id))
        with self._lock:
            if self._closed:
                pending.future.cancel()
                raise Unavailable("the server is stopping", cure="try again in a few seconds")
            self._start_supervisors()
            self._tasks.put(agency_id, pending, is_job=pending.is_job)
        return pending

    def run(self, task: Callable[[*ArgumentsT], ResultT], *arguments: *ArgumentsT, wait_s: float = 0.0) -> ResultT:
        """As `DecoderProcesses.run`."""
        return self.submit(task, *arguments, wait_s=wait_s).result()

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
