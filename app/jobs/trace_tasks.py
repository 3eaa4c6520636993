"""A recording, read and decoded inside a decoder process."""

from __future__ import annotations

import time

import numpy as np

from app.decoders.magnet.decoder import VERSION, decode_trace
from app.decoders.magnet.identify import TagCandidates
from app.decoders.magnet.readings import Finding
from app.formats.traces.read import read_trace
from app.jobs.memory_limit import memory_is_the_limit
from app.markers.magnet import InformationTag, parse_tag
from app.plots.trace import plot_trace
from app.sensors.magnetometer_bar import MagnetTrace
from app.services.decodes.trace_task import TraceResult, TraceTask, TraceTerms, trace_terms


def decode_recording(task: TraceTask, _before: None) -> TraceResult:
    """Read the files of a recording and decode their trace."""
    with memory_is_the_limit("recording", "cut the recording into shorter ones"):
        return _decode_recording(task)


def _decode_recording(task: TraceTask) -> TraceResult:
    began = time.perf_counter()
    terms = trace_terms(task.declared)
    file = read_trace({task.name: task.data}, terms.declaration, task.limits)
    loaded = time.perf_counter()
    trace = file.trace
    findings, version = _decode(task, terms, trace)
    decoded = time.perf_counter()
    return TraceResult(
        tuple(findings),
        file.report,
        _driven_m(trace),
        version,
        plot_trace(trace, terms.bar, findings).encode(),
        1e3 * (loaded - began),
        1e3 * (decoded - loaded),
    )


def _decode(task: TraceTask, terms: TraceTerms, trace: MagnetTrace) -> tuple[list[Finding], str]:
    """Findings, and the decoder's version."""
    if terms.method == "metro":
        from app.decoders.magnet import metro  # only here: scipy.signal takes most of a second to load

        return metro.decode_trace_metro(trace, terms.bar), metro.VERSION
    tags = [tag for text in task.tags if isinstance(tag := parse_tag(text), InformationTag)]
    candidates = TagCandidates(tags=tags) if tags else TagCandidates(formats=terms.formats or task.formats)
    return decode_trace(trace, terms.bar, candidates=candidates), VERSION


def _driven_m(trace: MagnetTrace) -> float:
    """Length of the drive by the vehicle's speed. [m]"""
    speed = np.interp(trace.t_s, trace.speed_t_s, trace.speed_m_s)
    return float(np.sum(np.diff(trace.t_s) * (speed[1:] + speed[:-1]) / 2))
