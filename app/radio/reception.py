"""Reception at each point of a road, and the probability that a marker is read in time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy
from pydantic import Field, GetPydanticSchema

from app.errors import InvalidParameter
from app.inputs import Flag, Number, Whole
from app.radio.link import LinkModel, sensitivity_dbm
from app.radio.settings import MAX_CHANNELS, RadioSettings, check_between, check_whole
from app.values import Floats

# === Share of packets that are received where many markers share the channel: pure ALOHA with capture.


CAPTURE_DB = 6.0  # [dB] a packet survives others this much weaker; source: Bor et al., MSWiM 2016, "Do LoRa low-power
# wide-area networks scale?"
_LEVELS = 64  # of the interpolation in `harmful_to_each`
_BIN = 0.02  # standard deviations of fading between the levels of `_binned`; source: its error bound, 0.242 _BIN^2 / 8


@dataclass(frozen=True, slots=True)
class Receiver:
    """The vehicle's receiver."""

    channels: Annotated[Whole, Field(description="Channels received at once: 1 for an SX1276, 8 for a gateway.")] = 1
    sensitivity_dbm: Annotated[Number | None, Field(description="-150 to -60; the chip's own if left out. [dBm]")] = (
        None
    )
    capture_db: Annotated[
        Number | None, Field(description="By which a packet outdoes others, 0 to 30; null for none. [dB]")
    ] = CAPTURE_DB
    relocks: Annotated[
        Flag, Field(description="It abandons a weak packet for a stronger one that begins later; an SX1276 does not.")
    ] = False

    def __post_init__(self) -> None:
        check_whole("receiver.channels", self.channels, 1, MAX_CHANNELS, "")
        if self.sensitivity_dbm is not None:
            check_between("receiver.sensitivity_dbm", self.sensitivity_dbm, -150.0, -60.0, "dBm")
        if self.capture_db is not None:
            check_between("receiver.capture_db", self.capture_db, 0.0, 30.0, "dB")

    def threshold_dbm(self, settings: RadioSettings) -> float:
        """The weakest packet of these settings that it can read. [dBm]"""
        if self.sensitivity_dbm is not None:
            return self.sensitivity_dbm
        return sensitivity_dbm(settings.spreading_factor, settings.bandwidth_hz)


def aloha_success(others: npt.ArrayLike, time_on_air_s: float, interval_s: float, channels: int = 1) -> Floats:
    """Share of packets that no other overlaps: exp(-2 N ToA / (T K)).

    Parameters
    ----------
    others : array_like
        Markers in range besides the wanted one; fractions are allowed.
    time_on_air_s, interval_s : float
        Of a packet, and from one to the next of each marker. [s]
    channels : int
        That packets are spread over evenly.

    Returns
    -------
    ndarray
        Of the shape of `others`.

    Raises
    ------
    InvalidParameter
        A value is outside its limits.

    Notes
    -----
    Abramson's pure ALOHA: a packet is lost where another begins within a time on air before or after its beginning.
    """
    check_between("time_on_air_s", time_on_air_s, 0.0, 100.0, "s")
    check_between("interval_s", interval_s, 1e-3, 1e6, "s")
    check_whole("channels", channels, 1, MAX_CHANNELS, "")
    return np.asarray(np.exp(-2 * np.asarray(others, float) * time_on_air_s / (interval_s * channels)))


def harmful_others(
    wanted_dbm: npt.ArrayLike, others_dbm: npt.ArrayLike, threshold_dbm: float, link: LinkModel, receiver: Receiver
) -> Floats:
    """Number of other markers that can destroy a packet, each counted as in plain ALOHA.

    Parameters
    ----------
    wanted_dbm : array_like, shape (...)
        Mean level of the wanted marker. [dBm]
    others_dbm : array_like, shape (..., M)
        Mean levels of all other markers. [dBm]
    threshold_dbm : float
        The weakest packet that is read. [dBm]
    link : LinkModel
        For its fading.

    Returns
    -------
    ndarray, shape (..., Q)
        For equally likely levels of the packets that are strong enough (`LinkModel.read_levels_dbm`).

    Notes
    -----
    Another marker counts fully if its packet is less than `capture_db` weaker: it destroys packets that it overlaps. A
    weaker readable one counts half if the receiver does not relock: it hides packets that begin while it is read.
    Without capture all readable markers count fully, and the share of received packets is plain ALOHA's.

    Others are compared one by one. Weaker ones on the air together, whose powers add, destroy some packets more: at
    most 4 % of all where 40 % or more are received (a test plays it). The simulation (`app.simulation.radio`) adds.
    """
    levels = link.read_levels_dbm(wanted_dbm, threshold_dbm)
    return _harmful_at(levels, _binned(np.asarray(others_dbm, float), link), threshold_dbm, link, receiver)


