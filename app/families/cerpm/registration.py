"""A CERPM that is to be registered, as its use case knows it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from app.families.inputs import PositionIn
from app.families.new_marker import NewMarker
from app.markers.cerpm import LaneSide, SpeedLimit
from app.radio.settings import RadioSettings


@dataclass(frozen=True, slots=True)
class NewCerpm(NewMarker):
    """A CERPM to register."""

    family: ClassVar[str] = "cerpm"
    position: PositionIn
    number: int | None = None
    side: LaneSide = LaneSide.UNKNOWN
    speed_limit: SpeedLimit | None = None
    dev_eui: str | None = None
    radio: RadioSettings = field(default_factory=RadioSettings)
    heading_deg: float | None = None
