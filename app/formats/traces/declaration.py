"""What an uploader declares about the files of a trace, the limits of reading them, and the report."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import Literal

from pydantic import Field, model_validator

from app.errors import InvalidParameter
from app.inputs import Declaration, Flag, Name, Number, Whole
from app.sensors.magnetometer_bar import MAX_SENSORS, BarDeclaration, MagnetometerBar, MagnetTrace


class TraceFormat(StrEnum):
    """Formats of the files of a recording."""

    STREAM = "metro-stream"
    RECORDER_FIELD = "recorder-raw-data"
    RECORDER_SPEED = "recorder-speed"
    RECORDER_STEERING = "recorder-steering-wheel-angle"
    CSV = "csv"
    PARQUET = "parquet"
    CAN = "can-log"
    DBC = "dbc"
    BAG = "bag"


FieldUnit = Literal["uT", "nT", "mT", "gauss", "mG"]
"""Unit of magnetic flux density."""
UT_PER_UNIT: dict[FieldUnit, float] = {"uT": 1.0, "nT": 1e-3, "mT": 1e3, "gauss": 100.0, "mG": 0.1}
AxisConvention = Literal["ISO8855", "FLU", "FRD"]
"""Directions of x, y, z as recorded: ISO 8855 is forward, left, up (also called FLU); FRD forward, right, down."""
SpeedUnit = Literal["m/s", "km/h", "mph", "kn"]
M_S_PER_UNIT: dict[SpeedUnit, float] = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704, "kn": 1852 / 3600}
AngleUnit = Literal["deg", "rad"]
TimeUnit = Literal["s", "ms", "us", "ns", "iso"]
"""Unit of a column of times; `iso` is text in RFC 3339 or without a zone."""
S_PER_UNIT: dict[TimeUnit, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
ByteOrder = Literal["little", "big"]
"""Of a CAN signal: Intel or Motorola."""


class TraceColumns(Declaration):
    """Columns of plain CSV and Parquet files."""

    time: Name = "t_s"
    time_unit: TimeUnit = "s"
    field: tuple[tuple[Name, Name, Name], ...] = Field(
        (), max_length=MAX_SENSORS, description="x, y, z of each sensor; s1_x, s1_y ... if left out."
    )
    speed: Name | None = Field("speed_m_s", description="Speed over ground, in any of the files.")
    speed_unit: SpeedUnit = "m/s"
    heading: Name | None = Field("heading_deg", description="Clockwise from true north, in any of the files.")
    heading_unit: AngleUnit = "deg"
    delimiter: Literal[",", ";", "\t"] = ","
    decimal: Literal[".", ","] = "."

    def field_names(self, sensors: int) -> tuple[tuple[str, str, str], ...]:
        """Columns of each sensor."""
        return self.field or tuple((f"s{i}_x", f"s{i}_y", f"s{i}_z") for i in range(1, sensors + 1))


MAX_STANDARD = 0x7FF
"""Largest CAN identifier of 11 bits (ISO 11898-1)."""


class CanSignal(Declaration):
    """A signal by its name in a DBC, or by identifier, bits and scaling."""

    name: Name | None = Field(None, description="`Message.Signal` where the name alone is not unique.")
    arbitration_id: Whole | None = Field(
        None,
        ge=0,
        le=0x1FFFFFFF,
        description="Beside a name: used instead of that of the DBC, to choose one of several senders of J1939.",
    )
    extended: Flag | None = Field(
        None,
        description="Whether the identifier has 29 bits, not 11. If left out, it is as in the DBC; without a DBC it "
        "has 29 bits if it is above 0x7FF, or if the log has it only so.",
    )
    start_bit: Whole = Field(
        0,
        ge=0,
        le=511,
        description="As a DBC counts: 0 is the lowest of byte 0; a big-endian signal starts at its highest bit.",
    )
    length: Whole = Field(16, ge=1, le=64, description="[bit]")
    byte_order: ByteOrder = "little"
    signed: Flag = False
    factor: Number = Field(1.0, description="Value = raw x factor + offset; not 0.")
    offset: Number = 0.0
    unit: Name | None = Field(None, description="Of the speed or heading; that of the DBC if left out.")
    minimum: Number | None = Field(None, description="Smaller values mean that there is none.")
    maximum: Number | None = Field(None, description="Larger values mean that there is none.")
    channel: Name | Whole | None = Field(None, description="Of this signal, where it is another than `can.channel`.")

    @model_validator(mode="after")
    def _is_placed(self) -> CanSignal:
        if self.name is None and self.arbitration_id is None:
            raise InvalidParameter(
                "a CAN signal has a name in a DBC, or an identifier and bits", limit="a name, an identifier, or both"
            )
        if self.extended is False and (self.arbitration_id or 0) > MAX_STANDARD:
            raise InvalidParameter("an identifier above 0x7FF has 29 bits", field="extended", limit="true or left out")
        if self.factor == 0:
            raise InvalidParameter("the factor of a CAN signal is 0", field="factor", limit="not 0")
        return self


class CanDeclaration(Declaration):
    """Speed and heading in CAN logs."""

    speed: CanSignal | None = None
    heading: CanSignal | None = None
    # The log's own clock is never believed: only differences of its times are used.
    offset_s: Number | None = Field(
        None, description="Trace time of the log's first frame; left out, it is found from the wheels' noise. [s]"
    )
    channel: Name | Whole | None = Field(
        None, description="Only frames of this channel, as the file writes it: 1, can0, vcan1."
    )


class TraceDeclaration(Declaration):
    """What is declared of the files of a recording. METRO's stream and recorder files need nothing."""

    bar: BarDeclaration | None = None
    unit: FieldUnit | None = Field(None, description="Of CSV and Parquet, and of bags whose fields are not in tesla.")
    axes: AxisConvention | None = Field(None, description="Of CSV, Parquet and bags.")
    calibrated: Flag = Field(False, description="Offsets are taken off: the earth's field remains.")
    background_removed: Flag = Field(False, description="The earth's field is taken off too.")
    columns: TraceColumns | None = None
    can: CanDeclaration | None = None
    formats: dict[Name, Literal["metro-stream", "csv", "parquet", "can-log", "dbc"]] | None = Field(
        None, max_length=32, description="Of files whose content does not show it, by name."
    )
    clock_offsets_s: dict[Name, Number] | None = Field(
        None, max_length=32, description="Added to the times of a file, by its name. [s]"
    )
    speed_m_s: Number | None = Field(None, ge=0.1, le=100, description="Constant speed where no file has one. [m/s]")
    rate_hz: Number | None = Field(None, ge=50, le=5000, description="Expected rate: finds the phase of a stream. [Hz]")
    interval_extra_us: Number | None = Field(
        None, ge=0, le=20_000, description="Time of the serial write, which a stream's intervals leave out. [us]"
    )

    def check(self) -> None:
        """Refuse members that contradict each other, after a vehicle's profile completed them.

        Raises
        ------
        InvalidParameter
            The field is a path within the declaration.
        """
        columns, sensors = self.table, self.sensors.sensor_count
        if columns.delimiter == columns.decimal:
            raise InvalidParameter(
                f"delimiter {columns.delimiter!r} with decimal {columns.decimal!r}",
                field="columns.delimiter",
                limit="',', ';' or tab, and '.' or ',' that differ",
            )
        if columns.field and len(columns.field) != sensors:
            raise InvalidParameter(
                f"columns of {len(columns.field)} sensors, but {sensors} sensors",
                field="columns.field",
                limit=f"{sensors} triples",
            )

    @cached_property
    def sensors(self) -> MagnetometerBar:
        """The bar that recorded."""
        return (self.bar or BarDeclaration()).magnetometers

    @cached_property
    def table(self) -> TraceColumns:
        """Columns of plain files."""
        return self.columns or TraceColumns()


