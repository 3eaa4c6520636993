"""Read rates and path errors that the checks predict, beside those of the proof, on roads of their own."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any

import numpy as np

from app.planning.alignment import Alignment
from app.planning.placement import place_plan
from app.planning.plan import Plan, PlannedLineMagnet, PlannedPlate, PlannedTag
from app.planning.plan_checks.check import check_predictions
from app.planning.predict.rates import path_errors_m
from app.planning.proof import ProofTerms, UnitKind, wilson
from app.planning.proof.drives import drive_cerpms, drive_line, read_tag
from app.planning.proof.plates import read_frames
from app.planning.proof.report import DriveTerms, drive_terms
from app.planning.rules import PlanRules
from benchmarks.planning.roads import LANES, generated_road, prover_of, real_lane
from benchmarks.planning.tables import Section, table

GOAL = 0.10
"""Greatest difference of predicted and measured, as a share of the measured. Source: issue 13."""
SEED = 95
"""Of the roads and drives; the models are fitted to seeds from 1001."""
CONDITIONS = ("day", "night", "wear+dirt")
_UNSURE, _UNSURE_TIMES = (0.05, 0.9), 4
"""Predicted rates in this range are measured with so many times the passes: the interval of 240 is +-0.06."""
_CAMERAS = [
    {"name": "front"},
    {"name": "slow", "width_px": 1280, "height_px": 720, "horizontal_fov_deg": 90, "frames_per_s": 10,
     "exposure_s": 0.002},
]  # fmt: skip
RULES: dict[str, Any] = {
    "version": 1,
    "plates": {"spacing_m": 25},
    "lines": {},
    "tags": {"at": ["curve", "speed_limit", "junction"], "magnets": 5, "length_m": 6.0, "before": 10.0,
             "min_before_m": 0},
    "cerpm": {"spreading_factor": 7, "interval_s": 1.0},
    "cameras": _CAMERAS,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Compared:
    """A figure on one road: predicted, measured, and of how many passes or drives."""

    road: str
    what: str
    predicted: float
    measured: float
    passes: int
    unit: str

    @property
    def difference(self) -> float:
        """Predicted over measured, less 1."""
        return self.predicted / max(self.measured, 1e-9) - 1.0

    @property
    def optimism(self) -> float:
        """By how much it is predicted better than measured, as a share of the measured."""
        return self.difference if self.unit == "share" else -self.difference

    @property
    def interval(self) -> str:
        """95 % interval of a measured rate."""
        if self.unit != "share":
            return "-"
        low, high = wilson(self.measured, self.passes)
        return f"{low:.3f} to {high:.3f}"


def measure_predictions(short: bool) -> Section:
    """The table of all roads, and the worst of it."""
    roads = list(_roads(short))
    with ProcessPoolExecutor(min(len(roads), os.cpu_count() or 1)) as pool:
        rows = [row for found in pool.map(compare_road, roads, repeat(8 if short else 60)) for row in found]
    worst = max(rows, key=lambda row: abs(row.difference))
    hopeful = max(rows, key=lambda row: row.optimism)
    head = ("road", "what", "predicted", "measured", "95 % of measured", "passes", "difference")
    cells = [
        (row.road, row.what, f"{row.predicted:.3f}", f"{row.measured:.3f}", row.interval, row.passes,
         f"{row.difference:+.1%}")
        for row in rows
    ]  # fmt: skip
    text = (
        "Predictions of the checks beside simulated drives of the proof, on two generated roads to which nothing was "
        "fitted, and on four real lanes that helped to choose the form of the models, but not their parameters. Read "
        "rates as shares of passes; path errors as root mean squares [m].\n\n"
        f"{table(head, cells)}\n\nGoals: all predictions within {GOAL:.0%} of the measurement: "
        f"{sum(abs(r.difference) <= GOAL for r in rows)} of {len(rows)}; none more than {GOAL:.0%} too optimistic: "
        f"{sum(r.optimism <= GOAL for r in rows)} of {len(rows)}. Worst: {worst.what} on {worst.road}, "
        f"{worst.difference:+.1%}; most optimistic: {hopeful.what} on {hopeful.road}, {hopeful.optimism:+.1%}."
    )
    return Section("planning-predictions", text, abs(worst.difference) <= GOAL)


def _roads(short: bool) -> Iterator[Alignment]:
    rules = PlanRules.model_validate(RULES)
    for name in LANES[:1] if short else LANES:
        yield real_lane(name, rules.road)
    if not short:
        for seed, radii_m, speed_kmh in ((SEED, (60.0, 300.0), 70.0), (SEED + 1, (150.0, 900.0), 100.0)):
            road = replace_speed(rules, speed_kmh)
            yield generated_road(900.0, seed, radii_m=radii_m, rules=road.road)


def replace_speed(rules: PlanRules, speed_kmh: float) -> PlanRules:
    """The rules with a design speed."""
    return rules.model_copy(update={"road": rules.road.model_copy(update={"design_speed_kmh": speed_kmh})})


def compare_road(road: Alignment, passes: int) -> list[Compared]:
    """All figures of a road, from about so many passes for each."""
    return list(_compared(road, passes))


def _compared(road: Alignment, passes: int) -> Iterator[Compared]:
    rules = PlanRules.model_validate({**RULES, "predictions": {"conditions": list(CONDITIONS)}})
    plan = place_plan(road, rules, name=road.name)
    predicted = {found.name: found.figure for found in check_predictions(plan)}
    for camera in rules.cameras:
        for condition in CONDITIONS if camera.name == "front" else CONDITIONS[:1]:
            what = f"plates {camera.name} {condition}"
            rate = predicted[f"predicted-read-rate {what}"]
            more = _UNSURE_TIMES if _UNSURE[0] < rate < _UNSURE[1] else 1
            read, count = _plates_read(plan, condition, camera.name, more * passes)
            yield Compared(road.name, what, rate, read / count, count, "share")
    for what, (read, count) in (("tags", _tags_read(plan, passes)), ("line", _lines_read(plan, passes))):
        if count:
            name = f"predicted-read-rate {what}"
            yield Compared(road.name, what, predicted[name], read / count, count, "share")
    yield _path(plan, max(passes // 4, 2))


def _plates_read(plan: Plan, condition: str, camera: str, passes: int) -> tuple[int, int]:
    """Plates read and passed; frames are read until one of them is, as the proof counts."""
    plates = [marker for marker in plan.markers if isinstance(marker.detail, PlannedPlate)]
    drives = math.ceil(passes / len(plates))
    terms = ProofTerms(drives=drives, seed=SEED, conditions=(condition,), cameras=(camera,))
    prover, read, count = prover_of(plan, terms), 0, 0
    chosen = np.random.default_rng((SEED, len(condition))).permutation(len(plates) * drives)[: max(passes, drives)]
    for drive, k in (divmod(int(one), len(plates)) for one in chosen):
        drive_of: DriveTerms = drive_terms(plan, terms, drive)
        # every pass has a drive of its own, so that light and sensor differ between all of them
        drive_of = replace(drive_of, drive=drive + drives * k)
        read += read_frames(prover.plate_pass(plates[k], drive_of), enough=1).read > 0
        count += 1
    return read, count


def _tags_read(plan: Plan, passes: int) -> tuple[int, int]:
    tags = [marker for marker in plan.markers if isinstance(marker.detail, PlannedTag)]
    prover = prover_of(plan, ProofTerms(drives=passes, seed=SEED))
    if not tags:
        return 0, 0
    count = max(passes // 2, 1)
    return sum(read_tag(prover.tag_pass(tags[k % len(tags)], k))[0] for k in range(count)), count


def _lines_read(plan: Plan, passes: int) -> tuple[int, int]:
    if not any(isinstance(marker.detail, PlannedLineMagnet) for marker in plan.markers):
        return 0, 0
    terms = ProofTerms(drives=max(passes // 10, 1), seed=SEED, max_sections_per_drive=2)
    prover = prover_of(plan, terms)
    units = [unit for unit in prover.list_units() if unit.kind is UnitKind.LINE]
    found = [one for unit in units for one in drive_line(prover.line_pass(unit), 1.0)[0]]
    return sum(one["read"] for one in found), len(found)


def _path(plan: Plan, drives: int) -> Compared:
    terms = ProofTerms(drives=drives, seed=SEED, max_sections_per_drive=100)
    prover = prover_of(plan, terms)
    units = [unit for unit in prover.list_units() if unit.kind is UnitKind.LANE]
    found = [drive_cerpms(prover.lane_pass(unit)) for unit in units]
    measured = math.sqrt(sum(one["square_sum_m2"] for one in found) / sum(one["covered"] for one in found))
    squares: list[float] = []
    for lane in plan.alignment.lanes:
        at = np.array([m.chainage_m for m in plan.markers if m.family == "cerpm" and m.lane == lane.name])
        squares += (path_errors_m(lane, at, plan.rules.predictions)[0] ** 2).tolist()
    predicted = math.sqrt(sum(squares) / len(squares))
    return Compared(plan.alignment.name, "path error", predicted, measured, len(found), "m")
