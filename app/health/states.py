"""Rules, results and stored states of the tests of a marker, and of a vehicle's own errors; the test of a stretch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum

import numpy as np

from app.geodesy.frames import metres_per_radian
from app.values import Floats, JsonObject

# === Faults of markers, and the limits of the tests for them.


class Fault(StrEnum):
    """What can be wrong with a marker, or with what is registered of it; the last two are of a whole stretch."""

    MISSING = "missing"
    MOVED = "moved"
    CLONED = "cloned"
    WRONG_WAY = "wrong-way"
    FADING = "fading"
    UNREGISTERED = "unregistered"
    SHIFTED = "shifted"
    TURNED = "turned"


TESTED = (Fault.MISSING, Fault.MOVED, Fault.CLONED, Fault.WRONG_WAY, Fault.FADING)
"""Tests of a registered marker; the other faults are of a code that is not registered, and of a stretch."""

CLEAN, DIRTY = (1.0,), ((1.0, 0.6, 0.3), (0.90, 0.08, 0.02))
READING_LEVELS: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "plate": DIRTY,
    "fiducial": DIRTY,
    "magnet": (CLEAN, CLEAN),
    "cerpm": ((1.0, 0.5), (0.95, 0.05)),
}
"""Factors on the reading probability of a healthy marker and how common they are: dirt on faces, weak batteries;
nothing covers a magnet. `python -m benchmarks.health` draws its own."""


@dataclass(frozen=True, slots=True)
class HealthRules:
    """Error rates and bounds of the tests."""

    # share of healthy markers that become suspects in a month of traffic, at most
    # share of healthy markers that become suspects in a month of traffic, at most
    false_alarm_share: float = 1e-3  # source: the registry's requirement, one marker in a thousand
    # [nat] logarithm of the ratio at which a marker is accepted as healthy, and the test starts again
    # [nat] logarithm of the ratio at which a marker is accepted as healthy, and the test starts again
    lower: float = 0.0  # [nat] source: Page, Biometrika 41, 1954: tests in a row find a fault whenever it begins
    # distinct vehicles without which no marker becomes a suspect
    # distinct vehicles without which no marker becomes a suspect
    vehicles: int = 3  # two may share a workshop, and so a wrong calibration
    # [nat] what one vehicle adds to a test at most, however often it passes
    # [nat] what one vehicle adds to a test at most, however often it passes
    vehicle_bound: float = 5.0  # [nat] at 10,000 passes a month four vehicles are needed, and five do
    # passes in a month that are assumed at least
    # passes in a month that are assumed at least
    month_passes: float = 100.0  # three vehicles a day
    # share of the passes of healthy markers with which a test for a displacement begins
    # share of the passes of healthy markers with which a test for a displacement begins
    moved_test_starts: float = 0.01  # source: the scenes of `python -m benchmarks.health`: 0.6 to 1.2 %, once 2.3 %
    # [m] smallest estimated displacement of a suspect
    # [m] smallest estimated displacement of a suspect
    moved_m: float = 0.75  # [m] source: `python -m benchmarks.health`, finds 1.0 m in five passes
    # [m] a marker that stands this near to its registered position has not moved; two standard deviations of the survey
    # where they are more
    # [m] a marker that stands this near to its registered position has not moved; two standard deviations of the survey
    # where they are more
    disc_m: float = 0.25  # [m] what crews and surveys of roads are good to

    def upper(self, fault: Fault, month_passes: float) -> float:
        """Logarithm of the ratio from which a fault is suspected. [nat]

        Notes
        -----
        By Ville's inequality a likelihood ratio of a healthy marker ever exceeds 1/alpha with probability alpha at
        most. A test starts with a pass at the earliest, so there are no more tests in a month than passes, and
        alpha is the allowed share over passes and kinds of tests. A test for a displacement starts only with an offset
        that lies outside of the disc.
        """
        starts = self.moved_test_starts if fault is Fault.MOVED else 1.0
        tests = len(TESTED) * max(month_passes, self.month_passes) * starts
        return math.log(tests / self.false_alarm_share)


RULES = HealthRules()


# === What one upload shows of a marker, and what remains of it as evidence after the vehicle's own errors.


LonLat = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Pass:
    """What one upload of a vehicle shows of one marker."""

    marker_id: str
    family: str
    read: bool  # whether the marker was read
    expected: float = 0.0  # probability that a healthy, clean marker is read in such a pass; 0 where it is not known
    along: float = 0.0  # order in the drive: time, frame or odometer
    # [m] observed less registered position by the vehicle's own position, east and north
    offset_m: tuple[float, float] | None = None
    sigma_m: float = 0.0  # [m] standard deviation of the observation relative to the vehicle, each axis
    # [m] standard deviation of the vehicle's own position, each axis; None if unknown
    position_sigma_m: float | None = None
    offset_is_absolute: bool = False  # the offset rests on no position of the vehicle: by a marker's own message
    survey_m: float = 0.0  # [m] standard deviation of the registered position, each axis
    heading_deg: float | None = None  # [deg] of the vehicle
    reversed: bool | None = None  # whether it was met against its direction; None where it shows none
    quality: float | None = None  # signal or grade less the nominal one, in standard deviations
    quality_is_relative: bool = False  # the quality is compared with the other markers of the drive already
    elsewhere: LonLat | None = None  # [deg] where it was read, far from its place: longitude and latitude
    two_places: bool = False  # one drive received it from two places


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence of a pass on its marker after the vehicle's own errors."""

    marker_id: str
    family: str
    read: bool
    # that this vehicle reads a healthy, clean marker in this pass; 0 where a miss is no evidence
    read_probability: float
    # `offset_m`, `sigma_m`: [m] less the drive's common shift, east and north, and the standard deviation of each with
    # that of the shift
    offset_m: tuple[float, float] | None = None
    sigma_m: float = 0.0
    survey_m: float = 0.0
    reversed: bool | None = None  # against the direction of the other markers of the drive
    alone: bool = False  # the drive shows no other direction to compare with
    quality: float | None = None  # less that of the drive's other markers, in standard deviations
    elsewhere: LonLat | None = None
    two_places: bool = False


