"""``python -m benchmarks.training.magnet_odds [--seed N] [--scenes N]``: weights of the features for a magnet.

Fitted dipoles of simulated drives: scenes of the hunter, roads with iron and a few magnets, and roads without iron. A
dipole is right where a magnet of its kind and polarity lies. A logistic regression learns from two thirds of the
drives; what it would report of the others is printed beside its probabilities. Dipoles that are never reported, and
those beside magnets at the edge of the bar, count neither way.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.classify import Classification, is_strong
from app.decoders.magnet.decoder import MagnetDecoder, estimate_state
from app.decoders.magnet.dipole_fit import UPRIGHT
from app.decoders.magnet.fit_window import Dipole
from app.decoders.magnet.magnet_odds import FEATURES, magnet_features
from app.decoders.magnet.magnet_state import MagnetState
from app.decoders.magnet.readings import MagnetReading, NoiseFinding
from app.markers.magnet import Orientation, Polarity
from app.sensors.magnetometer_bar import MagnetometerBar
from app.simulation.magnetic.drive import SimulatedDrive
from benchmarks.hunt.magnet import simulate_scene
from benchmarks.magnets.drawn_scenes import draw_iron_drive, draw_magnets_drive
from benchmarks.magnets.score import REACH_M
from benchmarks.plates.tables import table

IRON_SHARE, IRON_LENGTH_M = 0.25, 1200.0
"""[1, m] drives over iron and a few magnets among all, and their length."""
CLEAN_SHARE, CLEAN_CLEARANCES_M = 0.2, (0.14, 0.42)
"""[1, m] drives over magnets without iron, and their clearances."""
TEST_EVERY = 3
PENALTY = 1.0
"""[1] inverse of the penalty on the squares of the standardised weights."""
THRESHOLDS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.99)
BINS = (0.0, 0.1, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 0.999, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """Evidence of a dipole (F,), where it was found, and the moment along its kind."""

    features: npt.NDArray[np.float64]
    explained: float
    t_s: float
    lateral_cm: float
    kind: int
    moment_am2: float


class _Recorder(MagnetDecoder):
    """Keeps the features of each dipole that could be reported."""

    def __init__(self, bar: MagnetometerBar, state: MagnetState) -> None:
        super().__init__(bar, state=state)
        self.samples: list[Sample] = []
        self._features: dict[int, npt.NDArray[np.float64]] = {}

    def _classify(self, dipoles: list[Dipole]) -> list[Classification]:
        around, half = [*self._before, *dipoles], self._array.half_width_m
        self._features = {id(d): magnet_features(d, around, self.state, half) for d in dipoles if is_strong(d, half)}
        return super()._classify(dipoles)

    def _reading(self, dipole: Dipole, classification: Classification) -> MagnetReading | NoiseFinding:
        reading = super()._reading(dipole, classification)
        if id(dipole) in self._features:
            features, moment = self._features[id(dipole)], float(dipole.params[3 + dipole.kind])
            at = reading.t_s, reading.lateral_cm
            self.samples.append(Sample(features, dipole.explained, *at, dipole.kind, moment))
        return reading


def collect(seed: int) -> tuple[list[Sample], list[bool]]:
    """The dipoles of a drive and whether each is right; none where the magnets never show the clearance."""
    rng = np.random.default_rng([seed, 4])
    kind, bar = rng.random(), MagnetometerBar.metro()
    if kind < CLEAN_SHARE:
        drive = draw_magnets_drive(rng, float(rng.uniform(*CLEAN_CLEARANCES_M)))
    elif kind < CLEAN_SHARE + IRON_SHARE:
        drive = draw_iron_drive(rng, town=bool(rng.random() < 0.5), lines=True, length_m=IRON_LENGTH_M)
    else:
        drive, bar = simulate_scene(seed)
    state, _ = estimate_state(drive.trace, bar)
    if not state.is_known:
        return [], []
    recorder = _Recorder(bar, state)
    recorder.feed(drive.trace)
    recorder.finish()
    return label(drive, recorder.samples)


def label(drive: SimulatedDrive, samples: Sequence[Sample]) -> tuple[list[Sample], list[bool]]:
    """The samples that count, the strongest first, and whether each is right."""
    taken: set[int] = set()
    kept, right = [], []
    for sample in sorted(samples, key=lambda one: -one.explained):
        apart = {
            k: math.hypot((sample.t_s - m.t_s) * m.speed_m_s, (sample.lateral_cm - m.lateral_cm) / 100)
            for k, m in enumerate(drive.magnets)
            if abs(sample.t_s - m.t_s) * m.speed_m_s < REACH_M
        }
        free = {k: d for k, d in apart.items() if k not in taken and d < REACH_M}
        if not free and apart:
            continue
        kept.append(sample)
        if not free:
            right.append(False)
            continue
        nearest = min(free, key=lambda k: free[k])
        taken.add(nearest)
        magnet = drive.magnets[nearest]
        is_kind = (sample.kind == UPRIGHT) == (magnet.orientation is Orientation.UP)
        right.append(is_kind and (sample.moment_am2 > 0) == (magnet.polarity is Polarity.N))
    return kept, right


def main() -> None:
    """Collect, fit and print."""
    from sklearn.linear_model import LogisticRegression

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=62_000)
    parser.add_argument("--scenes", type=int, default=560)
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    seeds = range(arguments.seed, arguments.seed + arguments.scenes)
    with ProcessPoolExecutor(arguments.processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        found = list(pool.map(collect, seeds, chunksize=4))
    drive = np.concatenate([np.full(len(right), k) for k, (_, right) in enumerate(found)])
    features = np.array([one.features for samples, _ in found for one in samples])
    right = np.array([one for _, rights in found for one in rights], bool)
    test = drive % TEST_EVERY == 0
    mean, std = features[~test].mean(axis=0), features[~test].std(axis=0)
    model = LogisticRegression(C=PENALTY, max_iter=5000).fit((features[~test] - mean) / std, right[~test])
    weights = model.coef_[0] / std
    bias = float(model.intercept_[0] - mean @ weights)
    print(f"{len(right)} dipoles of {len(found)} drives, {right.mean():.1%} are magnets\n\nWEIGHTS = np.array([")
    print("".join(f"    {weight:.4f},  # {name}\n" for name, weight in zip(FEATURES, weights, strict=True)) + "])")
    print(f"BIAS = {bias:.4f}\n")
    margin = np.expm1(features[test, FEATURES.index("margin")])
    odds = 1 / (1 + np.exp(-(features[test] @ weights + bias))) / (1 + np.exp(-margin / 2))
    true = right[test]
    rows = [(p, int(true[odds >= p].sum()), int(true.sum()), int((~true[odds >= p]).sum())) for p in THRESHOLDS]
    print(table(("from probability", "right", "of", "wrong"), rows))
    rows = [
        (f"{low:g} to {high:g}", int(one.sum()), f"{odds[one].mean():.4f}", f"{true[one].mean():.4f}")
        for low, high in pairwise(BINS)
        if (one := (odds >= low) & (odds < high)).any()
    ]
    print(table(("probability", "dipoles", "mean", "right"), rows))


if __name__ == "__main__":
    main()
