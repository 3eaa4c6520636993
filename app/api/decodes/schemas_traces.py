"""Schemas of magnetometer traces: the declaration that comes with one."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field

from app.api.http.dependencies import Number, Whole
from app.families.inputs import Flag, StrictModel
from app.sensors.magnetometer_bar import MAX_CLEARANCE_M, MAX_SENSORS, MIN_CLEARANCE_M

Text = Annotated[str, Field(min_length=1, max_length=120)]
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
    """Tags to look for where none is registered near by."""

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
