"""The set-ups of the papers as plans: what the paper gives, and what Waymark plans and computes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from app.markers.magnet_design import TagDesign
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme, plate_capacity
from app.planning.outputs.bill import magnet_line_length_m, plan_bill
from app.planning.placement import place_plan
from app.planning.plan import Plan, PlannedLineMagnet, PlannedPlate, PlannedTag
from app.planning.plan_checks import check_plan
from app.planning.proof import ProofTerms
from app.planning.proof.plates import FramesRead, read_frames
from app.planning.proof.report import drive_terms
from app.planning.rules import PlanRules
from app.radio.link import LinkModel
from benchmarks.planning.roads import generated_road, prover_of
from benchmarks.planning.tables import Section, table

FIGURE_17A = {
    1.0: (24, 24), 0.8: (32, 32), 0.5: (56, 56), 0.4: (72, 56), 0.2: (152, 120), 0.1: (312, 248), 0.05: (632, 488),
    0.02: (1592, 1208),
}  # fmt: skip
"""Ideal and coupled capacity by segment [m] of tags of three magnets on 4 m. Source: METRO figure 17a."""
PLATE_DIGITS = "023792168411"
"""Source: PolyU section II.A, the listing with `999` for the boundary markers."""
ROUTE_M, PER_SIDE, APART_M, PREVIEW_M = 275.0, 10, 30.6, 340.0
"""Source: CERPM paper, sections 3.2 and 4.1; nine gaps of 30.6 m."""
TERMS = ProofTerms(drives=1, seed=13)
"""One drive by day."""
_MAGNET_USD = 1.0  # source: METRO section 8.1, with its shell
_COSTS = {"currency": "USD", "items": [{"item": "magnet with shell", "per": "magnet", "price": _MAGNET_USD}]}


@dataclass(frozen=True, slots=True)
class Row:
    """A figure of a paper beside Waymark's."""

    what: str
    paper: str
    waymark: str
    same: bool


def measure_papers(short: bool) -> Section:
    """The table; the same in short mode."""
    del short
    rows = [*plate_rows(), *capacity_rows(), *cost_rows(), *cerpm_rows()]
    cells = [(row.what, row.paper, row.waymark, "yes" if row.same else "NO") for row in rows]
    text = "Figures that the papers state for their set-ups, and what Waymark computes for the same ones.\n\n"
    text += table(("set-up", "paper", "Waymark", "same"), cells)
    return Section("planning-papers", text, all(row.same for row in rows))


def plate_rows() -> list[Row]:
    """Digits and size of the default plate."""
    geometry = PlateGeometry()
    capacity = plate_capacity(geometry.n, PlateScheme.POSITION)
    frames = _frames_of_paper_plate()
    return [
        Row("side of a plate of 8 x 8 units of 35 mm, gaps of 5 mm", "325 mm", f"{geometry.side_mm:g} mm",
            geometry.side_mm == 325),
        Row("digits of a plate", "12", str(capacity.symbols), capacity.symbols == 12),
        Row("digits of the paper's plate, read at 50 km/h", PLATE_DIGITS,
            f"{PLATE_DIGITS if frames.read else 'none'} in {frames.read} of {frames.seen} frames",
            frames.read > 0 and not frames.wrong),
    ]  # fmt: skip


def _frames_of_paper_plate() -> FramesRead:
    """Frames of one simulated pass over the paper's plate, encoded, rendered and decoded."""
    rules = {"road": {"lanes": ["1"], "design_speed_kmh": 50}, "plates": {"scheme": "position", "spacing_m": 300}}
    plan = _plan(150.0, **rules)
    plate = plan.markers[0]
    assert isinstance(plate.detail, PlannedPlate)
    paper = replace(plate.detail, code=PlateCode(PLATE_DIGITS, PlateScheme.POSITION))
    marker = replace(plate, detail=paper, code=PLATE_DIGITS)
    prover = prover_of(replace(plan, markers=(marker,)), TERMS)
    return read_frames(prover.plate_pass(marker, drive_terms(plan, TERMS, 0)))