class _Others(NamedTuple):
    """Other markers by their mean levels: how many have each of them."""

    levels_dbm: Floats  # (..., B)
    number: Floats  # (..., B)


def _binned(others_dbm: Floats, link: LinkModel) -> _Others:
    """Markers with levels of shape (..., M), counted on a grid of levels where that is shorter.

    A marker between two levels counts for both in proportion, so that a sum over the grid differs from the sum over the
    markers by less than 2e-5 a marker: the second derivative of a normal distribution is at most 0.242.
    """
    rows = others_dbm.reshape(-1, others_dbm.shape[-1])
    low, span_db = rows.min(initial=np.inf), np.ptp(rows) if rows.size else 0.0
    steps = math.ceil(span_db / (_BIN * link.fading_db)) + 1 if link.fading_db else rows.shape[-1]
    if 2 * steps >= rows.shape[-1]:
        return _Others(others_dbm, np.ones_like(others_dbm))
    grid = low + _BIN * link.fading_db * np.arange(steps + 1)
    count = np.empty((len(rows), steps + 1))
    for k, row in enumerate(rows):
        place = (row - low) / (_BIN * link.fading_db)
        below = place.astype(np.intp)
        upper = np.bincount(below, place - below, minlength=steps + 1)
        count[k] = np.bincount(below, minlength=steps + 1) - upper
        count[k, 1:] += upper[:-1]
    return _Others(grid, count.reshape(*others_dbm.shape[:-1], steps + 1))


def _harmful_at(
    levels_dbm: Floats, others: _Others, threshold_dbm: float, link: LinkModel, receiver: Receiver
) -> Floats:
    """Harmful others of packets with given levels, shape (..., Q), among others of shape (..., M)."""
    readable = (link.share_above(others.levels_dbm, threshold_dbm) * others.number).sum(-1)[..., None]
    if receiver.capture_db is None:
        return np.asarray(np.broadcast_to(readable, levels_dbm.shape))
    limits_dbm = levels_dbm - receiver.capture_db
    share = link.share_above(others.levels_dbm[..., None, :], limits_dbm[..., None])
    strong = np.einsum("...qm,...m->...q", share, others.number)
    if receiver.relocks:
        return np.asarray(strong)
    return np.asarray(strong + 0.5 * np.maximum(readable - strong, 0.0))


def harmful_to_each(levels_dbm: Floats, threshold_dbm: float, link: LinkModel, receiver: Receiver) -> Floats:
    """`harmful_others` for each of many markers in range of one place, shape (M, Q).

    With fading it is interpolated between 64 levels.
    """
    if len(levels_dbm) == 0:
        return np.empty((0, 1))
    wanted = link.read_levels_dbm(levels_dbm, threshold_dbm)
    itself = harmful_others(levels_dbm, levels_dbm[:, None], threshold_dbm, link, receiver)
    everyone = _binned(levels_dbm, link)
    if link.fading_db == 0.0:
        return _harmful_at(wanted[:, 0], everyone, threshold_dbm, link, receiver)[:, None] - itself
    grid = np.linspace(wanted.min(), wanted.max(), _LEVELS)
    harmful = np.interp(wanted, grid, _harmful_at(grid, everyone, threshold_dbm, link, receiver))
    return np.asarray(np.maximum(harmful - itself, 0.0))


def packet_success(
    wanted_dbm: npt.ArrayLike,
    harmful: npt.ArrayLike,
    settings: RadioSettings,
    link: LinkModel,
    receiver: Receiver,
) -> Floats:
    """Share of a marker's packets that are strong enough, on a received channel, and not destroyed.

    Levels have shape (...), harmful others (..., Q); in slots only those that share the marker's slot and channel, each
    of which destroys every packet.
    """
    strong_enough = link.share_above(wanted_dbm, receiver.threshold_dbm(settings))
    return np.asarray(strong_enough * _clear_share(harmful, settings, receiver))


def _clear_share(harmful: npt.ArrayLike, settings: RadioSettings, receiver: Receiver) -> Floats:
    """Share of the strong packets that are on a received channel and not destroyed, shape (..., Q) to (...)."""
    channel_share = min(1.0, receiver.channels / settings.channels)
    if settings.slotted:
        return np.asarray(channel_share * np.exp(-np.asarray(harmful, float)).mean(-1))
    clear = aloha_success(harmful, settings.time_on_air_s, settings.interval_s, settings.channels)
    return np.asarray(channel_share * clear.mean(-1))


