"""The context of an upload: where the vehicle was, which camera took it, which kind of upload it is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from typing import Any, Literal

from app.errors import InvalidParameter
from app.formats.format import ArchiveLimits
from app.formats.images import ImageHeader, ImageLimits, check_thermal_range
from app.formats.packets.rows import PacketLimits
from app.formats.traces.declaration import TraceLimits
from app.formats.video_file import VideoLimits
from app.geodesy import check_lon_lat
from app.registry.decodes import DecodeRow
from app.sensors.camera import Camera
from app.services.decodes.declarations import frame_terms, packet_terms, trace_terms

# === Kinds of decodes.


class DecodeKind(StrEnum):
    """What was decoded."""

    FRAME = "frame"
    ARCHIVE = "archive"
    VIDEO = "video"
    TRACE = "trace"
    PACKETS = "packets"


# === Limits of decodes that a deployment can set.


@dataclass(frozen=True, slots=True)
class DecodeRules:
    """What uploads may cost."""

    images: ImageLimits = field(default_factory=ImageLimits)
    archives: ArchiveLimits = field(default_factory=ArchiveLimits)
    videos: VideoLimits = field(default_factory=VideoLimits)
    traces: TraceLimits = field(default_factory=TraceLimits)
    packets: PacketLimits = field(default_factory=PacketLimits)
    # [byte] recordings and packet logs up to this size are decoded while the caller waits, larger ones become jobs
    immediate_trace_bytes: int = 8 * 1024**2
    frames_in_flight: int = 2  # frames of one archive that are decoded at the same time
    progress_every: timedelta = timedelta(seconds=1)  # shortest time between two reports of a job's progress
    idempotency_ttl: timedelta = timedelta(hours=24)


# === Sentences about results.


def count_of(number: int, what: str) -> str:
    """A number with its noun, in the plural where it has to be."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


# === The times of a decode: UTC where the upload states when it was taken, else those of its recording.


_EPOCH_S = 1e9
"""[s] times beyond are seconds since 1970: no recording lasts 30 years."""


@dataclass(frozen=True, slots=True)
class DecodeTimes:
    """What the times of a decode count from."""

    clock: Literal["utc", "recording"]  # ``utc``: seconds since 1970-01-01 UTC; ``recording``: of the recording
    zero_s: float = 0.0  # [s] added to times of a trace or of a video's frames
    captured_s: float | None = None  # [s] when the upload was taken, by its context
    alone: bool = False  # the upload is a single frame, which was taken then

    def trace_s(self, t_s: float) -> float:
        """Time of a sample. [s]"""
        return round(t_s + self.zero_s, 4)

    def frame_s(self, frame: Mapping[str, Any]) -> float | None:
        """Time of a frame, None if it is not known. [s]"""
        if self.clock == "utc":
            return _seconds(frame.get("captured_at")) or (self.captured_s if self.alone else None)
        return frame.get("time_s")


def clock_of(row: DecodeRow) -> DecodeTimes:
    """The clock of a decode that has a result."""
    result, captured_s = row.result or {}, _seconds(row.context.get("captured_at"))
    if row.kind == DecodeKind.TRACE:
        start_s = float((result.get("motion") or {}).get("start_s", 0.0))
        if start_s > _EPOCH_S:
            return DecodeTimes("utc")
        return DecodeTimes("recording") if captured_s is None else DecodeTimes("utc", captured_s - start_s)
    if row.kind == DecodeKind.PACKETS:
        return DecodeTimes("utc")
    frames = result.get("frames", ())
    alone = len(frames) == 1 and row.kind == DecodeKind.FRAME
    stated = any(frame.get("captured_at") for frame in frames) or (alone and captured_s is not None)
    return DecodeTimes("utc" if stated else "recording", captured_s=captured_s, alone=alone)


def stamp(time_s: float | None, clock: DecodeTimes) -> str | None:
    """A time as RFC 3339; None unless it is UTC."""
    if time_s is None or clock.clock != "utc":
        return None
    return datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _seconds(value: str | datetime | None) -> float | None:
    if value is None:
        return None
    return (datetime.fromisoformat(value) if isinstance(value, str) else value).timestamp()


# === The context of an upload.


VIEW_RANGE_M = 100.0
MAX_ACCURACY_M = 20_000.0
_INTRINSICS = ("fx_px", "fy_px", "cx_px", "cy_px")


