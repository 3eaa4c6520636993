"""Lines in parts, joined where their ends meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

Floats = npt.NDArray[np.float64]

JOIN_M = 0.02
"""Ends that are this near meet. [m] Source: chosen by hand, twice the last digit of 1e-7 degrees."""
_EARTH_M = 6_371_000.0  # [m] mean radius; source: IUGG


@dataclass(frozen=True, slots=True)
class Link:
    """A part in a chain, by its number; `turned` if it runs against the direction in which it is drawn."""

    part: int
    turned: bool


def chain_parts(
    parts: Sequence[Floats], *, geographic: bool, unit_m: float, reversible: Sequence[bool] | None = None
) -> list[list[Link]]:
    """Chains of parts that meet end to start, each in order.

    Parameters
    ----------
    parts : sequence of ndarray, shape (N, 3)
        Vertices, N >= 1; only places of the ends count.
    geographic : bool
        Longitudes and latitudes [deg]; ends on both sides of the antimeridian can meet.
    unit_m : float
        Length of the unit of projected coordinates. [m]
    reversible : sequence of bool, optional
        Parts without a direction of their own; without, all have one.

    Notes
    -----
    A chain ends where more than two ends meet, and where two parts with directions meet head to head.
    """
    count = len(parts)
    if count == 1:
        return [[Link(0, False)]]
    turns = list(reversible) if reversible is not None else [False] * count
    places = _places_m(np.array([vertices[k, :2] for vertices in parts for k in (0, -1)]), geographic, unit_m)
    opposite = _meeting_ends(places)
    chains = []
    left = [True] * count
    for seed in sorted(range(count), key=lambda part: turns[part]):
        if not left[seed]:
            continue
        left[seed] = False
        ahead = _follow(2 * seed + 1, opposite, turns, left)
        behind = _follow(2 * seed, opposite, turns, left, backwards=True)
        chains.append([*reversed(behind), Link(seed, False), *ahead])
    return sorted(chains, key=lambda chain: min(link.part for link in chain))


def join_chain(parts: Sequence[Floats], chain: Sequence[Link]) -> Floats:
    """Vertices of a chain, shape (N, 3); the first vertex of each following part is left out."""
    return np.concatenate([turned_part(parts[link.part], link)[min(k, 1) :] for k, link in enumerate(chain)])


def turned_part(values: Floats, link: Link) -> Floats:
    """Values of a part in the direction of its chain."""
    return values[::-1] if link.turned else values


def gap_m(
    parts: Sequence[Floats], first: Sequence[Link], other: Sequence[Link], geographic: bool, unit_m: float
) -> float:
    """Distance from the end of a chain to the start of another. [m]"""
    end, start = turned_part(parts[first[-1].part], first[-1])[-1], turned_part(parts[other[0].part], other[0])[0]
    places = _places_m(np.array([end[:2], start[:2]]), geographic, unit_m)
    return float(np.linalg.norm(places[0] - places[1]))


def _places_m(ends: Floats, geographic: bool, unit_m: float) -> Floats:
    if not geographic:
        return ends * unit_m
    lon, lat = np.radians(ends[:, 0]), np.radians(ends[:, 1])
    across = np.cos(lat)
    return _EARTH_M * np.stack([across * np.cos(lon), across * np.sin(lon), np.sin(lat)], axis=1)


def _meeting_ends(places: Floats) -> dict[int, int]:
    """For each end that meets exactly one other end, that one. Part k has the ends 2 k (start) and 2 k + 1."""
    pairs = scipy.spatial.cKDTree(places).query_pairs(JOIN_M, output_type="ndarray")
    graph = scipy.sparse.coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(places), len(places)))
    node = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    order = np.argsort(node, kind="stable")
    first = np.flatnonzero(np.diff(node[order], prepend=-1))
    twos = first[np.diff(first, append=len(order)) == 2]
    one, two = order[twos].tolist(), order[twos + 1].tolist()
    return dict(zip(one + two, two + one, strict=True))


def _follow(
    end: int, opposite: dict[int, int], turns: Sequence[bool], left: list[bool], *, backwards: bool = False
) -> list[Link]:
    """Parts that follow an end (or precede it), marked as used."""
    found = []
    while (entry := opposite.get(end)) is not None and left[entry // 2]:
        part = entry // 2
        turned = entry % 2 == (0 if backwards else 1)
        if turned and not turns[part]:
            break
        left[part] = False
        found.append(Link(part, turned))
        end = entry ^ 1
    return found
