"""Scenes that failed once, kept as a regression test."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from benchmarks.hunt.families import FAMILIES
from benchmarks.hunt.scenes import Kind, Outcome, Scene, simplest

FOLDER = Path(__file__).parent / "kept_scenes"


@dataclass(frozen=True, slots=True)
class KeptScene:
    """A scene, how it failed when it was found, and how it ends with today's decoder.

    A scene whose failure is known and not cured has the failure as its ``now``: the test tells when that changes.
    """

    seed: int
    parameters: dict[str, float]
    kind: Kind
    now: Kind


def read_kept(family: str) -> list[KeptScene]:
    """The kept scenes of a family, in the order found; parameters that are newer than a scene are the simplest."""
    path, simple = FOLDER / f"{family}.json", simplest(FAMILIES[family].bounds)
    if not path.exists():
        return []
    return [
        KeptScene(one["seed"], {**simple, **one["parameters"]}, Kind(one["kind"]), Kind(one["now"]))
        for one in json.loads(path.read_text())
    ]


def keep(family: str, scene: Scene) -> None:
    """Add a shrunk scene, unless its seed is there."""
    kept = read_kept(family)
    if any(one.seed == scene.seed for one in kept):
        return
    kept.append(KeptScene(scene.seed, scene.parameters, scene.outcome.kind, scene.outcome.kind))
    _write(family, kept)


def evaluate_kept(family: str) -> list[Outcome]:
    """What comes of the kept scenes now."""
    return [FAMILIES[family].evaluate(one.parameters, one.seed) for one in read_kept(family)]


def update_kept(family: str) -> None:
    """Write down how the kept scenes end with today's decoder."""
    outcomes = evaluate_kept(family)
    _write(
        family,
        [
            KeptScene(one.seed, one.parameters, one.kind, outcome.kind)
            for one, outcome in zip(read_kept(family), outcomes, strict=True)
        ],
    )


def _write(family: str, kept: list[KeptScene]) -> None:
    FOLDER.mkdir(exist_ok=True)
    rows = [
        {
            "seed": one.seed,
            "kind": one.kind,
            "now": one.now,
            "parameters": {k: round(v, 6) for k, v in one.parameters.items()},
        }
        for one in kept
    ]
    (FOLDER / f"{family}.json").write_text(json.dumps(rows, indent=1) + "\n")
