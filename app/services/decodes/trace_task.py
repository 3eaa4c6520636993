"""Tasks of decoder processes about a trace, their results, and declarations as typed values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from app.decoders.magnet.identify import TagFormat
from app.decoders.magnet.readings import Finding
from app.errors import InvalidParameter
from app.formats.spooled_file import SpooledFile
from app.formats.traces.declaration import (
    AngleUnit,
    AxisConvention,
    CanDeclaration,
    CanSignal,
    FieldUnit,
    SpeedUnit,
    TimeUnit,
    TraceColumns,
    TraceDeclaration,
    TraceFormat,
    TraceLimits,
)
from app.formats.traces.report import TraceReport
from app.sensors.magnetometer_bar import MagnetometerBar, SensorRole
from app.services.decoder_processes import Task

METHODS = ("matched", "metro")
MAX_REACH_M = 20_000.0


@dataclass(frozen=True, slots=True)
class TraceTerms:
    """A declaration as the readers and the decoder know it.

    Attributes
    ----------
    bar : MagnetometerBar
    declaration : TraceDeclaration
    formats : tuple of TagFormat
        Tags to look for where the registry has none near by.
    method : str
        ``matched``, or ``metro`` for the paper's pipeline.
    reach_m : float
        How far from the coarse position the drive may lead. [m]
    """

    bar: MagnetometerBar
    declaration: TraceDeclaration
    formats: tuple[TagFormat, ...] = ()
    method: str = METHODS[0]
    reach_m: float = 2000.0


@dataclass(frozen=True, slots=True)
class TraceMotion:
    """Speed and heading over a recording, at even times.

    Attributes
    ----------
    start_s, step_s : float
        Trace time of the first value, which is that of the first sample, and the time between two. [s]
    speed_m_s, heading_deg : tuple of float
        Empty where the recording has none; NaN where it has none near by. [m/s, deg]
    """

    start_s: float
    step_s: float
    speed_m_s: tuple[float, ...] = ()
    heading_deg: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class TraceResult:
    """What a decoder process found in a recording.

    Attributes
    ----------
    findings : tuple of Finding
        In the order of their completion.
    report : TraceReport
        About reading the files.
    length_m : float
        Driven, by the vehicle's speed. [m]
    version : str
        Of the decoder.
    plot : bytes
        SVG.
    load_ms, decode_ms : float
        Time spent on reading the files and on the magnets. [ms]
    motion : TraceMotion
    """

    findings: tuple[Finding, ...]
    report: TraceReport
    length_m: float
    version: str
    plot: bytes
    load_ms: float
    decode_ms: float
    motion: TraceMotion


@dataclass(frozen=True, slots=True)
class CompileTracesTask(Task[None]):
    """Compile what decodes traces, so that no upload waits for it."""


@dataclass(frozen=True, slots=True)
class TraceTask(Task[TraceResult]):
    """One recording to decode.

    Attributes
    ----------
    name : str
        Of the file.
    data : bytes
        A file, or a ZIP of the files of one recording.
    declared : dict
        The declaration as it was sent; see `trace_terms`.
    tags : tuple of str
        Texts of the information tags that are registered near by.
    formats : tuple of TagFormat
        Used where there are none.
    limits : TraceLimits
    """

    name: str
    file: SpooledFile
    declared: Mapping[str, Any]
    tags: tuple[str, ...] = ()
    formats: tuple[TagFormat, ...] = ()
    limits: TraceLimits = field(default_factory=TraceLimits)


def trace_terms(declared: Mapping[str, Any]) -> TraceTerms:
    """Check a declaration.

    Parameters
    ----------
    declared : dict
        As `app.api.decodes.schemas_traces.TraceIn` describes it; what is left out has METRO's default.

    Raises
    ------
    InvalidParameter
        A value is out of its limits, or values contradict each other; the field is below ``trace``.
    """
    try:
        bar = _bar(declared.get("bar") or {})
        method = declared.get("method", METHODS[0])
        if method not in METHODS:
            raise InvalidParameter(f"there is no method {method}", field="method", limit=", ".join(METHODS))
        reach_m = float(declared.get("reach_m", 2000.0))
        if not 0 < reach_m <= MAX_REACH_M:
            raise InvalidParameter(
                f"reach_m is {reach_m:g}", field="reach_m", limit=f"above 0, at most {MAX_REACH_M:g} m"
            )
        formats = tuple(TagFormat(**entry) for entry in declared.get("tag_formats", ()))
        return TraceTerms(bar, _declaration(declared, bar), formats, method, reach_m)
    except InvalidParameter as error:
        error.field = f"trace.{error.field}" if error.field else "trace"
        raise


def _bar(declared: Mapping[str, Any]) -> MagnetometerBar:
    forward_m, clearance_m = float(declared.get("forward_m", 0.0)), declared.get("clearance_m")
    sensors = declared.get("sensors")
    if not sensors:
        return MagnetometerBar.metro(forward_m=forward_m, clearance_m=clearance_m)
    positions = np.array([sensor["position_m"] for sensor in sensors], float)
    positions[:, 0] += forward_m
    turns = [sensor.get("vehicle_from_sensor") or np.eye(3) for sensor in sensors]
    roles = tuple(SensorRole(sensor.get("role", "array")) for sensor in sensors)
    return MagnetometerBar(positions, roles, np.array(turns, float), clearance_m=clearance_m)


def _declaration(declared: Mapping[str, Any], bar: MagnetometerBar) -> TraceDeclaration:
    columns, can = declared.get("columns") or {}, declared.get("can")
    turned = any(sensor.get("vehicle_from_sensor") for sensor in (declared.get("bar") or {}).get("sensors") or ())
    declared_options = {
        name: declared[name]
        for name in ("calibrated", "background_removed", "speed_m_s", "rate_hz", "interval_extra_us", "clock_offsets_s")
        if declared.get(name) is not None
    }
    return TraceDeclaration(
        sensors=bar.sensor_count,
        unit=FieldUnit(declared["unit"]) if declared.get("unit") else None,
        axes=AxisConvention(declared["axes"]) if declared.get("axes") else None,
        vehicle_from_sensor=bar.vehicle_from_sensor if turned else None,
        references=tuple(int(i) for i in bar.references),
        columns=_columns(columns),
        can=_can(can) if can else None,
        formats={name: TraceFormat(kind) for name, kind in (declared.get("formats") or {}).items()},
        **declared_options,
    )


def _columns(declared: Mapping[str, Any]) -> TraceColumns:
    kinds: dict[str, Any] = {"time_unit": TimeUnit, "speed_unit": SpeedUnit, "heading_unit": AngleUnit}
    values: dict[str, Any] = {name: kinds.get(name, lambda same: same)(value) for name, value in declared.items()}
    if "field" in values:
        values["field"] = tuple(tuple(names) for names in values["field"])
    return TraceColumns(**values)


def _can(declared: Mapping[str, Any]) -> CanDeclaration:
    signals = {name: CanSignal(**declared[name]) for name in ("speed", "heading") if declared.get(name)}
    return CanDeclaration(**signals, offset_s=declared.get("offset_s"), channel=declared.get("channel"))
