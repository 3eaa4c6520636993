"""What the context of an upload declares of its files, checked, as the readers and the decoders take it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import date
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from app.decoders.cerpm.signal import SignalRules
from app.decoders.cerpm.verify import FreshnessRules
from app.decoders.magnet.identify import TagFormat
from app.errors import InvalidParameter
from app.formats.logs import LogClock, TimeScale
from app.formats.packets.rows import PacketDeclaration, PayloadText
from app.formats.poses import PoseDeclaration
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
)
from app.lanes.types import LaneRules
from app.sensors.magnetometer_bar import MagnetometerBar, SensorRole

if TYPE_CHECKING:  # it loads numba
    from app.lanes.control import Controller

# === Recordings of magnetometers.


TRACE_METHODS = ("matched", "metro")
MAX_REACH_M = 20_000.0


@dataclass(frozen=True, slots=True)
class TraceTerms:
    """A declaration as the readers and the decoder know it."""

    bar: MagnetometerBar
    declaration: TraceDeclaration
    formats: tuple[TagFormat, ...] = ()  # tags to look for where the registry has none nearby
    method: str = TRACE_METHODS[0]  # ``matched``, or ``metro`` for the paper's pipeline
    reach_m: float = 2000.0  # [m] how far from the coarse position the drive may lead


def trace_terms(declared: Mapping[str, Any]) -> TraceTerms:
    """Check a declaration.

    Parameters
    ----------
    declared : dict
        As `app.api.decodes.schemas.TraceIn` describes it; what is left out has METRO's default.

    Raises
    ------
    InvalidParameter
        A value is out of its limits, or values contradict each other; the field is below ``trace``.
    """
    try:
        bar = _bar(declared.get("bar") or {})
        method = declared.get("method", TRACE_METHODS[0])
        if method not in TRACE_METHODS:
            raise InvalidParameter(f"there is no method {method}", field="method", limit=", ".join(TRACE_METHODS))
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


def _columns(declared: Mapping[str, object]) -> TraceColumns:
    kinds: dict[str, Any] = {"time_unit": TimeUnit, "speed_unit": SpeedUnit, "heading_unit": AngleUnit}
    values: dict[str, Any] = {name: kinds.get(name, lambda same: same)(value) for name, value in declared.items()}
    if "field" in values:
        values["field"] = tuple(tuple(names) for names in values["field"])
    return TraceColumns(**values)


def _can(declared: Mapping[str, Any]) -> CanDeclaration:
    signals = {name: CanSignal(**declared[name]) for name in ("speed", "heading") if declared.get(name)}
    return CanDeclaration(**signals, offset_s=declared.get("offset_s"), channel=declared.get("channel"))


# === Packet logs of CERPMs.


PACKET_METHODS = ("waymark", "paper")
FILE_KINDS = ("packets", "poses", "frame")
PREDICTIVE, NO_CHECK = "predictive", "none"


@dataclass(frozen=True, slots=True)
class PacketTerms:
    """A declaration as the readers and the decoder know it."""

    packets: PacketDeclaration
    poses: PoseDeclaration
    files: Mapping[str, str]  # kind of a file by its name, where its content does not show it
    freshness: FreshnessRules
    lane: LaneRules
    method: Literal["waymark", "paper"]  # ``waymark``, or ``paper`` for section 2.2 of the CERPM paper
    accept_clear: bool  # use markers whose packets were received in clear only, without a tag
    controller: Controller | None  # of the check of steering; none is made without
    signal: SignalRules  # with the figures of the receiver that were declared


def packet_terms(declared: Mapping[str, Any]) -> PacketTerms:
    """Check a declaration.

    Parameters
    ----------
    declared : mapping
        As `app.api.decodes.schemas.PacketsIn` describes it.

    Raises
    ------
    InvalidParameter
        A figure is out of its limits; the field is below ``packets``.
    """
    try:
        method = declared.get("method", PACKET_METHODS[0])
        if method not in PACKET_METHODS:
            raise InvalidParameter(f"there is no method {method}", field="method", limit=", ".join(PACKET_METHODS))
        files = declared.get("files") or {}
        for name, kind in files.items():
            if kind not in FILE_KINDS:
                raise InvalidParameter(f"{name} is of no kind {kind}", field="files", limit=", ".join(FILE_KINDS))
        steering = declared.get("steering", PREDICTIVE)
        return PacketTerms(
            _packet_declaration(declared),
            pose_declaration(declared.get("poses") or {}),
            files,
            FreshnessRules(**(declared.get("freshness") or {})),
            LaneRules(**(declared.get("lane") or {})),
            method,
            bool(declared.get("accept_clear", False)),
            None if steering == NO_CHECK else _controller(steering),
            SignalRules(**(declared.get("receiver") or {})),
        )
    except InvalidParameter as error:
        error.field = f"packets.{error.field}" if error.field else "packets"
        raise


def _controller(name: str) -> Controller:
    from app.lanes.control import Controller

    return Controller(name)


def _packet_declaration(declared: Mapping[str, Any]) -> PacketDeclaration:
    return PacketDeclaration(
        _clock(declared.get("clock") or {}),
        declared.get("columns") or {},
        PayloadText(declared.get("payload_text", "auto")),
    )


# === Tracks and frames of a drive.


def pose_declaration(declared: Mapping[str, Any]) -> PoseDeclaration:
    """The declaration of a track, as `app.api.decodes.schemas.PosesIn` describes it."""
    return PoseDeclaration(
        _clock(declared.get("clock") or {}),
        declared.get("columns") or {},
        declared.get("crs"),
        _date(declared["date"]) if declared.get("date") else None,
        forward_m=float(declared.get("forward_m", 0.0)),
        left_m=float(declared.get("left_m", 0.0)),
        accuracy_m=declared.get("accuracy_m"),
    )


def _date(text: str) -> date:
    try:
        return date.fromisoformat(text)
    except ValueError as error:
        raise InvalidParameter(
            f"{text} is no date", field="poses.date", limit="YYYY-MM-DD", cure="give the UTC date of the first position"
        ) from error


def _clock(declared: Mapping[str, Any]) -> LogClock:
    return LogClock(
        TimeScale(declared.get("scale", "auto")),
        float(declared.get("offset_s", 0.0)),
        float(declared.get("utc_offset_s", 0.0)),
    )


@dataclass(frozen=True, slots=True)
class FrameTerms:
    """What is declared of the frames of a drive."""

    rate_hz: float | None = None  # [Hz] frames a second
    poses: PoseDeclaration = field(default_factory=PoseDeclaration)  # of a list of frames, or of a track beside them


def frame_terms(declared: Mapping[str, Any]) -> FrameTerms:
    """Check the section `frames` of a context.

    Raises
    ------
    InvalidParameter
        A figure is out of its limits; the field is below ``frames``.
    """
    rate_hz = declared.get("rate_hz")
    if rate_hz is not None and not 0.001 <= rate_hz <= 1000:
        raise InvalidParameter(f"the frame rate is {rate_hz:g}", field="frames.rate_hz", limit="0.001 to 1000 Hz")
    try:
        return FrameTerms(rate_hz, pose_declaration(declared.get("poses") or {}))
    except InvalidParameter as error:
        error.field = f"frames.{error.field}" if error.field else "frames"
        raise
