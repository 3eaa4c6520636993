"""``python -m benchmarks.hunt {plate,magnet,cerpm} --minutes N``: search for scenes that break a decoder.

Scenes are drawn from wide, physically bounded distributions, decoded, and judged beside the physical limit. Failures
are clustered by a shallow decision tree, each cluster's worst scene is shrunk to the simplest one that still fails in
the same way, and drawn. ``--keep`` adds these scenes to the kept ones, which ``--kept`` evaluates again.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.hunt.clusters import Cluster, find_clusters
from benchmarks.hunt.families import FAMILIES
from benchmarks.hunt.kept import evaluate_kept, keep, read_kept, update_kept
from benchmarks.hunt.scenes import FAILURES, Bound, Family, Kind, Scene, describe
from benchmarks.hunt.search import search
from benchmarks.hunt.shrink import shrink

_BINS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.99, 0.999, 1.0001)
_SHOWN = 4  # parameters that explain most, clusters of a kind
_SHOWN_DECILES, _MIN_DECILE = 8, 8  # tenths of parameters' values, and scenes in one at least


def main() -> None:
    """Search, cluster, shrink, draw and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.hunt", description=__doc__)
    parser.add_argument("family", choices=sorted(FAMILIES))
    parser.add_argument("--minutes", type=float, default=60.0, help="of searching; clusters take some more")
    parser.add_argument("--scenes", type=int, help="stop after so many scenes")
    parser.add_argument("--seed", type=int, default=1, help="of the first scene; scenes have consecutive seeds")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the shrunk scenes")
    parser.add_argument(
        "--keep",
        action="store_true",
        help="add the shrunk scenes to the kept ones; with --kept, write how they end now",
    )
    parser.add_argument("--kept", action="store_true", help="evaluate the kept scenes instead")
    args = parser.parse_args()
    if args.kept:
        _print_kept(args.family)
        if args.keep:
            update_kept(args.family)
        return
    family, start = FAMILIES[args.family], time.monotonic()
    scenes = search(args.family, args.seed, minutes=args.minutes, processes=args.processes, most=args.scenes)
    print(f"\n### hunt-{args.family}\n\n{_heading(scenes, time.monotonic() - start)}")
    print(f"\n{_counts(scenes)}\n\n{_reliability(scenes)}\n\n{_coverage(scenes)}")
    print(_worst_deciles(family.bounds, scenes))
    for kind in FAILURES:
        clusters, importance = find_clusters(family.bounds, scenes, kind)
        if clusters:
            _print_clusters(args, family, kind, clusters, importance)


def _heading(scenes: Sequence[Scene], seconds: float) -> str:
    return f"{len(scenes)} scenes, seeds {scenes[0].seed} to {scenes[-1].seed}; {seconds / 60:.1f} minutes."


def _counts(scenes: Sequence[Scene]) -> str:
    rows = []
    for kind in Kind:
        found = [scene for scene in scenes if scene.outcome.kind is kind]
        worst = max(found, key=lambda scene: scene.outcome.badness, default=None)
        detail = f"{worst.outcome.detail} (seed {worst.seed})" if worst is not None and worst.failed else ""
        rows.append(f"| {kind} | {len(found)} | {100 * len(found) / len(scenes):.1f} % | {detail} |")
    return "\n".join(["| outcome | scenes | share | worst |", "|---|--:|--:|---|", *rows])


def _reliability(scenes: Sequence[Scene]) -> str:
    sure = np.array([one for scene in scenes for one in scene.outcome.sure], float).reshape(-1, 2)
    rows = []
    for low, high in pairwise(_BINS):
        inside = (sure[:, 0] >= low) & (sure[:, 0] < high)
        if inside.any():
            mean, right = sure[inside].mean(0)
            rows.append(f"| {low:g} to {min(high, 1):g} | {int(inside.sum())} | {mean:.4f} | {right:.4f} |")
    return "\n".join(["| reported confidence | readings | mean | right |", "|---|--:|--:|--:|", *rows])


def _coverage(scenes: Sequence[Scene]) -> str:
    squared = np.array([value for scene in scenes for value, _ in scene.outcome.squared])
    if not len(squared):
        return ""
    z = np.sqrt(squared)
    return (
        f"Errors of {len(z)} estimates in reported standard deviations: {np.mean(z < 1):.1%} below 1 (68.3 %), "
        f"{np.mean(z < 2):.1%} below 2 (95.4 %), {np.mean(z < 3):.1%} below 3 (99.7 %); median of the squares "
        f"{np.median(squared):.2f} (0.45), mean {np.mean(squared):.2f} (1)."
    )


def _worst_deciles(bounds: Mapping[str, Bound], scenes: Sequence[Scene]) -> str:
    """Share read of what the limit allows: in the worst tenth of the scenes, and of each parameter's values."""
    judged = [scene for scene in scenes if scene.outcome.read is not None]
    if len(judged) < 2 * _MIN_DECILE:
        return ""
    read = np.array([scene.outcome.read for scene in judged], float)
    worst = np.sort(read)[: math.ceil(len(read) / 10)]
    rows = []
    for name, bound in bounds.items():
        values = np.array([scene.parameters[name] for scene in judged])
        varied = np.flatnonzero(values != bound.simple)
        cuts = np.unique(np.quantile(values[varied], np.linspace(0, 1, 11))) if len(varied) else np.zeros(0)
        for low, high in pairwise(cuts):
            inside = varied[(values[varied] >= low) & (values[varied] <= high)]
            if len(inside) >= _MIN_DECILE:
                rows.append((float(read[inside].mean()), f"{name} {low:.3g} to {high:.3g}", len(inside)))
    table = [f"| {text} | {count} | {share:.3f} |" for share, text, count in sorted(rows)[:_SHOWN_DECILES]]
    return "\n".join([
        f"Read of what the limit allows: {read.mean():.3f} in {len(read)} scenes, {worst.mean():.3f} in the worst "
        "tenth of them. Tenths of a parameter's values with the lowest shares:\n",
        "| values | scenes | read |", "|---|--:|--:|", *table,
    ])  # fmt: skip


def _print_clusters(
    args: argparse.Namespace,
    family: Family,
    kind: Kind,
    clusters: Sequence[Cluster],
    importance: Mapping[str, float],
) -> None:
    leading = [f"{name} {share:.0%}" for name, share in list(importance.items())[:_SHOWN] if share > 0]
    print(f"\n#### {kind}\n\nExplained by: {', '.join(leading) or 'nothing'}.\n")
    print("| cluster | failures | simplest scene | what happens |\n|---|--:|---|---|")
    for number, cluster in enumerate(clusters[:_SHOWN], 1):
        simple = shrink(family, cluster.worst, list(importance)[::-1])
        said = describe(family.bounds, simple.parameters)
        share = f"{cluster.failures} of {cluster.scenes}"
        print(f"| {cluster.conditions} | {share} | seed {simple.seed}: {said} | {simple.outcome.detail} |", flush=True)
        if args.pictures:
            args.pictures.mkdir(parents=True, exist_ok=True)
            family.draw(simple.parameters, simple.seed, args.pictures / f"{args.family}-{kind.name.lower()}-{number}")
        if args.keep:
            keep(args.family, simple)


def _print_kept(name: str) -> None:
    print(f"\n### hunt-{name}-kept\n\n| seed | was | is | what happens |\n|--:|---|---|---|")
    for scene, outcome in zip(read_kept(name), evaluate_kept(name), strict=True):
        print(f"| {scene.seed} | {scene.kind} | {outcome.kind} | {outcome.detail} |")


if __name__ == "__main__":
    main()