# === What the tests of a marker find.


@dataclass(frozen=True, slots=True)
class Verdict:
    """A fault that is suspected by the evidence of several vehicles."""

    fault: Fault
    # `ratio`, `limit`: [nat] logarithm of the likelihood ratio, and the limit that it has passed
    ratio: float
    limit: float
    # `vehicles`, `passes`: that added to it, and their passes where these are kept
    vehicles: int
    passes: int
    since_s: float  # when the evidence began. [s since 1970]
    offset_m: tuple[float, float] | None = None  # [m] estimated displacement, east and north
    elsewhere: LonLat | None = None  # [deg] where it was read, far from its place
    displacement: Displacement | None = None  # of a stretch


# === State of the tests of a marker and of a vehicle's own errors, as they are stored.


MONTH_S = 30 * 86_400.0
_BY_FAULT = ("ratios", "shares", "since")


@dataclass(slots=True)
class OffsetEntry:
    """Mean offset that one vehicle saw in the current test, and how often."""

    vehicle: str
    at_s: float
    east_m: float
    north_m: float
    sigma_m: float
    passes: int = 1


@dataclass(slots=True)
class FarEntry:
    """Where one vehicle last read the marker far from its place; None where one drive received it from two places."""

    vehicle: str
    at_s: float
    place: LonLat | None


