"""Faults of markers, and the limits of the tests for them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum


class Fault(StrEnum):
    """What can be wrong with a marker, or with what is registered of it."""

    MISSING = "missing"
    MOVED = "moved"
    CLONED = "cloned"
    WRONG_WAY = "wrong-way"
    FADING = "fading"
    UNREGISTERED = "unregistered"


TESTED = (Fault.MISSING, Fault.MOVED, Fault.CLONED, Fault.WRONG_WAY, Fault.FADING)
"""Tests of a registered marker; the sixth fault is of a code that is not registered."""

CLEAN, DIRTY = (1.0,), ((1.0, 0.6, 0.3), (0.90, 0.08, 0.02))
READING_LEVELS: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "plate": DIRTY,
    "fiducial": DIRTY,
    "magnet": (CLEAN, CLEAN),
    "cerpm": ((1.0, 0.5), (0.95, 0.05)),
}
"""Factors on the reading probability of a healthy marker and how common they are: dirt on faces, weak batteries;
nothing covers a magnet. Source: chosen by hand; `python -m benchmarks.health` draws its own."""


@dataclass(frozen=True, slots=True)
class HealthRules:
    """Error rates and bounds of the tests.

    Attributes
    ----------
    false_alarm_share : float
        Share of healthy markers that become suspects in a month of traffic, at most.
    lower : float
        Logarithm of the ratio at which a marker is accepted as healthy, and the test starts anew. [nat]
    vehicles : int
        Distinct vehicles without which no marker becomes a suspect.
    vehicle_bound : float
        What one vehicle adds to a test at most, however often it passes. [nat]
    month_passes : float
        Passes in a month that are assumed at least.
    moved_test_starts : float
        Share of the passes of healthy markers with which a test for a displacement begins.
    moved_m : float
        Smallest estimated displacement of a suspect. [m]
    disc_m : float
        A marker that stands this near to its registered position has not moved; two standard deviations of the survey
        where they are more. [m]
    """

    false_alarm_share: float = 1e-3  # source: the registry's requirement, one marker in a thousand
    lower: float = 0.0  # [nat] source: Page, Biometrika 41, 1954: tests in a row find a fault whenever it begins
    vehicles: int = 3  # source: chosen by hand; two may share a workshop, and so a wrong calibration
    vehicle_bound: float = 5.0  # [nat] source: by hand; at 10,000 passes a month four vehicles are needed, and five do
    month_passes: float = 100.0  # source: chosen by hand, three vehicles a day
    moved_test_starts: float = 0.01  # source: the scenes of `python -m benchmarks.health`: 0.6 to 1.2 %, once 2.3 %
    moved_m: float = 0.75  # [m] source: `python -m benchmarks.health`, finds 1.0 m in five passes
    disc_m: float = 0.25  # [m] source: by hand, what crews and surveys of roads are good to

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
