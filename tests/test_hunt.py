"""The scene hunter: its parts, and the scenes that failed once."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from benchmarks.hunt.clusters import find_clusters
from benchmarks.hunt.families import FAMILIES
from benchmarks.hunt.kept import read_kept
from benchmarks.hunt.scenes import FAILURES, Bound, Kind, Outcome, Parameters, Scene, draw_parameters
from benchmarks.hunt.shrink import shrink

_ORDER = (Kind.RIGHT, Kind.BEYOND, Kind.MISSED, Kind.OVERCONFIDENT, Kind.WRONG)


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_bounds_are_bounds_and_scenes_depend_on_the_seed_alone(family):
    bounds = FAMILIES[family].bounds
    for name, bound in bounds.items():
        assert bound.low < bound.high, name
        assert bound.source, name
        assert not bound.logarithmic or bound.low > 0, name
    assert draw_parameters(bounds, 7) == draw_parameters(bounds, 7)
    assert draw_parameters(bounds, 7) != draw_parameters(bounds, 8)
    for seed in range(50):
        for name, value in draw_parameters(bounds, seed).items():
            bound = bounds[name]
            assert value == bound.simple or bound.low <= value <= bound.high, name
            assert not bound.whole or value == int(value), name


@pytest.mark.parametrize("logarithmic", [True, False])
def test_values_and_shares_are_inverse(logarithmic):
    bound = Bound(2, 50, 4, "a test", logarithmic=logarithmic)
    for share in np.linspace(0, 1, 7):
        assert bound.share(bound.at(share)) == pytest.approx(share)
    assert bound.share(1.0) < 0
    assert bound.share(60.0) > 1


class Steep:
    """Fails where a slope is above 5, whatever the colour is."""

    bounds: Mapping[str, Bound] = {
        "slope": Bound(0, 10, 0, "a test"),
        "colour": Bound(0, 3, 0, "a test", whole=True),
        "size": Bound(1, 100, 10, "a test", logarithmic=True),
    }

    def evaluate(self, parameters: Parameters, seed: int) -> Outcome:
        steep = parameters["slope"] > 5
        return Outcome(Kind.WRONG if steep else Kind.RIGHT, parameters["slope"])

    def draw(self, parameters: Parameters, seed: int, path: Path) -> None:
        path.write_text(f"{parameters} {seed}")


def steep_scenes() -> list[Scene]:
    family = Steep()
    drawn = [(seed, draw_parameters(family.bounds, seed)) for seed in range(200)]
    return [Scene(seed, parameters, family.evaluate(parameters, seed)) for seed, parameters in drawn]


def test_the_cause_of_failures_is_found_and_scenes_are_shrunk_to_it():
    family, scenes = Steep(), steep_scenes()
    clusters, importance = find_clusters(family.bounds, scenes, Kind.WRONG)
    assert next(iter(importance)) == "slope"
    assert importance["slope"] > 0.95
    assert clusters[0].failures == sum(scene.failed for scene in scenes)
    assert clusters[0].conditions.startswith("slope > ")
    assert float(clusters[0].conditions.split(" > ")[1].split(" ")[0]) == pytest.approx(5, abs=0.3)
    simple = shrink(family, clusters[0].worst, list(importance)[::-1])
    assert simple.failed
    assert simple.parameters["colour"] == 0
    assert simple.parameters["size"] == 10
    assert 5 < simple.parameters["slope"] < 6.5
    assert find_clusters(family.bounds, scenes, Kind.MISSED) == ([], {})


@pytest.mark.slow
@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_scenes_that_failed_once_do_not_get_worse(family):
    kept = read_kept(family)
    assert kept
    for scene in kept:
        assert scene.kind in FAILURES
        outcome = FAMILIES[family].evaluate(scene.parameters, scene.seed)
        assert _ORDER.index(outcome.kind) <= _ORDER.index(scene.now), (scene.seed, outcome)