@dataclass(frozen=True, slots=True)
class TraceLimits:
    """Limits of reading."""

    file_bytes: int = 3 * 1024**3 // 2  # [byte] largest file, expanded
    rows: int = 3_000_000  # largest number of samples
    duration_s: float = 7200.0  # [s] longest trace
    can_frames: int = 20_000_000  # largest number of frames of CAN logs
    min_rate_hz: float = 100.0  # [Hz] slowest trace
    left_out: float = 0.05  # largest share of rows that may be left out before the file is refused


# === Report about reading a trace: what was read, replaced and left out.


MAX_LISTED = 200
"""Gaps and notes beyond this are only counted. Bounds the answer."""


@dataclass(frozen=True, slots=True)
class TraceGap:
    """A stretch without usable samples: `lost_s` after `t_s`, before the sample with this index."""

    part: str  # file that it comes from
    sample: int  # index in the trace of the first sample after it
    t_s: float  # [s] time of the sample before it
    lost_s: float  # [s] time lost; for a stream a lower bound, as bytes that were cut out cannot be counted
    skipped_bytes: int = 0  # [byte] bytes of the file that belong to no sample


@dataclass(frozen=True, slots=True)
class LeftOutRows:
    """Values or rows of a file that are not in the trace."""

    part: str  # file that it comes from
    what: str  # kind of loss, e.g. `rows-malformed`.
    count: int
    reason: str  # for people, with the first place


@dataclass(slots=True)
class TraceReport:
    """About reading the files of a recording."""

    formats: dict[str, TraceFormat] = field(default_factory=dict)  # detected or declared format of each file
    samples: int = 0
    rate_hz: float = 0.0  # [Hz] median
    duration_s: float = 0.0  # [s] from the first sample to the last
    driven_m: float = 0.0  # [m] by the vehicle's speed
    gaps: list[TraceGap] = field(default_factory=list)  # the first ones
    gap_count: int = 0
    left_out: list[LeftOutRows] = field(default_factory=list)
    # [s] added to the times of a file to get the trace's
    clock_offsets_s: dict[str, float] = field(default_factory=dict)
    # `speed_coverage`, `heading_coverage`: share of the trace with a value within a second, 0 to 1
    speed_coverage: float = 0.0
    heading_coverage: float = 0.0
    warnings: list[str] = field(default_factory=list)
    # `load_ms`, `decode_ms`: [ms] spent on reading the files, and on the magnets
    load_ms: float = 0.0
    decode_ms: float = 0.0

    def add_gap(self, gap: TraceGap) -> None:
        """Count a gap, and list it if there is room."""
        self.gap_count += 1
        if len(self.gaps) < MAX_LISTED:
            self.gaps.append(gap)

    def leave_out(self, part: str, what: str, count: int, reason: str) -> None:
        """Note a loss; the same kind in the same file adds up under its first reason."""
        if not count:
            return
        for i, known in enumerate(self.left_out):
            if (known.part, known.what) == (part, what):
                self.left_out[i] = LeftOutRows(part, what, known.count + count, known.reason)
                return
        self.left_out.append(LeftOutRows(part, what, count, reason))

    def warn(self, text: str) -> None:
        """Add a warning for the uploader."""
        if text not in self.warnings and len(self.warnings) < MAX_LISTED:
            self.warnings.append(text)


@dataclass(frozen=True, slots=True, eq=False)
class TraceFile:
    """A trace and the report about reading it."""

    trace: MagnetTrace
    report: TraceReport
