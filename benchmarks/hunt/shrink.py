"""The simplest scene that still fails in the same way."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.hunt.scenes import Family, Scene

_HALVINGS = 3  # of the way back to the simple value, where that value itself does not fail; source: by hand


def shrink(family: Family, scene: Scene, order: Sequence[str]) -> Scene:
    """Set parameters to their simple values, or nearer to them, while the scene fails in the same way.

    Parameters
    ----------
    family : Family
    scene : Scene
        That failed.
    order : sequence of str
        Names of parameters, those that explain failures least first.
    """
    best = scene
    for name in order:
        bound, value = family.bounds[name], best.parameters[name]
        if value == bound.simple:
            continue
        simpler = _try(family, best, name, bound.simple)
        if simpler is None and not bound.whole and bound.low <= bound.simple <= bound.high:
            near, far = bound.share(value), bound.share(bound.simple)
            for _ in range(_HALVINGS):
                middle = (near + far) / 2
                found = _try(family, best, name, bound.at(middle))
                if found is None:
                    far = middle
                else:
                    near, best = middle, found
        best = simpler or best
    return best


def _try(family: Family, scene: Scene, name: str, value: float) -> Scene | None:
    parameters = {**scene.parameters, name: value}
    outcome = family.evaluate(parameters, scene.seed)
    return Scene(scene.seed, parameters, outcome) if outcome.kind is scene.outcome.kind else None