def capacity_rows() -> list[Row]:
    """Figure 17a: codes of three magnets on 4 m, and the 2,688 of seven magnets."""
    rows = []
    for segment_m, (ideal, coupled) in FIGURE_17A.items():
        design = TagDesign(3, 4.0, segment_m)
        found = (design.ideal_capacity, design.coupled_capacity)
        rows.append(
            Row(f"codes of 3 magnets on 4 m, segments of {segment_m:g} m: ideal, coupled", f"{ideal}, {coupled}",
                f"{found[0]}, {found[1]}", found == (ideal, coupled))
        )  # fmt: skip
    seven = TagDesign(7, 4.0, 0.5).ideal_capacity
    return [*rows, Row("codes of 7 magnets on 4 m, segments of 0.5 m", "2688", str(seven), seven == 2688)]


def cost_rows() -> list[Row]:
    """A kilometre of one solid line, and a tag, with the paper's $1 a magnet."""
    plan = _plan(
        3600.0, lines={"sides": "right"}, tags={"at": ["speed_limit"], "before": 0.0}, costs=_COSTS
    )  # fmt: skip
    magnets = sum(isinstance(marker.detail, PlannedLineMagnet) for marker in plan.markers)
    tags = [marker.detail.tag for marker in plan.markers if isinstance(marker.detail, PlannedTag)]
    per_metre = magnets * _MAGNET_USD / magnet_line_length_m(plan)
    bill = plan_bill(plan)
    paint = next(row.cost for row in bill.comparisons if row.cost.unit == "metre" and row.cost.high_usd > 1)
    tag = (bill.total - magnets * _MAGNET_USD) / len(tags)
    return [
        Row("line magnets at most 6 m apart [USD/m]", "0.17", f"{per_metre:.2f}", f"{per_metre:.2f}" == "0.17"),
        Row("paint, for comparison in the bill [USD/m]", "0.21 to 7.70", f"{paint.low_usd:.2f} to {paint.high_usd:.2f}",
            (paint.low_usd, paint.high_usd) == (0.21, 7.70)),
        Row("information tag of 3 magnets [USD]", "3", f"{tag:.2f}", tag == 3.0),
    ]  # fmt: skip


def cerpm_rows() -> list[Row]:
    """Ten markers a side on 275 m, and their radio at 340 m."""
    rules = {
        "n_m": ROUTE_M / (PER_SIDE - 1.5), "straight": 1, "curve": 1, "max_path_error_m": None, "preview_m": PREVIEW_M,
    }  # fmt: skip
    plan = check_plan(_plan(ROUTE_M, cerpm=rules))
    length_m = plan.alignment.lane("1").length_m
    at = {side: np.array([m.chainage_m for m in plan.markers if m.offset_m * side > 0]) for side in (1, -1)}
    apart = float(np.mean(np.diff(at[1])))
    in_time = next(finding for finding in plan.findings if finding.name == "radio read-in-time")
    level_dbm = float(LinkModel().level_dbm(PREVIEW_M))
    return [
        Row(f"markers on each side of {length_m:.0f} m", str(PER_SIDE), f"{len(at[1])} and {len(at[-1])}",
            len(at[1]) == len(at[-1]) == PER_SIDE),
        Row("distance between them [m]", f"{APART_M}", f"{apart:.1f}", abs(apart - APART_M) < 0.1),
        Row("level at 340 m [dBm]", "-125", f"{level_dbm:.0f}", round(level_dbm) == -125),
        Row("preview [m]: 0.95 or more of the plan's markers are read before it", "340",
            f"{PREVIEW_M:.0f}, with a probability of {in_time.figure:.3f}", in_time.figure >= 0.95),
    ]  # fmt: skip


def _plan(length_m: float, **rules: Any) -> Plan:
    checked = PlanRules.model_validate({"version": 1, "road": {"lanes": ["1"]}, **rules})
    road = generated_road(length_m, 5, radii_m=(400.0, 900.0), rules=checked.road)
    return place_plan(road, checked, name="paper")
