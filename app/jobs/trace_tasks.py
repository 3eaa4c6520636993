"""A recording, read and decoded inside a decoder process."""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.decoder import VERSION, decode_trace
from app.decoders.magnet.identify import TagCandidates
from app.decoders.magnet.readings import Finding
from app.decoders.magnet.recording_check import find_mistakes
from app.formats.traces.read import read_trace
from app.formats.traces.series import NEAR_S
from app.jobs.memory_limit import memory_is_the_limit
from app.markers.magnet import MOMENT_AM2, InformationTag, Orientation, parse_tag
from app.plots.trace import plot_trace
from app.sensors.magnetometer_bar import MagnetTrace
from app.services.decodes.trace_task import (
    METHODS,
    CompileTracesTask,
    TraceMotion,
    TraceResult,
    TraceTask,
    TraceTerms,
    trace_terms,
)
from app.simulation.magnetic.dipoles import dipole_field_ut

_MOTION_STEP_S = 0.1  # [s] source: app/tracks/time_base.py has a node every 0.1 s
_MOTION_VALUES = 36_000  # at most; source: by hand, an hour, 0.5 MB of JSON

# the drive that is decoded to compile the kernels
_COMPILED_M, _COMPILED_M_S, _COMPILED_STEP_S, _COMPILED_CLEARANCE_M = 40.0, 12.0, 0.005, 0.2
_EARTH_UT, _NOISE_UT = (20.0, 0.0, -43.0), 1.0


def decode_recording(task: TraceTask, _before: None) -> TraceResult:
    """Read the files of a recording and decode their trace."""
    with memory_is_the_limit("recording", "cut the recording into shorter ones"):
        return _decode_recording(task)


def compile_traces(_task: CompileTracesTask, _before: None) -> None:
    """Decode a drive over one tag: the kernels are compiled, or loaded from numba's cache.

    The drive is straight and even. One of `app.simulation` would do, but holds 50 MB of scipy in an idle process.
    """
    tag = parse_tag("SNS_4_0.1_10-30")
    assert isinstance(tag, InformationTag)
    bar = trace_terms({}).bar
    rng = np.random.default_rng(1)
    t_s = np.arange(0.0, _COMPILED_M / _COMPILED_M_S, _COMPILED_STEP_S)
    travelled_m = _COMPILED_M_S * t_s[:, None] * (1.0, 0.0, 0.0)
    points_m = (travelled_m[:, None] + bar.positions_m + (0.0, 0.0, _COMPILED_CLEARANCE_M)).reshape(-1, 3)
    field_ut = rng.normal(_EARTH_UT, _NOISE_UT, points_m.shape)
    for magnet in tag.magnets:
        place_m = np.array([_COMPILED_M / 2 + magnet.along_m, magnet.lateral_m, 0.0])
        axis = (0.0, 0.0, 1.0) if magnet.orientation is Orientation.UP else (1.0, 0.0, 0.0)
        field_ut += dipole_field_ut(points_m, place_m, magnet.polarity.sign * MOMENT_AM2 * np.array(axis))
    trace = MagnetTrace(t_s, field_ut.reshape(t_s.size, -1, 3), t_s, np.full(t_s.size, _COMPILED_M_S))
    decode_trace(trace, bar, candidates=TagCandidates(tags=[tag]))


def _decode_recording(task: TraceTask) -> TraceResult:
    began = time.perf_counter()
    terms = trace_terms(task.declared)
    with task.file.open() as stream:
        file = read_trace({task.name: stream}, terms.declaration, task.limits)
    loaded = time.perf_counter()
    trace = file.trace
    findings, version = _decode(task, terms, trace)
    if terms.method == METHODS[0]:
        for mistake in find_mistakes(trace, terms.bar, findings):
            file.report.warn(mistake.text)
    decoded = time.perf_counter()
    return TraceResult(
        tuple(findings),
        file.report,
        _driven_m(trace),
        version,
        plot_trace(trace, terms.bar, findings).encode(),
        1e3 * (loaded - began),
        1e3 * (decoded - loaded),
        _motion(trace),
    )


def _decode(task: TraceTask, terms: TraceTerms, trace: MagnetTrace) -> tuple[list[Finding], str]:
    """Findings, and the decoder's version."""
    if terms.method == "metro":
        from app.decoders.magnet import metro  # only here: scipy.signal takes most of a second to load

        return metro.decode_trace_metro(trace, terms.bar), metro.VERSION
    tags = [tag for text in task.tags if isinstance(tag := parse_tag(text), InformationTag)]
    candidates = TagCandidates(tags=tags) if tags else TagCandidates(formats=terms.formats or task.formats)
    return decode_trace(trace, terms.bar, candidates=candidates), VERSION


def _motion(trace: MagnetTrace) -> TraceMotion:
    """Speed and heading ten times a second, less often in recordings of more than an hour."""
    duration = float(trace.t_s[-1] - trace.t_s[0])
    step = max(_MOTION_STEP_S, duration / _MOTION_VALUES)
    at = trace.t_s[0] + step * np.arange(int(duration / step) + 1)
    speed = _near(at, trace.speed_t_s, trace.speed_m_s)
    heading: list[float] = []
    if trace.heading_t_s is not None and trace.heading_deg is not None:
        heading = _near(at, trace.heading_t_s, np.unwrap(trace.heading_deg, period=360.0))
    return TraceMotion(float(trace.t_s[0]), step, tuple(speed), tuple(value % 360.0 for value in heading))


def _near(at: npt.NDArray[np.float64], time_s: npt.ArrayLike, values: npt.ArrayLike) -> list[float]:
    """Values between samples; NaN where none is near, an empty list where there are none."""
    time, given = np.asarray(time_s, float), np.asarray(values, float)
    kept = np.isfinite(time) & np.isfinite(given)
    time, given = time[kept], given[kept]
    if not time.size:
        return []
    after = np.clip(np.searchsorted(time, at), 1, max(time.size - 1, 1))
    near = np.minimum(np.abs(at - time[after - 1]), np.abs(at - time[np.minimum(after, time.size - 1)])) <= NEAR_S
    joined: list[float] = np.where(near, np.interp(at, time, given), np.nan).tolist()
    return joined


def _driven_m(trace: MagnetTrace) -> float:
    """Length of the drive by the vehicle's speed. [m]"""
    speed = np.interp(trace.t_s, trace.speed_t_s, trace.speed_m_s)
    return float(np.sum(np.diff(trace.t_s) * (speed[1:] + speed[:-1]) / 2))
