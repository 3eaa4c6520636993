"""Schemas of decodes: the context that comes with a frame, a trace or a packet log."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field, JsonValue

from app.api.http.dependencies import Number, Whole
from app.api.http.dependencies import Text as DependenciesText
from app.api.http.responses import Time
from app.families.documents import Flag, StrictModel
from app.sensors.magnetometer_bar import MAX_CLEARANCE_M, MAX_SENSORS, MIN_CLEARANCE_M
from app.services.decodes.context import ContextInput

# === Schemas of packet logs: the declaration that comes with one.


Text = Annotated[str, Field(min_length=1, max_length=120)]


class ClockIn(StrictModel):
    """How the times of a file are read."""

    scale: Literal["auto", "unix-s", "unix-ms", "unix-us", "unix-ns", "gps-s", "gps-ms"] = Field(
        "auto", description="Of times that are numbers; `auto` distinguishes s, ms, us and ns since 1970 by their size."
    )
    offset_s: Number = Field(0.0, description="Added to each time: the true time less the log's clock. [s]")
    utc_offset_s: Number = Field(0.0, description="Of times without a zone: local time less UTC. [s]")


class PosesIn(StrictModel):
    """What is declared of the vehicle's track."""

    clock: ClockIn | None = None
    columns: dict[Text, Text] | None = Field(
        None, max_length=12, description="Names of columns: time, lon, lat, heading, accuracy, crs."
    )
    crs: Text | None = Field(None, description="WGS 84 if left out; others are refused.")
    date: Annotated[str, Field(pattern=r"^\d{4}-\d{2}-\d{2}$")] | None = Field(
        None, description="UTC date of the first position, for NMEA without dates."
    )
    forward_m: Number | None = Field(
        None, ge=-100, le=100, description="Of what was positioned, ahead of the vehicle's reference point. [m]"
    )
    left_m: Number | None = Field(
        None, ge=-100, le=100, description="Of what was positioned, left of the vehicle's reference point. [m]"
    )
    accuracy_m: Number | None = Field(
        None, gt=0, le=1000, description="Standard deviation of a position where the track has none. [m]"
    )


class PacketReceiverIn(StrictModel):
    """The vehicle's radio receiver."""

    sensitivity_dbm: Number | None = Field(None, ge=-160, le=-40, description="Fitted if left out. [dBm]")
    antenna_height_m: Number | None = Field(None, gt=0, le=20, description="Above the road, 1.5 if left out. [m]")


class FreshnessIn(StrictModel):
    """How strictly times and sequences are compared."""

    clock_tolerance_s: Number = Field(60.0, description="Largest difference between the clocks of two drives. [s]")
    log_tolerance_s: Number = Field(3.0, description="Largest step back of the times within a log. [s]")
    echo_s: Number = Field(3.0, description="The same packet is an echo up to this time, later a replay. [s]")


class LaneRulesIn(StrictModel):
    """Rules for the lane's estimation."""

    usual_width_m: Number = Field(3.3, description="Width where only one side is known. [m]")
    off_the_line_m: Number = Field(
        0.6, description="A marker that is farther from its neighbours' line is left out. [m]"
    )
    bridge_m: Number = Field(150.0, description="Without a track, the widest stretch without a marker. [m]")


class PacketsIn(StrictModel):
    """The declaration of a packet log. Supported formats need none: send {}."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{}, {"clock": {"scale": "gps-s"}, "columns": {"payload": "raw"}}]},
    )

    clock: ClockIn | None = None
    columns: dict[Text, Text] | None = Field(
        None,
        max_length=16,
        description="Names of columns: payload, number, lon, lat, rssi, snr, time ...",
    )
    payload_text: Literal["auto", "hex", "base64"] = "auto"
    files: dict[Text, Literal["packets", "poses", "frame"]] | None = Field(
        None, max_length=32, description="Kinds of files in a ZIP whose content does not show it, by name."
    )
    poses: PosesIn | None = None
    receiver: PacketReceiverIn | None = None
    freshness: FreshnessIn | None = None
    lane: LaneRulesIn | None = None
    method: Literal["waymark", "paper"] = Field("waymark", description="`paper` is the CERPM paper's own way.")
    accept_clear: Flag = Field(
        False,
        description="Use markers whose packets were received in clear only; the path is then not for localization.",
    )
    steering: Literal["predictive", "stanley", "stanley-lookahead", "none"] = Field(
        "predictive", description="Controller of the simulated drive along the path."
    )


# === Schemas of magnetometer traces: the declaration that comes with one.


Triple = Annotated[list[Number], Field(min_length=3, max_length=3)]


class SensorIn(StrictModel):
    """One magnetometer of the bar."""

    position_m: Triple = Field(description="Forward, left, up in the vehicle (ISO 8855). [m]")
    role: Literal["array", "reference"] = "array"
    vehicle_from_sensor: Annotated[list[Triple], Field(min_length=3, max_length=3)] | None = Field(
        None, description="Rotation of the chip; with it `axes` is not needed."
    )


class BarIn(StrictModel):
    """The bar of magnetometers; METRO's twelve and two where no sensors are declared."""

    forward_m: Number = Field(0.0, ge=-20, le=20, description="Ahead of the point that moves along the heading. [m]")
    clearance_m: Number | None = Field(
        None,
        ge=MIN_CLEARANCE_M,
        le=MAX_CLEARANCE_M,
        description="Height of the array sensors above the road; left out, three magnets or more show it. [m]",
    )
    sensors: list[SensorIn] | None = Field(None, min_length=3, max_length=MAX_SENSORS)