# === Reception at each point of a road, and the probability that a marker is read in time.


MAX_MARKERS = 20_000  # bounds the time of a check
MAX_STATIONS = 2_000  # bounds the time of a check
MAX_OFFSET_M = 100.0  # [m] no marker of the road is further aside
SPACINGS_M = (1.0, 1000.0)  # [m] shortest and longest
LANE_WIDTH_M = 3.6  # [m] source: 12 ft, AASHTO Green Book, 4.3
_FADES = 2.5  # standard deviations of fading; source: normal distribution, beyond them one packet in 160
_APPROACH_STEPS = 40  # from the reach to the preview distance
_TRANSMISSIONS = 1_000  # on an approach, each by itself; source: 25 between two of its steps, where success is linear
_PHASES = 32  # of the transmissions on the approach


_Places = Annotated[
    Floats,
    GetPydanticSchema(
        lambda _, schema_of: schema_of(Annotated[list[Number], Field(min_length=1, max_length=MAX_MARKERS)])
    ),
]


@dataclass(frozen=True, slots=True, eq=False)
class RoadMarkers:
    """Where markers stand along a road, in any order: lists of one length."""

    # shape (M,)
    chainage_m: Annotated[_Places, Field(description="Along the road, rising in the direction of travel. [m]")]
    offset_m: Annotated[
        _Places, Field(description="From the receiver's path, left positive, -100 to 100. [m]")
    ]  # shape (M,)

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
    """Reception at one point of a road: the markers in range, nearest first."""

    station_m: float
    index: npt.NDArray[np.intp]  # shape (H,): index of each marker
    # `distance_m`, `level_dbm`: shape (H,)
    distance_m: Floats
    level_dbm: Floats
    success: Floats  # shape (H,): share of each marker's packets that are read


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
    if air.settings.slots is not None:  # the nearest ones have other places
        harmful = np.maximum(harmful - air.settings.slots.capacity, 0.0) / air.settings.slots.capacity
    success = packet_success(level, harmful, air.settings, air.link, air.receiver)
    in_range = level >= air.threshold_dbm
    return StationReception(station_m, near[in_range], distance_m[near[in_range]], level[in_range], success[in_range])


@dataclass(frozen=True, slots=True, eq=False)
class RoadReception:
    """Reception at points along the road; null where no marker is in range."""

    station_m: list[float]
    markers_in_range: list[int]
    # share of packets that are read, over the markers in range
    packet_success_mean: list[float | None]
    packet_success_min: list[float | None]


def road_reception(markers: RoadMarkers, stations_m: npt.ArrayLike, air: Air) -> RoadReception:
    """Number of markers in range at each point of a road, and the share of their packets that is read.

    Raises
    ------
    InvalidParameter
        No stations, or more than 2,000.
    """
    stations = np.atleast_1d(np.asarray(stations_m, float))
    check_whole("stations_m", len(stations), 1, MAX_STATIONS, "stations")
    road = RoadReception(stations.tolist(), [], [], [])
    for station_m in road.station_m:
        success = reception_at(markers, station_m, air).success
        road.markers_in_range.append(len(success))
        road.packet_success_mean.append(float(success.mean()) if len(success) else None)
        road.packet_success_min.append(float(success.min()) if len(success) else None)
    return road


@dataclass(frozen=True, slots=True, eq=False)
class Approach:
    """Reception of one marker while a vehicle drives towards it."""

    ahead_m: Floats  # shape (U,): [m] distance from the vehicle to the marker along the road, rising
    level_dbm: Floats  # shape (U,) [dBm]
    harmful: Floats  # shape (U, Q): others that can destroy its packets (`harmful_others`)


def approach(markers: RoadMarkers, index: int, nearest_m: float, air: Air) -> Approach:
    """Levels and harmful others from a marker's reach to `nearest_m` before it; empty where the reach is shorter."""
    if air.reach_m <= nearest_m:
        return Approach(np.empty(0), np.empty(0), np.empty((0, 1)))
    ahead_m = np.linspace(nearest_m, air.reach_m, _APPROACH_STEPS)
    away_m = markers.chainage_m - markers.chainage_m[index]
    others = (away_m >= -air.reach_m - air.harm_m) & (away_m <= air.harm_m - nearest_m)
    others[index] = False
    if air.settings.slots is not None:
        others &= _share_slot(markers, index, air.settings.slots.capacity)
    stations_m = markers.chainage_m[index] - ahead_m
    neighbours = RoadMarkers(markers.chainage_m[others], markers.offset_m[others]) if others.any() else None
    level = air.level_dbm(np.hypot(ahead_m, markers.offset_m[index]))
    if neighbours is None:
        return Approach(ahead_m, level, np.zeros((len(ahead_m), 1)))
    other_levels = air.level_dbm(neighbours.distances_m(stations_m))
    return Approach(ahead_m, level, harmful_others(level, other_levels, air.threshold_dbm, air.link, air.receiver))


