"""Bill of materials and cost of a plan, its schedule, report and trade-off; no price is assumed."""

from __future__ import annotations

import io
import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from app.encoders.magnet.layout import PAINT, CostRow
from app.encoders.magnet.sheets import fixed
from app.formats.text import TableWriter
from app.markers.cerpm import LaneSide
from app.markers.reading import Verdict
from app.planning.alignment import format_station
from app.planning.magnet_checks import ADHESIVE, unit_costs
from app.planning.plan import Optimum, Plan, PlanFinding, PlannedLineMagnet, PlannedMarker, PlannedPlate, PlannedTag
from app.planning.rules import CostItem

NO_UNIT_COST = "no unit cost given"
METRO_LABEL = "published figures for comparison, not the agency's prices"
BILL_COLUMNS = ("section", "family", "item", "quantity", "unit", "unit_cost", "cost", "currency", "pay_item", "note")
_LINE_TAGS, _INFORMATION_TAG, _RFID, _MAGNET = (
    "line tags at 6 m",
    "information tag of 3 magnets",
    "rugged RFID tag",
    "magnet with shell",
)  # items of app/planning/data/costs.csv
_CONTINUED = 3.0  # longest gap in a line of magnets, in spacings; two magnets left out


@dataclass(frozen=True, slots=True)
class Material:
    """Something that is bought."""

    family: str
    item: str
    quantity: int
    priced_by: tuple[str, ...]  # `CostItem.per` of the unit costs that cover it
    priced: bool  # whether the agency gives one of them


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
    """Materials and costs of a plan."""

    currency: str
    materials: tuple[Material, ...]
    rows: tuple[BillRow, ...]  # in the order of the agency's list
    # figures that the METRO paper publishes, in US dollars. They are no part of the total.
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
    on_surface = plan.rules.installation.on_surface
    return {
        "plate": counts.get("plate", 0),
        "magnet": magnets,
        "tag": len(tags),
        "cerpm": counts.get("cerpm", 0),
        "hole": 0 if on_surface else magnets,
        "shell": magnets if on_surface else 0,
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
    magnets = sum(quantity for (family, *_), quantity in counts.items() if family == "magnet")
    if magnets and plan.rules.installation.on_surface:
        counts["magnet", f"protective shell, {plan.rules.installation.height_mm:g} mm high", ("shell", "marker")] = (
            magnets
        )
        counts["magnet", ADHESIVE, ("shell", "marker")] = magnets
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
                    "item": row.cost.item,
                    "unit": row.cost.unit,
                    "quantity": row.quantity,
                    "unit_cost": [row.cost.low_usd, row.cost.high_usd],
                    "cost": [row.low_usd, row.high_usd],
                    "source": row.cost.source,
                }
                for row in bill.comparisons
            ],
        },
    }


def write_bill_csv(bill: PlanBill) -> bytes:
    """The bill as CSV in UTF-8: materials, the agency's unit costs, the total, and published figures."""
    stream = io.StringIO()
    writer = TableWriter(stream)
    writer.write_row(BILL_COLUMNS)
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


# === Report of a plan for people: counts, cost, findings, and what was left out, as Markdown.


_MAX_LEFT_OUT = 200
"""Places left out that the report lists; `plan.json` has all of them."""

_ZERO = 1e-9  # what is shown as 0; rounding of sums of metres
_COUNTED = {"plate": "plates", "magnet": "magnets", "tag": "information tags", "cerpm": "CERPMs"}


def counts_sentence(plan: Plan) -> str:
    """What is installed, for people."""
    found = plan_quantities(plan)
    parts = [
        f"{found[unit]:g} {name if found[unit] != 1 else name[:-1]}" for unit, name in _COUNTED.items() if found[unit]
    ]
    days = found["day"]
    work = "" if days is None else f"; {days:g} working day{'s' if days != 1 else ''}"
    return ", ".join(part for part in parts if not part.startswith("0 ")) + work


def verdict_counts(plan: Plan) -> dict[Verdict, int]:
    """Findings by verdict."""
    counts = Counter(finding.verdict for finding in plan.findings)
    return {verdict: counts.get(verdict, 0) for verdict in Verdict}


def finding_place(finding: PlanFinding) -> str:
    """Where a finding is: lane and displayed station; empty for the whole plan."""
    if finding.lane is None and finding.station_m is None:
        return ""
    station = ""
    if finding.station_m is not None:
        station = f" at {format_station(finding.station_m)}"
    return f"lane {finding.lane}{station}" if finding.lane is not None else station.strip()