@dataclass(slots=True)
class MarkerState:
    """Evidence on one marker."""

    family: str = ""
    # [nat] logarithm of the likelihood ratio of each fault that has evidence
    ratios: dict[str, float] = field(default_factory=dict)
    # what each vehicle added to the current test, by fault: missing, wrong-way, fading and unregistered
    shares: dict[str, dict[str, float]] = field(default_factory=dict)
    # probabilities of the factors of `READING_LEVELS` by the marker's own record
    levels: list[float] = field(default_factory=list)
    offsets: list[OffsetEntry] = field(default_factory=list)  # of the current test for a moved marker, oldest first
    survey_m: float = 0.0  # [m] standard deviation of the registered position, each axis
    far: list[FarEntry] = field(default_factory=list)
    # `quality`, `quality_passes`: mean quality of the record, and on how many passes it rests
    quality: float = 0.0
    quality_passes: float = 0.0
    # `passes`, `reads`: in all
    passes: int = 0
    reads: int = 0
    month_passes: float = 0.0  # passes that count less the longer ago they were, by the factor e in 30 days
    # `first_s`, `last_s`, `read_s`: first and last pass, and last reading at its place. [s since 1970]
    first_s: float = 0.0
    last_s: float = 0.0
    read_s: float = 0.0
    since: dict[str, float] = field(default_factory=dict)  # when the current evidence of a fault began. [s since 1970]

    @classmethod
    def new(cls, family: str) -> MarkerState:
        """A marker of a family without evidence."""
        return cls(family=family, levels=list(READING_LEVELS.get(family, READING_LEVELS["magnet"])[1]))

    @classmethod
    def from_document(cls, document: JsonObject) -> MarkerState:
        """The state that `document` stored."""
        far = [
            FarEntry(entry["vehicle"], entry["at_s"], None if entry["place"] is None else tuple(entry["place"]))
            for entry in document["far"]
        ]
        return cls(**{**document, "offsets": [OffsetEntry(**entry) for entry in document["offsets"]], "far": far})

    def document(self) -> JsonObject:
        """The state as JSON values."""
        named = {name: {str(fault): value for fault, value in getattr(self, name).items()} for name in _BY_FAULT}
        return {**asdict(self), **named}

    def reset(self, fault: str) -> None:
        """Forget the evidence of one fault: a person has decided on it, or the marker was accepted as healthy."""
        self.ratios.pop(fault, None)
        self.shares.pop(fault, None)
        self.since.pop(fault, None)
        if fault == "moved":
            self.offsets = []
        if fault == "cloned" or fault == "moved":
            self.far = [] if fault == "cloned" else [entry for entry in self.far if entry.place is None]

    def count(self, at_s: float, *, read: bool) -> None:
        """Count a pass."""
        aged = math.exp(-max(at_s - self.last_s, 0.0) / MONTH_S) if self.passes else 0.0
        self.month_passes = self.month_passes * aged + 1.0
        self.first_s = at_s if not self.passes else min(self.first_s, at_s)
        self.last_s = max(self.last_s, at_s)
        self.passes += 1
        if read:
            self.reads += 1
            self.read_s = max(self.read_s, at_s)


MEMORY_S = 600.0
"""[s] for which a vehicle's readings are evidence that its sensors work. Some kilometres of road."""
SHIFT_PRIOR_M = 0.5
"""[m] standard deviation of the shift of a vehicle without a record, each axis. A camera that is turned by 3 degrees
shifts a plate at 10 m by this."""
SHIFT_FLOOR_M = 0.1
"""[m] by which a vehicle's shift changes from pass to pass, each axis."""
_MAX_RECORD = 30.0  # passes; a camera is touched between drives
_STEP_M = 0.3  # [m] at most by one pass, so that a marker that has moved teaches little


@dataclass(slots=True)
class VehicleState:
    """A vehicle's own errors by its last passes."""

    # `forward_m`, `left_m`, `offsets`: [m] mean offset in the vehicle's frame, and on how many passes it rests
    forward_m: float = 0.0
    left_m: float = 0.0
    offsets: float = 0.0
    # `reads`, `expected`: of the last minutes, decaying
    reads: float = 0.0
    expected: float = 0.0
    at_s: float = 0.0  # of the last pass. [s since 1970]

    def age(self, at_s: float) -> None:
        """Let the readings decay until a time."""
        share = math.exp(-max(at_s - self.at_s, 0.0) / MEMORY_S)
        self.reads, self.expected, self.at_s = self.reads * share, self.expected * share, max(at_s, self.at_s)

    def learn(self, forward_m: float, left_m: float, passes: int) -> None:
        """Add the median offset of a drive."""
        self.offsets = min(self.offsets + passes, _MAX_RECORD)
        share = min(passes / self.offsets, 1.0)
        limit = _STEP_M * max(passes, 1)
        self.forward_m += max(-limit, min(limit, share * (forward_m - self.forward_m)))
        self.left_m += max(-limit, min(limit, share * (left_m - self.left_m)))

    @property
    def shift_sigma_m(self) -> float:
        """Standard deviation of the shift, each axis. [m]"""
        return math.hypot(SHIFT_PRIOR_M / math.sqrt(1.0 + self.offsets), SHIFT_FLOOR_M)

    def document(self) -> dict[str, object]:
        """The state as JSON values."""
        return asdict(self)


