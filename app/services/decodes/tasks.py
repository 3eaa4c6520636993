"""What decoder processes are asked to do with uploads, and their results: plain values that can be pickled."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from datetime import date
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field
from typing_extensions import TypedDict

from app.decoders.cerpm.signal import SignalRules
from app.decoders.cerpm.verify import FreshnessRules
from app.decoders.magnet.identify import TagFormat
from app.decoders.magnet.readings import Finding
from app.errors import InvalidParameter, WaymarkError
from app.families.family import FrameReading
from app.formats.format import SpooledFile
from app.formats.images import ImageHeader, ImageLimits
from app.formats.logs import LogClock, LogReport, TimeScale
from app.formats.packets.rows import PacketDeclaration, PacketLimits, PayloadText
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
    TraceLimits,
    TraceReport,
)
from app.formats.video import VideoFile, VideoIndex, VideoLimits
from app.lanes.types import Lane, LaneMarkers, LaneRules
from app.plots.annotated_frame import Outline
from app.sensors.camera import Camera
from app.sensors.magnetometer_bar import MagnetometerBar, SensorRole
from app.sensors.pose_track import PoseTrack, ReceivedPacket
from app.services.ports import Task

if TYPE_CHECKING:  # they load numba, and every decoder process loads this module when it starts
    from app.decoders.plate.video_search import FoundPlate
    from app.lanes.control import Controller
    from app.lanes.overlay import LaneOverlay
    from app.simulation.steering import SteeringCheck


# === Tasks of decoder processes about frames, and their results: plain values that can be pickled.


@dataclass(frozen=True, slots=True)
class FramePicture:
    """One frame to load.

    Attributes
    ----------
    file : SpooledFile
        JPEG or PNG.
    thermal : bool
    thermal_range : (float, float) or None
        Counts that become 0 and 255 in a 16-bit thermal frame. [counts]
    limits : ImageLimits
    """

    file: SpooledFile
    thermal: bool = False
    thermal_range: tuple[float, float] | None = None
    limits: ImageLimits = field(default_factory=ImageLimits)


@dataclass(frozen=True, slots=True)
class FrameSearch:
    """What to look for in a frame: what each family's `FrameReader.search` returns, by the family's name."""

    by_family: Mapping[str, object]


@dataclass(frozen=True, slots=True)
class FrameResult:
    """What a decoder process found in a frame.

    Attributes
    ----------
    header : ImageHeader
    readings : tuple of FrameReading
    load_ms, decode_ms : float
        Time spent on the picture's codec and on the markers. [ms]
    """

    header: ImageHeader
    readings: tuple[FrameReading, ...]
    load_ms: float
    decode_ms: float


@dataclass(frozen=True, slots=True)
class FrameTask(Task[FrameResult]):
    """One frame to decode, in two steps: the picture is loaded while the caller still finds out what to look for.

    Attributes
    ----------
    picture : FramePicture
    search : Future of FrameSearch
        The caller sets it.
    """

    is_long: ClassVar[bool] = False

    picture: FramePicture
    search: Future[FrameSearch] = field(default_factory=Future)

    def steps(self) -> tuple[object, ...]:
        """The picture, then the search."""
        return (self.picture, self.search)


@dataclass(frozen=True, slots=True)
class FrameRunTask(Task[tuple[FrameResult | WaymarkError, ...]]):
    """Several frames to decode one after the other, so that their processes are handed work less often.

    The result has the error of each frame that cannot be read. A frame that stops the process stops the whole run.

    Attributes
    ----------
    frames : tuple of (FramePicture, FrameSearch)
    """

    is_long: ClassVar[bool] = False

    frames: tuple[tuple[FramePicture, FrameSearch], ...]


@dataclass(frozen=True, slots=True)
class AnnotationTask(Task[bytes]):
    """A frame to draw its readings on.

    Attributes
    ----------
    suffix : str
        ``png`` or ``jpg``.
    """

    is_long: ClassVar[bool] = False

    file: SpooledFile
    outlines: tuple[Outline, ...]
    suffix: str
    thermal: bool = False
    thermal_range: tuple[float, float] | None = None
    limits: ImageLimits = field(default_factory=ImageLimits)


# === Tasks of decoder processes about videos, and their results: plain values that can be pickled.


@dataclass(frozen=True, slots=True)
class IndexVideoTask(Task[VideoIndex]):
    """A video whose frames are to be listed.

    Attributes
    ----------
    file : VideoFile
    limits : VideoLimits
    rate_hz : float or None
        Frames a second of a stream without times. [Hz]
    """

    file: VideoFile
    limits: VideoLimits = field(default_factory=VideoLimits)
    rate_hz: float | None = None


@dataclass(frozen=True, slots=True)
class SegmentTask(Task["SegmentResult"]):
    """A segment of a video to decode.

    Attributes
    ----------
    index : VideoIndex
    number : int
        Of the segment.
    by_family : mapping of str to object
        What to look for, as in `FrameSearch`.
    thermal : bool
    speeds : tuple of (float, float)
        Speed of the vehicle at times of the video. [s, m/s]
    """

    index: VideoIndex
    number: int
    by_family: Mapping[str, object]
    thermal: bool = False
    speeds: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True)
class SegmentResult:
    """What a segment shows.

    Attributes
    ----------
    width_px, height_px : int
        Of the upright frames; 0 if no frame could be decoded. [px]
    frames, decoded : int
        Frames that were searched, and those that went through the whole plate decoder.
    damaged, other_size : int
        Frames that could not be decoded, or that have another size than the video.
    plates : tuple of FoundPlate
    others : mapping of int to tuple of FrameReading
        Readings of other families by frame.
    load_ms, decode_ms : float
        Time spent on the video's codec and on the search. [ms]
    """

    width_px: int
    height_px: int
    frames: int
    decoded: int
    damaged: int
    other_size: int
    plates: tuple[FoundPlate, ...]
    others: Mapping[int, tuple[FrameReading, ...]]
    load_ms: float
    decode_ms: float


# === Tasks of decoder processes that read an upload again for a closer look, and their results.


MAX_POINTS = 200_000
"""Points of each series at most. 2 MB of JSON for a series."""
MAX_SERIES = 6
DEFAULT_SERIES = ("vertical", "forward")
MAX_PACKETS = 20_000
"""Packets that are listed at most. 2 MB of JSON."""


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


@dataclass(frozen=True, slots=True)
class SamplesTask(Task[SamplesDocument]):
    """Samples of a recording to read.

    Attributes
    ----------
    name : str
        Of the file.
    file : SpooledFile
    declared : mapping
        The declaration that came with the upload.
    series : tuple of str
        ``vertical`` and ``forward`` are the largest change on any sensor of the array, ``s3_x`` is an axis of a sensor.
    from_s, to_s : float or None
        Of the recording; None for its ends. [s]
    points : int
        Of each series at most.
    limits : TraceLimits
    """

    name: str
    file: SpooledFile
    declared: Mapping[str, Any]
    series: tuple[str, ...] = DEFAULT_SERIES
    from_s: float | None = None
    to_s: float | None = None
    points: int = 100_000
    limits: TraceLimits = field(default_factory=TraceLimits)


class VehicleTrackDocument(TypedDict):
    """The vehicle's own track beside a packet log; the heading is null where it is not known."""

    time_s: list[float]
    lon_deg: list[float]
    lat_deg: list[float]
    heading_deg: list[float | None]


