"""A fiducial sign that is to be registered, as its use case knows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from app.families.inputs import PositionIn
from app.families.new_marker import NewMarker
from app.markers.fiducial import FiducialCode, FiducialGeometry


@dataclass(frozen=True, slots=True)
class NewFiducial(NewMarker):
    """A fiducial sign to register."""

    family: ClassVar[str] = "fiducial"
    position: PositionIn
    code: FiducialCode
    geometry: FiducialGeometry
    heading_deg: float | None = None
