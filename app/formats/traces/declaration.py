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
    """Names and units of the columns of plain CSV and Parquet files.

    Attributes
    ----------
    time : str
        Column of times.
    time_unit : TimeUnit
    field : tuple of (str, str, str)
        Columns x, y, z of each sensor; empty means `s1_x, s1_y, s1_z, s2_x, ...`, as many as there are sensors.
    speed, heading : str or None
        Columns of speed over ground and of heading clockwise from true north, in any of the files.
    speed_unit, heading_unit
    delimiter, decimal : str
        Of CSV files.
    """

    time: str = "t_s"
    time_unit: TimeUnit = TimeUnit.SECOND
    field: tuple[tuple[str, str, str], ...] = ()
    speed: str | None = "speed_m_s"
    speed_unit: SpeedUnit = SpeedUnit.M_S
    heading: str | None = "heading_deg"
    heading_unit: AngleUnit = AngleUnit.DEGREE
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
    """Where a value is in the frames of a CAN log: by its name in a DBC, or by its bits.

    Attributes
    ----------
    name : str or None
        Of the signal in the DBC, `Message.Signal` where the name alone is not unique.
    arbitration_id : int or None
        Identifier of the frames.
    start_bit, length : int
        As a DBC counts them: bit 0 is the lowest of byte 0; a big-endian signal starts at its highest bit. [bit]
    byte_order, signed
    factor, offset : float
        Value = raw x factor + offset.
    unit : str or None
        Of the value: a `SpeedUnit` or `AngleUnit`; None takes the DBC's.
    minimum, maximum : float or None
        Values outside mean that there is no value; they are left out.
    """

    name: str | None = None
    arbitration_id: int | None = None
    start_bit: int = 0
    length: int = 16
    byte_order: ByteOrder = ByteOrder.LITTLE
    signed: bool = False
    factor: float = 1.0
    offset: float = 0.0
    unit: str | None = None
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
    """How CAN logs become speed and heading.

    Attributes
    ----------
    speed, heading : CanSignal or None
    offset_s : float or None
        Trace time of the log's first frame. The log's own clock is never believed: only differences of its times are
        used. None asks for alignment by the wheels' magnetic noise in the reference sensors. [s]
    channel : int, str or None
        Only frames of this channel.
    """

    speed: CanSignal | None = None
    heading: CanSignal | None = None
    offset_s: float | None = None
    channel: int | str | None = None

    def __post_init__(self) -> None:
        if self.offset_s is not None and not np.isfinite(self.offset_s):
            raise InvalidParameter("the offset is not finite", field="can.offset_s", limit="finite seconds")


@dataclass(frozen=True, slots=True, eq=False)
class TraceDeclaration:
    """What the uploader declares about the files.

    Attributes
    ----------
    sensors : int
        Number of magnetometers.
    unit : FieldUnit or None
        None means microtesla in METRO's formats; CSV and Parquet need it.
    axes : AxisConvention or None
        None means FRD in METRO's formats; CSV and Parquet need it, or rotations.
    vehicle_from_sensor : ndarray, shape (S, 3, 3), or None
        Rotations from the recorded axes of each sensor to ISO 8855, in place of `axes`.
    offsets_ut : ndarray, shape (S, 3), or None
        Calibration: subtracted from the recorded values, in their axes. [uT]
    calibrated : bool
        The offsets are already subtracted: the field has the earth field's magnitude.
    background_removed : bool
        The earth's field is subtracted too, so its magnitude cannot confirm the unit.
    references : tuple of int
        Indices of the reference sensors near the wheels.
    columns : TraceColumns
    can : CanDeclaration or None
    formats : mapping of str to TraceFormat
        Of files whose content does not show it, by name.
    clock_offsets_s : mapping of str to float
        Added to the times of a file, by its name, to get the trace's. [s]
    speed_m_s : float or None
        Constant speed, where no file has one. [m/s]
    rate_hz : float or None
        Expected sample rate: resolves the phase of a stream where it is ambiguous. [Hz]
    interval_extra_us : float
        Added to each interval of a stream: the firmware's intervals leave out the time of the serial write. [us]
    """

    sensors: int = 14
    unit: FieldUnit | None = None
    axes: AxisConvention | None = None
    vehicle_from_sensor: Floats | None = None
    offsets_ut: Floats | None = None
    calibrated: bool = False
    background_removed: bool = False
    references: tuple[int, ...] = (6, 13)
    columns: TraceColumns = field(default_factory=TraceColumns)
    can: CanDeclaration | None = None
    formats: Mapping[str, TraceFormat] = field(default_factory=dict)
    clock_offsets_s: Mapping[str, float] = field(default_factory=dict)
    speed_m_s: float | None = None
    rate_hz: float | None = None
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
    """Limits of reading.

    Attributes
    ----------
    file_bytes : int
        Largest file, expanded. [byte]
    rows : int
        Largest number of samples.
    duration_s : float
        Longest trace. [s]
    can_frames : int
        Largest number of frames of CAN logs.
    min_rate_hz : float
        Slowest trace. [Hz]
    left_out : float
        Largest share of rows that may be left out before the file is refused.
    """

    file_bytes: int = 3 * 1024**3 // 2
    rows: int = 3_000_000
    duration_s: float = 7200.0
    can_frames: int = 20_000_000
    min_rate_hz: float = 100.0
    left_out: float = 0.05