def finding_figures(finding: PlanFinding) -> tuple[str, str]:
    """Figure and limit of a finding with their unit, for people."""
    unit = f" {finding.unit}" if finding.unit else ""
    figure = 0.0 if abs(finding.figure) < _ZERO else finding.figure
    return f"{figure:.5g}{unit}", f"{finding.relation} {finding.limit:.5g}{unit}"


def write_report(plan: Plan, missing_files: Mapping[str, str] | None = None) -> bytes:
    """The report as Markdown in UTF-8.

    Parameters
    ----------
    missing_files : mapping of str to str, optional
        Files that cannot be written of this plan, with the reason.
    """
    road = plan.alignment
    lines = [f"# Plan {_cell(plan.name)}", ""]
    if not road.surveyed:
        lines += ["**PLANNED - POSITIONS NOT SURVEYED**: the road was placed by an origin.", ""]
    length_km = road.lane_length_m / 1000
    lines += [
        f"Road {_cell(road.name)}: {len(road.lanes)} lanes, {length_km:.3f} km of lane, {len(road.events)} events, "
        f"{len(road.areas)} areas to avoid. Positions: grade {road.grade}; {road.crs}.",
        "",
        *(f"- Warning: {_cell(warning)}" for warning in road.warnings),
        *([""] if road.warnings else []),
        "## Markers",
        "",
        "| what | quantity |",
        "|---|---:|",
    ]
    lines += [f"| {name.replace('_', ' ')} | {value:g} |" for name, value in plan_quantities(plan).items() if value]
    bill = plan_bill(plan)
    lines += ["", "## Cost", "", bill.sentence + ".", "", "## Checks", ""]
    if plan.findings:
        lines += ["| check | verdict | figure | limit | where | result | source |", "|---|---|---:|---:|---|---|---|"]
    for finding in plan.findings:
        figure, limit = finding_figures(finding)
        cells = (finding.name, finding.verdict.value, figure, limit, finding_place(finding), finding.sentence,
                 finding.source)  # fmt: skip
        lines.append("| " + " | ".join(_cell(cell) for cell in cells) + " |")
    lines += ["", "## Left out and moved", ""]
    for left in plan.left_out[:_MAX_LEFT_OUT]:
        what = "left out" if left.moved_m is None else f"moved by {left.moved_m:.2f} m"
        at = f"{left.chainage_m:.1f} m" if left.station_m is None else format_station(left.station_m)
        lines.append(f"- {left.family}, lane {_cell(left.lane)}, {at}: {what}: {_cell(left.reason)}")
    if len(plan.left_out) > _MAX_LEFT_OUT:
        lines.append(f"- and {len(plan.left_out) - _MAX_LEFT_OUT} more, in plan.json")
    if not plan.left_out:
        lines.append("Nothing.")
    if missing_files:
        lines += ["", "## Files that are left out", ""]
        lines += [f"- {name}: {_cell(reason)}" for name, reason in missing_files.items()]
    return ("\n".join(lines) + "\n").encode()


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


# === Schedule of work: which stretch of which lane is built when, and what a crew carries there.


