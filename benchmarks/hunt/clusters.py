"""Failures in clusters, and the parameters that explain them: a shallow decision tree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from sklearn.tree import DecisionTreeClassifier

from benchmarks.hunt.scenes import Bound, Kind, Scene

DEPTH, MIN_LEAF = 3, 8
"""Of the tree: questions, and scenes in a leaf at least. Source: chosen by hand."""
MIN_FAILURES = 2


@dataclass(frozen=True, slots=True)
class Cluster:
    """Scenes of one leaf that failed in the same way."""

    kind: Kind
    conditions: str  # on the parameters
    # `failures`, `scenes`: in the leaf
    failures: int
    scenes: int
    worst: Scene


def find_clusters(
    bounds: Mapping[str, Bound], scenes: Sequence[Scene], kind: Kind
) -> tuple[list[Cluster], dict[str, float]]:
    """Clusters of one kind of failure, the largest first, and how much each parameter explains.

    Returns
    -------
    clusters : list of Cluster
        Leaves with at least two failures. Where the tree finds nothing, one cluster of all failures.
    importance : dict of str to float
        Share of the tree's decrease of impurity, the largest first.
    """
    failed = np.array([scene.outcome.kind is kind for scene in scenes])
    if not failed.any():
        return [], {}
    names = list(bounds)
    shares = np.array([[bounds[name].share(scene.parameters[name]) for name in names] for scene in scenes])
    tree = DecisionTreeClassifier(max_depth=DEPTH, min_samples_leaf=MIN_LEAF, class_weight="balanced", random_state=0)
    tree.fit(shares, failed)
    importance = dict(sorted(zip(names, tree.feature_importances_.tolist(), strict=True), key=lambda one: -one[1]))
    leaves = tree.apply(shares)
    clusters = []
    for leaf in np.unique(leaves[failed]):
        inside = np.flatnonzero((leaves == leaf) & failed)
        if len(inside) < MIN_FAILURES and failed.sum() >= MIN_FAILURES:
            continue
        worst = max((scenes[int(k)] for k in inside), key=lambda scene: scene.outcome.badness)
        path = _conditions(tree, bounds, names, shares[inside[0]])
        clusters.append(Cluster(kind, path, len(inside), int((leaves == leaf).sum()), worst))
    return sorted(clusters, key=lambda one: -one.failures), importance


def _conditions(
    tree: DecisionTreeClassifier, bounds: Mapping[str, Bound], names: Sequence[str], shares: np.ndarray
) -> str:
    """The questions on the way to the leaf of a scene."""
    inner, said = tree.tree_, []
    for node in tree.decision_path(shares[None]).indices:
        if inner.children_left[node] == inner.children_right[node]:
            continue
        name = names[inner.feature[node]]
        limit = bounds[name].at(float(inner.threshold[node]))
        below = shares[inner.feature[node]] <= inner.threshold[node]
        said.append(f"{name} {'<=' if below else '>'} {limit:.3g}")
    return " and ".join(said) or "anywhere"
