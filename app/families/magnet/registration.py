"""Magnets that are to be registered, as their use case knows them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar

from pyproj import Geod

from app.families.magnet.layouts import MAX_MAGNETS, LaneInput, PlacedLine, PlacedTag
from app.families.new_marker import NewMarker
from app.markers.magnet import LineStyle

MAX_TAG_MAGNETS = 7  # source: `TagDesign`, seven magnets
_GEOD = Geod(ellps="WGS84")


@dataclass(frozen=True, slots=True)
class TagInput:
    """An information tag to place, named by its text or by its meaning in a codebook."""

    place: PlacedTag
    code: str | None = None
    codebook_id: str | None = None
    meaning: tuple[str, float | str] | None = None


@dataclass(frozen=True, slots=True)
class LineInput:
    """A line of line tags to place."""

    place: PlacedLine
    style: LineStyle


@dataclass(frozen=True, slots=True)
class NewMagnets(NewMarker):
    """A tag or a line of magnets to register."""

    family: ClassVar[str] = "magnet"
    lane: LaneInput
    what: TagInput | LineInput
    site: dict[str, Any] = field(default_factory=dict)

    @property
    def part_count(self) -> int:
        """Magnets of a line, from its length; up to those that one marker may have."""
        if isinstance(self.what, TagInput):
            return MAX_TAG_MAGNETS
        first, second = zip(*self.lane.coordinates, strict=True)
        length_m = _GEOD.line_length(first, second) if not self.lane.projected else _plane_length(first, second)
        place = self.what.place
        to_m = length_m if place.to_m is None else min(place.to_m, length_m)
        count = (to_m - place.from_m) / place.spacing_m if place.spacing_m > 0 else math.inf
        return 1 + math.ceil(min(max(count, 0.0), MAX_MAGNETS))


def _plane_length(east: tuple[float, ...], north: tuple[float, ...]) -> float:
    return sum(math.dist(one, other) for one, other in pairwise(zip(east, north, strict=True)))
