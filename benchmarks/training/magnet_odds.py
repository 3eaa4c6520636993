"""``python -m benchmarks.training.magnet_odds [--seed N] [--scenes N]``: weights of the features for a magnet.

Fitted dipoles of simulated drives: scenes of the hunter, roads with iron and a few magnets, tags with a line beside
them, and single magnets without iron. A dipole is right where a magnet of its kind and polarity lies. The weights are
the likeliest on two thirds of the drives; what they report of the others is printed beside their probabilities. Dipoles
that are never reported, and those beside magnets at the edge of the bar, count neither way.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from app.decoders.magnet.classify import (
    FEATURES,
    Classification,
    MagnetState,
    is_strong,
    kind_probability,
    magnet_features,
)
from app.decoders.magnet.decoder import MagnetDecoder, estimate_state, learn_wheels
from app.decoders.magnet.dipole_fit import UPRIGHT
from app.decoders.magnet.fit_window import Dipole
from app.decoders.magnet.readings import MagnetReading, NoiseFinding
from app.decoders.magnet.wheel_noise import WheelNoiseCanceller
from app.markers.magnet import Orientation, Polarity
from app.sensors.magnetometer_bar import MagnetometerBar
from app.simulation.magnetic.drive import SimulatedDrive
from benchmarks.hunt.magnet import simulate_scene
from benchmarks.magnets.drawn_scenes import draw_iron_drive, draw_line_beside_tags, draw_magnets_drive
from benchmarks.magnets.score import REACH_M
from benchmarks.plates.tables import table
from benchmarks.training import reliability_rows

IRON_SHARE, IRON_LENGTH_M = 0.25, 1200.0
"""[1, m] drives over iron and a few magnets among all, and their length."""
CLEAN_SHARE, CLEAN_CLEARANCES_M = 0.15, (0.14, 0.42)
"""[1, m] drives over magnets without iron, and their clearances."""
BESIDE_SHARE = 0.15
"""Drives over tags with a line beside them."""
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

    def __init__(self, bar: MagnetometerBar, state: MagnetState, wheels: WheelNoiseCanceller) -> None:
        super().__init__(bar, state=state, wheels=wheels)
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
    elif kind < CLEAN_SHARE + BESIDE_SHARE:
        drive = draw_line_beside_tags(rng)
    elif kind < CLEAN_SHARE + BESIDE_SHARE + IRON_SHARE:
        drive = draw_iron_drive(rng, town=bool(rng.random() < 0.5), lines=True, length_m=IRON_LENGTH_M)
    else:
        drive, bar = simulate_scene(seed)
    wheels = learn_wheels(drive.trace, bar)
    state, _ = estimate_state(drive.trace, bar, wheels)
    if not state.is_known:
        return [], []
    recorder = _Recorder(bar, state, wheels)
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


def fit_weights(
    features: npt.NDArray[np.float64], right: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.float64], float]:
    """Likeliest weights (F,) and intercept for features (N, F) and whether each dipole is right (N,).

    The probability of the kind is a factor of the model, so this is no plain logistic regression.
    """
    mean, std = features.mean(axis=0), features.std(axis=0)
    scaled = np.column_stack([(features - mean) / std, np.ones(len(features))])
    kind = kind_probability(features)

    def cost(weights: npt.NDArray[np.float64]) -> tuple[float, npt.NDArray[np.float64]]:
        magnet = 1 / (1 + np.exp(-scaled @ weights))
        odds = np.clip(magnet * kind, 1e-12, 1 - 1e-12)
        slope = np.where(right, -1 / odds, 1 / (1 - odds)) * magnet * (1 - magnet) * kind
        size = np.append(weights[:-1], 0.0)
        loss = -np.log(np.where(right, odds, 1 - odds)).sum() + size @ size / (2 * PENALTY)
        return float(loss), scaled.T @ slope + size / PENALTY

    found = scipy.optimize.minimize(cost, np.zeros(scaled.shape[1]), jac=True, method="L-BFGS-B").x
    weights = found[:-1] / std
    return weights, float(found[-1] - mean @ weights)


def main() -> None:
    """Collect, fit and print."""
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
    weights, bias = fit_weights(features[~test], right[~test])
    print(f"{len(right)} dipoles of {len(found)} drives, {right.mean():.1%} are magnets\n\nWEIGHTS = np.array([")
    print("".join(f"    {weight:.4f},  # {name}\n" for name, weight in zip(FEATURES, weights, strict=True)) + "])")
    print(f"BIAS = {bias:.4f}\n")
    odds = kind_probability(features[test]) / (1 + np.exp(-(features[test] @ weights + bias)))
    true = right[test]
    rows = [(p, int(true[odds >= p].sum()), int(true.sum()), int((~true[odds >= p]).sum())) for p in THRESHOLDS]
    print(table(("from probability", "right", "of", "wrong"), rows))
    print(table(("probability", "dipoles", "mean", "right"), reliability_rows(odds, true, BINS)))


if __name__ == "__main__":
    main()