class PacketsDocument(TypedDict):
    """Packets of a log in the order of their times, as columns; null where a value is not known.

    `time_s` are seconds since 1970-01-01 UTC. `verdict` is `accepted` for authentic packets and their repetitions, else
    the reason why a packet was refused; it is null where the decode does not list it, which has 500 refused packets at
    most. The position is that of the vehicle.
    """

    total: int
    entry: list[int]
    time_s: list[float | None]
    number: list[int | None]
    rssi_dbm: list[float | None]
    snr_db: list[float | None]
    verdict: list[str | None]
    reason: list[str | None]
    lon_deg: list[float | None]
    lat_deg: list[float | None]
    track: VehicleTrackDocument | None


@dataclass(frozen=True, slots=True)
class VideoFrameTask(Task[bytes]):
    """A frame of a video to draw its readings on.

    Attributes
    ----------
    file : VideoFile
    number : int
        Of the frame.
    outlines : tuple of Outline
    suffix : str
        ``png`` or ``jpg``.
    limits : VideoLimits
    rate_hz : float or None
        Frames a second of a stream without times. [Hz]
    """

    file: VideoFile
    number: int
    outlines: tuple[Outline, ...]
    suffix: Literal["png", "jpg"]
    limits: VideoLimits = field(default_factory=VideoLimits)
    rate_hz: float | None = None
    is_long: ClassVar[bool] = True


# === Tasks of decoder processes about a trace, their results, and declarations as typed values.


TRACE_METHODS = ("matched", "metro")
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
    method: str = TRACE_METHODS[0]
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


def _columns(declared: Mapping[str, Any]) -> TraceColumns:
    kinds: dict[str, Any] = {"time_unit": TimeUnit, "speed_unit": SpeedUnit, "heading_unit": AngleUnit}
    values: dict[str, Any] = {name: kinds.get(name, lambda same: same)(value) for name, value in declared.items()}
    if "field" in values:
        values["field"] = tuple(tuple(names) for names in values["field"])
    return TraceColumns(**values)


def _can(declared: Mapping[str, Any]) -> CanDeclaration:
    signals = {name: CanSignal(**declared[name]) for name in ("speed", "heading") if declared.get(name)}
    return CanDeclaration(**signals, offset_s=declared.get("offset_s"), channel=declared.get("channel"))


# === Tasks of decoder processes about a drive past CERPMs, their results, and declarations as typed values.


