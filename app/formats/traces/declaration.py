"""What an uploader declares about the files of a trace, the limits of reading them, and the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.sensors.magnetometer_bar import MAX_SENSORS, MagnetTrace

Floats = npt.NDArray[np.float64]


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


class FieldUnit(StrEnum):
    """Unit of magnetic flux density."""

    MICROTESLA = "uT"
    NANOTESLA = "nT"
    MILLITESLA = "mT"
    GAUSS = "gauss"
    MILLIGAUSS = "mG"


UT_PER_UNIT = {
    FieldUnit.MICROTESLA: 1.0,
    FieldUnit.NANOTESLA: 1e-3,
    FieldUnit.MILLITESLA: 1e3,
    FieldUnit.GAUSS: 100.0,
    FieldUnit.MILLIGAUSS: 0.1,
}


class AxisConvention(StrEnum):
    """Directions of x, y, z as recorded: ISO 8855 is forward, left, up (also called FLU); FRD forward, right, down."""

    ISO8855 = "ISO8855"
    FLU = "FLU"
    FRD = "FRD"


class SpeedUnit(StrEnum):
    """Unit of speed."""

    M_S = "m/s"
    KM_H = "km/h"
    MPH = "mph"
    KNOT = "kn"


M_S_PER_UNIT = {SpeedUnit.M_S: 1.0, SpeedUnit.KM_H: 1 / 3.6, SpeedUnit.MPH: 0.44704, SpeedUnit.KNOT: 1852 / 3600}


class AngleUnit(StrEnum):
    """Unit of the heading."""

    DEGREE = "deg"
    RADIAN = "rad"


class TimeUnit(StrEnum):
    """Unit of a column of times; `ISO` is text in RFC 3339 or without a zone."""

    SECOND = "s"
    MILLISECOND = "ms"
    MICROSECOND = "us"
    NANOSECOND = "ns"
    ISO = "iso"


S_PER_UNIT = {TimeUnit.SECOND: 1.0, TimeUnit.MILLISECOND: 1e-3, TimeUnit.MICROSECOND: 1e-6, TimeUnit.NANOSECOND: 1e-9}


class ByteOrder(StrEnum):
    """Of a CAN signal: Intel or Motorola."""

    LITTLE = "little"
    BIG = "big"


@dataclass(frozen=True, slots=True)
class TraceColumns:
    """Names and units of the columns of plain CSV and Parquet files."""

    time: str = "t_s"  # column of times
    time_unit: TimeUnit = TimeUnit.SECOND
    # columns x, y, z of each sensor; empty means `s1_x, s1_y, s1_z, s2_x, ...`, as many as there are sensors
    field: tuple[tuple[str, str, str], ...] = ()
    # `speed`, `heading`: columns of speed over ground and of heading clockwise from true north, in any of the files
    speed: str | None = "speed_m_s"
    speed_unit: SpeedUnit = SpeedUnit.M_S
    heading: str | None = "heading_deg"
    heading_unit: AngleUnit = AngleUnit.DEGREE
    # `delimiter`, `decimal`: of CSV files
    delimiter: str = ","
    decimal: str = "."

    def __post_init__(self) -> None:
        if self.delimiter not in (",", ";", "\t") or self.decimal not in (".", ",") or self.delimiter == self.decimal:
            raise InvalidParameter(
                f"delimiter {self.delimiter!r} with decimal {self.decimal!r}",
                field="columns.delimiter",
                limit="',', ';' or tab, and '.' or ',' that differ",
            )

    def field_names(self, sensors: int) -> tuple[tuple[str, str, str], ...]:
        """Columns of each sensor."""
        return self.field or tuple((f"s{i}_x", f"s{i}_y", f"s{i}_z") for i in range(1, sensors + 1))


@dataclass(frozen=True, slots=True)
class CanSignal:
    """Where a value is in the frames of a CAN log: by its name in a DBC, or by its bits."""

    name: str | None = None  # of the signal in the DBC, `Message.Signal` where the name alone is not unique
    arbitration_id: int | None = None  # Identifier of the frames
    # `start_bit`, `length`: [bit] as a DBC counts them: bit 0 is the lowest of byte 0; a big-endian signal starts at
    # its highest bit
    start_bit: int = 0
    length: int = 16
    byte_order: ByteOrder = ByteOrder.LITTLE
    signed: bool = False
    # `factor`, `offset`: value = raw x factor + offset
    factor: float = 1.0
    offset: float = 0.0
    unit: str | None = None  # of the value: a `SpeedUnit` or `AngleUnit`; None takes the DBC's
    # `minimum`, `maximum`: values outside mean that there is no value; they are left out
    minimum: float | None = None
    maximum: float | None = None

    def __post_init__(self) -> None:
        if (self.name is None) == (self.arbitration_id is None):
            raise InvalidParameter(
                "a CAN signal has a name in a DBC, or an identifier and bits", field="can.signal", limit="one of both"
            )
        if not (1 <= self.length <= 64 and 0 <= self.start_bit < 512):
            raise InvalidParameter(
                f"start bit {self.start_bit}, {self.length} bits",
                field="can.signal.length",
                limit="1 to 64 bits from bit 0 to 511",
            )
        if not np.isfinite((self.factor, self.offset)).all() or self.factor == 0:
            raise InvalidParameter(
                "factor and offset are finite, the factor not 0", field="can.signal.factor", limit="finite"
            )


@dataclass(frozen=True, slots=True)
class CanDeclaration:
    """How CAN logs become speed and heading."""

    speed: CanSignal | None = None
    heading: CanSignal | None = None
    # [s] trace time of the log's first frame. The log's own clock is never believed: only differences of its times are
    # used. None asks for alignment by the wheels' magnetic noise in the reference sensors.
    offset_s: float | None = None
    channel: int | str | None = None  # only frames of this channel

    def __post_init__(self) -> None:
        if self.offset_s is not None and not np.isfinite(self.offset_s):
            raise InvalidParameter("the offset is not finite", field="can.offset_s", limit="finite seconds")


@dataclass(frozen=True, slots=True, eq=False)
class TraceDeclaration:
    """What the uploader declares about the files."""

    sensors: int = 14  # number of magnetometers
    unit: FieldUnit | None = None  # None means microtesla in METRO's formats; CSV and Parquet need it
    axes: AxisConvention | None = None  # None means FRD in METRO's formats; CSV and Parquet need it, or rotations
    # shape (S, 3, 3), or None: rotations from the recorded axes of each sensor to ISO 8855, in place of `axes`
    vehicle_from_sensor: Floats | None = None
    # shape (S, 3), or None: [uT] calibration: subtracted from the recorded values, in their axes
    offsets_ut: Floats | None = None
    calibrated: bool = False  # the offsets are already subtracted: the field has the earth field's magnitude
    background_removed: bool = False  # the earth's field is subtracted too, so its magnitude cannot confirm the unit
    references: tuple[int, ...] = (6, 13)  # indices of the reference sensors near the wheels
    columns: TraceColumns = field(default_factory=TraceColumns)
    can: CanDeclaration | None = None
    formats: Mapping[str, TraceFormat] = field(default_factory=dict)  # of files whose content does not show it, by name
    # [s] added to the times of a file, by its name, to get the trace's
    clock_offsets_s: Mapping[str, float] = field(default_factory=dict)
    speed_m_s: float | None = None  # [m/s] constant speed, where no file has one
    rate_hz: float | None = None  # [Hz] expected sample rate: resolves the phase of a stream where it is ambiguous
    # [us] added to each interval of a stream: the firmware's intervals leave out the time of the serial write
    interval_extra_us: float = 0.0

    def __post_init__(self) -> None:
        if not 1 <= self.sensors <= MAX_SENSORS:
            raise InvalidParameter(f"{self.sensors} sensors", field="sensors", limit=f"1 to {MAX_SENSORS}")
        names = self.columns.field
        if names and len(names) != self.sensors:
            raise InvalidParameter(
                f"columns of {len(names)} sensors, but {self.sensors} sensors",
                field="columns.field",
                limit=f"{self.sensors} triples",
            )
        for name, shape in (("vehicle_from_sensor", (3, 3)), ("offsets_ut", (3,))):
            value = getattr(self, name)
            if value is None:
                continue
            array = np.asarray(value, float)
            if array.shape != (self.sensors, *shape) or not np.isfinite(array).all():
                raise InvalidParameter(
                    f"{name} has shape {array.shape}", field=name, limit=f"finite, shape {(self.sensors, *shape)}"
                )
            object.__setattr__(self, name, array)
        turns = self.vehicle_from_sensor
        if turns is not None and not (
            np.allclose(turns @ turns.transpose(0, 2, 1), np.eye(3), atol=1e-6)
            and np.allclose(np.linalg.det(turns), 1, atol=1e-6)
        ):
            raise InvalidParameter("not all are rotations", field="vehicle_from_sensor", limit="rotation matrices")
        if not all(np.isfinite(v) for v in self.clock_offsets_s.values()):
            raise InvalidParameter("clock offsets are finite", field="clock_offsets_s", limit="finite seconds")
        _check_range("speed_m_s", self.speed_m_s, 0.1, 100)
        _check_range("rate_hz", self.rate_hz, 50, 5000)
        _check_range("interval_extra_us", self.interval_extra_us, 0, 20_000)


@dataclass(frozen=True, slots=True)
class TraceLimits:
    """Limits of reading."""

    file_bytes: int = 3 * 1024**3 // 2  # [byte] largest file, expanded
    rows: int = 3_000_000  # largest number of samples
    duration_s: float = 7200.0  # [s] longest trace
    can_frames: int = 20_000_000  # largest number of frames of CAN logs
    min_rate_hz: float = 100.0  # [Hz] slowest trace
    left_out: float = 0.05  # largest share of rows that may be left out before the file is refused


def _check_range(name: str, value: float | None, low: float, high: float) -> None:
    if value is not None and not low <= value <= high:
        raise InvalidParameter(f"{name} is {value:g}", field=name, limit=f"{low:g} to {high:g}")


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
