"""Schemas of packet logs: what is declared of them, and what was found."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from app.api.dependencies import Number

Flag = Annotated[bool, Field(strict=True)]
Text = Annotated[str, Field(min_length=1, max_length=120)]
_STRICT = ConfigDict(extra="forbid")


class ClockIn(BaseModel):
    """How the times of a file are read."""

    model_config = _STRICT

    scale: Literal["auto", "unix-s", "unix-ms", "unix-us", "unix-ns", "gps-s", "gps-ms"] = Field(
        "auto", description="Of times that are numbers; `auto` tells s, ms, us and ns since 1970 by their size."
    )
    offset_s: Number = Field(0.0, description="Added to each time: the true time less the log's clock. [s]")
    utc_offset_s: Number = Field(0.0, description="Of times without a zone: local time less UTC. [s]")


class PosesIn(BaseModel):
    """What is declared of the vehicle's track."""

    model_config = _STRICT

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
        None, gt=0, le=1000, description="Standard deviation of a position where the track does not say. [m]"
    )


class PacketReceiverIn(BaseModel):
    """The vehicle's radio receiver."""

    model_config = _STRICT

    sensitivity_dbm: Number | None = Field(None, ge=-160, le=-40, description="Fitted if left out. [dBm]")
    antenna_height_m: Number | None = Field(None, gt=0, le=20, description="Above the road, 1.5 if left out. [m]")


class FreshnessIn(BaseModel):
    """How strictly times and sequences are held against each other."""

    model_config = _STRICT

    clock_tolerance_s: Number = Field(60.0, description="Most that the clocks of two drives differ by. [s]")
    log_tolerance_s: Number = Field(3.0, description="Most that times within a log are out of order by. [s]")
    echo_s: Number = Field(3.0, description="Until when the same packet again is an echo, not a replay. [s]")


class LaneRulesIn(BaseModel):
    """What the lane may look like."""

    model_config = _STRICT

    usual_width_m: Number = Field(3.3, description="Width where only one side is known. [m]")
    off_the_line_m: Number = Field(0.6, description="Least by which a marker must stray to be left out. [m]")
    bridge_m: Number = Field(150.0, description="Without a track, the widest stretch without a marker. [m]")


class PacketsIn(BaseModel):
    """What is declared of a packet log. Formats that are known need nothing: send {}."""

    model_config = ConfigDict(
        extra="forbid",
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
        False, description="Use markers that were only heard in clear; the path is then not for localization."
    )
    steering: Literal["predictive", "stanley", "stanley-lookahead", "none"] = Field(
        "predictive", description="Controller of the simulated drive along the path."
    )


class HealthOut(BaseModel):
    """How well a marker is heard."""

    verdict: str
    sentence: str
    level_db: float | None
    level_db_low: float | None
    level_db_high: float | None
    delivery: float | None
    farthest_m: float | None


class RssiProfileOut(BaseModel):
    """Strength of a marker's packets by distance, nearest first; at most 200 of them."""

    distance_m: list[float]
    rssi_dbm: list[float]


class HeardMarkerOut(BaseModel):
    """One marker that was heard."""

    number: int
    marker_id: str | None
    registered: bool
    authentic: bool
    side: str
    lon_deg: float | None
    lat_deg: float | None
    packets: int
    first_sequence: int | None
    last_sequence: int | None
    best_rssi_dbm: float | None
    off_registered_m: float | None
    residual_m: float | None
    left_out: str | None
    notes: list[str]
    health: HealthOut | None
    rssi_profile: RssiProfileOut | None


class DecodedLaneOut(BaseModel):
    """The lane's reference path, at stations along it."""

    method: str
    refusal: str | None
    doubts: list[str]
    localization_grade: str
    length_m: float
    sigma_median_m: float | None
    sigma_max_m: float | None
    min_radius_m: float | None
    speed_limits_km_h: list[float]
    origin: dict[str, float]
    stations: dict[str, list[float | None]]
    left: list[list[list[float]]]
    right: list[list[list[float]]]


class SteeringOut(BaseModel):
    """A simulated drive along the path."""

    refusal: str | None
    controller: str | None
    completed: bool | None
    rms_m: float | None
    max_m: float | None
    mse_m2: float | None
    mean_speed_m_s: float | None
    lateral_acceleration_m_s2: float | None
    distance_m: float | None


class OverlayOut(BaseModel):
    """Pixel coordinates of the lane in the camera frame."""

    frame: str
    left_px: list[list[list[float]]]
    right_px: list[list[list[float]]]
    centre_px: list[list[list[float]]]
    area_px: list[list[list[float]]]
    markers_px: list[list[float]]


class PacketReportOut(BaseModel):
    """About reading and verifying the log."""

    files: dict[str, dict[str, Any]]
    packets: int
    verdicts: dict[str, int]
    refused: list[dict[str, Any]]
    left_out: list[dict[str, Any]]
    warnings: list[str]
    driven_m: float | None
    load_ms: float
    verify_ms: float
    decode_ms: float
