"""Schemas of decodes: the context that comes in, and what goes out as OpenAPI describes it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, JsonValue

from app.api.dependencies import Number, Text, Whole
from app.api.schemas_packets import DecodedLaneOut, HeardMarkerOut, OverlayOut, PacketReportOut, PacketsIn, SteeringOut
from app.api.schemas_traces import CrossingOut, MagnetReadingOut, NoiseOut, ReportOut, TagFixOut, TagOut, TraceIn
from app.services.decode_context import GivenContext

Flag = Annotated[bool, Field(strict=True)]
State = Literal["queued", "running", "done", "failed", "cancelled"]

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


class CoarsePositionIn(BaseModel):
    """Where the vehicle believed to be."""

    model_config = ConfigDict(extra="forbid")

    lon_deg: Number = Field(description="Longitude, -180 to 180. [deg]")
    lat_deg: Number = Field(description="Latitude, -90 to 90. [deg]")
    accuracy_m: Number = Field(description="Radius that holds the vehicle, up to 20 000. [m]")


class CameraIn(BaseModel):
    """Intrinsics of the frames or their horizontal field of view, and the mount on the vehicle."""

    model_config = ConfigDict(extra="forbid")

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


class ContextIn(BaseModel):
    """What is known about an upload. Everything is optional, but without a coarse position nothing is matched."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [CONTEXT_EXAMPLE]})

    coarse_position: CoarsePositionIn | None = None
    heading_deg: Number | None = Field(None, description="Of the vehicle, clockwise from true north. [deg]")
    camera: CameraIn | None = None
    thermal: Flag = Field(False, description="The frame is from a thermal camera.")
    thermal_range: Annotated[list[Number], Field(min_length=2, max_length=2)] | None = Field(
        None, description="Counts of 16-bit thermal frames that become 0 and 255."
    )
    captured_at: AwareDatetime | None = Field(None, description="When the frame was taken, or the trace began.")
    trace: TraceIn | None = Field(None, description="The file is a magnetometer trace; {} for METRO's own formats.")

    packets: PacketsIn | None = Field(
        None, description="The file is a packet log of CERPMs, or a ZIP of one with the vehicle's poses and a frame."
    )

    vehicle: Text | None = Field(
        None,
        min_length=1,
        max_length=80,
        description="Name or id of the vehicle: its profile stands behind what the context says.",
    )

    def given(self, file_name: str = "") -> GivenContext:
        """What was said and nothing else; a member that is null is said to be unknown."""
        stated = self.model_dump(exclude_unset=True, exclude={"vehicle"})
        return GivenContext(stated, self.vehicle, file_name)


class FixOut(BaseModel):
    """The vehicle's position; the covariance is of east, north, up [m] and heading [rad]."""

    lon_deg: float
    lat_deg: float
    height_m: float | None
    heading_deg: float
    covariance: list[list[float]]
    sigma: dict[str, float | None]
    localization_grade: Literal["exact", "approximate, not for localization"]
    notes: list[str]
    marker_ids: list[str]


class MatchOut(BaseModel):
    """The registry's plate, or where an unregistered one says it is."""

    registered: bool
    marker_id: str | None
    status: str | None
    localization_grade: str | None
    lon_deg: float | None
    lat_deg: float | None
    distance_m: float | None
    plausible: bool
    ambiguous: bool
    other_marker_ids: list[str]
    note: str | None


class ReadingOut(BaseModel):
    """One candidate plate and what became of it; digits only where the outcome is `read`."""

    frame: int
    outcome: str
    reason: str | None
    digits: str | None
    scheme: str | None
    registry_number: int | None
    confidence: float
    cell_confidence: list[float]
    corrected_cells: list[int]
    from_codebook: bool
    corners_px: list[list[float]] | None
    corner_sigma_px: float | None
    height_px: float
    width_px: float
    geometry: dict[str, float] | None
    grade: dict[str, Any] | None
    pose: dict[str, Any] | None
    match: MatchOut | None
    fix: FixOut | None


class FrameOut(BaseModel):
    """One frame of the upload."""

    frame: int
    name: str | None
    error: dict[str, str] | None
    width_px: int | None
    height_px: int | None
    format: str | None
    orientation: int | None
    ignored_trailing_bytes: int
    load_ms: float
    decode_ms: float
    readings: int
    fix: FixOut | None


class DecodeOut(BaseModel):
    """A decode. `decoder` and what follows it are there once it is done."""

    id: str
    state: State
    kind: Literal["frame", "archive", "trace", "packets"]
    progress: float
    attempts: int
    created_at: str
    finished_at: str | None
    context: dict[str, Any]
    error: dict[str, str] | None
    links: dict[str, str]
    decoder: str | None = None
    codebook_plates: int | None = None
    summary: dict[str, Any] | None = None
    readings: list[ReadingOut] | None = None
    fix: FixOut | TagFixOut | None = None
    frames: list[FrameOut] | None = None
    codebook_tags: int | None = None
    report: ReportOut | PacketReportOut | None = None
    tags: list[TagOut] | None = None
    crossings: list[CrossingOut] | None = None
    magnets: list[MagnetReadingOut] | None = None
    noise: list[NoiseOut] | None = None
    markers: list[HeardMarkerOut] | None = None
    lane: DecodedLaneOut | None = None
    steering: SteeringOut | None = None
    overlay: OverlayOut | None = None
    path_loss: dict[str, Any] | None = None


class DecodePage(BaseModel):
    """A page of decodes without their results, newest first; the Link header leads to the next one."""

    items: list[DecodeOut]
