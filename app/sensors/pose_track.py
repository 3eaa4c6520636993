"""Positions of a vehicle over time."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.geodesy.frames import metres_per_radian
from app.markers.cerpm import LaneSide, SpeedLimit
from app.values import Floats

MIN_STEP_M = 5.0  # [m] shorter steps are the receiver's noise; docs/fleet.md
MAX_STEP_M = 50.0  # [m] of inaccurate receivers
STEP_SIGMAS = 8.0  # accuracies in a step that counts as driven; two positions at 5.7 sigma
DEFAULT_STEP_M = 10.0  # [m] without a reported accuracy; 8 x 1.25 m
UNKNOWN_ACCURACY_M = 3.0  # [m] assumed where a receiver reports none; a receiver without corrections
# How vehicles and their receivers differ from a lane's middle; source: the upper bounds of `benchmarks.hunt.cerpm`.
DRIVER_OFFSET_SD_M = 0.25  # [m] of a driver's usual offset
WANDER_SD_M, WANDER_LENGTH_M = 0.25, 30.0  # [m, m] of a driver along the lane
RECEIVER_OPTIMISM = 1.5  # true error of a receiver over the accuracy that it reports
SLOW_SHARE = 0.3  # of a receiver's error that changes along the track like wander
MAX_SPEED_M_S = 70.0  # [m/s] a faster step is a gap in the track; 252 km/h
FASTEST_M_S = 150.0
"""A point that can only be reached faster than this, from both sides, is an outlier. [m/s] 540 km/h."""
_LEAST_STEPS = 5  # by which headings are compared with the direction of travel
_SLACK_M = 30.0  # [m] jump of a receiver that is no outlier
_M_PER_DEG = 111_195.0  # [m/deg] on a sphere of 6371 km, the Earth's mean radius


@dataclass(frozen=True, slots=True)
class PosePoint:
    """One position of a vehicle, as a file has it."""

    entry: int  # row, line or point of the file, from 0
    time_s: float  # [s] seconds since 1970-01-01 UTC; NaN where it is not known
    # `lon_deg`, `lat_deg`, `heading_deg`, `accuracy_m`: as in `PoseTrack`
    lon_deg: float
    lat_deg: float
    heading_deg: float = math.nan
    accuracy_m: float = math.nan


@dataclass(frozen=True, slots=True, eq=False)
class PoseTrack:
    """A vehicle's own positions over time.

    Raises
    ------
    InvalidParameter
        Lengths differ, times do not rise, or a position is not finite.
    """

    time_s: Floats  # shape (T,): [s] seconds since 1970-01-01 UTC, rising
    # `lon_deg`, `lat_deg`: shape (T,): [deg] WGS 84 / ITRF
    lon_deg: Floats
    lat_deg: Floats
    heading_deg: Floats  # shape (T,): [deg] clockwise from true north; NaN where it is not known
    accuracy_m: Floats  # shape (T,): [m] horizontal standard deviation of a position; NaN where it is not known

    def __post_init__(self) -> None:
        arrays = {name: np.asarray(getattr(self, name), float) for name in self.__slots__}
        lengths = {len(values) for values in arrays.values()}
        if len(lengths) != 1 or any(values.ndim != 1 for values in arrays.values()):
            raise InvalidParameter("a pose track has one value of each kind per time", field="poses")
        for name in ("time_s", "lon_deg", "lat_deg"):
            if not np.isfinite(arrays[name]).all():
                raise InvalidParameter(f"{name} of a pose is not finite", field=f"poses.{name}", limit="finite numbers")
        if (np.diff(arrays["time_s"]) <= 0).any():
            raise InvalidParameter("times of poses do not rise", field="poses.time_s", limit="rising times")
        for name, values in arrays.items():
            object.__setattr__(self, name, values)

    @property
    def usual_accuracy_m(self) -> float:
        """Median of the accuracies that its receiver states; that of one without corrections if it states none. [m]"""
        stated = self.accuracy_m[np.isfinite(self.accuracy_m)]
        return max(float(np.median(stated)), 0.0) if len(stated) else UNKNOWN_ACCURACY_M

    def moved(self, forward_m: float, left_m: float) -> PoseTrack:
        """The track of another point of the vehicle.

        Parameters
        ----------
        forward_m, left_m : float
            From the point of this track to the other, in the vehicle (ISO 8855). [m]

        Returns
        -------
        PoseTrack
            This track if no heading is known; between known headings the heading is interpolated.
        """
        known = np.isfinite(self.heading_deg)
        if not known.any():
            return self
        turned = np.unwrap(self.heading_deg[known], period=360.0)
        heading = np.radians(np.interp(self.time_s, self.time_s[known], turned))
        east_m = forward_m * np.sin(heading) - left_m * np.cos(heading)
        north_m = forward_m * np.cos(heading) + left_m * np.sin(heading)
        lat_rad = np.radians(self.lat_deg)
        east_per_rad, north_per_rad = metres_per_radian(lat_rad)
        lon_deg = self.lon_deg + np.degrees(east_m / east_per_rad)
        return replace(
            self,
            lon_deg=(lon_deg + 180.0) % 360.0 - 180.0,
            lat_deg=self.lat_deg + np.degrees(north_m / north_per_rad),
        )

    def heading_misfit_deg(self) -> float:
        """Median angle between the headings and the direction of travel; NaN where neither can be compared. [deg]"""
        east_per_rad, north_per_rad = metres_per_radian(np.radians(self.lat_deg[:-1]))
        east_m = np.radians((np.diff(self.lon_deg) + 180.0) % 360.0 - 180.0) * east_per_rad
        north_m = np.radians(np.diff(self.lat_deg)) * north_per_rad
        apart = (self.heading_deg[:-1] - np.degrees(np.arctan2(east_m, north_m)) + 180.0) % 360.0 - 180.0
        known = np.isfinite(apart) & (np.hypot(east_m, north_m) >= MIN_STEP_M)
        return float(np.median(np.abs(apart[known]))) if known.sum() >= _LEAST_STEPS else math.nan

    def driven_m(self) -> float:
        """Distance that the vehicle drove.

        Returns
        -------
        float
            Sum of the straight lines between places that are at least 5 m and eight times the accuracy of the position
            apart (10 m where it is not known, 50 m at most): the position of a parked receiver wanders.
            A line that would take more than 70 m/s is a gap in the track and is not counted. [m]
        """
        if len(self.time_s) < 2:
            return 0.0
        lon, lat = np.radians(np.unwrap(self.lon_deg, period=360.0)), np.radians(self.lat_deg)
        east_per_rad, north_per_rad = metres_per_radian(lat)
        accuracy_m = np.nan_to_num(self.accuracy_m, nan=DEFAULT_STEP_M / STEP_SIGMAS)
        step_m = np.clip(STEP_SIGMAS * accuracy_m, MIN_STEP_M, MAX_STEP_M)
        total_m, at = 0.0, 0
        for k in range(1, len(lon)):
            leg_m = math.hypot((lon[k] - lon[at]) * east_per_rad[at], (lat[k] - lat[at]) * north_per_rad[at])
            if leg_m < step_m[k]:
                continue
            if leg_m <= MAX_SPEED_M_S * (self.time_s[k] - self.time_s[at]):
                total_m += leg_m
            at = k
        return total_m


def find_jumps(table: Floats) -> npt.NDArray[np.bool_]:
    """Which rows (time [s], longitude, latitude [deg], ...) can only be reached too fast, from both sides."""
    if len(table) < 3:
        return np.zeros(len(table), bool)
    east = (np.diff(table[:, 1]) + 180) % 360 - 180
    step_m = _M_PER_DEG * np.hypot(east * np.cos(np.radians(table[:-1, 2])), np.diff(table[:, 2]))
    fast = step_m > FASTEST_M_S * np.diff(table[:, 0]) + _SLACK_M
    across = _M_PER_DEG * np.hypot(
        ((table[2:, 1] - table[:-2, 1] + 180) % 360 - 180) * np.cos(np.radians(table[:-2, 2])),
        table[2:, 2] - table[:-2, 2],
    )
    direct = across <= FASTEST_M_S * (table[2:, 0] - table[:-2, 0]) + _SLACK_M
    return np.concatenate(([False], fast[:-1] & fast[1:] & direct, [False]))


# === Packets as a receiver in a vehicle received them.


@dataclass(frozen=True, slots=True)
class PlainClaim:
    """Contents of a packet in clear, as in the CERPM paper, without a tag: anyone could have sent it."""

    number: int
    lon_deg: float
    lat_deg: float
    height_m: float | None = None
    side: LaneSide = LaneSide.UNKNOWN
    speed_limit: SpeedLimit | None = None


@dataclass(frozen=True, slots=True)
class ReceivedPacket:
    """One packet as logged by a receiver or a network server."""

    entry: int  # which row, line or event of the log it came from, from 0
    received_at_s: float  # [s] time of reception, seconds since 1970-01-01 UTC; NaN if the log has none
    payload: bytes | None = None  # the message as it was sent, with its tag; None for a packet in clear
    claim: PlainClaim | None = None  # contents of a packet in clear; None where there is a payload
    # `rssi_dbm`, `snr_db`: NaN if the log has none
    rssi_dbm: float = float("nan")
    snr_db: float = float("nan")
    device: str | None = None  # LoRaWAN DevEUI or another name of the sender in the log
    # Identifier of the uplink on its network server; packets with the same one are one uplink received twice
    event: str | None = None
