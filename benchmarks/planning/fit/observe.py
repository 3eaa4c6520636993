"""Simulated passes that the models are fitted to: of plates, tags, lines and lanes, each under drawn circumstances.

Roads are generated from seeds of 1001 and above, which no other benchmark and no test uses.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from app.errors import InvalidParameter
from app.planning.placement import place_plan
from app.planning.plan import Plan, PlannedPlate, PlannedTag
from app.planning.predict.rates import lane_stretches
from app.planning.proof import ProofTerms, ProofUnit, UnitKind
from app.planning.proof.drives import drive_cerpms, drive_line, read_tag
from app.planning.proof.plates import read_frames
from app.planning.proof.prove import Prover
from app.planning.proof.report import DriveTerms
from app.planning.rules import CameraRules, PlanRules
from benchmarks.planning.roads import generated_road, prover_of

FIRST_SEED = 1001
"""Of the roads and drives."""
_LENGTH_M = 4000.0  # [m] of a road: some markers of every kind
_FRAME_STEP_M = 0.7  # [m] between frames: about ten of a pass
_SPEEDS_KMH = (20.0, 130.0)
_EXPOSURES_S = (0.0002, 0.004)


class PlatePassSeen(NamedTuple):
    """A pass over a plate: blur [units], frames as (height of a unit [px], read), and the error of the fix [m]."""

    blur_units: float
    frames: list[tuple[float, bool]]
    fix_m: float | None


class TagPassSeen(NamedTuple):
    """A pass over a tag."""

    clearance_m: float
    speed_m_s: float
    segment_m: float
    magnets: int
    curvature_per_m: float
    read: bool
    fix_m: float | None


class LineSeen(NamedTuple):
    """A drive along a line: magnets under the bar, and those that were read."""

    clearance_m: float
    speed_m_s: float
    curvature_per_m: float
    magnets: int
    read: int


class PathSeen(NamedTuple):
    """A drive along a stretch with CERPMs, without a stretch that was refused."""

    spacing_m: float
    survey_m: float
    speed_m_s: float
    exact_rms_m: float
    ends_per_m: float
    rms_m: float
    worst_m: float


def plate_passes(condition: str, count: int, seed: int) -> Iterator[PlatePassSeen]:
    """Passes by cameras, speeds and exposures that are drawn, over plates of one size."""
    plan = _plan(seed, plates={"spacing_m": 100})
    prover = prover_of(plan, ProofTerms(seed=seed, survey_rmse_m=0.0))
    rng = np.random.default_rng((seed, 1))
    for k in range(count):
        marker = plan.markers[k % len(plan.markers)]
        assert isinstance(marker.detail, PlannedPlate)
        camera = CameraRules(
            width_px=int(rng.choice([1280, 1920])), height_px=int(rng.choice([720, 1080])),
            horizontal_fov_deg=float(rng.uniform(50, 100)), height_m=float(rng.uniform(1.2, 2.6)),
            depression_deg=float(rng.uniform(12, 35)), exposure_s=_log_uniform(rng, *_EXPOSURES_S),
        )  # fmt: skip
        speed_m_s = float(rng.uniform(*_SPEEDS_KMH)) / 3.6
        one = prover.plate_pass(marker, DriveTerms(k, condition, camera))
        one = replace(one, speed_m_s=speed_m_s, fps=speed_m_s / _FRAME_STEP_M)
        seen = read_frames(one)
        blur = speed_m_s * one.conditions.exposure_s / (marker.detail.geometry.pitch_mm / 1000)
        fix = None if seen.fix_m is None else math.hypot(*seen.fix_m)
        yield PlatePassSeen(blur, seen.frames, fix)


def tag_passes(count: int, seed: int) -> Iterator[TagPassSeen]:
    """Passes over tags by clearances, speeds and designs that are drawn; lines on both sides."""
    done = 0
    for road in range(count):
        rng = np.random.default_rng((seed, road, 2))
        segment_m, magnets = float(rng.choice([1.0, 0.5, 0.2, 0.1])), int(rng.integers(3, 6))
        length_m = 4.0 if segment_m < 1 else 6.0
        events = ["speed_limit", "curve", "junction"]
        tags = {"at": events, "magnets": magnets, "length_m": length_m, "segment_m": segment_m}
        try:
            plan = _plan(seed + road, tags=tags, lines={})
        except InvalidParameter:  # the design has fewer codes than the road has meanings
            continue
        markers = [marker for marker in plan.markers if isinstance(marker.detail, PlannedTag)]
        for k, marker in enumerate(markers):
            clearance = float(rng.uniform(0.08, 0.36))
            prover = prover_of(plan, ProofTerms(seed=seed, clearance_m=clearance, survey_rmse_m=0.0))
            speed = float(rng.uniform(*_SPEEDS_KMH)) / 3.6
            one = replace(prover.tag_pass(marker, k), speed_m_s=speed)
            read, fix, _wrong = read_tag(one)
            lane = plan.alignment.lane(marker.lane)
            bend = abs(float(lane.value_at(lane.curvature_per_m, marker.chainage_m)))
            yield TagPassSeen(
                clearance, speed, segment_m, magnets, bend, read, None if fix is None else math.hypot(*fix)
            )
            done += 1
            if done >= count:
                return


def line_drives(count: int, seed: int) -> Iterator[LineSeen]:
    """Drives along painted lines."""
    plan = _plan(seed, lines={})
    rng = np.random.default_rng((seed, 3))
    for k in range(count):
        clearance = float(rng.uniform(0.08, 0.36))
        prover = prover_of(plan, ProofTerms(drives=1, seed=seed + k, clearance_m=clearance, max_sections_per_drive=1))
        unit = next(unit for unit in prover.list_units() if unit.kind is UnitKind.LINE)
        speed = float(rng.uniform(*_SPEEDS_KMH)) / 3.6
        passes, _wrong = drive_line(replace(prover.line_pass(unit), speed_m_s=speed), 1.0)
        lane = plan.alignment.lane(unit.lane)
        bend = float(np.abs(lane.value_at(lane.curvature_per_m, np.linspace(unit.from_m, unit.to_m, 20))).mean())
        yield LineSeen(clearance, speed, bend, len(passes), sum(one["read"] for one in passes))


def path_drives(count: int, seed: int) -> Iterator[PathSeen]:
    """Drives past CERPMs at spacings and accuracies that are drawn."""
    for k in range(count):
        rng = np.random.default_rng((seed, k, 4))
        radii = (float(rng.uniform(50, 120)), float(rng.uniform(200, 800)))
        rules = {"cerpm": {"straight": float(rng.uniform(0.5, 3.0)), "curve": float(rng.uniform(0.4, 2.0)),
                           "max_path_error_m": [None, 0.05, 0.2][int(rng.integers(3))],
                           "spreading_factor": 7, "interval_s": 1.0}}  # fmt: skip
        speed_kmh = float(rng.uniform(30.0, 110.0))
        length_m = float(rng.uniform(250.0, 1500.0))
        rough_m = max(float(rng.uniform(-0.02, 0.03)), 0.0)
        plan = _plan(
            seed + k, length_m=length_m, radii_m=radii, rough_m=rough_m, road={"design_speed_kmh": speed_kmh}, **rules
        )
        survey = float(rng.choice([0.0, 0.02, 0.03, 0.06, 0.1]))
        prover = prover_of(plan, ProofTerms(drives=1, seed=seed + k, survey_rmse_m=survey, max_sections_per_drive=2))
        for unit in prover.list_units():
            seen = path_seen(prover, unit, survey)
            if seen.rms_m > 0:  # the others have no path
                yield seen


def path_seen(prover: Prover, unit: ProofUnit, survey_m: float) -> PathSeen:
    """One drive along one stretch."""
    found = drive_cerpms(prover.lane_pass(unit))
    lane = prover.lanes[unit.lane]
    own = [one.chainage_m for one in prover.plan.markers if one.lane == unit.lane and one.family == "cerpm"]
    stretches = lane_stretches(lane, np.array(own))
    k = round(unit.from_m / (unit.to_m - unit.from_m))
    return PathSeen(
        float(stretches.spacing_m[k]), survey_m, float(stretches.speed_m_s[k]), float(stretches.exact_rms_m[k]),
        float(stretches.ends_per_m[k]),
        math.sqrt(found["square_sum_m2"] / max(found["covered"], 1)), found["worst_m"],
    )  # fmt: skip


def _plan(
    seed: int, *, length_m: float = _LENGTH_M, radii_m: tuple[float, float] = (80.0, 800.0), rough_m: float = 0.0,
    **rules: Any,
) -> Plan:  # fmt: skip
    checked = PlanRules.model_validate({"version": 1, "road": {"design_speed_kmh": 80}, **rules})
    road = generated_road(length_m, seed, radii_m=radii_m, rules=checked.road, rough_m=rough_m)
    return place_plan(road, checked, name=f"fit {seed}")


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))
