"""Decoder processes: a Pebble pool whose children have limits, and that outlives any of them."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError
from concurrent.futures import TimeoutError as FutureTimeout
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Generic, TypeVar

from pebble import ProcessExpired, ProcessFuture, ProcessPool

from app.errors import Unavailable, UnreadableUpload
from app.jobs.child import ONE_THREAD, ChildLimits, DecodePlates, annotate_frame, decode_frame, warm_child
from app.services.frames import AnnotationTask, FrameResult, FrameTask

T = TypeVar("T")
_START_S = 120.0
_PATIENCE_S = 120.0


class DecodePool:
    """Processes that decode frames.

    Parameters
    ----------
    decode : callable
        Module-level `decode_plates`; it is imported by name in each child.
    workers : int
    limits : ChildLimits
    max_pixels : int
        Most pixels that OpenCV in a child agrees to decode: a second line behind the header check.
    max_waiting : int
        Most frames that are waiting or being decoded; more are refused as busy.
    """

    def __init__(
        self,
        decode: DecodePlates,
        *,
        workers: int = 2,
        limits: ChildLimits | None = None,
        max_pixels: int = 50_000_000,
        max_waiting: int = 32,
    ) -> None:
        self._decode = decode
        self._workers = workers
        self._limits = limits or ChildLimits()
        self._max_pixels = max_pixels
        self._places = threading.BoundedSemaphore(max_waiting)
        self._lock = threading.Lock()
        self._pool: ProcessPool | None = None
        self._pending: set[Pending[Any]] = set()
        self._closed = False

    def warm(self) -> None:
        """Start the processes without waiting for them; without it the first frame starts them."""
        self._running_pool().schedule(os.getpid)

    def open(self) -> None:
        """Start the processes and wait until one is ready.

        Raises
        ------
        Unavailable
            None could be started.
        """
        try:
            self._schedule(os.getpid, ()).result(timeout=_START_S)
        except (FutureTimeout, BrokenProcessPool, ProcessExpired) as error:
            raise Unavailable("no decoder process could be started") from error

    def close(self) -> None:
        """Stop the processes, also in the middle of a frame."""
        with self._lock:
            self._closed = True
            pool, self._pool = self._pool, None
            pending = list(self._pending)
        for waiting in pending:  # Pebble forgets the tasks of a pool that is stopped; their callers would wait for ever
            waiting.cancel()
        if pool is not None:
            _stop(pool)

    def is_ready(self) -> bool:
        """Whether frames can be handed over. A pool that was given up says so once, and is replaced on the way."""
        with self._lock:
            pool, closed = self._pool, self._closed
        if closed:
            return False
        if pool is None or pool.active:
            return True
        self._discard(pool)
        self.warm()
        return False

    def start(self, task: FrameTask, *, wait_s: float = 0.0) -> Pending[FrameResult]:
        """Hand a frame over and return, at once or as soon as there is a place for it within `wait_s`."""
        return self._start(decode_frame, task, wait_s)

    def annotate(self, task: AnnotationTask) -> bytes:
        """Picture with outlines, encoded."""
        return self._start(annotate_frame, task).result()

    def _start(self, function: Callable[[Any], T], task: Any, wait_s: float = 0.0) -> Pending[T]:
        if not (self._places.acquire(timeout=wait_s) if wait_s else self._places.acquire(blocking=False)):
            raise Unavailable("every decoder process is busy", cure="try again in a few seconds")
        try:
            pending = Pending(lambda: self._schedule(function, (task,)), self._release, self._limits.timeout_s)
        except BaseException:
            self._places.release()
            raise
        with self._lock:
            self._pending.add(pending)
            closed = self._closed
        if closed:
            pending.cancel()
        return pending

    def _release(self, pending: Pending[Any]) -> None:
        with self._lock:
            self._pending.discard(pending)
        self._places.release()

    def _schedule(self, function: Callable[..., T], args: tuple[Any, ...]) -> ProcessFuture[T]:
        for _attempt in range(2):
            pool = self._running_pool()
            try:
                return pool.schedule(function, args=args, timeout=self._limits.timeout_s)
            except RuntimeError:  # Pebble gives the whole pool up when an idle child is killed: take a new one
                self._discard(pool)
        raise Unavailable("no decoder process could be started", cure="try again in a few seconds")

    def _running_pool(self) -> ProcessPool:
        with self._lock:
            if self._closed:
                raise Unavailable("the server is stopping", cure="try again in a few seconds")
            if self._pool is None:
                # children take these from the environment before they import numpy or OpenCV
                os.environ.update(ONE_THREAD, OPENCV_IO_MAX_IMAGE_PIXELS=str(self._max_pixels))
                self._pool = ProcessPool(
                    max_workers=self._workers,
                    initializer=warm_child,
                    initargs=(self._decode, self._limits),
                    context=multiprocessing.get_context("spawn"),
                )
            return self._pool

    def _discard(self, pool: ProcessPool) -> None:
        with self._lock:
            if self._pool is pool:
                self._pool = None
        _stop(pool)


def _cancel(future: Any) -> None:
    future.cancel()


def _stop(pool: Any) -> None:
    pool.stop()
    pool.join()


class Pending(Generic[T]):
    """A task on its way through a decoder process.

    Parameters
    ----------
    schedule : callable
        Hands the task over. It is called again once if the process dies: that can be another's fault.
    release : callable
        Called once, with this, when the task is over.
    timeout_s : float
        For the message only. [s]
    """

    def __init__(
        self, schedule: Callable[[], ProcessFuture[T]], release: Callable[[Pending[T]], None], timeout_s: float
    ) -> None:
        self._schedule = schedule
        self._releases = [release]
        self._timeout_s = timeout_s
        self._cancelled = False
        self._future = schedule()

    def result(self) -> T:
        """Wait for it, once; what goes wrong in the process comes back as the domain's error."""
        try:
            try:
                return self._future.result(self._timeout_s + _PATIENCE_S)
            except (ProcessExpired, BrokenProcessPool):
                if self._cancelled:
                    raise
                self._future = self._schedule()
                return self._future.result(self._timeout_s + _PATIENCE_S)
        except (FutureTimeout, TimeoutError) as error:
            if not self._future.done():  # nobody took it: the processes do not start, or are all busy for minutes
                _cancel(self._future)
                raise Unavailable("no decoder process is free", cure="try again later") from error
            raise UnreadableUpload(
                "decoding the picture took too long and was stopped",
                field="file",
                limit=f"{self._timeout_s:g} s a frame",
                cure="send the frame as the camera wrote it; if it is, report it as a defect",
            ) from error
        except ProcessExpired as error:
            raise UnreadableUpload(
                "the picture stopped the decoder process, twice",
                field="file",
                cure="send the frame as the camera wrote it; if it is, report it as a defect",
            ) from error
        except (BrokenProcessPool, CancelledError) as error:
            raise Unavailable("the decoder process was stopped", cure="try again in a few seconds") from error
        finally:
            self._release_once()

    def cancel(self) -> None:
        """Stop it, also when it runs already."""
        self._cancelled = True
        _cancel(self._future)
        self._release_once()

    def _release_once(self) -> None:
        while self._releases:
            self._releases.pop()(self)
