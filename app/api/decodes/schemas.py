"""Schemas of decodes: the context that comes with an upload."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field, JsonValue

from app.api.decodes.schemas_packets import PacketsIn, PosesIn
from app.api.decodes.schemas_traces import TraceIn
from app.api.http.dependencies import Number, Text, Whole
from app.api.http.times import Time
from app.families.inputs import Flag, StrictModel
from app.services.decodes.context import ContextInput

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


class CoarsePositionIn(StrictModel):
    """The vehicle's approximate position."""

    lon_deg: Number = Field(description="Longitude, -180 to 180. [deg]")
    lat_deg: Number = Field(description="Latitude, -90 to 90. [deg]")
    accuracy_m: Number = Field(description="Radius that holds the vehicle, up to 20 000. [m]")


class CameraIn(StrictModel):
    """Intrinsics of the frames or their horizontal field of view, and the mount on the vehicle."""

    width_px: Whole | None = Field(None, ge=1, description="Width of the upright frames. [px]")
    height_px: Whole | None = Field(None, ge=1, description="Height of the upright frames. [px]")
    fx_px: Number | None = Field(None, description="Focal length in x. [px]")
    fy_px: Number | None = Field(None, description="Focal length in y. [px]")
    cx_px: Number | None = Field(None, description="Principal point, pixel centres at integers. [px]")
    cy_px: Number | None = Field(None, description="Principal point, pixel centres at integers. [px]")
    distortion: list[Number] = Field(default_factory=list, max_length=8, description="OpenCV k1 k2 p1 p2 [k3 ...].")
    horizontal_fov_deg: Number | None = Field(None, description="Horizontal field of view. [deg]")
    height_m: Number = Field(1.57, le=100, description="Above the road. [m]")
    depression_deg: Number = Field(23.0, ge=-90, le=90, description="Optical axis below the horizontal. [deg]")
    azimuth_deg: Number = Field(0.0, ge=-180, le=360, description="Optical axis right of straight ahead. [deg]")
    roll_deg: Number = Field(0.0, ge=-180, le=180, description="Clockwise about the optical axis. [deg]")
    forward_m: Number = Field(0.0, ge=-100, le=100, description="Ahead of the vehicle's reference point. [m]")
    left_m: Number = Field(0.0, ge=-100, le=100, description="Left of the vehicle's reference point. [m]")
    readout_s: Number = Field(
        0.0, ge=0, le=1, description="Rolling shutter: from the first row's exposure to the last's. [s]"
    )


class FramesIn(StrictModel):
    """What is declared of the frames of a drive: a ZIP of pictures or a video."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"rate_hz": 10.0}, {"poses": {"accuracy_m": 1.5}}]})

    rate_hz: Number | None = Field(
        None,
        ge=0.001,
        le=1000,
        description="Frames a second from captured_at on, where the files state no times. A JPEG with it is a raw "
        "MJPEG stream. [Hz]",
    )
    poses: PosesIn | None = Field(None, description="Of frames.csv, or of a track beside the frames.")


class ContextIn(StrictModel):
    """The context of an upload. Everything is optional, but without a coarse position nothing is matched."""

    model_config = ConfigDict(json_schema_extra={"examples": [CONTEXT_EXAMPLE]})

    coarse_position: CoarsePositionIn | None = None
    heading_deg: Number | None = Field(None, description="Of the vehicle, clockwise from true north. [deg]")
    camera: CameraIn | None = None
    thermal: Flag = Field(False, description="The frame is from a thermal camera.")
    thermal_range: Annotated[list[Number], Field(min_length=2, max_length=2)] | None = Field(
        None, description="Counts of 16-bit thermal frames that become 0 and 255."
    )
    captured_at: Time | None = Field(None, description="When the frame was taken, or the trace or the video began.")
    frames: FramesIn | None = Field(None, description="The frames of a drive: their rate, and where they were taken.")
    trace: TraceIn | None = Field(None, description="The file is a magnetometer trace; {} for METRO's own formats.")
    packets: PacketsIn | None = Field(
        None, description="The file is a packet log of CERPMs, or a ZIP of one with the vehicle's poses and a frame."
    )
    vehicle: Text | None = Field(
        None,
        min_length=1,
        max_length=80,
        description="Name or id of the vehicle: its profile gives what the context leaves out.",
    )

    def given(self, file_name: str = "") -> ContextInput:
        """The members that were sent and nothing else; one that is null is declared to be unknown."""
        stated = self.model_dump(exclude_unset=True, exclude={"vehicle"})
        return ContextInput(stated, self.vehicle, file_name)