# === A stretch of road whose markers are all displaced alike, by several drives.
#
# One drive with an ordinary receiver cannot show that all markers of a stretch are a metre beside the lane, as by a
# survey in another datum: its own position is no better. The errors of receivers are independent from drive to drive,
# and a driver's habit is to one side of the direction of travel, which is the other side of the road in the other
# direction. Only the distance across the path is compared: along a straight road nothing can be seen. So four unknowns,
# all in metres, are common to all drives: the shift of the markers' path to the east and to the north, its turn
# anticlockwise about the middle of the stretch (as the displacement 250 m from there), and the offset to the left that
# drivers have in common. A drive is evidence in information form: what it weighs, and its weighted sum.


TURN_REACH_M = 250.0  # [m] from the middle of a stretch, where a turn is stated; half of a stretch
SHIFT_SD_M, SHIFT_SHARE = (1.0, 10.0), (0.9, 0.1)
"""Standard deviations of a shift or a turn before it is seen, each axis [m], and how common they are: realizations of
a datum that were mistaken for each other (0.2 to 2 m), and larger mistakes."""
TOLERANCE_SD_M = 0.1
"""[m] of the shift of a correct survey, each axis, at least. Source: `HealthRules.disc_m` is 2.5 of it."""
COMMON_HABIT_SD_M, HABIT_SD_M = 0.1, 0.25
"""[m] offset to one side that drivers have in common, and that of one driver. Source: the habits of
`app.lanes.lane_path`; where one direction is driven, the first remains."""
WANDER_SD_M, WANDER_LENGTH_M, SLOW_SHARE = 0.25, 30.0, 0.3
"""[m, m, 1] of drivers along the path, and the share of a receiver's error that wanders likewise. Source: as above."""
OPTIMISM = 1.5  # true error of a receiver over the accuracy that it reports, before a stretch has its own record
RECEIVER_FLOOR_M = 0.1  # [m] each axis, of what no receiver states: the mounting of its antenna, its own datum
STRAY_SHARE, STRAY_SD_M = 0.05, 3.0
"""Share of drives that are displaced by their own fault, and by how much [m]: wrong datum, wrong lane."""
MEMORY_SD_M = 0.05
"""[m] standard deviation at which older drives begin to be forgotten: a survey may change, and markers with it."""
MAX_STRETCH_VEHICLES = 10
"""Vehicles whose drives are kept one by one; older ones are kept as sums. So one vehicle is a tenth at most."""
_MAX_SHARED_PASSES = 5  # of a vehicle that its mean rests on, so that it follows a change
_SCALE_DRIVES, _MIN_SCALE, _MAX_SQUARE = 10.0, 0.4, 9.0  # weight of `OPTIMISM` as drives; limits of variance ratios


@dataclass(frozen=True, slots=True)
class StretchRules:
    """Error rates and bounds of the test of a stretch."""

    false_alarm_share: float = 1e-3  # share of correct stretches that are reported in a month, at most
    lower: float = -2.0  # [nat] at which a stretch is accepted as correct, and the test starts again
    vehicles: int = 3  # distinct vehicles without which nothing is reported
    vehicle_bound: float = 5.0  # [nat] as of `HealthRules`
    month_passes: float = 100.0  # passes in a month that are assumed at least
    # tests that start in a pass. Source: `python -m benchmarks.health --only stretches`: 0.02 to 0.1 with RTK
    test_starts: float = 0.05
    min_m: float = 0.3  # [m] smallest displacement that is reported; a lane leaves more room

    def upper(self, month_passes: float) -> float:
        """Logarithm of the ratio from which a displacement is reported, as `HealthRules.upper`. [nat]"""
        return math.log(2.0 * max(month_passes, self.month_passes) * self.test_starts / self.false_alarm_share)


STRETCH_RULES = StretchRules()


