"""Decoder processes: children with limits, each behind a thread and a pipe of its own, and outlived by the pool."""

from __future__ import annotations

import os
import queue
import threading
from concurrent.futures import Future
from typing import Any

from app.decoders.calibration.results import CameraCalibration
from app.errors import Unavailable
from app.jobs.calibration_child import calibrate_photos
from app.jobs.child import ONE_THREAD, ChildLimits, DecodePlates, annotate_frame, find_plates, load_frame, process_id
from app.jobs.keeper import Keeper, Pending, Step
from app.jobs.packet_child import draw_overlay, lay_lane, read_drive
from app.jobs.survey_child import read_survey_file
from app.jobs.trace_child import decode_recording
from app.registry.exchange.table import SurveyTable
from app.services.calibrations import CalibrationTask
from app.services.frames import AnnotationTask, FrameResult, FrameTask, PlateSearch
from app.services.imports import SurveyTask
from app.services.packets import DriveFiles, DriveTask, LaneResult, LaneTask, OverlayTask
from app.services.traces import TraceResult, TraceTask


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
        self._tasks: queue.SimpleQueue[Pending[Any] | None] = queue.SimpleQueue()
        self._keepers: list[Keeper] = []
        self._closed = False

    def warm(self) -> None:
        """Start the processes without waiting for them; without it the first frame starts them."""
        with self._lock:
            self._start_keepers()

    def open(self) -> None:
        """Start the processes and wait until one is ready.

        Raises
        ------
        Unavailable
            None could be started.
        """
        self._start(((process_id, None),)).result()

    def close(self) -> None:
        """Stop the processes, also in the middle of a frame."""
        with self._lock:
            self._closed = True
            keepers, self._keepers = self._keepers, []
        for keeper in keepers:
            keeper.close()
        for _keeper in keepers:
            self._tasks.put(None)
        for keeper in keepers:
            keeper.join()

    def is_ready(self) -> bool:
        """Whether frames can be handed over."""
        with self._lock:
            return not self._closed and (not self._keepers or any(keeper.is_up for keeper in self._keepers))

    def start(self, task: FrameTask, search: Future[PlateSearch], *, wait_s: float = 0.0) -> Pending[FrameResult]:
        """Hand a frame over and return, at once or as soon as there is a place for it within `wait_s`.

        The picture is loaded while the caller still finds out what to look for, and fills `search`.
        """
        return self._start(((load_frame, task), (find_plates, search)), wait_s)

    def start_trace(self, task: TraceTask, *, wait_s: float = 0.0) -> Pending[TraceResult]:
        """Hand a recording over and return, at once or as soon as there is a place for it within `wait_s`."""
        return self._start(((decode_recording, task),), wait_s, self._limits.trace_timeout_s)

    def start_drive(self, task: DriveTask, *, wait_s: float = 0.0) -> Pending[DriveFiles]:
        """Hand the files of a drive over to be read, at once or as soon as there is a place within `wait_s`."""
        return self._start(((read_drive, task),), wait_s, self._limits.trace_timeout_s)

    def start_lane(self, task: LaneTask, *, wait_s: float = 0.0) -> Pending[LaneResult]:
        """Hand verified markers over to lay a lane, at once or as soon as there is a place within `wait_s`."""
        return self._start(((lay_lane, task),), wait_s, self._limits.trace_timeout_s)

    def start_survey(self, task: SurveyTask, *, wait_s: float = 0.0) -> Pending[SurveyTable]:
        """Hand a survey over to be read, at once or as soon as there is a place within `wait_s`."""
        return self._start(((read_survey_file, task),), wait_s, self._limits.trace_timeout_s)

    def start_calibration(self, task: CalibrationTask, *, wait_s: float = 0.0) -> Pending[CameraCalibration]:
        """Hand photos of a board over, at once or as soon as there is a place within `wait_s`."""
        return self._start(((calibrate_photos, task),), wait_s, self._limits.trace_timeout_s)

    def draw_overlay(self, task: OverlayTask) -> bytes:
        """Camera frame with a lane, encoded."""
        drawn: bytes = self._start(((draw_overlay, task),)).result()
        return drawn

    def annotate(self, task: AnnotationTask) -> bytes:
        """Picture with outlines, encoded."""
        drawn: bytes = self._start(((annotate_frame, task),)).result()
        return drawn

    def _start(self, steps: tuple[Step, ...], wait_s: float = 0.0, timeout_s: float | None = None) -> Pending[Any]:
        if not (self._places.acquire(timeout=wait_s) if wait_s else self._places.acquire(blocking=False)):
            raise Unavailable("every decoder process is busy", cure="try again in a few seconds")
        pending: Pending[Any] = Pending(steps, self._interrupt, timeout_s or self._limits.timeout_s)
        pending.future.add_done_callback(lambda _future: self._places.release())
        with self._lock:
            if self._closed:
                pending.future.cancel()
                raise Unavailable("the server is stopping", cure="try again in a few seconds")
            self._start_keepers()
            self._tasks.put(pending)
        return pending

    def _interrupt(self, pending: Pending[Any]) -> None:
        for keeper in self._keepers:
            keeper.interrupt(pending)

    def _start_keepers(self) -> None:
        if self._keepers or self._closed:
            return
        # children take these from the environment before they import numpy or OpenCV
        os.environ.update(ONE_THREAD, OPENCV_IO_MAX_IMAGE_PIXELS=str(self._max_pixels))
        self._keepers = [Keeper(self._tasks, self._decode, self._limits) for _ in range(self._workers)]
        for keeper in self._keepers:
            keeper.start()
