"""Videos and lists of frames, indexed and decoded inside a decoder process."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from app.decoders.plate.video_search import PlateVideoSearch
from app.errors import InvalidParameter, NotFound
from app.families.family import FrameReading
from app.families.plate.frames import PlateSearch
from app.families.plate.plates import PLATE
from app.formats.frame_list import is_frame_list, read_frame_list
from app.formats.poses import read_poses
from app.formats.traces.read import read_trace
from app.formats.video import AnyFrame, ReadReport, VideoIndex, index_video, read_frames
from app.jobs.frame_tasks import memory_is_the_limit
from app.plots.annotated_frame import draw_outlines, encode_picture
from app.plots.trace import largest_change
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace
from app.services.decodes.frame_poses import FrameLists, FrameListTask, describe_report
from app.services.decodes.matching import FRAME_READERS
from app.services.decodes.tasks import (
    DEFAULT_SERIES,
    IndexVideoTask,
    SamplesDocument,
    SamplesTask,
    SegmentResult,
    SegmentTask,
    VideoFrameTask,
    trace_terms,
)

OTHER_STEP = 3
"""[frames] of which one is searched for markers of other families than plates. For speed."""
MAX_BEYOND = 45
"""[frames] after a segment in which a plate that is in view at its end is followed."""
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


# === Uploads that are read again for a closer look, inside a decoder process: samples of a trace, a frame of a video.


Floats = npt.NDArray[np.float64]
_AXES = "xyz"
_DERIVED = dict(zip(DEFAULT_SERIES, (2, 0), strict=True))


def read_samples(task: SamplesTask, _before: None) -> SamplesDocument:
    """Read a recording, and thin the samples of some series."""
    with memory_is_the_limit("recording", "cut the recording into shorter ones"), task.file.open() as stream:
        terms = trace_terms(task.declared)
        trace = read_trace({task.name: stream}, terms.declaration, task.limits).trace
        return _document(trace, terms.bar, task)


def _document(trace: MagnetTrace, bar: MagnetometerBar, task: SamplesTask) -> SamplesDocument:
    available = [*_DERIVED, *(f"s{k + 1}_{axis}" for k in range(trace.field_ut.shape[1]) for axis in _AXES)]
    unknown = next((name for name in task.series if name not in available), None)
    if unknown is not None:
        raise InvalidParameter(
            f"the recording has no series {unknown[:40]}",
            field="series",
            limit=f"{', '.join(DEFAULT_SERIES)}, s1_x to {available[-1]}",
            cure="`available` of the response lists the names",
        )
    from_s = float(trace.t_s[0]) if task.from_s is None else task.from_s
    to_s = float(trace.t_s[-1]) if task.to_s is None else task.to_s
    first, end = np.searchsorted(trace.t_s, from_s, "left"), np.searchsorted(trace.t_s, to_s, "right")
    t_s = trace.t_s[first:end]
    starts = _groups(len(t_s), task.points)
    series = [_series(trace, bar, name)[first:end] for name in task.series]
    return {
        "series": [
            {"name": name, "values": _listed(values if starts is None else _extremes(values, starts))}
            for name, values in zip(task.series, series, strict=True)
        ],
        "t_s": np.round(t_s if starts is None else _times(t_s, starts), 5).tolist(),
        "from_s": from_s,
        "to_s": to_s,
        "samples": len(t_s),
        "thinned": starts is not None,
        "available": available,
    }


def _series(trace: MagnetTrace, bar: MagnetometerBar, name: str) -> Floats:
    if name in _DERIVED:
        return largest_change(trace, bar, _DERIVED[name])
    found = re.fullmatch(r"s(\d+)_([xyz])", name)
    assert found is not None
    return np.asarray(trace.field_ut[:, int(found[1]) - 1, _AXES.index(found[2])], float)


def _groups(count: int, points: int) -> npt.NDArray[np.intp] | None:
    """First samples of groups that have two points each; None where there are no more samples than points."""
    if count <= points:
        return None
    return np.unique(np.linspace(0, count, max(points // 2, 1), endpoint=False).astype(np.intp))


def _times(t_s: Floats, starts: npt.NDArray[np.intp]) -> Floats:
    middles = (starts + np.r_[starts[1:], len(t_s)]) // 2
    return np.column_stack([t_s[starts], t_s[middles]]).ravel()


def _extremes(values: Floats, starts: npt.NDArray[np.intp]) -> Floats:
    """Smallest and largest value of each group; NaN of a group without values."""
    low = np.fmin.reduceat(values, starts)
    high = np.fmax.reduceat(values, starts)
    return np.column_stack([low, high]).ravel()


def _listed(values: Floats) -> list[float | None]:
    rounded: list[float] = np.round(values, 2).tolist()
    return [value if value == value else None for value in rounded]  # NaN is not itself


def draw_video_frame(task: VideoFrameTask, _before: None) -> bytes:
    """Decode a video up to one of its frames, and draw outlines over it."""
    with memory_is_the_limit("video", "record at a lower resolution"):
        index = index_video(task.file, task.limits, rate_hz=task.rate_hz)
        segment = next((part for part in index.segments if part.first <= task.number < part.end), None)
        frames = read_frames(index, segment, ReadReport()) if segment is not None else iter(())
        frame = next((frame for frame in frames if frame.number == task.number), None)
        if frame is None:
            raise NotFound(f"frame {task.number} of the video cannot be decoded", field="frame")
        return encode_picture(draw_outlines(frame.bgr(), task.outlines), task.suffix)


# === Lists of frames and tracks beside them, read inside a decoder process.


def read_frame_lists(task: FrameListTask, _before: None) -> FrameLists:
    """Read the first list of frames and the first track."""
    read = FrameLists()
    for name, data in task.files:
        if is_frame_list(name):
            if read.frames is None:
                frames = read_frame_list(name, data, task.declaration)
                read = replace(read, frames=frames, warnings=(*read.warnings, *describe_report(name, frames.report)))
                continue
        elif read.track is None:
            track, report = read_poses(name, data, task.declaration, task.limits)
            read = replace(read, track=track, warnings=(*read.warnings, *describe_report(name, report)))
            continue
        read = replace(read, warnings=(*read.warnings, f"{name} is not used: there is another file of its kind"))
    return read
