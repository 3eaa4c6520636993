"""A marker that is to be registered: what every family asks for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from app.families.rules import PLANNED


@dataclass(frozen=True, slots=True, kw_only=True)
class NewMarker:
    """Members that markers of every family have; each family adds its own.

    Attributes
    ----------
    family : str
        Name of the family.
    status : str
    heading_rmse_deg : float or None
    road : str or None
    measure_m, offset_m : float or None
    kind, reason : str or None
        Kind of the first version in the marker's history, and why it was made.
    """

    family: ClassVar[str]
    status: str = PLANNED
    heading_rmse_deg: float | None = None
    road: str | None = None
    measure_m: float | None = None
    offset_m: float | None = None
    kind: str | None = None
    reason: str | None = None

    @property
    def part_count(self) -> int:
        """Things in the road that the marker has at most, e.g. magnets: what its registration costs."""
        return 1
