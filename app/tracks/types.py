"""What a track is estimated from, and what is estimated."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

import numpy as np
from pydantic import Field

from app.errors import InvalidParameter
from app.inputs import Declaration, Number
from app.values import Bools, Floats

EAST, NORTH, HEADING, SPEED, YAW_RATE, SCALE, BIAS, WANDER, CLOCKS = range(9)
"""Places in the state (`app.tracks.kernel`); the offsets of the clocks follow from `CLOCKS` on."""


class LeftOutReason(StrEnum):
    """Why a marker is not used."""

    OUTLIER = "outlier"
    NO_TIME = "no-time"
    NO_GRADE = "no-position-grade"
    AMBIGUOUS = "ambiguous-match"
    NOT_REGISTERED = "not-registered"
    IMPLAUSIBLE = "implausible-match"
    SUSPECT = "status"
    NO_FIX = "no-fix"
    OFF_LANE = "off-lane"


class ClockState(StrEnum):
    """What is known of a sensor's clock."""

    REFERENCE = "reference"
    ESTIMATED = "estimated"
    NOT_OBSERVABLE = "not-observable"
    DECLARED = "declared"
    NO_CLOCK = "no-clock"


@dataclass(frozen=True, slots=True)
class Clock:
    """A sensor's clock, as it is declared."""

    name: str  # of the sensor; each once
    offset_s: float = 0.0  # [s] what is to be added to the sensor's times
    sigma_s: float = 0.5  # [s] how far that may be off; 0: it is exact

    def __post_init__(self) -> None:
        if not (
            math.isfinite(self.offset_s) and math.isfinite(self.sigma_s) and 0 <= self.sigma_s <= MAX_CLOCK_SIGMA_S
        ):
            raise InvalidParameter(
                f"the clock of {self.name} cannot be off by {self.sigma_s:g} s",
                field="clock.sigma_s",
                limit=f"0 to {MAX_CLOCK_SIGMA_S:g} s",
                cure="set the clocks by GNSS or NTP, or declare offset_s",
            )


@dataclass(frozen=True, slots=True)
class PositionFix:
    """Where the vehicle was, by one marker or by one position of its receiver."""

    clock: str  # name of the sensor whose time it has
    time_s: float  # [s] seconds since 1970-01-01 UTC on that clock
    # `lon_deg`, `lat_deg`: [deg] WGS 84 / ITRF
    lon_deg: float
    lat_deg: float
    covariance_m2: tuple[float, float, float]  # [m2] East-east, east-north, north-north
    # `heading_deg`, `heading_sigma_deg`: [deg] clockwise from true north; NaN where it is not known
    heading_deg: float = math.nan
    heading_sigma_deg: float = math.nan
    common_m2: float = 0.0  # [m2] part of the variance of each axis that all fixes by the same marker share: its survey
    marker_id: str | None = None  # None for a position of the vehicle's own receiver
    family: str = ""
    decode_id: str = ""
    place: int = 0  # index in the decode, e.g. of the frame
    heading_cross_m_rad: tuple[float, float] = (0.0, 0.0)  # [m rad] covariances of the heading with east and north

    def __post_init__(self) -> None:
        east, cross, north = self.covariance_m2
        finite = all(math.isfinite(value) for value in (self.time_s, self.lon_deg, self.lat_deg, east, cross, north))
        if not finite or abs(self.lat_deg) > MAX_LAT_DEG or abs(self.lon_deg) > 360 or east * north <= cross * cross:
            raise InvalidParameter(
                f"a fix of {self.decode_id or self.clock} has no place, no time or no covariance",
                field="fixes",
                limit=f"finite numbers, latitudes to {MAX_LAT_DEG:g} deg, a positive definite covariance",
            )
        if min(east, north) <= 0:
            raise InvalidParameter("a variance of a fix is not positive", field="fixes", limit="> 0")


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Speeds or headings over time."""

    clock: str  # name of the sensor whose times they have
    # `time_s`, `value`: shape (N,): [deg] seconds since 1970-01-01 UTC; speed along the vehicle, backwards negative
    # [m/s], or heading clockwise from true north
    time_s: Floats
    value: Floats
    sigma: float  # [m/s or deg] noise of one value, without scale error or bias

    def __post_init__(self) -> None:
        time, value = np.asarray(self.time_s, float), np.asarray(self.value, float)
        if time.ndim != 1 or time.shape != value.shape or not self.sigma > 0:
            raise InvalidParameter("samples have one value for each time, and noise", field="samples")
        kept = np.isfinite(time) & np.isfinite(value)
        order = np.argsort(time[kept], kind="stable")
        object.__setattr__(self, "time_s", time[kept][order])
        object.__setattr__(self, "value", value[kept][order])


@dataclass(frozen=True, slots=True, eq=False)
class LanePath:
    """A lane's path: where it leads is known, not when it was driven."""

    decode_id: str
    # `lon_deg`, `lat_deg`: shape (N,): [deg] in the direction of travel
    lon_deg: Floats
    lat_deg: Floats
    sigma_m: float  # [m] standard deviation of the path across


