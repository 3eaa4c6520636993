"""The context of an upload: what is declared of it, as a client sends it, as it is stored, and as decoders read it."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Literal

from pydantic import AfterValidator, ConfigDict, Field, JsonValue, model_validator

from app.decoders.cerpm.signal import ReceiverDeclaration
from app.decoders.cerpm.verify import FreshnessDeclaration
from app.decoders.magnet.identify import TagFormat
from app.errors import InvalidParameter, naming
from app.formats.images import ImageHeader, check_thermal_range
from app.formats.packets.rows import PacketDeclaration
from app.formats.poses import PoseDeclaration
from app.formats.traces.declaration import TraceDeclaration
from app.geodesy import check_lon_lat
from app.inputs import Declaration, Flag, Name, Number, Text, Time
from app.lanes.types import LaneDeclaration
from app.sensors.camera import Camera, CameraDeclaration

# === What an upload declares of its files.


class DeclaredTrace(TraceDeclaration):
    """What is declared of a recording. METRO's stream and recorder files need nothing: send {}."""

    model_config = ConfigDict(json_schema_extra={"examples": [{}, {"unit": "uT", "axes": "FRD"}]})

    tag_formats: tuple[TagFormat, ...] | None = Field(
        None, min_length=1, max_length=20, description="Tags to look for where none is registered nearby."
    )
    method: Literal["matched", "metro"] = Field("matched", description="`metro` is the paper's own pipeline.")
    reach_m: Number = Field(
        2000.0, gt=0, le=20_000, description="How far from the coarse position the drive may lead. [m]"
    )


class DeclaredPackets(PacketDeclaration):
    """The declaration of a packet log. Supported formats need none: send {}."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{}, {"clock": {"scale": "gps-s"}, "columns": {"payload": "raw"}}]},
    )

    files: dict[Name, Literal["packets", "poses", "frame"]] | None = Field(
        None, max_length=32, description="Kinds of files in a ZIP whose content does not show it, by name."
    )
    poses: PoseDeclaration | None = None
    receiver: ReceiverDeclaration | None = None
    freshness: FreshnessDeclaration | None = None
    lane: LaneDeclaration | None = None
    method: Literal["waymark", "paper"] = Field("waymark", description="`paper` is the CERPM paper's own way.")
    accept_clear: Flag = Field(
        False,
        description="Use markers whose packets were received in clear only; the path is then not for localization.",
    )
    steering: Literal["predictive", "mpc", "stanley", "stanley-lookahead", "none"] = Field(
        "predictive",
        description="Controller of the simulated drive along the path. `mpc` is model predictive control, which takes "
        "about 1 s of processor time a kilometre.",
    )


class DeclaredFrames(Declaration):
    """What is declared of the frames of a drive: a ZIP of pictures or a video."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"rate_hz": 10.0}, {"poses": {"accuracy_m": 1.5}}]})

    rate_hz: Number | None = Field(
        None,
        ge=0.001,
        le=1000,
        description="Frames a second from captured_at on, where the files state no times. A JPEG with it is a raw "
        "MJPEG stream. [Hz]",
    )
    poses: PoseDeclaration | None = Field(None, description="Of frames.csv, or of a track beside the frames.")
    method: Literal["waymark", "paper"] = Field(
        "waymark",
        description="`paper` reads plates by the paper's own algorithm, in pictures and ZIPs of colour pictures: for "
        "comparison. It makes no missed observations of markers.",
    )

    @cached_property
    def track(self) -> PoseDeclaration:
        """The list of frames, or the track beside them."""
        return self.poses or PoseDeclaration()


# === The context of an upload.


VIEW_RANGE_M = 100.0
MAX_ACCURACY_M = 20_000.0
CONTEXT_EXAMPLE: dict[str, JsonValue] = {
    "coarse_position": {"lon_deg": 114.17921, "lat_deg": 22.30413, "accuracy_m": 15.0},
    "heading_deg": 78.0,
    "camera": {
        "width_px": 1920,
        "height_px": 1080,
        "horizontal_fov_deg": 70.0,
        "height_m": 1.57,
        "depression_deg": 23.0,
    },
    "captured_at": "2026-05-04T08:30:00Z",
}


