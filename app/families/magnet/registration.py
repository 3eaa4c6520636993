"""Magnets that are to be registered, as their use case knows them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from app.families.magnet.layouts import LaneInput, PlacedLine, PlacedTag
from app.families.new_marker import NewMarker
from app.markers.magnet import LineStyle


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