@dataclass(frozen=True, slots=True)
class Displacement:
    """How the markers of a stretch lie against the lane as vehicles drive it.

    Standard deviations are large in a direction that drives cannot show, as along a straight road.
    """

    # `east_m`, `north_m`: [m] shift of the markers at the middle of the stretch, with standard deviations
    east_m: float
    north_m: float
    east_sigma_m: float
    north_sigma_m: float
    sigma_m: float  # [m] of the shift in its own direction
    # `turn_deg`, `turn_sigma_deg`: [deg] turn of the markers about the middle of the stretch, anticlockwise
    turn_deg: float
    turn_sigma_deg: float
    directions: int  # of travel that were driven: 1 or 2


@dataclass(slots=True)
class StretchDrive:
    """What one drive shows of a stretch."""

    # `lon_deg`, `lat_deg`: [deg] point about which the turn is stated
    lon_deg: float
    lat_deg: float
    heading_deg: float  # [deg] mean direction of travel
    # shape (4, 4), (4,): information on shift east and north, turn, and common offset [1/m2], and times values [1/m]
    information: Floats
    weighted: Floats
    survey_m: float = 0.0  # [m] standard deviation of the registered positions, each axis, where it is stated

    @classmethod
    def from_document(cls, document: JsonObject) -> StretchDrive:
        """The evidence that `document` stored."""
        arrays = {name: np.array(document[name], dtype=np.float64) for name in ("information", "weighted")}
        return cls(**{**document, **arrays})

    def document(self) -> JsonObject:
        """The evidence as JSON values."""
        place = {"lon_deg": round(self.lon_deg, 7), "lat_deg": round(self.lat_deg, 7)}
        rest = {"heading_deg": round(self.heading_deg, 1), "survey_m": round(self.survey_m, 3)}
        return {**place, **rest, "information": _short(self.information), "weighted": _short(self.weighted)}

    def about(self, lon_deg: float, lat_deg: float) -> tuple[Floats, Floats]:
        """Information and weighted values about another point: where it is the middle, a turn is another shift."""
        east_per_rad, north_per_rad = (float(value) for value in metres_per_radian(np.radians(lat_deg)))
        east_m = math.radians((self.lon_deg - lon_deg + 180.0) % 360.0 - 180.0) * east_per_rad
        north_m = math.radians(self.lat_deg - lat_deg) * north_per_rad
        own = np.eye(4)
        own[:2, 2] = -north_m / TURN_REACH_M, east_m / TURN_REACH_M
        return own.T @ self.information @ own, own.T @ self.weighted


def _short(values: Floats) -> list[object]:
    """Values for storage, to six significant digits."""
    flat = [float(f"{value:.6g}") for value in values.ravel().tolist()]
    shortened: list[object] = np.array(flat).reshape(values.shape).tolist()
    return shortened


def stretch_drive(
    vehicle_m: Floats, path_m: Floats, normal: Floats, along_m: Floats, accuracy_m: float
) -> tuple[Floats, Floats]:
    """Information of one drive about the middle of its places, which are in a plane with axes east and north.

    Parameters
    ----------
    vehicle_m : ndarray, shape (N, 2)
        Places of the vehicle, evenly along the path. [m]
    path_m, normal : ndarray, shape (N, 2)
        Places of the markers' path beside them [m], and unit vectors to its left in the direction of travel.
    along_m : ndarray, shape (N,)
        Of the places along the path. [m]
    accuracy_m : float
        That the receiver states, each axis. [m]

    Returns
    -------
    information : ndarray, shape (4, 4)
        [1/m2]
    weighted : ndarray, shape (4,)
        [1/m]

    Notes
    -----
    A place q of the vehicle and p of the path, with the normal n and c as the middle, have
    n . (q - p) = habit - n . (shift + turn x (p - c)) + error. The errors of a drive are its driver's own habit, an
    error of the receiver that is constant, one that changes evenly along the stretch, and wander, correlated over 30 m.
    """
    count = len(along_m)
    from_middle = path_m - path_m.mean(axis=0)
    turned = np.stack([-from_middle[:, 1], from_middle[:, 0]], axis=1) / TURN_REACH_M
    design = np.column_stack([-normal, -np.sum(normal * turned, axis=1), np.ones(count)])
    beside_m = np.sum(normal * (vehicle_m - path_m), axis=1)
    error_m = OPTIMISM * accuracy_m
    spacing_m = max(float(np.ptp(along_m)) / max(count - 1, 1), 0.1)
    wander_m = math.hypot(WANDER_SD_M, SLOW_SHARE * error_m) * math.sqrt(max(2 * WANDER_LENGTH_M / spacing_m, 1.0))
    drift = (along_m - along_m.mean()) / max(float(along_m.std()), 1.0)
    constant = math.hypot(error_m, RECEIVER_FLOOR_M)
    effects = np.column_stack([HABIT_SD_M * np.ones(count), constant * normal, error_m * drift])
    covariance = wander_m**2 * np.eye(count) + effects @ effects.T
    solved = np.linalg.solve(covariance, np.column_stack([design, beside_m]))
    return design.T @ solved[:, :4], design.T @ solved[:, 4]