@dataclass(frozen=True, slots=True)
class CoarsePosition:
    """The vehicle's approximate position."""

    # `lon_deg`, `lat_deg`: [deg] WGS 84
    lon_deg: float
    lat_deg: float
    accuracy_m: float  # [m] radius that holds the true position with near certainty, at most 20 km

    def __post_init__(self) -> None:
        check_lon_lat(self.lon_deg, self.lat_deg, field="coarse_position")
        if not 0 < self.accuracy_m <= MAX_ACCURACY_M:
            raise InvalidParameter(
                f"accuracy_m is {self.accuracy_m:g}",
                field="coarse_position.accuracy_m",
                limit=f"above 0, at most {MAX_ACCURACY_M:g} m",
                cure="give the radius that holds the vehicle; decimals alone cannot place a plate much further away",
            )

    @property
    def reach_m(self) -> float:
        """How far from here a plate in view can be. [m]"""
        return self.accuracy_m + VIEW_RANGE_M


@dataclass(frozen=True, slots=True)
class CameraSetup:
    """A camera as a vehicle declares it: intrinsics, or the horizontal field of view, and the mount."""

    # `width_px`, `height_px`: [px] size of the frames; must be theirs
    width_px: int | None = None
    height_px: int | None = None
    # `fx_px`, `fy_px`, `cx_px`, `cy_px`: [px] all four, or none with `horizontal_fov_deg`
    fx_px: float | None = None
    fy_px: float | None = None
    cx_px: float | None = None
    cy_px: float | None = None
    distortion: tuple[float, ...] = ()  # OpenCV's coefficients, with intrinsics only
    horizontal_fov_deg: float | None = None  # [deg] field of view of an undistorted camera
    # `height_m`, `depression_deg`, `azimuth_deg`, `roll_deg`, `forward_m`, `left_m`: mount, as in `Camera`
    height_m: float = 1.57
    depression_deg: float = 23.0
    azimuth_deg: float = 0.0
    roll_deg: float = 0.0
    forward_m: float = 0.0
    left_m: float = 0.0
    readout_s: float = 0.0  # [s] rolling shutter, as in `Camera`

    def __post_init__(self) -> None:
        intrinsics = [name for name in _INTRINSICS if getattr(self, name) is not None]
        if bool(intrinsics) == (self.horizontal_fov_deg is not None) or len(intrinsics) not in (0, 4):
            raise InvalidParameter(
                "a camera has four intrinsics or a horizontal field of view",
                field="camera.horizontal_fov_deg" if not intrinsics else "camera.fx_px",
                limit="fx_px, fy_px, cx_px, cy_px; or horizontal_fov_deg",
                cure="send all four intrinsics with width_px and height_px, or horizontal_fov_deg alone",
            )
        if intrinsics and (self.width_px is None or self.height_px is None):
            raise InvalidParameter(
                "intrinsics belong to one size of frame",
                field="camera.width_px",
                limit="width_px and height_px beside intrinsics",
                cure="send the size of the frames that the camera was calibrated with",
            )
        if self.distortion and not intrinsics:
            raise InvalidParameter(
                "distortion needs the four intrinsics", field="camera.distortion", limit="with intrinsics only"
            )
        for name, value in asdict(self).items():
            values = value if isinstance(value, tuple) else (value,)
            if any(isinstance(v, float) and not math.isfinite(v) for v in values):
                raise InvalidParameter(f"{name} is not finite", field=f"camera.{name}", limit="finite numbers")
        self._camera(self.width_px or 1920, self.height_px or 1080)

    def camera_for(self, header: ImageHeader) -> Camera:
        """The camera of a frame.

        Raises
        ------
        InvalidParameter
            The frame has another size than the camera.
        """
        for name, declared, actual in (
            ("width_px", self.width_px, header.width_px),
            ("height_px", self.height_px, header.height_px),
        ):
            if declared is not None and declared != actual:
                raise InvalidParameter(
                    f"the camera's {name} is {declared}, the frame's is {actual} (upright)",
                    field=f"camera.{name}",
                    limit=f"{header.width_px} x {header.height_px} px",
                    cure="send the camera parameters of these frames, or the frames as the camera wrote them",
                )
        return self._camera(header.width_px, header.height_px)

    def _camera(self, width_px: int, height_px: int) -> Camera:
        if self.horizontal_fov_deg is not None:
            return Camera.from_field_of_view(
                width_px,
                height_px,
                self.horizontal_fov_deg,
                height_m=self.height_m,
                depression_deg=self.depression_deg,
                azimuth_deg=self.azimuth_deg,
                roll_deg=self.roll_deg,
                forward_m=self.forward_m,
                left_m=self.left_m,
                readout_s=self.readout_s,
            )
        fx, fy, cx, cy = (float(getattr(self, name)) for name in _INTRINSICS)
        return Camera(
            width_px, height_px, fx, fy, cx, cy, self.distortion,
            self.height_m, self.depression_deg, self.azimuth_deg, self.roll_deg, self.forward_m, self.left_m,
            self.readout_s,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class ContextInput:
    """The context as it was sent with an upload, before its vehicle's profile completes it."""

    stated: dict[str, object] = field(default_factory=dict)  # members of the context that were sent and nothing else
    vehicle: str | None = None  # name or id of the vehicle
    file_name: str = ""  # of the file; empty where it has none


@dataclass(frozen=True, slots=True)
class DecodeContext:
    """Everything that comes with an upload."""

    coarse_position: CoarsePosition | None = None  # without it nothing is looked up in the registry
    heading_deg: float | None = None  # [deg] of the vehicle, clockwise from true north
    camera: CameraSetup | None = None
    thermal: bool = False
    thermal_range: tuple[float, float] | None = None  # [counts] counts that become 0 and 255 in 16-bit thermal frames
    captured_at: datetime | None = None  # aware
    # the upload is a magnetometer trace, declared like this (`app.services.decodes.declarations.trace_terms`)
    trace: dict[str, object] | None = None
    # the upload is a packet log, declared like this (`app.services.decodes.declarations.packet_terms`)
    packets: dict[str, object] | None = None
    # frame rate, list and track of the frames of a drive, declared like this
    # (`app.services.decodes.declarations.frame_terms`)
    frames: dict[str, object] | None = None
    # id, name and version of the vehicle, and the source of each member (`app.services.fleet.vehicles.inherit`)
    vehicle: dict[str, Any] | None = None
    file_name: str | None = None  # of the uploaded file, for people

    def __post_init__(self) -> None:
        if self.trace is not None and self.packets is not None:
            raise InvalidParameter(
                "an upload is a trace or a packet log", field="packets", limit="one of trace, packets", cure="send one"
            )
        if self.trace is not None:
            trace_terms(self.trace)
        if self.packets is not None:
            packet_terms(self.packets)
        if self.frames is not None:
            frame_terms(self.frames)
        if self.heading_deg is not None and not 0 <= self.heading_deg <= 360:
            raise InvalidParameter(
                f"heading_deg is {self.heading_deg:g}",
                field="heading_deg",
                limit="0 to 360 deg",
                cure="give degrees clockwise from true north",
            )
        if self.thermal_range is not None:
            check_thermal_range(self.thermal_range)
            if not self.thermal:
                raise InvalidParameter(
                    "thermal_range means nothing in a frame that is not thermal",
                    field="thermal_range",
                    limit="with thermal only",
                    cure="set thermal to true, or leave thermal_range out",
                )
        if self.captured_at is not None and self.captured_at.tzinfo is None:
            raise InvalidParameter(
                "captured_at has no time zone",
                field="captured_at",
                limit="RFC 3339 with an offset",
                cure="add Z for UTC",
            )

    def document(self) -> dict[str, object]:
        """The context as it is stored: the members that have a value."""
        stated = _without_none(asdict(replace(self, trace=None, packets=None, frames=None, vehicle=None)))
        document = {name: value for name, value in stated.items() if value is not False}
        declared = {name: getattr(self, name) for name in ("trace", "packets", "frames", "vehicle")}
        return {**document, **{name: value for name, value in declared.items() if value is not None}}


def context_from_document(document: dict[str, Any]) -> DecodeContext:
    """The context that `DecodeContext.document` stored."""
    position, camera = document.get("coarse_position"), document.get("camera")
    captured_at, counts = document.get("captured_at"), document.get("thermal_range")
    context = DecodeContext(
        coarse_position=CoarsePosition(**position) if position else None,
        heading_deg=document.get("heading_deg"),
        thermal=document.get("thermal", False),
        thermal_range=(counts[0], counts[1]) if counts else None,
        captured_at=datetime.fromisoformat(captured_at) if isinstance(captured_at, str) else captured_at,
        trace=document.get("trace"),
        packets=document.get("packets"),
        frames=document.get("frames"),
        vehicle=document.get("vehicle"),
        file_name=document.get("file_name"),
    )
    if camera is not None:
        setup = CameraSetup(**{**camera, "distortion": tuple(camera.get("distortion", ()))})
        context = replace(context, camera=setup)
    return context


def _without_none(values: dict[str, object]) -> dict[str, object]:
    return {
        name: _without_none(value) if isinstance(value, dict) else value
        for name, value in values.items()
        if value is not None and value != ()
    }
