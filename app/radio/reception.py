"""Reception at each point of a road, and the probability that a marker is read in time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.radio.airtime import check_between, check_whole
from app.radio.collisions import Receiver, harmful_others, harmful_to_each, packet_success
from app.radio.link import LinkModel
from app.radio.settings import RadioSettings

Floats = npt.NDArray[np.float64]

MAX_MARKERS = 20_000  # source: by hand, bounds the time of a check
MAX_STATIONS = 2_000  # source: by hand, bounds the time of a check
MAX_OFFSET_M = 100.0  # [m] source: by hand, no marker of the road is further aside
SPACINGS_M = (1.0, 1000.0)  # [m] shortest and longest; source: by hand
LANE_WIDTH_M = 3.6  # [m] source: 12 ft, AASHTO Green Book, 4.3
_FADES = 2.5  # standard deviations of fading; source: normal distribution, beyond them one packet in 160
_APPROACH_STEPS = 40  # from the reach to the preview distance; source: by hand, no measurement kept
_TRANSMISSIONS = 1_000  # on an approach, each by itself; source: 25 between two of its steps, where success is linear
_PHASES = 32  # of the transmissions on the approach; source: by hand, no measurement kept


@dataclass(frozen=True, slots=True, eq=False)
class RoadMarkers:
    """Positions of markers along a road.

    Parameters
    ----------
    chainage_m : array_like, shape (M,)
        Along the road, rising in the direction of travel; in any order. [m]
    offset_m : array_like, shape (M,)
        From the receiver's path, left positive, within 100 m. [m]

    Raises
    ------
    InvalidParameter
        Lengths differ, a value is not finite, or there are none or more than 20,000.
    """

    chainage_m: Floats
    offset_m: Floats

    def __post_init__(self) -> None:
        for name in self.__slots__:
            object.__setattr__(self, name, np.atleast_1d(np.asarray(getattr(self, name), float)))
        if self.chainage_m.ndim != 1 or self.chainage_m.shape != self.offset_m.shape:
            raise InvalidParameter("a marker has one chainage and one offset", field="markers", limit="equal lengths")
        check_whole("markers", len(self.chainage_m), 1, MAX_MARKERS, "")
        if not (np.isfinite(self.chainage_m).all() and (np.abs(self.offset_m) <= MAX_OFFSET_M).all()):
            raise InvalidParameter(
                "a marker's chainage or offset is not finite or far off the road",
                field="markers",
                limit=f"finite; offsets within {MAX_OFFSET_M:g} m",
            )

    @classmethod
    def evenly(
        cls, spacing_m: float, reach_m: float, *, sides: int = 2, lane_width_m: float = LANE_WIDTH_M
    ) -> RoadMarkers:
        """Markers at even distances on one or both sides, from -reach to reach; the first one is at 0.

        Raises
        ------
        InvalidParameter
            A spacing outside 1 to 1,000 m, another number of sides, a lane outside 1 to 20 m, or too many markers.
        """
        check_between("spacing_m", spacing_m, *SPACINGS_M, "m")
        check_whole("sides", sides, 1, 2, "")
        check_between("lane_width_m", lane_width_m, 1.0, 20.0, "m")
        count = sides * (1 + 2 * math.floor(reach_m / spacing_m))
        if count > MAX_MARKERS:
            raise InvalidParameter(
                f"{count} markers are in reach of one receiver",
                field="spacing_m",
                limit=f"at most {MAX_MARKERS} markers in reach",
                cure="use a lower spreading factor, a wider band or less power: most packets would collide",
            )
        steps = np.arange(1, max(1, math.floor(reach_m / spacing_m)) + 1) * spacing_m
        along = np.concatenate([[0.0], -steps, steps])
        offsets = np.array([1.0, -1.0])[:sides] * lane_width_m / 2
        return cls(np.repeat(along, sides), np.tile(offsets, len(along)))

    def distances_m(self, station_m: npt.ArrayLike) -> Floats:
        """From stations on the road, shape (...) to (..., M). [m]"""
        away = np.asarray(station_m, float)[..., None] - self.chainage_m
        return np.asarray(np.sqrt(away**2 + self.offset_m**2))


@dataclass(frozen=True, slots=True)
class Air:
    """Everything that determines whether a packet is read: radio settings, link and receiver."""

    settings: RadioSettings
    link: LinkModel
    receiver: Receiver

    @property
    def threshold_dbm(self) -> float:
        """Level of the weakest packet that can be read. [dBm]"""
        return self.receiver.threshold_dbm(self.settings)

    @property
    def range_m(self) -> float:
        """Distance at which the mean level falls to the threshold. [m]"""
        return self.link.range_m(self.threshold_dbm, self.settings.power_dbm)

    @property
    def reach_m(self) -> float:
        """Distance beyond which at most one packet in 160 is strong enough. [m]"""
        return self.link.range_m(self.threshold_dbm - _FADES * self.link.fading_db, self.settings.power_dbm)

    @property
    def harm_m(self) -> float:
        """Distance beyond which a marker has no effect, even as interference. [m]"""
        beneath_db = _FADES * self.link.fading_db + (self.receiver.capture_db or 0.0)
        return self.link.range_m(self.threshold_dbm - beneath_db, self.settings.power_dbm)

    def level_dbm(self, distance_m: npt.ArrayLike) -> Floats:
        """Mean level at distances. [dBm]"""
        return self.link.level_dbm(distance_m, self.settings.power_dbm)


@dataclass(frozen=True, slots=True, eq=False)
class StationReception:
    """Reception at one point of a road: the markers in range, nearest first.

    Attributes
    ----------
    station_m : float
        [m]
    index : ndarray of int, shape (H,)
        Index of each marker.
    distance_m, level_dbm : ndarray, shape (H,)
        [m], [dBm]
    success : ndarray, shape (H,)
        Share of each marker's packets that are read.
    """

    station_m: float
    index: npt.NDArray[np.intp]
    distance_m: Floats
    level_dbm: Floats
    success: Floats


def reception_at(markers: RoadMarkers, station_m: float, air: Air) -> StationReception:
    """The markers in range of one point, with their levels and the share of their packets that are read.

    Raises
    ------
    InvalidParameter
        The station is not finite.
    """
    check_between("station_m", station_m, -1e9, 1e9, "m")
    distance_m = markers.distances_m(station_m)
    near = np.flatnonzero(distance_m <= air.harm_m)
    near = near[np.argsort(distance_m[near], kind="stable")]
    level = air.level_dbm(distance_m[near])
    harmful = harmful_to_each(level, air.threshold_dbm, air.link, air.receiver)
    success = packet_success(level, harmful, air.settings, air.link, air.receiver)
    in_range = level >= air.threshold_dbm
    return StationReception(station_m, near[in_range], distance_m[near[in_range]], level[in_range], success[in_range])


@dataclass(frozen=True, slots=True, eq=False)
class RoadReception:
    """Reception along a road.

    Attributes
    ----------
    station_m : ndarray, shape (S,)
        [m]
    in_range : ndarray of int, shape (S,)
        Number of markers in range.
    success_mean, success_min : ndarray, shape (S,)
        Share of packets read, mean and minimum over the markers in range; NaN if there are none.
    """

    station_m: Floats
    in_range: npt.NDArray[np.intp]
    success_mean: Floats
    success_min: Floats


def road_reception(markers: RoadMarkers, stations_m: npt.ArrayLike, air: Air) -> RoadReception:
    """Number of markers in range at each point of a road, and the share of their packets that is read.

    Raises
    ------
    InvalidParameter
        No stations, or more than 2,000.
    """
    stations = np.atleast_1d(np.asarray(stations_m, float))
    check_whole("stations_m", len(stations), 1, MAX_STATIONS, "stations")
    in_range = np.zeros(len(stations), np.intp)
    mean, lowest = np.full(len(stations), math.nan), np.full(len(stations), math.nan)
    for i, station_m in enumerate(stations):
        success = reception_at(markers, float(station_m), air).success
        in_range[i] = len(success)
        if len(success):
            mean[i], lowest[i] = success.mean(), success.min()
    return RoadReception(stations, in_range, mean, lowest)


@dataclass(frozen=True, slots=True, eq=False)
class Approach:
    """Reception of one marker while a vehicle drives towards it.

    Attributes
    ----------
    ahead_m : ndarray, shape (U,)
        Distance from the vehicle to the marker along the road, rising. [m]
    level_dbm : ndarray, shape (U,)
        [dBm]
    harmful : ndarray, shape (U, Q)
        Others that can destroy its packets (`harmful_others`).
    """

    ahead_m: Floats
    level_dbm: Floats
    harmful: Floats


def approach(markers: RoadMarkers, index: int, nearest_m: float, air: Air) -> Approach:
    """Levels and harmful others from a marker's reach to `nearest_m` before it; empty where the reach is shorter."""
    if air.reach_m <= nearest_m:
        return Approach(np.empty(0), np.empty(0), np.empty((0, 1)))
    ahead_m = np.linspace(nearest_m, air.reach_m, _APPROACH_STEPS)
    away_m = markers.chainage_m - markers.chainage_m[index]
    others = (away_m >= -air.reach_m - air.harm_m) & (away_m <= air.harm_m - nearest_m)
    others[index] = False
    stations_m = markers.chainage_m[index] - ahead_m
    neighbours = RoadMarkers(markers.chainage_m[others], markers.offset_m[others]) if others.any() else None
    level = air.level_dbm(np.hypot(ahead_m, markers.offset_m[index]))
    if neighbours is None:
        return Approach(ahead_m, level, np.zeros((len(ahead_m), 1)))
    other_levels = air.level_dbm(neighbours.distances_m(stations_m))
    return Approach(ahead_m, level, harmful_others(level, other_levels, air.threshold_dbm, air.link, air.receiver))


