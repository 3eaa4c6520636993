"""Magnets in their order -> line crossings and information tags."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.book import Match, TagBook
from app.decoders.magnet.readings import LineCrossing, MagnetReading, Side, TagReading
from app.markers.magnet import MAX_LINE_SPACING_M, LineStyle, LineTag, Orientation, Polarity

Floats = npt.NDArray[np.float64]

LONGEST_GAP_M = 6.5
"""Magnets of one tag stand at most so far apart, unless a book of tags says otherwise."""
_SPEED_ERROR = 0.002
"""Share by which the speed may drift between two gaps of a tag."""
_SAME_LANE_CM = 70.0


@dataclass(frozen=True, slots=True, eq=False)
class PlacedMagnet:
    """A magnet's reading and where it lies on the plane."""

    reading: MagnetReading
    place_m: Floats


class Assembler:
    """Groups magnets as they come.

    Parameters
    ----------
    book : TagBook
        Tags that may be on the road; an empty one groups by gaps alone.
    """

    def __init__(self, book: TagBook) -> None:
        self._book = book
        self._row: list[PlacedMagnet] = []
        self._lines: list[MagnetReading] = []
        self._longest_m = book.longest_gap_m or LONGEST_GAP_M

    def add(self, magnet: PlacedMagnet) -> list[LineCrossing | TagReading]:
        """Findings that a further magnet completes."""
        if magnet.reading.orientation is Orientation.UP:
            return self._cross(magnet.reading)
        found = self.pass_by(magnet.reading.odometer_m)
        self._row.append(magnet)
        return [*found, *self._complete()]

    def pass_by(self, odometer_m: float) -> list[LineCrossing | TagReading]:
        """Findings that are complete because nothing came for a while."""
        if self._row and odometer_m - self._row[-1].reading.odometer_m > self._longest_m * 1.05 + 0.3:
            return self.finish()
        return []

    def finish(self) -> list[LineCrossing | TagReading]:
        """What the magnets so far are."""
        found: list[LineCrossing | TagReading] = []
        while self._row:
            match = self._book.best_match(self._row) if self._book else None
            if match is None:
                if len(self._row) > 1 and not found:
                    found.append(make_reading(self._row, None))
                self._row = []
            else:
                found.append(make_reading(self._row, match))
                self._row = self._row[match.members[-1] + 1 :]
        return found

    def _complete(self) -> list[LineCrossing | TagReading]:
        """A tag that is whole, where no longer one could still come of it."""
        if not self._book or len(self._row) < 2:
            return []
        match = self._book.best_match(self._row)
        if match is None or match.missing or match.members[-1] != len(self._row) - 1:
            return []
        length = math.dist(self._row[match.members[0]].place_m, self._row[-1].place_m)
        if length < self._book.longest_m * 0.95 - 0.1:
            return []
        reading = make_reading(self._row, match)
        self._row = []
        return [reading]

    def _cross(self, magnet: MagnetReading) -> list[LineCrossing | TagReading]:
        reach = 1.5 * MAX_LINE_SPACING_M
        self._lines = [m for m in self._lines if magnet.odometer_m - m.odometer_m < reach]
        known = [
            m
            for m in self._lines
            if m.polarity is magnet.polarity and abs(m.lateral_cm - magnet.lateral_cm) < _SAME_LANE_CM
        ]
        self._lines = [m for m in self._lines if m not in known] + [magnet]
        if known:
            return []
        style: LineStyle = LineTag(magnet.polarity).style
        side = Side.LEFT if magnet.lateral_cm >= 0 else Side.RIGHT
        return [LineCrossing(magnet.t_s, magnet.odometer_m, style, side, magnet.lateral_cm, magnet.confidence)]


def make_reading(row: Sequence[PlacedMagnet], match: Match | None) -> TagReading:
    """The reading of a row of magnets, as the tag that was matched or as it is."""
    members = [row[i] for i in match.members] if match else list(row)
    readings = tuple(m.reading for m in members)
    gaps = tuple(math.dist(a.place_m, b.place_m) for a, b in pairwise(members))
    std = tuple(
        math.hypot(a.along_std_m, b.along_std_m, _SPEED_ERROR * gap)
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
