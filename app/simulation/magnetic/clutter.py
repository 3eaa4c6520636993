"""Iron that is not a marker: cars beside the road, manhole covers, joints, rebar, plates and scrap.

Each is a cluster of dipoles in lane coordinates (along, left, up), induced by the earth's field and, as steel is,
permanently magnetised several times as much. Moments are chosen so that the fields agree with what is published for
such objects: a car some ten uT at 1 m, a cover tens of uT at 20 cm, a bolt a few uT at 20 cm.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from app.simulation.magnetic.road import Road, turned_to_world
from app.values import Floats


@dataclass(frozen=True, slots=True)
class Clutter:
    """An object beside or in the road."""

    kind: str  # a key of `KINDS`
    # `chainage_m`, `left_m`: [m] its middle
    chainage_m: float
    left_m: float


def _car(rng: np.random.Generator) -> Floats:
    n = 14
    place = np.stack([rng.uniform(-2.1, 2.1, n), rng.uniform(-0.8, 0.8, n), rng.uniform(0.25, 0.8, n)], 1)
    common = rng.normal(0, 8, 3) * (1, 1, 1) + (0, 0, -10)
    return np.hstack([place, common + rng.normal(0, 8, (n, 3))])


def _cover(rng: np.random.Generator) -> Floats:
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    rings = [(0.3, angle), (0.18, angle[::2]), (0.05, angle[::4])]
    place = np.concatenate([np.stack([r * np.cos(a), r * np.sin(a), np.full(a.size, -0.03)], 1) for r, a in rings])
    common = rng.normal((0.0, 0.0, -0.3), 0.4)
    return np.hstack([place, common + rng.normal(0, 0.35, place.shape)])


def _joint(rng: np.random.Generator) -> Floats:
    left = np.arange(-3.5, 3.5, 0.06)
    edges = []
    for along in (-0.04, 0.04):
        place = np.stack([np.full(left.size, along), left, np.full(left.size, -0.02)], 1)
        common = rng.normal(0, 0.15, 3)
        slow = np.cumsum(rng.normal(0, 0.02, (left.size, 3)), axis=0)
        edges.append(np.hstack([place, common + slow + rng.normal(0, 0.05, place.shape)]))
    return np.concatenate(edges)


def _rebar(rng: np.random.Generator) -> Floats:
    """Twelve metres of mesh: bars across every 20 cm, 6 cm deep, magnetised along themselves and by the mill."""
    bars = []
    for along in np.arange(-6, 6, 0.2):
        left = np.arange(-1.8, 1.8, 0.12)
        place = np.stack(
            [along + rng.normal(0, 0.01) + 0 * left, left, np.full(left.size, -0.06 + rng.normal(0, 0.005))], 1
        )
        moment = rng.normal(0, 0.012, 3) + np.array([0, rng.normal(0, 0.05), -0.01])
        bars.append(np.hstack([place, moment + rng.normal(0, 0.004, place.shape)]))
    return np.concatenate(bars)


def _plate(rng: np.random.Generator) -> Floats:
    """A steel plate over a trench, 2 by 1.5 m: its rim carries the poles."""
    u = np.arange(-1, 1.01, 0.1)
    v = np.arange(-0.75, 0.76, 0.1)
    place = np.concatenate(
        [np.stack([u, np.full(u.size, s * 0.75), 0 * u], 1) for s in (-1, 1)]
        + [np.stack([np.full(v.size, s), v, 0 * v], 1) for s in (-1.0, 1.0)]
    )
    common = rng.normal(0, 0.6, 3)
    return np.hstack([place, common + rng.normal(0, 0.3, place.shape)])


def _bolt(rng: np.random.Generator) -> Floats:
    """A nut, a bolt, a piece of wire."""
    moment = rng.normal(0, 1, 3)
    moment *= 10 ** rng.uniform(-2.0, -0.2) / np.linalg.norm(moment)
    return np.hstack([[0.0, 0.0, 0.01], moment])[None]


def _scrap(rng: np.random.Generator) -> Floats:
    """A piece of exhaust or a tool, 15 to 50 cm long, magnetised along itself and in parts."""
    length, turn = rng.uniform(0.15, 0.5), rng.uniform(0, 2 * np.pi)
    along = np.linspace(-0.5, 0.5, 7) * length
    place = np.stack([along * np.cos(turn), along * np.sin(turn), np.full(7, 0.02)], 1)
    strength = 10 ** rng.uniform(-1.0, 0.6) / 7
    axis = np.array([np.cos(turn), np.sin(turn), 0])
    return np.hstack([place, strength * (axis + rng.normal(0, 0.5, (7, 3)))])


def _slab_joint(rng: np.random.Generator) -> Floats:
    """A joint of concrete slabs: dowels along the lane, 32 by 450 mm, every 30 cm, 12 cm deep, each magnetised anew."""
    along = np.linspace(-0.18, 0.18, 5)
    dowels = []
    for left in np.arange(-1.8, 1.81, 0.3):
        place = np.stack([along, left + 0 * along, np.full(5, -0.12)], 1)
        moment = rng.normal((0, 0, -0.02), (0.5, 0.06, 0.06)) / 5
        dowels.append(np.hstack([place, np.tile(moment, (5, 1))]))
    return np.concatenate(dowels)


def _tram_rails(rng: np.random.Generator) -> Floats:
    """Sixty metres of grooved rails, 60 kg/m, in the road; their magnetisation changes from metre to metre."""
    step = 0.08
    along = np.arange(-30, 30, step)
    rails = []
    for left in (-0.7175, 0.7175):
        place = np.stack([along, np.full(along.size, left), np.full(along.size, -0.06)], 1)
        knots = np.cumsum(rng.normal(0, 0.5, (62, 3)), axis=0) + rng.normal(0, (6, 2, 2))
        slow = np.stack([np.interp(along, np.arange(62) - 31, column) for column in knots.T], 1)  # [A m2/m]
        rails.append(np.hstack([place, slow * step]))
    return np.concatenate(rails)


KINDS: dict[str, Callable[[np.random.Generator], Floats]] = {
    "car": _car, "manhole cover": _cover, "bridge joint": _joint, "rebar": _rebar, "steel plate": _plate,
    "bolt": _bolt, "scrap": _scrap, "slab joint": _slab_joint, "tram rails": _tram_rails,
}  # fmt: skip
SCATTERED = ("car", "manhole cover", "bridge joint", "rebar", "steel plate", "bolt", "scrap")
"""Kinds that lie about one by one; slab joints come in rows, and rails run along the road."""


Draw = Callable[[Clutter, Road, np.random.Generator], Floats]
"""From an object on a road to its dipoles in lane coordinates, shape (N, 6): place and moment. [m, A m2]"""


def dipole_clutter(thing: Clutter, _road: Road, rng: np.random.Generator) -> Floats:
    """Dipoles of an object as this module describes it, shape (N, 6). [m, A m2]"""
    return KINDS[thing.kind](rng)


def place_clutter(
    objects: Iterable[Clutter], road: Road, rng: np.random.Generator, *, draw: Draw = dipole_clutter
) -> tuple[Floats, Floats]:
    """Dipoles of objects, (N, 6) place and moment in the world, and the chainage of each."""
    rows, chainages = [], []
    for thing in objects:
        local = draw(thing, road, rng)
        chainage = thing.chainage_m + local[:, 0]
        world = np.empty_like(local)
        world[:, :2] = road.world_m(chainage, thing.left_m + local[:, 1])
        world[:, 2] = local[:, 2]
        turned_to_world(local[:, 3:], road.yaw_rad(chainage), out=world[:, 3:])
        rows.append(world)
        chainages.append(chainage)
    if not rows:
        return np.empty((0, 6)), np.empty(0)
    return np.concatenate(rows), np.concatenate(chainages)


def town_clutter(start_m: float, end_m: float, rng: np.random.Generator) -> list[Clutter]:
    """What a kilometre of town holds: parked cars, covers, small iron, a joint, some rebar."""
    per_km = {"car": 60, "manhole cover": 12, "bolt": 12, "scrap": 2, "bridge joint": 1, "rebar": 2, "steel plate": 0.5}
    found = []
    for kind, rate in per_km.items():
        for _ in range(rng.poisson(rate * (end_m - start_m) / 1000)):
            if kind == "car":
                left = rng.choice((-1, 1)) * rng.uniform(2.4, 3.2)
            elif kind in ("bridge joint", "rebar"):
                left = 0.0
            else:
                left = rng.uniform(-1.6, 1.6)
            found.append(Clutter(kind, float(rng.uniform(start_m, end_m)), float(left)))
    return found


def ferrous_clutter(start_m: float, end_m: float, spacing_m: float, rng: np.random.Generator) -> list[Clutter]:
    """One object after the other, of every scattered kind in turn, all driven over but the cars."""
    found = []
    for i, at in enumerate(np.arange(start_m, end_m, spacing_m)):
        kind = SCATTERED[i % len(SCATTERED)]
        left = float(rng.choice((-1, 1)) * rng.uniform(1.9, 2.8)) if kind == "car" else float(rng.uniform(-0.9, 0.9))
        found.append(Clutter(kind, float(at), left))
    return found


def slab_joints(start_m: float, end_m: float, slab_m: float) -> list[Clutter]:
    """Joints of the slabs of a concrete road, evenly apart."""
    return [Clutter("slab joint", float(at), 0.0) for at in np.arange(start_m, end_m, slab_m)]