class CoarsePosition(Declaration):
    """The vehicle's approximate position."""

    lon_deg: Number = Field(description="Longitude, -180 to 180. [deg]")
    lat_deg: Number = Field(description="Latitude, -90 to 90. [deg]")
    accuracy_m: Number = Field(description="Radius that holds the vehicle, up to 20 000. [m]")

    @model_validator(mode="after")
    def _is_on_earth(self) -> CoarsePosition:
        check_lon_lat(self.lon_deg, self.lat_deg, field="coarse_position")
        if not 0 < self.accuracy_m <= MAX_ACCURACY_M:
            raise InvalidParameter(
                f"accuracy_m is {self.accuracy_m:g}",
                field="accuracy_m",
                limit=f"above 0, at most {MAX_ACCURACY_M:g} m",
                cure="give the radius that holds the vehicle; decimals alone cannot place a plate much further away",
            )
        return self

    @property
    def reach_m(self) -> float:
        """How far from here a plate in view can be. [m]"""
        return self.accuracy_m + VIEW_RANGE_M


def _check_heading(heading_deg: float | None) -> float | None:
    if heading_deg is not None and not 0 <= heading_deg <= 360:
        raise InvalidParameter(
            f"heading_deg is {heading_deg:g}", limit="0 to 360 deg", cure="give degrees clockwise from true north"
        )
    return heading_deg


class Profile(Declaration):
    """Members of a context that the profile of a vehicle can give."""

    camera: CameraDeclaration | None = None
    thermal: Flag | None = Field(None, description="The frames are from a thermal camera.")
    thermal_range: tuple[Number, Number] | None = Field(
        None, description="Counts of 16-bit thermal frames that become 0 and 255."
    )
    frames: DeclaredFrames | None = Field(None, description="Frames of a drive: their rate, and where they were taken.")
    trace: DeclaredTrace | None = Field(
        None,
        description="Magnetometer traces; {} for METRO's own formats. In a context it states that the file is one.",
    )
    packets: DeclaredPackets | None = Field(
        None,
        description="Packet logs of CERPMs, alone or in a ZIP with the vehicle's poses and a frame; {} for supported "
        "formats. In a context it states that the file is one.",
    )

    @property
    def is_paper(self) -> bool:
        """Whether plates are read by the paper's own algorithm."""
        return self.frames is not None and self.frames.method == "paper"

    def check(self) -> None:
        """Refuse what is incomplete or contradicts itself, after a vehicle's profile completed an upload's context.

        Raises
        ------
        InvalidParameter
            The field is a path within the context.
        """
        if self.camera is not None:
            self.camera.check()
        if self.trace is not None:
            with naming("trace"):
                self.trace.check()
        if self.thermal and self.is_paper:
            raise InvalidParameter(
                "the method paper finds plates by their colours, which a thermal frame does not have",
                field="frames.method",
                limit="waymark with thermal",
                cure="leave frames.method out, or set thermal to false",
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


class _Context(Profile):
    coarse_position: CoarsePosition | None = None
    heading_deg: Annotated[Number | None, AfterValidator(_check_heading)] = Field(
        None, description="Of the vehicle, clockwise from true north. [deg]"
    )
    captured_at: Time | None = Field(None, description="When the frame was taken, or the trace or the video began.")


class UploadContext(_Context):
    """The context of an upload. Everything is optional, but without a coarse position nothing is matched."""

    model_config = ConfigDict(json_schema_extra={"examples": [CONTEXT_EXAMPLE]})

    vehicle: Text | None = Field(
        None,
        min_length=1,
        max_length=80,
        description="Name or id of the vehicle: its profile gives what the context leaves out.",
    )

    @property
    def stated(self) -> dict[str, object]:
        """The members that were sent and nothing else; one that is null is declared to be unknown."""
        return self.model_dump(mode="json", exclude_unset=True, exclude={"vehicle"})


class UsedVehicle(Declaration):
    """The vehicle of an upload, and where each member of the context is from."""

    id: str
    name: str
    version: int
    sources: dict[str, str]  # path of each member to ``upload``, ``vehicle`` or ``default``


class DecodeContext(_Context):
    """Everything that comes with an upload, completed by its vehicle's profile."""

    vehicle: UsedVehicle | None = None
    file_name: str | None = None  # of the uploaded file; its suffix distinguishes kinds of text files

    @model_validator(mode="after")
    def _agrees(self) -> DecodeContext:
        if self.trace is not None and self.packets is not None:
            raise InvalidParameter(
                "an upload is a trace or a packet log", field="packets", limit="one of trace, packets", cure="send one"
            )
        self.check()
        return self

    @property
    def is_thermal(self) -> bool:
        """Whether the frames are from a thermal camera."""
        return self.thermal is True

    def camera_of(self, frame: ImageHeader) -> Camera | None:
        """The camera of a frame; None where none is declared.

        Raises
        ------
        InvalidParameter
            The frame has another size than the camera.
        """
        return self.camera.camera_of(frame.width_px, frame.height_px) if self.camera is not None else None

    def document(self) -> dict[str, object]:
        """The context as it is stored: the members that were declared."""
        return self.model_dump(mode="json", exclude_unset=True)