def _share_slot(markers: RoadMarkers, index: int, capacity: int) -> npt.NDArray[np.bool_]:
    """Which markers have the place of one, if places are assigned along the road, over all its lanes; shape (M,)."""
    place = np.empty(len(markers.chainage_m), int)
    place[np.argsort(markers.chainage_m, kind="stable")] = np.arange(len(place))
    return np.asarray((place - place[index]) % capacity == 0)


def read_probability(reception: Approach, speed_m_s: float, air: Air) -> float:
    """Probability that a marker is read at least once on the approach.

    Parameters
    ----------
    reception : Approach
        Down to the preview distance.
    speed_m_s : float
        0.5 to 70. [m/s]

    Raises
    ------
    InvalidParameter
        A speed outside its limits.

    Notes
    -----
    The marker sends every interval from a random phase; the result is averaged over 32 phases. Packets are assumed to
    fade and collide independently; for collisions jitter makes this nearly true. In slots there are hardly any
    collisions, so that what is lost is lost by fading, and then it matters that consecutive packets meet the same
    shadows (`_miss_in_shadows`).
    """
    check_between("design_speed_m_s", speed_m_s, 0.5, 70.0, "m/s")
    if len(reception.ahead_m) == 0:
        return 0.0
    success = packet_success(reception.level_dbm, reception.harmful, air.settings, air.link, air.receiver)
    stride_m = speed_m_s * air.settings.interval_s
    stretch_m = reception.ahead_m[-1] - reception.ahead_m[0]
    each = math.ceil(stretch_m / stride_m / _TRANSMISSIONS)  # transmissions that are taken as sent from one place
    count = math.ceil(stretch_m / (each * stride_m))
    phases = (np.arange(_PHASES) + 0.5) / _PHASES
    sent_m = reception.ahead_m[0] + each * stride_m * (phases[:, None] + np.arange(count))
    if air.settings.slotted:
        return 1 - _miss_in_shadows(reception, sent_m, each, air)
    missed = 1 - np.interp(sent_m, reception.ahead_m, success, right=0.0)
    return float(1 - (missed**each).prod(axis=1).mean())


SHADOW_M = 25.0  # [m] length over which shadows are alike; source: as `simulation.radio.link.Radio`
PACKET_FADING_DB = 2.0  # [dB] from packet to packet, besides the shadows; source: as `simulation.radio.link.Radio`
_SHADOWS = np.linspace(-4.0, 4.0, 65)  # standard deviations of a shadow's depth


def _miss_in_shadows(reception: Approach, sent_m: Floats, each: int, air: Air) -> float:
    """Probability that all packets sent at distances of shape (phases, K), rising, are missed.

    Notes
    -----
    The depth of the shadow is a Gauss-Markov process along the way with the link's fading as standard deviation
    (Gudmundson, Electronics Letters 27 (1991), 2145), on a grid; each packet also fades by itself. A forward recursion
    from the farthest packet to the nearest: probability of each depth and of no packet read so far.
    """
    if np.size(sent_m) == 0:
        return 1.0
    keep = math.exp(-(sent_m[0, 1] - sent_m[0, 0]) / SHADOW_M) if sent_m.shape[1] > 1 else 0.0
    step = np.exp(-((_SHADOWS - keep * _SHADOWS[:, None]) ** 2) / (2 * max(1 - keep**2, 1e-2)))
    step /= step.sum(axis=1, keepdims=True)
    clear = _clear_share(reception.harmful, air.settings, air.receiver)
    missed = np.broadcast_to(np.exp(-(_SHADOWS**2) / 2), (len(sent_m), len(_SHADOWS)))
    missed = missed / missed.sum(axis=1, keepdims=True)
    for k in range(sent_m.shape[1])[::-1]:
        level = np.interp(sent_m[:, k], reception.ahead_m, reception.level_dbm)[:, None] + _SHADOWS * air.link.fading_db
        strong = scipy.special.ndtr((level - air.threshold_dbm) / PACKET_FADING_DB)
        read = strong * np.interp(sent_m[:, k], reception.ahead_m, clear, right=0.0)[:, None]
        missed = (missed if k == sent_m.shape[1] - 1 else missed @ step) * (1 - read) ** each
    return float(missed.sum(axis=1).mean())
