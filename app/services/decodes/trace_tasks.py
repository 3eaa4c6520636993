"""Recordings of magnetometers in a decoder process: decoded, and read again for a closer look."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field
from typing_extensions import TypedDict

from app.decoders.magnet.identify import TagCandidates, TagFormat
from app.decoders.magnet.readings import Finding
from app.decoding.declarations import DeclaredTrace
from app.decoding.recordings import bar_above, find_magnets
from app.errors import InvalidParameter
from app.formats.format import SpooledFile
from app.formats.traces.declaration import TraceLimits, TraceReport
from app.formats.traces.parts import NEAR_S
from app.formats.traces.read import read_trace
from app.markers.magnet import HALF_HEIGHT_M, MOMENT_AM2, InformationTag, Orientation, parse_tag
from app.plots.trace import largest_change, plot_trace
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace
from app.services.decoder_tasks import decoder_task
from app.services.documents import listed
from app.values import Floats

_RECORDING = ("recording", "cut the recording into shorter ones")

# === Decoding.


_MOTION_STEP_S = 0.1  # [s] source: app/tracks/time_base.py has a node every 0.1 s
_MOTION_VALUES = 36_000  # at most; an hour, 0.5 MB of JSON


@dataclass(frozen=True, slots=True)
class TraceMotion:
    """Speed and heading at even times from the trace's first sample on; null where the recording has none nearby."""

    start_s: float
    step_s: float
    speed_m_s: list[float | None]  # empty where the recording has none
    heading_deg: list[float | None]  # the same


@dataclass(frozen=True, slots=True)
class DecodedTrace:
    """What a decoder process found in a recording."""

    findings: tuple[Finding, ...]  # in the order of their completion
    report: TraceReport  # about reading the files
    version: str  # of the decoder
    plot: bytes  # SVG
    motion: TraceMotion


@decoder_task(*_RECORDING)
def decode_recording(
    name: str,
    file: SpooledFile,
    declared: DeclaredTrace = DeclaredTrace(),
    tags: tuple[str, ...] = (),
    formats: tuple[TagFormat, ...] = (),
    limits: TraceLimits = TraceLimits(),
    depth_m: float | None = -HALF_HEIGHT_M,
) -> DecodedTrace:
    """Read the files of a recording and decode their trace.

    Parameters
    ----------
    name : str
        Of the file.
    file : SpooledFile
        A file, or a ZIP of the files of one recording.
    tags : tuple of str
        Texts of the information tags that are registered nearby.
    formats : tuple of TagFormat
        Used where there are none.
    depth_m : float, optional
        Of the magnets that are registered nearby, below the road; None where they differ. [m]
    """
    from app.decoders.magnet.recording_check import find_mistakes

    began = time.perf_counter()
    with file.open() as stream:
        content = read_trace({name: stream}, declared, limits)
    loaded = time.perf_counter()
    trace, report = content.trace, content.report
    checked, version = find_magnets(trace, declared, tags, formats, depth_m)
    findings = checked.findings
    for mistake in checked.faults:
        report.warn(mistake.text)
    if declared.method == "matched" and not checked.is_refused:
        bar = bar_above(declared.sensors, depth_m)
        for mistake in find_mistakes(checked.trace, bar, findings, depth_m=depth_m or 0.0):
            report.warn(mistake.text)
    report.load_ms, report.decode_ms = 1e3 * (loaded - began), 1e3 * (time.perf_counter() - loaded)
    speed = np.interp(trace.t_s, trace.speed_t_s, trace.speed_m_s)
    report.driven_m = float(np.sum(np.diff(trace.t_s) * (speed[1:] + speed[:-1]) / 2))
    plot = plot_trace(trace, declared.sensors, findings).encode()
    return DecodedTrace(tuple(findings), report, version, plot, _motion(trace))


def _motion(trace: MagnetTrace) -> TraceMotion:
    """Speed and heading ten times a second, less often in recordings of more than an hour."""
    duration = float(trace.t_s[-1] - trace.t_s[0])
    step = max(_MOTION_STEP_S, duration / _MOTION_VALUES)
    at = trace.t_s[0] + step * np.arange(int(duration / step) + 1)
    speed, heading = _near(at, trace.speed_t_s, trace.speed_m_s), np.empty(0)
    if trace.heading_t_s is not None and trace.heading_deg is not None:
        heading = _near(at, trace.heading_t_s, np.unwrap(trace.heading_deg, period=360.0)) % 360.0
    return TraceMotion(float(trace.t_s[0]), step, listed(speed, 3), listed(heading, 2))