PACKET_METHODS = ("waymark", "paper")
FILE_KINDS = ("packets", "poses", "frame")
PREDICTIVE, NO_CHECK = "predictive", "none"


@dataclass(frozen=True, slots=True)
class PacketTerms:
    """A declaration as the readers and the decoder know it.

    Attributes
    ----------
    packets : PacketDeclaration
    poses : PoseDeclaration
    files : mapping of str to str
        Kind of a file by its name, where its content does not show it.
    freshness : FreshnessRules
    lane : LaneRules
    method : str
        ``waymark``, or ``paper`` for section 2.2 of the CERPM paper.
    accept_clear : bool
        Use markers whose packets were received in clear only, without a tag.
    controller : Controller or None
        Of the check of steering; none is made without.
    signal : SignalRules
        With the figures of the receiver that were declared.
    """

    packets: PacketDeclaration
    poses: PoseDeclaration
    files: Mapping[str, str]
    freshness: FreshnessRules
    lane: LaneRules
    method: str
    accept_clear: bool
    controller: Controller | None
    signal: SignalRules


@dataclass(frozen=True, slots=True)
class DriveFiles:
    """What the files of a drive hold.

    Attributes
    ----------
    packets : list of ReceivedPacket
        Of all packet logs; entries go on counting from file to file.
    track : PoseTrack or None
    reports : dict of str to LogReport
        About reading each file.
    frame : (str, ImageHeader) or None
        Name and header of the camera frame.
    load_ms : float
        [ms]
    driven_m : float or None
        Along the track. [m]
    """

    packets: list[ReceivedPacket]
    track: PoseTrack | None
    reports: dict[str, LogReport]
    frame: tuple[str, ImageHeader] | None
    load_ms: float
    driven_m: float | None = None


@dataclass(frozen=True, slots=True)
class DriveTask(Task[DriveFiles]):
    """The files of one drive to read.

    Attributes
    ----------
    name : str
        Of the file.
    file : SpooledFile
        A packet log, or a ZIP of packet logs, poses and a camera frame.
    declared : mapping
        The declaration as it was sent; see `packet_terms`.
    packets : PacketLimits
    images : ImageLimits
    """

    name: str
    file: SpooledFile
    declared: Mapping[str, Any]
    packets: PacketLimits = field(default_factory=PacketLimits)
    images: ImageLimits = field(default_factory=ImageLimits)


@dataclass(frozen=True, slots=True, eq=False)
class LaneResult:
    """The lane and what follows from it.

    Attributes
    ----------
    lane : Lane
    steering : SteeringCheck or str or None
        The check, or why it could not be made.
    overlay : LaneOverlay or None
    plot : bytes
        SVG.
    decode_ms : float
        [ms]
    """

    lane: Lane
    steering: SteeringCheck | str | None
    overlay: LaneOverlay | None
    plot: bytes
    decode_ms: float


@dataclass(frozen=True, slots=True, eq=False)
class LaneTask(Task[LaneResult]):
    """Verified markers to estimate a lane through.

    Attributes
    ----------
    markers : LaneMarkers
    left_out : tuple of (int, float, float, str)
        Markers that were left out before: number, longitude and latitude that they claim [deg], and why.
    track : PoseTrack or None
    terms : PacketTerms
    strengths : (ndarray, ndarray)
        Distance and RSSI of accepted packets. [m, dBm]
    path_loss : (float, float) or None
        Fitted: level at 1 m and exponent. [dBm, 1]
    camera : Camera or None
        Of the frame to draw the lane over.
    pose : (float, float, float) or None
        Longitude, latitude and heading of the vehicle when it was taken. [deg]
    """

    markers: LaneMarkers
    left_out: tuple[tuple[int, float, float, str], ...]
    track: PoseTrack | None
    terms: PacketTerms
    strengths: tuple[Any, Any]
    path_loss: tuple[float, float] | None
    camera: Camera | None
    pose: tuple[float, float, float] | None


@dataclass(frozen=True, slots=True, eq=False)
class OverlayTask(Task[bytes]):
    """A lane to draw over the camera frame of an upload.

    Attributes
    ----------
    file : SpooledFile
        The upload.
    frame : str
        Name of the picture in it.
    overlay : LaneOverlay
    suffix : str
        ``png`` or ``jpg``.
    images : ImageLimits
    """

    is_long: ClassVar[bool] = False

    file: SpooledFile
    frame: str
    overlay: LaneOverlay
    suffix: str
    images: ImageLimits = field(default_factory=ImageLimits)


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


# === What the context of an upload declares of the frames of a drive.


@dataclass(frozen=True, slots=True)
class FrameTerms:
    """What is declared of the frames of a drive.

    Attributes
    ----------
    rate_hz : float or None
        Frames a second. [Hz]
    poses : PoseDeclaration
        Of a list of frames, or of a track beside them.
    """

    rate_hz: float | None = None
    poses: PoseDeclaration = field(default_factory=PoseDeclaration)


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
