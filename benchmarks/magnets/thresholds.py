"""``python -m benchmarks.magnets.thresholds [--seed N] [--length M]``: what each threshold of the decoder is for.

Every threshold is taken out alone, and the same drives are decoded again: magnets found with the right polarity and
orientation, wrong ones, and readings where there is no magnet. A threshold that changes nothing is not needed by these
drives. Thresholds of compiled kernels are constants of the compiler and cannot be taken out here.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from app.decoders.magnet import classify, detect_dipoles, ferrous, fit_window
from app.decoders.magnet.decoder import decode_trace
from app.simulation.magnetic.drive import SimulatedDrive
from app.simulation.magnetic.vehicle import Vehicle
from benchmarks.magnets import scenes
from benchmarks.magnets.__main__ import table
from benchmarks.magnets.score import Tally, score_magnets

BAR = Vehicle.compact().bar


@dataclass(frozen=True, slots=True)
class Threshold:
    """A threshold by its name in the module that uses it, and the value that takes it out."""

    module: object
    name: str
    without: float

    @property
    def value(self) -> float:
        """As it is in the decoder."""
        return float(getattr(self.module, self.name))


THRESHOLDS = (
    Threshold(classify, "MIN_ENERGY", 0.0),
    Threshold(classify, "MIN_MARGIN", 0.0),
    Threshold(classify, "MAX_PRIOR_COST", math.inf),
    Threshold(classify, "MAX_PRIOR_COST_DEEP", classify.MAX_PRIOR_COST),
    Threshold(classify, "MAX_SHAPE_COST", math.inf),
    Threshold(classify, "MIN_MOMENT_RATIO", 0.0),
    Threshold(classify, "MAX_MOMENT_RATIO", math.inf),
    Threshold(classify, "MAX_MISFIT", math.inf),
    Threshold(fit_window, "MAX_REGION_PRIOR_COST", math.inf),
    Threshold(ferrous, "CROWD_M", 0.0),
    Threshold(ferrous, "MIXED_M", 0.0),
    Threshold(ferrous, "MIN_NEIGHBOUR_M", 0.0),
    Threshold(ferrous, "PIECE_M", 0.0),
    Threshold(ferrous, "BESIDE_REACH_M", 0.0),
    Threshold(detect_dipoles, "STOP_SHARE", 0.0),
    Threshold(detect_dipoles, "PENALTY", 0.0),
    Threshold(detect_dipoles, "CLOSE_PENALTY", 0.0),
    Threshold(detect_dipoles, "CONFIRMED_SHARE", 0.0),
    Threshold(detect_dipoles, "MAX_FAILED", math.inf),
)


@contextmanager
def without(threshold: Threshold) -> Iterator[None]:
    """The decoder without a threshold."""
    value = getattr(threshold.module, threshold.name)
    setattr(threshold.module, threshold.name, threshold.without)
    try:
        yield
    finally:
        setattr(threshold.module, threshold.name, value)


def draw_drives(seed: int, length_m: float) -> list[SimulatedDrive]:
    """Magnets at two clearances, tags of five magnets 0.5 m apart, and iron of every kind at two clearances."""
    rng = [np.random.default_rng([seed, 61, k]) for k in range(5)]
    form = scenes.TagFormat(5, 2.0, 0.5)
    return [
        scenes.magnets_drive(rng[0], clearance_m=0.16, speed_mph=30, count=60),
        scenes.magnets_drive(rng[1], clearance_m=0.35, speed_mph=50, count=60),
        scenes.tags_drive(rng[2], form, count=20, clearance_m=0.2),
        scenes.noise_drive(rng[3], length_m=length_m, town=False, clearance_m=0.16),
        scenes.noise_drive(rng[4], length_m=length_m, town=False, clearance_m=0.30),
    ]


def count(drives: list[SimulatedDrive]) -> Tally:
    """Readings of all drives."""
    tally = Tally()
    for drive in drives:
        tally.add(score_magnets(drive, decode_trace(drive.trace, BAR)))
    return tally


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.magnets.thresholds", description=__doc__)
    parser.add_argument("--seed", type=int, default=41)
    parser.add_argument("--length", type=float, default=2000.0, help="of each drive over iron [m]")
    args = parser.parse_args()
    drives = draw_drives(args.seed, args.length)
    whole = count(drives)
    rows: list[tuple[object, ...]] = [("none", "-", whole.found, whole.wrong, whole.extra)]
    for threshold in THRESHOLDS:
        value = threshold.value
        with without(threshold):
            tally = count(drives)
        rows.append((threshold.name, f"{value:g}", tally.found, tally.wrong, tally.extra))
    print(f"{whole.true} magnets, {2 * args.length / 1000:g} km over iron; seed {args.seed}.\n")
    print(table(("taken out", "value", "found", "wrong", "false"), rows))


if __name__ == "__main__":
    main()
