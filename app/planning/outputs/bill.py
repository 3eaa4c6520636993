"""Bill of materials and cost of a plan: quantities, and the agency's unit costs; no price is assumed."""

from __future__ import annotations

import io
import math
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

from app.encoders.magnet.bill import PAINT, CostRow
from app.encoders.magnet.sheet_csv import fixed
from app.formats.spreadsheet import TableWriter
from app.markers.cerpm import LaneSide
from app.planning.costs import unit_costs
from app.planning.plan import Plan, PlannedLineMagnet, PlannedPlate, PlannedTag
from app.planning.rules import CostItem

NO_UNIT_COST = "no unit cost given"
METRO_LABEL = "published figures for comparison, not the agency's prices"
COLUMNS = ("section", "family", "item", "quantity", "unit", "unit_cost", "cost", "currency", "pay_item", "note")
_LINE_TAGS, _INFORMATION_TAG, _RFID, _MAGNET = (
    "line tags at 6 m",
    "information tag of 3 magnets",
    "rugged RFID tag",
    "magnet with shell",
)  # items of app/planning/data/costs.csv
_CONTINUED = 3.0  # longest gap in a line of magnets, in spacings; source: chosen by hand, two magnets left out


@dataclass(frozen=True, slots=True)
class Material:
    """Something that is bought.

    Attributes
    ----------
    family, item : str
    quantity : int
    priced_by : tuple of str
        `CostItem.per` of the unit costs that cover it.
    priced : bool
        Whether the agency gives one of them.
    """

    family: str
    item: str
    quantity: int
    priced_by: tuple[str, ...]
    priced: bool


@dataclass(frozen=True, slots=True)
class BillRow:
    """One of the agency's unit costs with its quantity; quantity and cost are None where the quantity is unknown."""

    item: CostItem
    quantity: float | None

    @property
    def cost(self) -> float | None:
        """In the currency of the bill."""
        return None if self.quantity is None else round(self.quantity * self.item.price, 2)


@dataclass(frozen=True, slots=True)
class PlanBill:
    """Materials and costs of a plan.

    Attributes
    ----------
    currency : str
    materials : tuple of Material
    rows : tuple of BillRow
        In the order of the agency's list.
    comparisons : tuple of CostRow
        Figures that the METRO paper publishes, in US dollars. They are no part of the total.
    """

    currency: str
    materials: tuple[Material, ...]
    rows: tuple[BillRow, ...]
    comparisons: tuple[CostRow, ...]

    @property
    def total(self) -> float:
        """Of all rows with a cost."""
        return round(sum(row.cost for row in self.rows if row.cost is not None), 2)

    @property
    def missing(self) -> tuple[str, ...]:
        """Materials without a unit cost, and rows without a quantity."""
        unknown = [row.item.item for row in self.rows if row.quantity is None]
        return (*(material.item for material in self.materials if not material.priced), *unknown)

    @property
    def complete(self) -> bool:
        """Whether the total covers all materials."""
        return not self.missing

    @property
    def sentence(self) -> str:
        """The total for people."""
        amount = f"{self.total:,.2f} {self.currency}"
        return amount if self.complete else f"{amount}, incomplete: {NO_UNIT_COST} for {'; '.join(self.missing)}"


def plan_bill(plan: Plan) -> PlanBill:
    """Quantities of a plan, with the agency's unit costs."""
    costs = plan.rules.costs
    quantities = plan_quantities(plan)
    return PlanBill(
        costs.currency,
        _materials(plan, {item.per for item in costs.items}),
        tuple(BillRow(item, quantities[item.per]) for item in costs.items),
        _comparisons(plan, quantities),
    )


def plan_quantities(plan: Plan) -> dict[str, float | None]:
    """Quantity of each unit that prices are given per; days are whole, and None where no rate is given."""
    tags = [marker.detail.tag for marker in plan.markers if isinstance(marker.detail, PlannedTag)]
    lines = sum(isinstance(marker.detail, PlannedLineMagnet) for marker in plan.markers)
    magnets = lines + sum(tag.magnet_count for tag in tags)
    counts = plan.counts
    rate = plan.rules.costs.markers_per_day
    wanted = set(plan.rules.road.lanes or [lane.name for lane in plan.alignment.lanes])
    return {
        "plate": counts.get("plate", 0),
        "magnet": magnets,
        "tag": len(tags),
        "cerpm": counts.get("cerpm", 0),
        "hole": magnets,
        "marker": len(plan.markers),
        "metre_of_lane": round(sum(lane.length_m for lane in plan.alignment.lanes if lane.name in wanted), 3),
        "day": None if rate is None else math.ceil(len(plan.markers) / rate - 1e-9),
        "plan": 1,
    }


