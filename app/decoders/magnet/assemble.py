"""Magnets in the order of the road, grouped to line crossings and information tags."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.identify import Identification, TagCandidates
from app.decoders.magnet.readings import LineCrossing, MagnetReading, PlacedMagnet, Side, TagReading
from app.markers.magnet import MAX_LINE_SPACING_M, LineStyle, LineTag, Orientation, Polarity

Floats = npt.NDArray[np.float64]

MAX_GAP_M = 6.5
"""Largest distance between two magnets of a tag where the candidates have none. [m] Source: chosen by hand, more than
the 6 m of METRO section 6.3."""
_GAP_FACTOR, _GAP_SPARE_M = 1.05, 0.3  # a row ends after so many largest gaps, and metres more; source: by hand
_MIN_LENGTH_SHARE, _MIN_LENGTH_SPARE_M = 0.95, 0.1  # shortest row that no longer tag can still be; source: by hand
_SPEED_STD = 0.002  # share by which the speed may drift between two gaps of a tag; source: by hand, 0.2 %
_LINE_REACH = 1.5  # distance of two magnets of one line over the largest allowed one; source: by hand, one missed
_SAME_LINE_CM = 70.0  # [cm] lateral distance up to which magnets are of one line; source: by hand, a weaving vehicle


class TagAssembler:
    """Groups magnets as they come.

    Parameters
    ----------
    candidates : TagCandidates
        Tags that may be on the road; an empty one groups by gaps alone.
    """

    def __init__(self, candidates: TagCandidates) -> None:
        self._candidates = candidates
        self._row: list[PlacedMagnet] = []
        self._lines: list[MagnetReading] = []
        self._longest_m = candidates.longest_gap_m or MAX_GAP_M

    def add(self, magnet: PlacedMagnet) -> list[LineCrossing | TagReading]:
        """Findings that a further magnet completes."""
        if magnet.reading.orientation is Orientation.UP:
            return self._cross(magnet.reading)
        found = self.pass_by(magnet.reading.odometer_m)
        self._row.append(magnet)
        return [*found, *self._complete()]

    def pass_by(self, odometer_m: float) -> list[LineCrossing | TagReading]:
        """Findings that are complete because nothing came for a while."""
        if self._row and odometer_m - self._row[-1].reading.odometer_m > _GAP_FACTOR * self._longest_m + _GAP_SPARE_M:
            return self.finish()
        return []

    def finish(self) -> list[LineCrossing | TagReading]:
        """Findings of the magnets so far, which no further one joins."""
        found: list[LineCrossing | TagReading] = []
        while self._row:
            match = self._candidates.identify(self._row) if self._candidates else None
            if match is None:
                if len(self._row) > 1 and not found:
                    found.append(make_reading(self._row, None))
                self._row = []
            else:
                found.append(make_reading(self._row, match))
                self._row = self._row[match.members[-1] + 1 :]
        return found

    def _complete(self) -> list[LineCrossing | TagReading]:
        """A whole tag at the end of the row that cannot be the beginning of a longer one."""
        if not self._candidates or len(self._row) < 2:
            return []
        match = self._candidates.identify(self._row)
        if match is None or match.missing or match.members[-1] != len(self._row) - 1:
            return []
        length = math.dist(self._row[match.members[0]].place_m, self._row[-1].place_m)
        if length < _MIN_LENGTH_SHARE * self._candidates.longest_m - _MIN_LENGTH_SPARE_M:
            return []
        reading = make_reading(self._row, match)
        self._row = []
        return [reading]

    def _cross(self, magnet: MagnetReading) -> list[LineCrossing | TagReading]:
        """A line crossing, at the first magnet of a line."""
        reach = _LINE_REACH * MAX_LINE_SPACING_M
        self._lines = [m for m in self._lines if magnet.odometer_m - m.odometer_m < reach]
        known = [
            m
            for m in self._lines
            if m.polarity is magnet.polarity and abs(m.lateral_cm - magnet.lateral_cm) < _SAME_LINE_CM
        ]
        self._lines = [m for m in self._lines if m not in known] + [magnet]
        if known:
            return []
        style: LineStyle = LineTag(magnet.polarity).style
        side = Side.LEFT if magnet.lateral_cm >= 0 else Side.RIGHT
        return [LineCrossing(magnet.t_s, magnet.odometer_m, style, side, magnet.lateral_cm, magnet.confidence)]


def make_reading(row: Sequence[PlacedMagnet], match: Identification | None) -> TagReading:
    """The reading of a row of magnets, as the tag that was identified or without one."""
    members = [row[i] for i in match.members] if match else list(row)
    readings = tuple(m.reading for m in members)
    gaps = tuple(math.dist(a.place_m, b.place_m) for a, b in pairwise(members))
    std = tuple(
        math.hypot(a.relative_std_m, b.relative_std_m, _SPEED_STD * gap)
        for (a, b), gap in zip(pairwise(readings), gaps, strict=True)
    )
    ratios = tuple(g / gaps[0] for g in gaps[1:]) if gaps and gaps[0] > 0 else ()
    ratio_std = tuple(
        r * math.hypot(s / g, std[0] / gaps[0]) for r, g, s in zip(ratios, gaps[1:], std[1:], strict=True)
    )
    confidence = math.prod(r.confidence for r in readings)
    polarities: tuple[Polarity, ...] = tuple(r.polarity for r in readings)
    return TagReading(
        start_s=readings[0].t_s,
        end_s=readings[-1].t_s,
        polarities=polarities,
        gaps_m=gaps,
        gap_std_m=std,
        length_m=sum(gaps),
        ratios=ratios,
        ratio_std=ratio_std,
        lateral_cm=float(np.mean([r.lateral_cm for r in readings])),
        tag=match.tag if match else None,
        wrong_way=bool(match and match.wrong_way),
        missing=match.missing if match else 0,
        extra=match.extra if match else 0,
        confidence=confidence * (match.probability if match else 1.0),
        magnets=readings,
    )
