"""The drilling sheet: a layout with what was checked and what it costs, for the writers."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from app.encoders.magnet.checks import Check, Site, check_layout
from app.encoders.magnet.costs import Bill, bill_of_materials
from app.encoders.magnet.layout import MagnetLayout


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
    """What the crew, the planner and the buyer need of one layout."""

    layout: MagnetLayout
    checks: tuple[Check, ...]
    bill: Bill

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)


def drilling_sheet(layout: MagnetLayout, site: Site | None = None) -> DrillingSheet:
    """Check a layout and count its materials."""
    return DrillingSheet(layout, check_layout(layout, site or Site()), bill_of_materials(layout))
