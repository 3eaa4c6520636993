"""Bill of materials of a layout, compared with what else could mark the road."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources

from app.encoders.magnet.layout import MagnetLayout
from app.markers.magnet import InformationTag

_MAGNET = "magnet with shell"
_PAINT = "paint or thermoplastic marking"
_RFID = "rugged RFID tag"


@dataclass(frozen=True, slots=True)
class UnitCost:
    """What one of something costs, from the cheapest to the dearest. [USD]"""

    item: str
    unit: str
    low_usd: float
    high_usd: float
    source: str


@dataclass(frozen=True, slots=True)
class CostRow:
    """A quantity of something and what it costs. [USD]"""

    cost: UnitCost
    quantity: float

    @property
    def low_usd(self) -> float:
        """At the lowest price. [USD]"""
        return round(self.quantity * self.cost.low_usd, 2)

    @property
    def high_usd(self) -> float:
        """At the highest price. [USD]"""
        return round(self.quantity * self.cost.high_usd, 2)


@dataclass(frozen=True, slots=True)
class Bill:
    """Materials of a layout and their alternatives.

    Attributes
    ----------
    materials : tuple of CostRow
        What is bought: the magnets in their shells.
    alternatives : tuple of CostRow
        Paint along the same length; for an information tag also one rugged RFID tag.
    """

    materials: tuple[CostRow, ...]
    alternatives: tuple[CostRow, ...]

    @property
    def total_usd(self) -> float:
        """Materials, at the highest price. [USD]"""
        return round(sum(row.high_usd for row in self.materials), 2)

    @property
    def paint(self) -> CostRow:
        """Paint or thermoplastic over the same length."""
        return next(row for row in self.alternatives if row.cost.item == _PAINT)


@lru_cache(maxsize=1)
def unit_costs() -> dict[str, UnitCost]:
    """Unit costs that the METRO paper gives, by item (section 8.1 and table 2)."""
    text = (resources.files("app.encoders.magnet") / "data" / "costs.csv").read_text("utf-8")
    rows = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    return {
        row["item"]: UnitCost(row["item"], row["unit"], float(row["low"]), float(row["high"]), row["source"])
        for row in rows
    }


def bill_of_materials(layout: MagnetLayout) -> Bill:
    """What a layout costs in materials, beside paint of the same length."""
    costs = unit_costs()
    alternatives = [CostRow(costs[_PAINT], round(layout.length_m, 2))]
    if isinstance(layout.tag, InformationTag):
        alternatives.append(CostRow(costs[_RFID], 1))
    return Bill((CostRow(costs[_MAGNET], len(layout.holes)),), tuple(alternatives))
