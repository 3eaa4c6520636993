"""A plate that is to be registered, as its use case knows it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from app.families.inputs import PositionIn
from app.families.new_marker import NewMarker
from app.markers.plate import PlateGeometry, PlateScheme
from app.markers.recommended_plate import RECOMMENDED_SCHEME


@dataclass(frozen=True, slots=True)
class CodeInput:
    """The code that a plate is to have."""

    scheme: PlateScheme = RECOMMENDED_SCHEME
    digits: str | None = None
    check_digits: int | None = None
    registry_number: int | None = None
    allow_mismatched_digits: bool = False


@dataclass(frozen=True, slots=True)
class NewPlate(NewMarker):
    """A plate to register."""

    family: ClassVar[str] = "plate"
    position: PositionIn
    code: CodeInput = field(default_factory=CodeInput)
    geometry: PlateGeometry = field(default_factory=PlateGeometry)
    heading_deg: float | None = None
