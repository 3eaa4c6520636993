"""Rules, results and stored states of the tests of a marker, and of a vehicle's own errors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum

from app.values import JsonObject

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
