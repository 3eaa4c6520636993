"""Tasks of decoder processes about a drive past CERPMs, their results, and declarations as typed values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import date
from typing import TYPE_CHECKING, Any, ClassVar

from app.decoders.cerpm.freshness import FreshnessRules
from app.decoders.cerpm.signal import SignalRules
from app.errors import InvalidParameter
from app.formats.images import ImageHeader, ImageLimits
from app.formats.log_report import LogReport
from app.formats.log_times import LogClock, TimeScale
from app.formats.packets.declaration import PacketDeclaration, PacketLimits
from app.formats.packets.rows import PayloadText
from app.formats.poses.declaration import PoseDeclaration
from app.formats.spooled_file import SpooledFile
from app.lanes.types import Lane, LaneMarkers, LaneRules
from app.sensors.camera import Camera
from app.sensors.pose_track import PoseTrack
from app.sensors.receiver import ReceivedPacket
from app.services.decoder_processes import Task

if TYPE_CHECKING:  # they load numba, and every decoder process loads this module when it starts
    from app.lanes.control import Controller
    from app.lanes.overlay import LaneOverlay
    from app.simulation.steering import SteeringCheck

METHODS = ("waymark", "paper")
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
        As `app.api.decodes.schemas_packets.PacketsIn` describes it.

    Raises
    ------
    InvalidParameter
        A figure is out of its limits; the field is below ``packets``.
    """
    try:
        method = declared.get("method", METHODS[0])
        if method not in METHODS:
            raise InvalidParameter(f"there is no method {method}", field="method", limit=", ".join(METHODS))
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
    """The declaration of a track, as `app.api.decodes.schemas_packets.PosesIn` describes it."""
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