def _check_range(name: str, value: float | None, low: float, high: float) -> None:
    if value is not None and not low <= value <= high:
        raise InvalidParameter(f"{name} is {value:g}", field=name, limit=f"{low:g} to {high:g}")


# === Report about reading a trace: what was read, replaced and left out.


MAX_LISTED = 200
"""Gaps and notes beyond this are only counted. Bounds the answer."""


@dataclass(frozen=True, slots=True)
class TraceGap:
    """A stretch without usable samples.

    Attributes
    ----------
    part : str
        File.
    sample : int
        Index in the trace of the first sample after it.
    t_s : float
        Time of the sample before it. [s]
    lost_s : float
        Time lost; for a stream a lower bound, as bytes that were cut out cannot be counted. [s]
    skipped_bytes : int
        Bytes of the file that belong to no sample. [byte]
    """

    part: str
    sample: int
    t_s: float
    lost_s: float
    skipped_bytes: int = 0


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Values or rows of a file that are not in the trace.

    Attributes
    ----------
    part : str
        File.
    what : str
        Kind of loss, e.g. `rows-malformed`.
    count : int
    reason : str
        For people, with the first place.
    """

    part: str
    what: str
    count: int
    reason: str


@dataclass(slots=True)
class TraceReport:
    """About reading a trace.

    Attributes
    ----------
    formats : dict of str to TraceFormat
        Detected or declared format of each file.
    samples : int
    rate_hz : float
        Median. [Hz]
    duration_s : float
        From the first sample to the last. [s]
    gaps : list of TraceGap
        The first ones.
    gap_count : int
    left_out : list of LeftOut
    clock_offsets_s : dict of str to float
        Added to the times of a file to get the trace's. [s]
    speed_coverage, heading_coverage : float
        Share of the trace with a value within a second, 0 to 1.
    warnings : list of str
    """

    formats: dict[str, TraceFormat] = field(default_factory=dict)
    samples: int = 0
    rate_hz: float = 0.0
    duration_s: float = 0.0
    gaps: list[TraceGap] = field(default_factory=list)
    gap_count: int = 0
    left_out: list[LeftOut] = field(default_factory=list)
    clock_offsets_s: dict[str, float] = field(default_factory=dict)
    speed_coverage: float = 0.0
    heading_coverage: float = 0.0
    warnings: list[str] = field(default_factory=list)

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
                self.left_out[i] = LeftOut(part, what, known.count + count, known.reason)
                return
        self.left_out.append(LeftOut(part, what, count, reason))

    def warn(self, text: str) -> None:
        """Add a warning for the uploader."""
        if text not in self.warnings and len(self.warnings) < MAX_LISTED:
            self.warnings.append(text)


@dataclass(frozen=True, slots=True, eq=False)
class TraceFile:
    """A trace and the report about reading it."""

    trace: MagnetTrace
    report: TraceReport