@dataclass(frozen=True, slots=True)
class TrackInput:
    """All that is known of a drive."""

    clocks: tuple[Clock, ...]
    fixes: tuple[PositionFix, ...] = ()
    speeds: tuple[Samples, ...] = ()
    headings: tuple[Samples, ...] = ()
    paths: tuple[LanePath, ...] = ()


class TrackRules(Declaration):
    """How a track is estimated."""

    rate_hz: Number = Field(2.0, ge=0.1, le=10, description="Of the positions. [Hz]")
    max_sigma_m: Number = Field(
        2.0, ge=0.05, le=100, description="Where a standard deviation is larger, the track has a gap. [m]"
    )
    outlier_probability: Number = Field(
        1e-3, ge=1e-9, le=0.1, description="Share of good markers that the gate may leave out."
    )
    speed_scale_sigma: Number = Field(
        0.03, ge=1e-4, le=0.2, description="Scale error of the vehicle's speed to be expected."
    )
    heading_bias_sigma_deg: Number = Field(
        3.0, ge=0.01, le=30, description="Bias of the vehicle's heading to be expected. [deg]"
    )
    wander_m: Number = Field(
        0.4, ge=0.05, le=5, description="How far from the middle of its lane the vehicle drives. [m]"
    )
    wander_length_m: Number = Field(100.0, ge=1, le=10_000, description="Length over which that changes. [m]")


MAX_CLOCK_SIGMA_S = 10.0
"""Largest error of a clock that an offset is estimated for. [s] The filter is linear in the offset, and 10 s are 140 m
at 50 km/h, about the distance between two markers."""
MAX_LAT_DEG = 89.9
"""Northernmost latitude. [deg] 11 km from the pole a heading changes by 0.1 deg in 20 m."""


@dataclass(frozen=True, slots=True)
class FixResult:
    """What became of a fix."""

    fix: PositionFix
    used: bool
    reason: LeftOutReason | None
    time_s: float  # [s] on the reference clock
    distance: float  # Mahalanobis distance to the track that the other fixes give; NaN where there is none
    # `along_m`, `across_m`: [m] from that track, forward and left positive
    along_m: float
    across_m: float


@dataclass(frozen=True, slots=True)
class DriveMarker:
    """A marker of a drive: used, or left out and why."""

    marker_id: str | None
    family: str
    decode_id: str
    place: Annotated[int, Field(description="Frame of an archive, tag of a trace, marker of a packet log.")]
    used: bool
    reason: LeftOutReason | None
    detail: str | None
    number: Annotated[int | None, Field(description="Of a CERPM.")] = None
    time: str | None = None
    lon_deg: float | None = None
    lat_deg: float | None = None
    distance: Annotated[float | None, Field(description="Mahalanobis distance to the track by all others.")] = None
    along_m: Annotated[float | None, Field(description="From that track, forward positive.")] = None
    across_m: Annotated[float | None, Field(description="From that track, left positive.")] = None


@dataclass(frozen=True, slots=True)
class ReceiverResult:
    """Positions of the vehicle's own receiver, of one decode."""

    decode_id: str
    clock: str
    used: int
    left_out: Annotated[int, Field(description="Too far from the track by all others.")]
    stated_m: Annotated[float, Field(description="Median of the standard deviations that the receiver states.")]
    assumed_m: Annotated[float, Field(description="The same, enlarged to what the markers show of it.")]


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """The offset of a sensor's clock, from one time on."""

    clock: str
    state: ClockState
    # `offset_s`, `sigma_s`: [s] to be added to the sensor's times
    offset_s: float
    sigma_s: float
    # `from_s`, `to_s`: [s] first and last time on the sensor's clock that it holds for
    from_s: float
    to_s: float
    jumped: bool = False  # the clock was set before `from_s`


@dataclass(frozen=True, slots=True)
class TrackGap:
    """A stretch whose positions are worse than the limit, or that has no data."""

    from_s: float
    to_s: float
    length_m: float
    max_sigma_m: float
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A drive as positions on one time base."""

    time_s: Floats  # shape (N,): [s] seconds since 1970-01-01 UTC on the reference clock
    # `lon_deg`, `lat_deg`, `heading_deg`, `speed_m_s`: shape (N,)
    lon_deg: Floats
    lat_deg: Floats
    heading_deg: Floats
    speed_m_s: Floats
    covariance_m2: Floats  # shape (N, 3): [m2] East-east, east-north, north-north
    heading_sigma_deg: Floats  # shape (N,)
    in_gap: Bools  # shape (N,)
    fixes: tuple[FixResult, ...]  # by markers
    clocks: tuple[ClockOffset, ...]
    gaps: tuple[TrackGap, ...]
    length_m: float
    speed_scale: tuple[float, float]
    heading_bias_deg: tuple[float, float]
    path_points: int = 0
    receivers: tuple[ReceiverResult, ...] = ()
    warnings: tuple[str, ...] = field(default=())

    @property
    def sigma_m(self) -> Floats:
        """The larger standard deviation of each position, shape (N,). [m]"""
        east, cross, north = self.covariance_m2.T
        larger = (east + north) / 2 + np.sqrt(((east - north) / 2) ** 2 + cross**2)
        return np.asarray(np.sqrt(np.maximum(larger, 0.0)))
