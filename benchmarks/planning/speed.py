"""Seconds on one core to read, place and check a road with all families, and how they grow with its length."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import orjson

from benchmarks.planning.roads import generated_file
from benchmarks.planning.tables import Section, table

GOAL_S, GOAL_KM = 30.0, 100.0
"""Source: issue 13, 100 km of two-lane road with all families."""
GROWTH = 1.5
"""Seconds a kilometre of the longest road, over those of the one before it, at most; 1 is linear growth."""
LENGTHS_KM, SHORT_KM = (1.0, 10.0, 100.0), (0.5, 2.0)
SEED, RADII_M = 13, (120.0, 900.0)
STEPS = ("read", "build", "place", "check")
RULES: dict[str, Any] = {
    "version": 1,
    "name": "all families",
    "road": {"design_speed_kmh": 80},
    "plates": {"spacing_m": 100},
    "decision_points": {"at": ["junction", "curve"]},
    "lines": {},
    "tags": {"at": ["curve", "speed_limit", "junction"], "magnets": 5, "length_m": 6.0},
    "cerpm": {},
    "cameras": [{"name": "front", "frames_per_s": 60, "exposure_s": 0.0005}],
}
"""All families by their default spacings; tags with room for every turn of a bend."""
_ONE_CORE = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Figures:
    """What one road took: seconds of each step, markers, findings, and the greatest memory [MiB]."""

    km: float
    seconds: dict[str, float]
    markers: dict[str, int]
    findings: int
    mib: float

    @property
    def total_s(self) -> float:
        """Of all steps. [s]"""
        return sum(self.seconds.values())


def measure_speed(short: bool) -> Section:
    """The table; each road in a process of its own, on one core."""
    found = [_run_apart(km) for km in (SHORT_KM if short else LENGTHS_KM)]
    head = ("road [km]", "markers", *(f"{step} [s]" for step in STEPS), "all [s]", "s/km", "peak memory [MiB]")
    rows = [
        (
            f"{one.km:g}", sum(one.markers.values()), *(f"{one.seconds[step]:.2f}" for step in STEPS),
            f"{one.total_s:.1f}", f"{one.total_s / one.km:.2f}", f"{one.mib:.0f}",
        )
        for one in found
    ]  # fmt: skip
    last, before = found[-1], found[-2]
    growth = last.total_s / last.km / (before.total_s / before.km)
    names = {"cerpm": "CERPMs", "magnet": "magnets", "plate": "plates"}
    counts = ", ".join(f"{count} {names.get(family, family)}" for family, count in last.markers.items())
    limit_s = GOAL_S * max(last.km / GOAL_KM, 0.2)
    goals = (
        f"Goals: {GOAL_S:g} s for {GOAL_KM:g} km; from the second longest road to the longest, the seconds per "
        f"kilometre grow by a factor of at most {GROWTH:g} (measured: {growth:.2f})."
    )
    text = (
        "Two-lane road with plates, line magnets, information tags and CERPMs; bends with radii of "
        f"{RADII_M[0]:g} to {RADII_M[1]:g} m; one core. The longest road has {counts} and {last.findings} findings.\n\n"
        f"{table(head, rows)}\n\n{goals}"
    )
    return Section("planning-speed", text, last.total_s <= limit_s and growth <= GROWTH)


def measure_road(km: float) -> Figures:
    """Plan a road in this process."""
    from app.formats.alignments.read import read_alignment
    from app.planning.build_alignment import build_alignment
    from app.planning.placement import place_plan
    from app.planning.plan_checks import check_plan
    from app.planning.rules import PlanRules

    data = generated_file(1000 * km, SEED, radii_m=RADII_M)
    rules = PlanRules.model_validate(RULES)
    seconds: dict[str, float] = {}
    file = _timed(seconds, "read", lambda: read_alignment(data, "road.geojson"))
    road = _timed(seconds, "build", lambda: build_alignment(file, rules.road))
    placed = _timed(seconds, "place", lambda: place_plan(road, rules, name="benchmark"))
    checked = _timed(seconds, "check", lambda: check_plan(placed))
    return Figures(km, seconds, checked.counts, len(checked.findings), _peak_mib())


def _peak_mib() -> float:
    """Greatest memory of this process alone; what `getrusage` gives has the parent's share. [MiB]"""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return float(status["VmHWM"].split()[0]) / 1024


def _timed(seconds: dict[str, float], step: str, run: Callable[[], _T]) -> _T:
    began = time.perf_counter()
    found = run()
    seconds[step] = time.perf_counter() - began
    return found


def _run_apart(km: float) -> Figures:
    command = [sys.executable, "-m", "benchmarks.planning.speed", str(km)]
    done = subprocess.run(command, check=True, capture_output=True, env={**os.environ, **_ONE_CORE})
    return Figures(**orjson.loads(done.stdout.splitlines()[-1]))


if __name__ == "__main__":
    print(orjson.dumps(measure_road(float(sys.argv[1]))).decode())
