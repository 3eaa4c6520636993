"""The drilling sheet: a layout with its checks and its costs, for the writers."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from app.encoders.magnet.bill import Bill
from app.encoders.magnet.layout import MagnetLayout
from app.markers.checks import Check


class SheetFormat(StrEnum):
    """What a drilling sheet can be written as; the value is the file's extension."""

    PDF = "pdf"
    CSV = "csv"
    GEOJSON = "geojson"

    @property
    def media_type(self) -> str:
        """For HTTP's Content-Type."""
        return {"pdf": "application/pdf", "csv": "text/csv; charset=utf-8", "geojson": "application/geo+json"}[self]


@dataclass(frozen=True, slots=True, eq=False)
class DrillingSheet:
    """What the crew, the planner and the buyer need of one layout; `holes` is what the agency states of the holes."""

    layout: MagnetLayout
    checks: tuple[Check, ...]
    bill: Bill
    holes: str = ""

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)
