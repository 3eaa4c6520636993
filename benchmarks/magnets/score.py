"""Findings compared with the true magnets and tags."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from app.decoders.magnet.readings import Finding, MagnetReading, TagReading
from app.markers.magnet import Orientation
from app.simulation.magnetic.drive import SimulatedDrive, TrueMagnet

REACH_M = 0.4
UNDER_CM = 88.0


@dataclass
class Tally:
    """Counts over magnets that pass under the bar."""

    true: int = 0
    found: int = 0
    wrong: int = 0
    extra: int = 0
    lateral_cm: list[float] = field(default_factory=list)

    @property
    def recall(self) -> float:
        """Share found with the right polarity and orientation."""
        return self.found / max(self.true, 1)

    @property
    def precision(self) -> float:
        """Share of the readings that are right."""
        return self.found / max(self.found + self.wrong + self.extra, 1)

    def add(self, other: Tally) -> None:
        """Add another drive's."""
        self.true += other.true
        self.found += other.found
        self.wrong += other.wrong
        self.extra += other.extra
        self.lateral_cm += other.lateral_cm


def score_magnets(drive: SimulatedDrive, findings: Sequence[Finding], only: Orientation | None = None) -> Tally:
    """Readings matched to the nearest magnet within `REACH_M`; with `only`, magnets of that kind and readings of it."""
    readings = sorted((r for r in findings if isinstance(r, MagnetReading)), key=lambda r: r.t_s)
    times = np.array([r.t_s for r in readings])
    used: set[int] = set()
    tally = Tally()
    for magnet in drive.magnets:
        if (only is not None and magnet.orientation is not only) or abs(magnet.lateral_cm) > UNDER_CM:
            continue
        tally.true += 1
        k = _nearest(magnet, readings, times, used)
        if k is None:
            continue
        used.add(k)
        reading = readings[k]
        if reading.polarity is magnet.polarity and reading.phi_deg is magnet.orientation:
            tally.found += 1
            tally.lateral_cm.append(reading.lateral_cm - magnet.lateral_cm)
        else:
            tally.wrong += 1
    at_edge = [m for m in drive.magnets if abs(m.lateral_cm) > UNDER_CM]
    for k, reading in enumerate(readings):
        near = any(abs(reading.t_s - m.t_s) * m.speed_m_s < REACH_M for m in at_edge)
        other = only is not None and any(
            abs(reading.t_s - m.t_s) * m.speed_m_s < REACH_M for m in drive.magnets if m.orientation is not only
        )
        tally.extra += k not in used and not near and not other
    return tally


def _nearest(magnet: TrueMagnet, readings: Sequence[MagnetReading], times: np.ndarray, used: set[int]) -> int | None:
    reach = REACH_M / magnet.speed_m_s
    low, high = np.searchsorted(times, (magnet.t_s - reach, magnet.t_s + reach))
    apart_m = {
        k: math.hypot(
            (readings[k].t_s - magnet.t_s) * magnet.speed_m_s, (readings[k].lateral_cm - magnet.lateral_cm) / 100
        )
        for k in range(low, high)
        if k not in used
    }
    near = [k for k in apart_m if apart_m[k] < REACH_M]
    return min(near, key=lambda k: apart_m[k], default=None)


@dataclass
class TagTally:
    """Counts over tags, and deviation ratios: measured over true ratio."""

    true: int = 0
    right: int = 0
    wrong: int = 0
    deviations: list[float] = field(default_factory=list)

    def add(self, other: TagTally) -> None:
        """Add another drive's."""
        self.true += other.true
        self.right += other.right
        self.wrong += other.wrong
        self.deviations += other.deviations


def score_tags(drive: SimulatedDrive, findings: Sequence[Finding], *, segment_m: float | None = None) -> TagTally:
    """Tags with the right polarities and places; with a segment, places are what the measured ratios round to."""
    readings = [r for r in findings if isinstance(r, TagReading)]
    tally = TagTally()
    claimed: set[int] = set()
    for number, placed in enumerate(drive.tags):
        magnets = [m for m in drive.magnets if m.tag == number]
        if len(magnets) < placed.tag.magnet_count:
            continue
        tally.true += 1
        first = magnets[0]
        near = [k for k, r in enumerate(readings) if abs(r.start_s - first.t_s) * first.speed_m_s < 0.6]
        if not near:
            continue
        claimed.update(near)
        reading = readings[near[0]]
        polarities = tuple(m.polarity for m in magnets)
        if segment_m is None:
            right = reading.tag is not None and reading.tag == placed.tag
        else:
            at = np.cumsum((0.0, *reading.gaps_m)) / max(sum(reading.gaps_m), 1e-9) * placed.tag.length_m
            wanted = placed.tag.offsets_m
            right = reading.polarities == polarities and len(at) == len(wanted)
            right = right and bool(np.all(np.abs(at - wanted) < segment_m / 2))
        tally.right += right
        tally.wrong += not right and (reading.tag is not None or segment_m is not None)
        if reading.polarities == polarities and len(reading.ratios) == len(placed.tag.ratios):
            tally.deviations += [a / b for a, b in zip(reading.ratios, placed.tag.ratios, strict=True)]
    tally.wrong += sum(r.tag is not None for k, r in enumerate(readings) if k not in claimed)
    return tally
