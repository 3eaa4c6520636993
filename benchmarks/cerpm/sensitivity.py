"""``python -m benchmarks.cerpm.sensitivity [NAME ...] [--seed N]``: how much the error depends on a constant.

Constants of `app.lanes` that were chosen by hand are halved and doubled, one at a time, on the short drives of the
benchmark: the conditions of `cerpm-path`, `cerpm-spoof` and `cerpm-dirty`. The error is the RMS distance from the true
centre line at all true places, where a distance above 1 m and a place without a path count as 1 m. Printed are the
ratios of the error at half and at twice the value to the error at the value itself: 1.00 means that the constant has
no effect, ratios above 1 on both sides mean that the value is near the best. Comments in `app.lanes` quote the two
ratios.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np

from app.lanes.estimate import fit_lane
from app.lanes.least_squares import Hyperparameters
from app.lanes.types import LaneMarkers, LaneRules
from app.sensors.pose_track import PoseTrack
from app.simulation.radio.lanes import TrueLane
from benchmarks.cerpm import paths, scenes
from benchmarks.cerpm.path_errors import NEAR_M, path_errors

CONSTANTS = (
    "estimate._BEYOND_TRACK_M",
    "initial_line._BEND",
    "initial_line._FINE_TRACK_M",
    "initial_line._JERK_M_S3",
    "initial_line._MAX_BESIDE_M",
    "initial_line._NEIGHBOURS",
    "initial_line._ROUNDS",
    "initial_line._SIDED_SIGMA_M",
    "initial_line._SINGLE_ROW_M",
    "initial_line._SLOW_TO_WHITE",
    "lane_fit._CLEAR_BAND_M",
    "lane_fit._COARSE_WANDER",
    "lane_fit._CONVERGED_M",
    "lane_fit._GRID_HALF_M",
    "lane_fit._GRID_STEP_M",
    "lane_fit._MARKER_SIGMA_M",
    "lane_fit._MAX_REJECTIONS",
    "lane_fit._MAX_ROUNDS",
    "lane_fit._NEARLY_CONVERGED_M",
    "lane_fit._OUTLIER_COST",
    "lane_fit._REJECTION_STRETCH_M",
    "lane_fit._TRACK_COST",
    "lane_fit._WRONG_SIDE_COST",
    "least_squares.Hyperparameters.slow_m",
    "least_squares.Hyperparameters.width_length_m",
    "least_squares.Hyperparameters.width_sd_m",
    "least_squares.KNOT_M",
    "observations._CLEARLY_BETTER",
    "observations._EVEN_M",
    "observations._MAX_EXCESS_SHARE",
    "observations._MAX_SPACINGS",
    "observations._MIN_EVEN_SHARE",
    "observations._MIN_LENGTHS",
    "observations._MIN_PAIRED_SHARE",
    "observations._MIN_PAIRS",
    "observations._MIN_ROW_STAGGER_M",
    "observations._MIN_SPACING_M",
    "observations._SAME_STATION_M",
    "observations._TURN_SIGMA_M",
    "smooth_line._SEPARATE_LEG_M",
    "types.LaneRules.bridge_m",
    "types.LaneRules.max_end_sigma_m",
    "types.LaneRules.max_median_sigma_m",
    "types.LaneRules.max_outlier_ratio",
    "types.LaneRules.off_the_line_m",
    "types.LaneRules.off_the_line_z",
)


@dataclass(frozen=True)
class Drive:
    """Input of a fit, and what is true."""

    lane: TrueLane
    markers: LaneMarkers
    track: PoseTrack | None
    first_m: float
    last_m: float


def list_drives(seed: int) -> list[Drive]:
    """The drives of the short benchmark."""
    return [*_path_drives(seed), *_spoofed_drives(seed), *_dirty_drives(seed)]


def error_m(drives: list[Drive], rules: LaneRules) -> float:
    """RMS distance of paths, at most 1 m. [m]"""
    squares, count = 0.0, 0
    for drive in drives:
        path = fit_lane(drive.markers, drive.track, rules=rules)
        tally = path_errors(drive.lane, path, drive.first_m, drive.last_m)
        off = np.concatenate(tally.off_m) if tally.off_m else np.empty(0)
        squares += float(np.sum(np.minimum(off, NEAR_M) ** 2)) + max(tally.places - len(off), 0) * NEAR_M**2
        count += tally.places
    return float(np.sqrt(squares / count))


@contextmanager
def scaled(name: str, factor: float) -> Iterator[tuple[LaneRules, float]]:
    """The lane rules and the constant's own value, while the constant is multiplied by a factor."""
    module, *_, constant = name.split(".")
    if ".LaneRules." in name:
        value = getattr(LaneRules(), constant)
        yield LaneRules(**{constant: factor * value}), value
    elif ".Hyperparameters." in name:
        value = getattr(Hyperparameters(), constant)

        def changed(**others: float) -> Hyperparameters:
            return Hyperparameters(**{constant: factor * value, **others})

        with patch.object(importlib.import_module("app.lanes.lane_fit"), "Hyperparameters", changed):
            yield LaneRules(), value
    else:
        holder = importlib.import_module(f"app.lanes.{module}")
        value = getattr(holder, constant)
        new = max(round(factor * value), 1) if isinstance(value, int) else factor * value
        with patch.object(holder, constant, new):
            yield LaneRules(), value


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cerpm.sensitivity", description=__doc__)
    parser.add_argument("names", nargs="*", default=CONSTANTS)
    parser.add_argument("--seed", type=int, default=61)
    args = parser.parse_args()
    drives = list_drives(args.seed)
    usual = error_m(drives, LaneRules())
    print(f"Error {usual:.4f} m over {len(drives)} drives, seed {args.seed}.\n")
    print("| constant | value | half | twice |\n|---|--:|--:|--:|", flush=True)
    for name in args.names:
        ratios = []
        for factor in (0.5, 2.0):
            with scaled(name, factor) as (rules, value):
                ratios.append(error_m(drives, rules) / usual)
        print(f"| {name} | {value:g} | {ratios[0]:.2f} | {ratios[1]:.2f} |", flush=True)


def _path_drives(seed: int) -> Iterator[Drive]:
    for number, condition in enumerate(paths.CONDITIONS):
        for _name, whole, rng in paths.list_scenes(seed, True, 10 + number):
            lane = scenes.shortened(whole, condition.longest_m)
            installed = scenes.install(lane, rng, condition.per_side)
            if condition.lose is not None:
                installed = condition.lose(installed, rng)
            track = scenes.track(lane, rng) if condition.with_track else None
            yield Drive(lane, scenes.markers_for_lane(installed), track, *paths.span_of(installed))


def _spoofed_drives(seed: int) -> Iterator[Drive]:
    for number, case in enumerate(paths.SPOOF_CASES):
        for _name, lane, rng in paths.list_scenes(seed, True, 30 + number):
            spoofed, _row, track, span = paths.spoofed_markers(case, lane, rng)
            yield Drive(lane, scenes.markers_for_lane(spoofed), track, *span)


def _dirty_drives(seed: int) -> Iterator[Drive]:
    for number, more in enumerate((False, True)):
        for _name, lane, rng in paths.list_scenes(seed, True, 40 + number):
            log = paths.dirty_log(lane, rng, more)
            yield Drive(lane, paths.markers_of_log(log), log.track, *log.span_m)


if __name__ == "__main__":
    main()
