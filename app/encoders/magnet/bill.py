"""Bill of materials of a layout: quantities, unit costs and totals."""

from __future__ import annotations

from dataclasses import dataclass

PAINT = "paint or thermoplastic marking"


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
        return next(row for row in self.alternatives if row.cost.item == PAINT)