@dataclass(slots=True)
class StretchEntry:
    """Mean evidence of one vehicle in the current test, about the middle of the stretch."""

    vehicle: str
    information: Floats
    weighted: Floats
    passes: int = 1


@dataclass(slots=True)
class _Running:
    """Hypotheses after some vehicles: of H first the correct survey, then shifts, then turns."""

    totals: Floats  # shape (H,): [nat] logarithms of likelihood ratios against the first
    # `information`, `weighted`: shape (H, 4, 4), (H, 4): sums over vehicles
    information: Floats
    weighted: Floats
    # `squares`, `drives`: sum of the squared deviations of drives from their prediction, in variances; their number
    squares: float = 0.0
    drives: float = 0.0
    supporters: int = 0  # vehicles that speak against a correct survey

    @classmethod
    def new(cls) -> _Running:
        count = 1 + 2 * len(SHIFT_SD_M)
        return cls(np.zeros(count), np.zeros((count, 4, 4)), np.zeros((count, 4)))

    def copy(self) -> _Running:
        arrays = (self.totals.copy(), self.information.copy(), self.weighted.copy())
        return _Running(*arrays, self.squares, self.drives, self.supporters)

    def posterior(self, prior_precision: Floats) -> tuple[Floats, Floats]:
        """Means and covariances, shape (H, 4) and (H, 4, 4)."""
        covariance = np.linalg.inv(prior_precision + self.information)
        return np.einsum("hij,hj->hi", covariance, self.weighted), np.asarray(covariance, np.float64)

    def add(self, entry: StretchEntry, prior_precision: Floats, bound: float) -> None:
        """Predict a vehicle by each hypothesis, compare the predictions, and learn from it.

        A vehicle whose receiver has a fault of its own is as likely under all hypotheses; each learns from it by the
        probability that it has none. The variances of drives are scaled by how earlier ones scattered.
        """
        scale = max((_SCALE_DRIVES + self.squares) / (_SCALE_DRIVES + self.drives), _MIN_SCALE)
        information, weighted = entry.information / scale, entry.weighted / scale
        mean, covariance = self.posterior(prior_precision)
        stray = np.diag([STRAY_SD_M, STRAY_SD_M, STRAY_SD_M, 0.0]) ** 2
        as_usual = math.log(1.0 - STRAY_SHARE) + _predicted(mean, covariance, information, weighted)
        as_stray = math.log(STRAY_SHARE) + _predicted(mean, covariance + stray, information, weighted)
        likelihood = np.logaddexp(as_usual, as_stray)
        trust = np.exp(as_usual - likelihood)
        gain = np.clip(likelihood - likelihood[0], -bound - 2.0, bound)
        self._learn_scatter(entry, mean, covariance)
        self.totals += gain
        self.supporters += bool(gain.max() > 0.0)
        self.information += trust[:, None, None] * information
        self.weighted += trust[:, None] * weighted
        most = self.information[:, 0, 0] + self.information[:, 1, 1]
        kept = np.minimum(1.0, MEMORY_SD_M**-2 / np.maximum(most, 1e-9))
        self.information *= kept[:, None, None]
        self.weighted *= kept[:, None]

    def _learn_scatter(self, entry: StretchEntry, mean: Floats, covariance: Floats) -> None:
        """Squared deviation of a vehicle from the likeliest hypothesis, in the direction that it shows best."""
        likeliest = int(np.argmax(self.totals))
        values, vectors = np.linalg.eigh(entry.information)
        value, vector = float(values[-1]), vectors[:, -1]
        deviation = float(vector @ (entry.weighted - entry.information @ mean[likeliest]))
        variance = value + value**2 * float(vector @ covariance[likeliest] @ vector)
        self.squares += min(deviation**2 / variance, _MAX_SQUARE)
        self.drives += 1.0


