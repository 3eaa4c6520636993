"""``python -m benchmarks.plates.thresholds [--seed N] [--frames N]``: what each threshold of the decoder is for.

Every threshold is taken out alone, and the same frames are decoded again without a codebook: digits that were read
right, and wrong ones. A threshold that changes neither is not needed by these frames.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from operator import attrgetter

import cv2

from app.decoders.plate import decode_symbols, detect_thermal, evidence, marker_colours, reader, unit_likelihoods
from app.decoders.plate.reader import decode_plates
from benchmarks.plates.evaluate import find_right
from benchmarks.plates.sets import Job, Shot, read_trials, shoot
from benchmarks.plates.tables import table

ANY = (-math.inf, math.inf)


@dataclass(frozen=True, slots=True)
class Threshold:
    """A threshold by its name in the module that uses it (`CONSTANT` or `LIMITS.field`), and the value without it."""

    module: object
    name: str
    without: object

    @property
    def value(self) -> object:
        """As it is in the decoder."""
        return attrgetter(self.name)(self.module)


THRESHOLDS = (
    Threshold(decode_symbols, "TEMPER", 1.0),
    Threshold(decode_symbols, "OUTLIER_CONFIDENCE", 1.0),
    Threshold(evidence, "MAX_DAMAGE", math.inf),
    Threshold(decode_symbols, "MAX_DECIMAL_COST", math.inf),
    Threshold(evidence, "MIN_CONFIDENCE", 0.5),
    Threshold(evidence, "MIN_EXPLAINED_ALONE", 0.0),
    Threshold(evidence, "MIN_EXPLAINED_SMALL", 0.0),
    Threshold(evidence, "MIN_ROWS_ALONE", 0.0),
    Threshold(evidence, "CLEAN_EXPLAINED", 0.0),
    Threshold(marker_colours, "ALONE.min_margin", -math.inf),
    Threshold(marker_colours, "ALONE.min_tint", -math.inf),
    Threshold(marker_colours, "ALONE.min_triangle_tint", -math.inf),
    Threshold(marker_colours, "ALONE.cast", ANY),
    Threshold(unit_likelihoods, "FULL_WEIGHT_PX", 1e-9),
    Threshold(unit_likelihoods, "MAX_BLUR_UNITS", math.inf),
    Threshold(unit_likelihoods, "CELL_LIGHT_RANGE", ANY),
    Threshold(decode_symbols, "MAX_LEVEL_RESIDUAL", math.inf),
    Threshold(unit_likelihoods, "MAX_LARGE_RESIDUAL", unit_likelihoods.MAX_LEVEL_RESIDUAL),
    Threshold(unit_likelihoods, "MAX_RESIDUAL_SPREAD", math.inf),
    Threshold(unit_likelihoods, "STAIN_UNIT_PX", 1e-9),
    Threshold(reader, "ORIENTATION_EVIDENCE", 0.0),
    Threshold(detect_thermal, "MAX_MARKER_MISFIT", math.inf),
    Threshold(detect_thermal, "MIN_TWO_LEVEL", 0.0),
)


@contextmanager
def without(threshold: Threshold) -> Iterator[None]:
    """The decoder without a threshold."""
    constant, _, field = threshold.name.partition(".")
    value = getattr(threshold.module, constant)
    setattr(threshold.module, constant, replace(value, **{field: threshold.without}) if field else threshold.without)
    try:
        yield
    finally:
        setattr(threshold.module, constant, value)


def draw_shots(seed: int, frames: int) -> list[Shot]:
    """Frames of every set: a fifth of them from the trials, most from the sets that the thresholds are for."""
    shots: list[Shot] = []
    for index in range(0, len(read_trials()), 5):
        seen = [s for s in shoot(Job("trial", index, seed, 0, share=0.08)) if isinstance(s, Shot)]
        shots += seen[: max(frames // 30, 1)]
    for name, share in (("stress", 0.3), ("night", 0.1), ("hidden", 0.2), ("free", 0.1)):
        shots += [s for s in shoot(Job(name, 0, seed, max(round(share * frames), 1))) if isinstance(s, Shot)]
    for index in range(2):
        seen = [s for s in shoot(Job("thermal", index, seed, 0, share=0.3)) if isinstance(s, Shot)]
        shots += seen[: max(frames // 20, 1)]
    return shots


def count_readings(shots: list[Shot]) -> tuple[int, int]:
    """Frames whose digits were read right, and wrong digits."""
    right = wrong = 0
    for shot in shots:
        readings = decode_plates(shot.frame.image, thermal=shot.thermal)
        hit, others = find_right(readings, shot.code, shot.frame.truths[0] if shot.code is not None else None)
        right += hit is not None
        wrong += len(others)
    return right, wrong


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.plates.thresholds", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=100, help="about how many")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    shots = draw_shots(args.seed, args.frames)
    right, wrong = count_readings(shots)
    rows: list[tuple[object, ...]] = [("all as they are", "", right, wrong)]
    for threshold in THRESHOLDS:
        value = threshold.value
        with without(threshold):
            rows.append((threshold.name, f"{value} to {threshold.without}", *count_readings(shots)))
        print(*rows[-1], flush=True)
    print(f"\nSeed {args.seed}, {len(shots)} frames, no codebook.\n")
    print(table(("taken out", "value", "right", "wrong"), rows))


if __name__ == "__main__":
    main()