def _materials(plan: Plan, given: set[str]) -> tuple[Material, ...]:
    counts: Counter[tuple[str, str, tuple[str, ...]]] = Counter()
    for marker in plan.markers:
        detail = marker.detail
        match detail:
            case PlannedPlate():
                size = detail.geometry
                item = (
                    f"coded plate {size.side_mm:g} x {size.side_mm:g} x {size.thickness_mm:g} mm, "
                    f"{size.n} x {size.n} units of {size.unit_mm:g} mm, {detail.code.scheme.value}"
                )
                counts["plate", item, ("plate", "marker")] += 1
            case PlannedLineMagnet():
                counts["magnet", f"line magnet, {_north(detail.tag.polarity.value)}", ("magnet", "marker")] += 1
            case PlannedTag():
                item = f"lying magnet, in information tags of {detail.tag.magnet_count}"
                counts["magnet", item, ("magnet", "tag", "marker")] += detail.tag.magnet_count
            case _:
                counts["cerpm", "chip-enabled raised pavement marker", ("cerpm", "marker")] += 1
    return tuple(
        Material(family, item, quantity, priced_by, not given.isdisjoint(priced_by))
        for (family, item, priced_by), quantity in sorted(counts.items())
    )


def _north(polarity: str) -> str:
    return "north pole up" if polarity == "N" else "south pole up"


def _comparisons(plan: Plan, quantities: Mapping[str, float | None]) -> tuple[CostRow, ...]:
    known = unit_costs()
    line_m = round(magnet_line_length_m(plan), 1)
    rows = []
    if line_m:
        rows += [CostRow(known[_LINE_TAGS], line_m), CostRow(known[PAINT], line_m)]
    if tags := quantities["tag"]:
        rows += [CostRow(known[_INFORMATION_TAG], tags), CostRow(known[_RFID], tags)]
    if magnets := quantities["magnet"]:
        rows.append(CostRow(known[_MAGNET], magnets))
    return tuple(rows)


def magnet_line_length_m(plan: Plan) -> float:
    """Length of painted line that has magnets, without gaps of more than three spacings. [m]"""
    if plan.rules.lines is None:
        return 0.0
    places: dict[tuple[str, LaneSide], list[float]] = defaultdict(list)
    for marker in plan.markers:
        if isinstance(marker.detail, PlannedLineMagnet):
            places[marker.lane, marker.detail.side].append(marker.chainage_m)
    spacing = plan.rules.lines.max_spacing_m
    pairs = (pair for chainages in places.values() for pair in pairwise(sorted(chainages)))
    return sum(b - a for a, b in pairs if b - a <= _CONTINUED * spacing)


def bill_document(bill: PlanBill) -> dict[str, object]:
    """The bill as plain values, for JSON."""
    return {
        "currency": bill.currency,
        "total": bill.total,
        "complete": bill.complete,
        "sentence": bill.sentence,
        "missing": list(bill.missing),
        "materials": [
            {"family": m.family, "item": m.item, "quantity": m.quantity, "priced": m.priced} for m in bill.materials
        ],
        "rows": [{**row.item.model_dump(), "quantity": row.quantity, "cost": row.cost} for row in bill.rows],
        "comparison": {
            "label": METRO_LABEL,
            "currency": "USD",
            "rows": [
                {
                    "item": row.cost.item, "unit": row.cost.unit, "quantity": row.quantity,
                    "unit_cost": [row.cost.low_usd, row.cost.high_usd], "cost": [row.low_usd, row.high_usd],
                    "source": row.cost.source,
                }
                for row in bill.comparisons
            ],
        },
    }  # fmt: skip


def write_bill_csv(bill: PlanBill) -> bytes:
    """The bill as CSV in UTF-8: materials, the agency's unit costs, the total, and published figures."""
    stream = io.StringIO()
    writer = TableWriter(stream)
    writer.write_row(COLUMNS)
    for material in bill.materials:
        note = "" if material.priced else NO_UNIT_COST
        writer.write_row(["material", material.family, material.item, material.quantity, "each", "", "", "", "", note])
    for row in bill.rows:
        item = row.item
        cost = "" if row.cost is None else fixed(row.cost, 2)
        texts = [item.item, item.pay_item or "", item.source]
        writer.write_row(
            ["cost", "", texts[0], _plain(row.quantity), item.per.replace("_", " "), _plain(item.price), cost,
             bill.currency, texts[1], texts[2] if cost else "the quantity is unknown"]
        )  # fmt: skip
    note = "" if bill.complete else f"incomplete: {NO_UNIT_COST} for {'; '.join(bill.missing)}"
    writer.write_row(["total", "", "total of the costs", "", "", "", fixed(bill.total, 2), bill.currency, "", note])
    for compared in bill.comparisons:
        unit = compared.cost
        costs = [_range(unit.low_usd, unit.high_usd), _range(compared.low_usd, compared.high_usd)]
        note = f"{unit.source}; {METRO_LABEL}"
        writer.write_row(["comparison", "", unit.item, _plain(compared.quantity), unit.unit, *costs, "USD", "", note])
    return stream.getvalue().encode()


def _plain(value: float | None) -> str:
    return "" if value is None else f"{value:.10g}"


def _range(low: float, high: float) -> str:
    return fixed(low, 2) if low == high else f"{fixed(low, 2)} to {fixed(high, 2)}"
