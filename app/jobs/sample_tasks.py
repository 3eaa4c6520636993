"""Uploads that are read again for a closer look, inside a decoder process: samples of a trace, a frame of a video."""

from __future__ import annotations

import re

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, NotFound
from app.formats.traces.read import read_trace
from app.formats.video.frames import ReadReport, read_frames
from app.formats.video.index import index_video
from app.jobs.memory_limit import memory_is_the_limit
from app.plots.annotated_frame import draw_outlines, encode_picture
from app.plots.trace import largest_change
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace
from app.services.decodes.sample_task import DEFAULT_SERIES, SamplesDocument, SamplesTask, VideoFrameTask
from app.services.decodes.trace_task import trace_terms

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