class ColumnsIn(StrictModel):
    """Columns of plain CSV and Parquet files."""

    time: Text = "t_s"
    time_unit: Literal["s", "ms", "us", "ns", "iso"] = "s"
    field: list[Annotated[list[Text], Field(min_length=3, max_length=3)]] = Field(
        default_factory=list, max_length=MAX_SENSORS, description="x, y, z of each sensor; s1_x, s1_y ... if left out."
    )
    speed: Text | None = "speed_m_s"
    speed_unit: Literal["m/s", "km/h", "mph", "kn"] = "m/s"
    heading: Text | None = "heading_deg"
    heading_unit: Literal["deg", "rad"] = "deg"
    delimiter: Literal[",", ";", "\t"] = ","
    decimal: Literal[".", ","] = "."


class CanSignalIn(StrictModel):
    """A signal by its name in a DBC, or by identifier, bits and scaling."""

    name: Text | None = None
    arbitration_id: Whole | None = Field(None, ge=0, le=0x1FFFFFFF)
    start_bit: Whole = Field(0, ge=0, le=511)
    length: Whole = Field(16, ge=1, le=64)
    byte_order: Literal["little", "big"] = "little"
    signed: Flag = False
    factor: Number = 1.0
    offset: Number = 0.0
    unit: Text | None = None
    minimum: Number | None = None
    maximum: Number | None = None


class CanIn(StrictModel):
    """Speed and heading in CAN logs."""

    speed: CanSignalIn | None = None
    heading: CanSignalIn | None = None
    offset_s: Number | None = Field(
        None, description="Trace time of the log's first frame; left out, it is found from the wheels' noise. [s]"
    )
    channel: Text | Whole | None = None


class TagFormatIn(StrictModel):
    """Tags to look for where none is registered nearby."""

    magnets: Whole = Field(3, ge=2, le=7)
    length_m: Number = 4.0
    segment_m: Number = 1.0


class TraceIn(StrictModel):
    """What is declared of a recording. METRO's stream and recorder files need nothing: send {}."""

    model_config = ConfigDict(json_schema_extra={"examples": [{}, {"unit": "uT", "axes": "FRD"}]})

    bar: BarIn | None = None
    unit: Literal["uT", "nT", "mT", "gauss", "mG"] | None = Field(
        None, description="Of CSV and Parquet, and of bags whose fields are not in tesla."
    )
    axes: Literal["ISO8855", "FLU", "FRD"] | None = Field(None, description="Of CSV, Parquet and bags.")
    calibrated: Flag = Field(False, description="Offsets are taken off: the earth's field remains.")
    background_removed: Flag = Field(False, description="The earth's field is taken off too.")
    columns: ColumnsIn | None = None
    can: CanIn | None = None
    formats: dict[Text, Literal["metro-stream", "csv", "parquet", "can-log", "dbc"]] | None = Field(
        None, max_length=32, description="Of files whose content does not show it, by name."
    )
    clock_offsets_s: dict[Text, Number] | None = Field(
        None, max_length=32, description="Added to the times of a file, by its name. [s]"
    )
    speed_m_s: Number | None = Field(None, description="Constant speed where no file has one. [m/s]")
    rate_hz: Number | None = Field(None, description="Expected rate: finds the phase of a stream. [Hz]")
    interval_extra_us: Number | None = Field(None, description="Time of the serial write, per sample. [us]")
    tag_formats: list[TagFormatIn] | None = Field(None, min_length=1, max_length=20)
    method: Literal["matched", "metro"] = Field("matched", description="`metro` is the paper's own pipeline.")
    reach_m: Number = Field(
        2000.0, gt=0, le=20_000, description="How far from the coarse position the drive may lead. [m]"
    )


# === Schemas of decodes: the context that comes with an upload.


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
    vehicle: DependenciesText | None = Field(
        None,
        min_length=1,
        max_length=80,
        description="Name or id of the vehicle: its profile gives what the context leaves out.",
    )

    def context_input(self, file_name: str = "") -> ContextInput:
        """The members that were sent and nothing else; one that is null is declared to be unknown."""
        stated = self.model_dump(exclude_unset=True, exclude={"vehicle"})
        return ContextInput(stated, self.vehicle, file_name)
