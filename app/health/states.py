"""State of the tests of a marker and of a vehicle's own errors, as they are stored."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from app.health.passes import LonLat
from app.health.rules import READING_LEVELS

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
    """Evidence on one marker.

    Attributes
    ----------
    family : str
    ratios : dict of str to float
        Logarithm of the likelihood ratio of each fault that has evidence. [nat]
    shares : dict of str to dict
        What each vehicle added to the current test, by fault: missing, wrong-way, fading and unregistered.
    levels : list of float
        Probabilities of the factors of `READING_LEVELS` by the marker's own record.
    offsets : list of OffsetEntry
        Of the current test for a moved marker, oldest first.
    survey_m : float
        Standard deviation of the registered position, each axis. [m]
    far : list of FarEntry
    quality, quality_passes : float
        Mean quality of the record, and on how many passes it rests.
    passes, reads : int
        In all.
    month_passes : float
        Passes that count less the longer ago they were, by the factor e in 30 days.
    first_s, last_s, read_s : float
        First and last pass, and last reading at its place. [s since 1970]
    since : dict of str to float
        When the current evidence of a fault began. [s since 1970]
    """

    family: str = ""
    ratios: dict[str, float] = field(default_factory=dict)
    shares: dict[str, dict[str, float]] = field(default_factory=dict)
    levels: list[float] = field(default_factory=list)
    offsets: list[OffsetEntry] = field(default_factory=list)
    survey_m: float = 0.0
    far: list[FarEntry] = field(default_factory=list)
    quality: float = 0.0
    quality_passes: float = 0.0
    passes: int = 0
    reads: int = 0
    month_passes: float = 0.0
    first_s: float = 0.0
    last_s: float = 0.0
    read_s: float = 0.0
    since: dict[str, float] = field(default_factory=dict)

    @classmethod
    def new(cls, family: str) -> MarkerState:
        """A marker of a family without evidence."""
        return cls(family=family, levels=list(READING_LEVELS.get(family, READING_LEVELS["magnet"])[1]))

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> MarkerState:
        """The state that `document` stored."""
        far = [
            FarEntry(entry["vehicle"], entry["at_s"], None if entry["place"] is None else tuple(entry["place"]))
            for entry in document["far"]
        ]
        return cls(**{**document, "offsets": [OffsetEntry(**entry) for entry in document["offsets"]], "far": far})

    def document(self) -> dict[str, Any]:
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
"""[s] for which a vehicle's readings are evidence that its sensors work. Source: by hand, some kilometres of road."""
SHIFT_PRIOR_M = 0.5
"""[m] standard deviation of the shift of a vehicle without a record, each axis. Source: by hand: a camera that is
turned by 3 degrees shifts a plate at 10 m by this."""
SHIFT_FLOOR_M = 0.1
"""[m] by which a vehicle's shift changes from pass to pass, each axis. Source: chosen by hand."""
_MAX_RECORD = 30.0  # passes; source: chosen by hand, a camera is touched between drives
_STEP_M = 0.3  # [m] at most by one pass, so that a marker that has moved teaches little; source: chosen by hand


@dataclass(slots=True)
class VehicleState:
    """A vehicle's own errors by its last passes.

    Attributes
    ----------
    forward_m, left_m, offsets : float
        Mean offset in the vehicle's frame, and on how many passes it rests. [m]
    reads, expected : float
        Of the last minutes, decaying.
    at_s : float
        Of the last pass. [s since 1970]
    """

    forward_m: float = 0.0
    left_m: float = 0.0
    offsets: float = 0.0
    reads: float = 0.0
    expected: float = 0.0
    at_s: float = 0.0

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

    def document(self) -> dict[str, Any]:
        """The state as JSON values."""
        return asdict(self)