def _predicted(mean: Floats, covariance: Floats, information: Floats, weighted: Floats) -> Floats:
    """Logarithm of a drive's likelihood by predictions, but for a term that all have in common, shape (H,). [nat]"""
    ahead = np.eye(4) + covariance @ information
    rest = weighted - mean @ information
    spread = np.linalg.solve(ahead, np.einsum("hij,hj->hi", covariance, rest)[:, :, None])[:, :, 0]
    explained = np.einsum("hi,hi->h", rest, spread)
    own = mean @ weighted - 0.5 * np.einsum("hi,ij,hj->h", mean, information, mean)
    return np.asarray(own + 0.5 * explained - 0.5 * np.linalg.slogdet(ahead)[1])


@dataclass(slots=True)
class StretchState:
    """Evidence on one stretch."""

    # `lon_deg`, `lat_deg`: [deg] its middle, about which a turn is stated
    lon_deg: float
    lat_deg: float
    heading_deg: float  # [deg] of the first drive
    earlier: _Running = field(default_factory=_Running.new)  # vehicles that are no longer kept one by one
    entries: list[StretchEntry] = field(default_factory=list)
    # `forward`, `backward`: drives in the direction of the first one, and against it
    forward: int = 0
    backward: int = 0
    survey_m: float = 0.0  # [m] of the last drive
    ratios: dict[str, float] = field(default_factory=dict)  # [nat] of each fault
    passes: int = 0
    month_passes: float = 0.0  # as of `MarkerState`
    since_s: float = 0.0  # when the current test began. [s since 1970]
    last_s: float = 0.0

    @classmethod
    def from_document(cls, document: JsonObject) -> StretchState:
        """The state that `document` stored."""
        earlier: JsonObject = {
            name: np.array(value, dtype=np.float64) if isinstance(value, list) else value
            for name, value in document["earlier"].items()
        }
        entries = [
            StretchEntry(
                one["vehicle"], np.array(one["information"], np.float64), np.array(one["weighted"], np.float64),
                one["passes"],
            )
            for one in document["entries"]
        ]  # fmt: skip
        return cls(**{**document, "earlier": _Running(**earlier), "entries": entries})

    def document(self) -> JsonObject:
        """The state as JSON values."""

        def short(value: object) -> object:
            return _short(value) if isinstance(value, np.ndarray) else value

        found = asdict(self)
        found["earlier"] = {name: short(value) for name, value in found["earlier"].items()}
        found["entries"] = [{name: short(value) for name, value in one.items()} for one in found["entries"]]
        return found

    def reset(self) -> None:
        """Start the test again: a person has decided, or the stretch was accepted as correct. Its scatter is kept."""
        running, self.entries = self.earlier, []
        self.earlier = _Running.new()
        self.earlier.squares, self.earlier.drives = running.squares, running.drives
        self.ratios, self.forward, self.backward = {}, 0, 0
        self.since_s = self.last_s