def read_probability(reception: Approach, speed_mps: float, air: Air) -> float:
    """Probability that a marker is read at least once on the approach.

    Parameters
    ----------
    reception : Approach
        Down to the preview distance.
    speed_mps : float
        0.5 to 70. [m/s]
    air : Air

    Raises
    ------
    InvalidParameter
        A speed outside its limits.

    Notes
    -----
    The marker sends every interval from a random phase; the result is averaged over 32 phases. Packets are assumed to
    fade and collide independently; for collisions jitter makes this nearly true.
    """
    check_between("design_speed_mps", speed_mps, 0.5, 70.0, "m/s")
    if len(reception.ahead_m) == 0:
        return 0.0
    success = packet_success(reception.level_dbm, reception.harmful, air.settings, air.link, air.receiver)
    stride_m = speed_mps * air.settings.interval_s
    stretch_m = reception.ahead_m[-1] - reception.ahead_m[0]
    each = math.ceil(stretch_m / stride_m / _TRANSMISSIONS)  # transmissions that are taken as sent from one place
    count = math.ceil(stretch_m / (each * stride_m))
    phases = (np.arange(_PHASES) + 0.5) / _PHASES
    sent_m = reception.ahead_m[0] + each * stride_m * (phases[:, None] + np.arange(count))
    missed = 1 - np.interp(sent_m, reception.ahead_m, success, right=0.0)
    return float(1 - (missed**each).prod(axis=1).mean())
