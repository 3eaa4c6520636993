"""Schemas of packet logs: the declaration that comes with one."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field

from app.api.http.dependencies import Number
from app.families.inputs import Flag, StrictModel

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
