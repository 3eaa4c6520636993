"""Videos, indexed and decoded inside a decoder process."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from app.decoders.plate.video_search import PlateVideoSearch
from app.errors import InvalidParameter
from app.families.frames import FrameReading
from app.families.plate.frames import PlateSearch
from app.families.plate.plates import PLATE
from app.formats.video.frames import AnyFrame, ReadReport, read_frames
from app.formats.video.index import VideoIndex, index_video
from app.jobs.memory_limit import memory_is_the_limit
from app.services.decodes.matching import FRAME_READERS
from app.services.decodes.video_task import IndexVideoTask, SegmentResult, SegmentTask

OTHER_STEP = 3
"""[frames] of which one is searched for markers of other families than plates. Source: chosen by hand, for speed."""
MAX_BEYOND = 45
"""[frames] after a segment in which a plate that is in view at its end is followed. Source: chosen by hand."""
_VIDEO = ("video", "record at a lower resolution")


def index_frames(task: IndexVideoTask, _before: None) -> VideoIndex:
    """List the frames of a video."""
    with memory_is_the_limit(*_VIDEO):
        return index_video(task.file, task.limits, rate_hz=task.rate_hz)


def decode_segment(task: SegmentTask, _before: None) -> SegmentResult:
    """Search the frames of a segment, and follow the plates that are in view at its end."""
    with memory_is_the_limit(*_VIDEO):
        return _SegmentDecoder(task).run()


class _SegmentDecoder:
    def __init__(self, task: SegmentTask) -> None:
        self._task = task
        wanted = task.by_family.get(PLATE.name)
        self._wanted = wanted if isinstance(wanted, PlateSearch) else PlateSearch()
        self._search: PlateVideoSearch | None = None
        self._others = {name: search for name, search in task.by_family.items() if name != PLATE.name}
        self._size = (0, 0)
        self._load_s = 0.0

    def run(self) -> SegmentResult:
        began, report = time.perf_counter(), ReadReport()
        index, segment = self._task.index, self._task.index.segments[self._task.number]
        plates, others, frames = [], {}, 0
        for frame in self._timed(read_frames(index, segment, report, beyond=MAX_BEYOND)):
            search = self._search_of(frame)
            if frame.number >= segment.end and not search.expects:
                break
            plates += search.look(frame.number, frame.time_s, frame.half_bgr, self._full(frame), self._speed(frame))
            if frame.number < segment.end:
                frames += 1
                if self._others and frame.number % OTHER_STEP == 0:
                    others[frame.number] = tuple(self._read_others(frame))
        if self._search is not None:
            plates += self._search.finish()
        own = tuple(plate for plate in plates if plate.seen[0].frame < segment.end)
        decode_ms = 1e3 * (time.perf_counter() - began - self._load_s)
        return SegmentResult(
            *self._size, frames, self._search.decoded if self._search else 0, report.damaged, report.other_size, own,
            {number: found for number, found in others.items() if found}, 1e3 * self._load_s, decode_ms,
        )  # fmt: skip

    def _timed(self, frames: Iterator[AnyFrame]) -> Iterator[AnyFrame]:
        while True:
            began = time.perf_counter()
            frame = next(frames, None)
            self._load_s += time.perf_counter() - began
            if frame is None:
                return
            yield frame

    def _search_of(self, frame: AnyFrame) -> PlateVideoSearch:
        if self._search is None:
            self._size = frame.size_px
            camera = self._wanted.camera
            if camera is not None and (camera.width_px, camera.height_px) != self._size:
                raise InvalidParameter(
                    f"the camera has {camera.width_px} x {camera.height_px} px, the video "
                    f"{self._size[0]} x {self._size[1]} (upright)",
                    field="camera.width_px",
                    limit=f"{self._size[0]} x {self._size[1]} px",
                    cure="send the camera parameters of this video",
                )
            wanted = self._wanted
            self._search = PlateVideoSearch(
                camera, wanted.codebook, wanted.geometries, thermal=self._task.thermal
            )  # fmt: skip
        return self._search

    def _full(self, frame: AnyFrame) -> Any:
        return frame.grey if self._task.thermal else frame.bgr

    def _speed(self, frame: AnyFrame) -> float | None:
        if not self._task.speeds:
            return None
        times, speeds = np.array(self._task.speeds).T
        return float(np.interp(frame.time_s, times, speeds))

    def _read_others(self, frame: AnyFrame) -> Iterator[FrameReading]:
        pixels = frame.grey() if self._task.thermal else frame.bgr()
        for name, search in self._others.items():
            yield from FRAME_READERS[name].read(pixels, search, thermal=self._task.thermal)