def _near(at: Floats, time_s: npt.ArrayLike, values: npt.ArrayLike) -> Floats:
    """Values between samples; NaN where none is near, empty where there are none."""
    time, given = np.asarray(time_s, float), np.asarray(values, float)
    kept = np.isfinite(time) & np.isfinite(given)
    time, given = time[kept], given[kept]
    if not time.size:
        return np.empty(0)
    after = np.clip(np.searchsorted(time, at), 1, max(time.size - 1, 1))
    near = np.minimum(np.abs(at - time[after - 1]), np.abs(at - time[np.minimum(after, time.size - 1)])) <= NEAR_S
    return np.asarray(np.where(near, np.interp(at, time, given), np.nan))


# === Compiling, so that no upload waits for it.


_COMPILED_M, _COMPILED_M_S, _COMPILED_STEP_S, _COMPILED_CLEARANCE_M = 40.0, 12.0, 0.005, 0.2
_EARTH_UT, _NOISE_UT = (20.0, 0.0, -43.0), 1.0


def compile_traces() -> None:
    """Decode a drive over one tag: the kernels are compiled, or loaded from numba's cache.

    The drive is straight and even. `simulate_drive` would load 45 MB of scipy into an idle process.
    """
    from app.decoders.magnet.recording_check import decode_checked
    from app.simulation.magnetic.dipoles import dipole_field_ut

    tag = parse_tag("SNS_4_0.1_10-30")
    assert isinstance(tag, InformationTag)
    bar = MagnetometerBar.metro()
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
    decode_checked(trace, bar, candidates=TagCandidates(tags=[tag]))


# === Samples.


MAX_POINTS = 200_000
"""Points of each series at most. 2 MB of JSON for a series."""
MAX_SERIES = 6
DEFAULT_SERIES = ("vertical", "forward")
_AXES = "xyz"
_DERIVED = dict(zip(DEFAULT_SERIES, (2, 0), strict=True))


class SampleSeries(TypedDict):
    """Values of one series, null where a sample is missing. [uT]"""

    name: str
    values: list[float | None]


class SamplesDocument(TypedDict):
    """Samples of a recording.

    If there are more than asked for, two points stand for each group of samples: the smallest and the largest value of
    a series, at the times of the group's first and middle sample. `t_s` is the recording's time, as in `tags` and
    `magnets` of the decode.
    """

    series: list[SampleSeries]
    t_s: list[float]
    from_s: float
    to_s: float
    samples: Annotated[int, Field(description="Between from_s and to_s.")]
    thinned: bool
    available: Annotated[list[str], Field(description="Names that `series` may have.")]


@decoder_task(*_RECORDING)
def read_samples(
    name: str,
    file: SpooledFile,
    declared: DeclaredTrace,
    series: tuple[str, ...],
    from_s: float | None,
    to_s: float | None,
    points: int,
    limits: TraceLimits,
) -> SamplesDocument:
    """Read a recording, and thin the samples of some series to so many points each.

    The series ``vertical`` and ``forward`` are the largest change on any sensor of the array, ``s3_x`` is an axis of a
    sensor. Without times, the samples are those of the whole recording.
    """
    with file.open() as stream:
        trace = read_trace({name: stream}, declared, limits).trace
    available = [*_DERIVED, *(f"s{k + 1}_{axis}" for k in range(trace.field_ut.shape[1]) for axis in _AXES)]
    unknown = next((name for name in series if name not in available), None)
    if unknown is not None:
        raise InvalidParameter(
            f"the recording has no series {unknown[:40]}",
            field="series",
            limit=f"{', '.join(DEFAULT_SERIES)}, s1_x to {available[-1]}",
            cure="`available` of the response lists the names",
        )
    from_s = float(trace.t_s[0]) if from_s is None else from_s
    to_s = float(trace.t_s[-1]) if to_s is None else to_s
    first, end = np.searchsorted(trace.t_s, from_s, "left"), np.searchsorted(trace.t_s, to_s, "right")
    t_s = trace.t_s[first:end]
    starts = _groups(len(t_s), points)
    values = [_series(trace, declared.sensors, name)[first:end] for name in series]
    return {
        "series": [
            {"name": name, "values": listed(chosen if starts is None else _extremes(chosen, starts), 2)}
            for name, chosen in zip(series, values, strict=True)
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
