"""Costs of optimised plans against even spacing of equal quality, and against brute force on short lines."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from app.planning.alignment import Alignment
from app.planning.optimise.cover import cheapest_cover, least_gain
from app.planning.optimise.plan import optimise_by_prediction
from app.planning.rules import PlanRules
from app.values import Floats
from benchmarks.planning.roads import LANES, generated_road, real_lane
from benchmarks.planning.tables import Section, table

GOAL = 0.8
"""Share of the cost of even spacing on roads with bends, at most. Source: issue 13."""
_SEED = 91
_GENERATED = {
    "bends of 60 to 200 m": (60.0, 200.0), "bends of 120 to 500 m": (120.0, 500.0),
    "bends of 300 to 900 m": (300.0, 900.0),
}  # fmt: skip
_KM, _SHORT_KM = 3.0, 1.0
_COSTS = {
    "currency": "EUR",
    "items": [{"item": "plate", "per": "plate", "price": 105}, {"item": "CERPM", "per": "cerpm", "price": 47}],
}
_FIXES = {"fix_every_m": 100, "fix_probability": 0.99, "fix_error_m": 0.1}
_REQUIREMENTS: dict[str, dict[str, Any]] = {
    "path error 2 cm": {"cerpm": {"straight": 3.0}, "quality": {"path_error_m": 0.02}},
    "path error 5 cm": {"cerpm": {"straight": 3.0}, "quality": {"path_error_m": 0.05}},
    "path error 10 cm": {"cerpm": {"straight": 3.0}, "quality": {"path_error_m": 0.10}},
    "fixes every 100 m, path error 5 cm": {
        "cerpm": {"straight": 3.0}, "plates": {}, "quality": {**_FIXES, "path_error_m": 0.05},
    },
    "fixes every 100 m": {"plates": {}, "quality": _FIXES},
    "fixes every 100 m, weak camera": {
        "plates": {}, "quality": _FIXES, "cameras": [{"frames_per_s": 4, "exposure_s": 0.002}],
    },
}  # fmt: skip
"""Plates and pairs of CERPMs, these at most 36.6 m apart (3 N), at example prices."""


@dataclass(frozen=True, slots=True)
class Share:
    """Cost of an optimised plan over even spacing's, and over the bound."""

    road: str
    requirement: str
    of_even: float
    of_bound: float


def measure_optimiser(short: bool) -> Section:
    """Both tables."""
    shares = [share for name, road in _roads(short) for share in _shares(name, road)]
    bends = [one for one in shares if one.road.startswith("bends")]
    met = sum(one.of_even <= GOAL for one in bends)
    exact, lines = brute_force(10 if short else 60)
    names = list(dict.fromkeys(one.road for one in shares))
    cells = []
    for requirement in _REQUIREMENTS:
        found = {one.road: one for one in shares if one.requirement == requirement}
        values = [f"{found[n].of_even:.2f} ({found[n].of_bound:.2f})" if n in found else "-" for n in names]
        cells.append((requirement, *values))
    text = (
        "Cost of the markers of the optimised plan as a share of the cost of even spacing with equal quality. In "
        "brackets: the cost over the lower bound for any plan with the same pairs of markers; 1.00 is optimal. Example "
        "prices.\n\n"
        f"{table(('requirement', *names), cells)}\n\nGoals: a cost share of at most {GOAL:g} on generated roads "
        f"with bends: {met} of {len(bends)}; equal to brute force on short lines: {exact} of {lines}."
    )
    return Section("planning-optimiser", text, met == len(bends) and exact == lines)


def _roads(short: bool) -> Iterator[tuple[str, Alignment]]:
    rules = PlanRules.model_validate({"version": 1, "plates": {}, "road": {"design_speed_kmh": 80}})
    length_m = 1000 * (_SHORT_KM if short else _KM)
    for name, radii_m in list(_GENERATED.items())[: 1 if short else None]:
        yield name, generated_road(length_m, _SEED, radii_m=radii_m, rules=rules.road)
    for name in () if short else LANES:
        yield name, real_lane(name)


def _shares(name: str, road: Alignment) -> Iterator[Share]:
    for requirement, parts in _REQUIREMENTS.items():
        rules = PlanRules.model_validate({"version": 1, "costs": _COSTS, **parts})
        found = optimise_by_prediction(road, rules)
        point = found.table[0]
        if point.even_cost:
            yield Share(name, requirement, point.cost / point.even_cost, point.cost / point.bound)


def brute_force(count: int) -> tuple[int, int]:
    """How many of so many drawn lines of 6 to 12 candidates cost as little as the best of all choices."""
    rng = np.random.default_rng(_SEED)
    equal = lines = 0
    while lines < count:
        size = int(rng.integers(6, 13))
        chainage = np.sort(rng.uniform(0.0, 400.0, size))
        cost = rng.choice([60.0, 100.0, 140.0], size)
        gain = rng.choice([0.4, 0.7, 1.0, 1.6], size)
        if least_gain(chainage, gain, 120.0, 400.0) < 1.0:
            continue
        lines += 1
        found = cheapest_cover(chainage, cost, gain, need=1.0, window_m=120.0, length_m=400.0)
        equal += abs(found.cost - _cheapest(chainage, cost, gain)) < 1e-6
    return equal, lines


def _cheapest(chainage: Floats, cost: Floats, gain: Floats) -> float:
    best = float(cost.sum())
    for picked in itertools.product((False, True), repeat=len(cost)):
        chosen = np.array(picked)
        price = float(cost[chosen].sum())
        if price < best and least_gain(chainage, np.where(chosen, gain, 0.0), 120.0, 400.0) >= 1.0 - 1e-9:
            best = price
    return best