SECTION_M = 1000.0
"""Length of a section where no daily rate is given. [m] From one kilometre post to the next."""
SCHEDULE_COLUMNS = (
    "order", "day", "lane", "from_station", "to_station", "from_chainage_m", "to_chainage_m", "first_marker",
    "last_marker", "markers", "plates", "line_magnets", "information_tags", "holes", "cerpms",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Section:
    """One stretch of a lane that is built without a break, in the direction of travel."""

    order: int  # from 1, in the order of installation
    day: int | None  # working day from 1; None without a daily rate
    lane: str
    markers: tuple[PlannedMarker, ...]  # by number
    on_surface: bool = False  # magnets are glued onto the road

    def count(self, family: str) -> int:
        """Markers of a family."""
        return sum(marker.family == family for marker in self.markers)

    @property
    def line_magnets(self) -> int:
        """Magnets of painted lines."""
        return sum(isinstance(marker.detail, PlannedLineMagnet) for marker in self.markers)

    @property
    def tags(self) -> tuple[PlannedTag, ...]:
        """Information tags."""
        return tuple(marker.detail for marker in self.markers if isinstance(marker.detail, PlannedTag))

    @property
    def holes(self) -> int:
        """Holes to drill: one a magnet, none for magnets on the surface."""
        return 0 if self.on_surface else self.line_magnets + sum(tag.tag.magnet_count for tag in self.tags)


def plan_schedule(plan: Plan) -> tuple[Section, ...]:
    """Sections in the order of installation: lane by lane, in the direction of travel.

    Notes
    -----
    With `costs.markers_per_day` a day holds as many markers as the crew installs, and a section ends with the day or
    with the lane. Without, a section is a kilometre of a lane.
    """
    rate = plan.rules.costs.markers_per_day
    sections: list[Section] = []
    done = 0
    for markers in _by_lane(plan.markers):
        start = 0
        while start < len(markers):
            if rate is None:
                day, end = None, _end_of_kilometre(markers, start)
            else:
                day = math.floor(done / rate + 1e-9) + 1
                end = start + max(math.floor(day * rate + 1e-9) - done, 1)
            part = tuple(markers[start:end])
            sections.append(Section(len(sections) + 1, day, part[0].lane, part, plan.rules.installation.on_surface))
            start, done = start + len(part), done + len(part)
    return tuple(sections)


def _by_lane(markers: Sequence[PlannedMarker]) -> Iterator[list[PlannedMarker]]:
    lanes: dict[str, list[PlannedMarker]] = {}
    for marker in markers:
        lanes.setdefault(marker.lane, []).append(marker)
    yield from lanes.values()


def _end_of_kilometre(markers: Sequence[PlannedMarker], start: int) -> int:
    kilometre = markers[start].chainage_m // SECTION_M
    return next(
        (k for k in range(start, len(markers)) if markers[k].chainage_m // SECTION_M != kilometre), len(markers)
    )


def write_schedule_csv(plan: Plan) -> bytes:
    """The schedule as CSV in UTF-8, one row a section."""
    stream = io.StringIO()
    writer = TableWriter(stream)
    writer.write_row(SCHEDULE_COLUMNS)
    for section in plan_schedule(plan):
        first, last = section.markers[0], section.markers[-1]
        stations = [format_station(m.station_m) for m in (first, last)]
        writer.write_row(
            [
                section.order, section.day or "", section.lane, *stations,
                fixed(first.chainage_m, 2), fixed(last.chainage_m, 2), first.number, last.number,
                len(section.markers), section.count("plate"), section.line_magnets, len(section.tags), section.holes,
                section.count("cerpm"),
            ]
        )  # fmt: skip
    return stream.getvalue().encode()


# === The trade-off of an optimised plan as a table and a sentence.


TRADE_OFF_COLUMNS = (
    "fix_every_m", "path_error_m", "cost", "bound", "even_cost", "share_of_even", "currency", "markers", "required",
)  # fmt: skip


def write_trade_off_csv(optimum: Optimum, currency: str) -> bytes:
    """Requirements with the cheapest cost found, its bound, and the cost of even spacing, as CSV in UTF-8."""
    stream = io.StringIO()
    writer = TableWriter(stream)
    writer.write_row(TRADE_OFF_COLUMNS)
    required = optimum.quality
    for point in optimum.table:
        even = point.even_cost
        is_required = (point.fix_every_m, point.path_error_m) == (required.fix_every_m, required.path_error_m)
        writer.write_row(
            [
                f"{point.fix_every_m:.10g}", "" if point.path_error_m is None else f"{point.path_error_m:.10g}",
                f"{point.cost:.2f}", f"{point.bound:.2f}", "" if even is None else f"{even:.2f}",
                "" if even is None else f"{point.cost / even:.3f}", currency,
                "; ".join(f"{count} {family}" for family, count in point.counts), "yes" if is_required else "no",
            ]
        )  # fmt: skip
    return stream.getvalue().encode()


def optimum_sentence(optimum: Optimum, currency: str) -> str:
    """The optimum for people."""
    asked = f"a fix every {optimum.quality.fix_every_m:g} m"
    if optimum.quality.path_error_m is not None:
        asked += f", path error {optimum.quality.path_error_m:g} m"
    sentence = f"cheapest plan found for {asked}: {optimum.cost:,.2f} {currency}, bound {optimum.bound:,.2f}"
    even = optimum.table[0].even_cost if optimum.table else None
    return sentence + ("" if even is None else f"; even spacing of equal quality: {even:,.2f}")