def update_stretch(
    state: StretchState, drive: StretchDrive, vehicle: str, at_s: float, rules: StretchRules = STRETCH_RULES
) -> Verdict | None:
    """Add a drive to the test of its stretch.

    Parameters
    ----------
    state : StretchState
        Changed in place.
    drive : StretchDrive
        Of `stretch_drive`.
    vehicle : str
        Who drove: its drives count as one, because they share the errors of its receiver and its driver.
    at_s : float
        When it was driven. [s since 1970]

    Returns
    -------
    Verdict or None
        A shift or a turn that is suspected now.
    """
    aged = math.exp(-max(at_s - state.last_s, 0.0) / MONTH_S) if state.passes else 0.0
    state.month_passes, state.passes = state.month_passes * aged + 1.0, state.passes + 1
    state.last_s, state.survey_m = max(state.last_s, at_s), drive.survey_m
    state.since_s = state.since_s or at_s
    is_forward = math.cos(math.radians(drive.heading_deg - state.heading_deg)) >= 0.0
    state.forward, state.backward = state.forward + is_forward, state.backward + (not is_forward)
    _add_entry(state, drive, vehicle)
    prior = _prior_precision(max(TOLERANCE_SD_M, state.survey_m))
    if len(state.entries) > MAX_STRETCH_VEHICLES:
        state.earlier.add(state.entries.pop(0), prior, rules.vehicle_bound)
    running = state.earlier.copy()
    for entry in state.entries:
        running.add(entry, prior, rules.vehicle_bound)
    share, count = np.log(SHIFT_SHARE), len(SHIFT_SD_M)
    shift = float(np.logaddexp.reduce(running.totals[1 : 1 + count] + share))
    turn = float(np.logaddexp.reduce(running.totals[1 + count :] + share))
    if max(shift, turn) <= rules.lower:
        state.earlier.squares, state.earlier.drives = running.squares, running.drives
        state.reset()
        return None
    state.ratios = {str(Fault.SHIFTED): shift, str(Fault.TURNED): turn - max(shift, 0.0)}
    limit = rules.upper(state.month_passes)
    if running.supporters < rules.vehicles or max(shift, turn) < limit:
        return None
    return _displaced(state, running, prior, limit, rules)


def _add_entry(state: StretchState, drive: StretchDrive, vehicle: str) -> None:
    information, weighted = drive.about(state.lon_deg, state.lat_deg)
    for entry in state.entries:
        if entry.vehicle == vehicle:
            entry.passes += 1
            share = 1.0 / min(entry.passes, _MAX_SHARED_PASSES)
            entry.information = entry.information + share * (information - entry.information)
            entry.weighted = entry.weighted + share * (weighted - entry.weighted)
            return
    state.entries.append(StretchEntry(vehicle, information, weighted))


def _prior_precision(tolerance_m: float) -> Floats:
    """Precisions of the four unknowns by each hypothesis, shape (H, 4, 4). [1/m2]"""
    sizes = [(tolerance_m, tolerance_m)]
    sizes += [(size, tolerance_m) for size in SHIFT_SD_M]
    sizes += [(size, size) for size in SHIFT_SD_M]
    deviations = np.array([(shift, shift, turn, COMMON_HABIT_SD_M) for shift, turn in sizes])
    return deviations[:, :, None] ** -2.0 * np.eye(4)


def _displaced(
    state: StretchState, running: _Running, prior: Floats, limit: float, rules: StretchRules
) -> Verdict | None:
    """The displacement by the widest hypothesis of what is suspected; None where it is too small to matter."""
    fault = Fault.TURNED if state.ratios[Fault.TURNED] >= limit else Fault.SHIFTED
    if state.ratios[fault] < limit:
        return None
    mean, covariance = running.posterior(prior)
    which = -1 if fault is Fault.TURNED else len(SHIFT_SD_M)
    east_m, north_m, turn_m, _habit = (float(value) for value in mean[which])
    own = covariance[which]
    size_m = math.hypot(east_m, north_m)
    if max(size_m, abs(turn_m) if fault is Fault.TURNED else 0.0) < rules.min_m:
        return None
    shift = np.array([east_m, north_m])
    sigma = np.sqrt(np.diag(own))
    in_sigmas = math.sqrt(float(shift @ np.linalg.solve(own[:2, :2], shift)))
    found = Displacement(
        east_m, north_m, float(sigma[0]), float(sigma[1]), size_m / max(in_sigmas, 1e-9),
        math.degrees(turn_m / TURN_REACH_M), math.degrees(float(sigma[2]) / TURN_REACH_M),
        1 + (state.forward > 0 and state.backward > 0),
    )  # fmt: skip
    return Verdict(
        fault, state.ratios[fault], limit, running.supporters, state.forward + state.backward, state.since_s,
        (east_m, north_m), displacement=found,
    )  # fmt: skip
