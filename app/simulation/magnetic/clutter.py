"""Iron that is not a marker: cars beside the road, manhole covers, joints, rebar, plates and scrap.

Each is a cluster of dipoles in lane coordinates (along, left, up), induced by the earth's field and, as steel is,
permanently magnetised several times as much. Moments are chosen so that the fields agree with what is published for
such objects: a car some ten uT at 1 m, a cover tens of uT at 20 cm, a bolt a few uT at 20 cm. The same objects exist as
prolate spheroids that the earth's field magnetises.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy

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


# === Iron as prolate spheroids: magnetisation, the dipoles that give their field, and clutter of them.


STEEL_SUSCEPTIBILITY = 200.0
"""Of structural steel in weak fields. Source: assumed, within the 100 to 300 of mild steel's initial permeability."""
_UT_PER_A_M = 0.4 * math.pi
"""mu0. [uT / (A/m)] Source: SI."""
_NODE_M = 0.05
"""Mean distance between the dipoles of a long spheroid. [m] Source: a bar's field 16 cm above it is good to 1 %, with
8 cm only to 8 % (tests/simulation/test_magnetic_physics.py)."""
_SPHERE_ASPECT = 1.001
"""Below this ratio of axes the factors are a sphere's; they differ by less than 3e-4. Source: Osborn 1945."""


@dataclass(frozen=True, slots=True)
class Spheroid:
    """A body of iron with one long axis, in lane coordinates (along, left, up)."""

    centre_m: tuple[float, float, float]
    axis: tuple[float, float, float]  # unit vector along its long axis
    # `half_length_m`, `half_width_m`: [m] Semi-axes; the first is not the shorter one
    half_length_m: float
    half_width_m: float
    # [A/m] Permanent magnetisation as seen from outside, along, left and up
    permanent_am: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # of the iron; for a hull or a frame, the iron's times the share of the volume that it fills
    susceptibility: float = STEEL_SUSCEPTIBILITY

    @property
    def volume_m3(self) -> float:
        """[m3]"""
        return 4 / 3 * math.pi * self.half_length_m * self.half_width_m**2


def demagnetising_factors(aspect: float) -> tuple[float, float]:
    """Demagnetising factors of a prolate spheroid along and across its long axis.

    Parameters
    ----------
    aspect : float
        Long over short axis, 1 or more.

    Notes
    -----
    Osborn, "Demagnetizing factors of the general ellipsoid", Physical Review 67 (1945), 351, prolate spheroid; the
    three factors add up to 1.
    """
    if aspect < _SPHERE_ASPECT:
        return 1 / 3, 1 / 3
    root = math.sqrt(aspect**2 - 1)
    along = (aspect / root * math.log(aspect + root) - 1) / root**2
    return along, (1 - along) / 2


def spheroid_moment_am2(spheroid: Spheroid, earth_ut: Floats) -> Floats:
    """Moment of a spheroid in the earth's field, shape (3,). [A m2]

    Parameters
    ----------
    earth_ut : ndarray, shape (3,)
        The earth's field along, left and up. [uT]

    Notes
    -----
    Volume times magnetisation, which is the permanent one plus chi H / (1 + chi N) for each axis of the spheroid, with
    its demagnetising factor N. Fields of other iron are neglected.
    """
    along, across = demagnetising_factors(spheroid.half_length_m / spheroid.half_width_m)
    axis, chi = np.array(spheroid.axis), spheroid.susceptibility
    field_am = np.asarray(earth_ut, float) / _UT_PER_A_M
    lengthwise = axis * (axis @ field_am)
    induced_am = chi * lengthwise / (1 + chi * along) + chi * (field_am - lengthwise) / (1 + chi * across)
    moment: Floats = spheroid.volume_m3 * (induced_am + np.array(spheroid.permanent_am))
    return moment


def spheroid_dipoles(spheroid: Spheroid, earth_ut: Floats, *, nodes: int | None = None) -> Floats:
    """Dipoles whose field outside a spheroid is the spheroid's, shape (K, 6): place and moment. [m, A m2]

    Parameters
    ----------
    earth_ut : ndarray, shape (3,)
        The earth's field along, left and up. [uT]
    nodes : int, optional
        K; by default one for every 5 cm between the foci.

    Notes
    -----
    The potential of a uniform prolate spheroid is that of a line between its foci with a density of 1 - (s/c)^2, c the
    distance of a focus from the centre (MacMillan, The Theory of the Potential, 1930). By Poisson's theorem a uniformly
    magnetised one has the field of dipoles with that density. The line is a Gauss-Jacobi quadrature. A test compares
    the field at the tip with that inside.
    """
    focus_m = math.sqrt(max(spheroid.half_length_m**2 - spheroid.half_width_m**2, 0.0))
    at, share = _line_of_foci(nodes or math.ceil(2 * focus_m / _NODE_M) + 1)
    place = np.array(spheroid.centre_m) + focus_m * at[:, None] * np.array(spheroid.axis)
    return np.hstack([place, share[:, None] * spheroid_moment_am2(spheroid, earth_ut)])


@lru_cache(maxsize=64)
def _line_of_foci(nodes: int) -> tuple[Floats, Floats]:
    """Nodes from -1 to 1 and their shares of the whole, for the density 1 - x^2."""
    at, weight = scipy.special.roots_jacobi(nodes, 1.0, 1.0)
    return at, weight / weight.sum()


# === The objects of `clutter` as prolate spheroids that the earth's field magnetises, in place of dipoles.
#
# Sizes are those of the objects. Permanent magnetisations are drawn so that the fields are about those of the dipoles
# in `clutter`, whose sources it names; all standard deviations in A/m are assumed. Flat objects are rows of bars, in
# which a vertical field induces up to twice as much: a bar's demagnetising factor across is 1/2, a plate's 1.


Vector = tuple[float, float, float]

_ALONG: Vector = (1.0, 0.0, 0.0)
_ACROSS: Vector = (0.0, 1.0, 0.0)
_BODY_FILL = 0.02
"""Share of a car's hull that is steel. Source: assumed, 0.9 t of steel in 6 m3."""


def spheroid_clutter(thing: Clutter, road: Road, rng: np.random.Generator, *, earth_ut: Vector) -> Floats:
    """Dipoles of an object made of spheroids, shape (N, 6): place and moment in lane coordinates. [m, A m2]

    Parameters
    ----------
    road : Road
        Its direction at the object turns the earth's field.
    rng : numpy.random.Generator
        Draws the permanent magnetisation and what differs from object to object.
    earth_ut : tuple of float
        The earth's field, east, north, up. [uT]
    """
    yaw = float(road.yaw_rad(np.array([thing.chainage_m]))[0])
    c, s = math.cos(yaw), math.sin(yaw)
    earth_lane_ut = np.array([c * earth_ut[0] + s * earth_ut[1], -s * earth_ut[0] + c * earth_ut[1], earth_ut[2]])
    return np.concatenate([spheroid_dipoles(one, earth_lane_ut) for one in SHAPES[thing.kind](rng)])


def _magnetised(values_am: Floats) -> Vector:
    return float(values_am[0]), float(values_am[1]), float(values_am[2])


def _car_spheroids(rng: np.random.Generator) -> list[Spheroid]:
    """A hull, an engine in front or behind, and two axles."""
    front = float(rng.choice((-1, 1)))
    hull_am, engine_am = rng.normal(0, 20, 3), rng.normal(0, 300, 3)
    axles = [
        Spheroid((at, 0.0, 0.3), _ACROSS, 0.75, 0.03, (0.0, float(rng.normal(0, 3000)), 0.0)) for at in (-1.35, 1.35)
    ]
    return [
        Spheroid((0.0, 0.0, 0.7), _ALONG, 2.2, 0.8, _magnetised(hull_am), _BODY_FILL * STEEL_SUSCEPTIBILITY),
        Spheroid((1.4 * front, 0.0, 0.5), _ACROSS, 0.35, 0.25, _magnetised(engine_am)),
        *axles,
    ]


def _cover_spheroids(rng: np.random.Generator) -> list[Spheroid]:
    """Seven parallel bars that fill a disc of 60 cm, 70 kg."""
    common_am = rng.normal((0.0, 0.0, -900.0), 1200.0)
    return [
        Spheroid(
            (0.0, left, -0.03), _ALONG, math.sqrt(0.3**2 - left**2), 0.035,
            _magnetised(common_am + rng.normal(0, 600, 3)),
        )
        for left in (-0.24, -0.16, -0.08, 0.0, 0.08, 0.16, 0.24)
    ]  # fmt: skip


def _joint_spheroids(rng: np.random.Generator) -> list[Spheroid]:
    """Two edges across the road, each of seven bars of a metre."""
    return [
        Spheroid((along, left, -0.03), _ACROSS, 0.5, 0.03, _magnetised(rng.normal(0, (1000, 2000, 1000))))
        for along in (-0.04, 0.04)
        for left in np.arange(-3.0, 3.1, 1.0).tolist()
    ]


def _rebar_spheroids(rng: np.random.Generator) -> list[Spheroid]:
    """Twelve metres of bars across, 16 mm thick, one every 20 cm, 6 cm deep."""
    return [
        Spheroid(
            (along + float(rng.normal(0, 0.01)), 0.0, -0.06 + float(rng.normal(0, 0.005))), _ACROSS, 1.8, 0.008,
            _magnetised(rng.normal(0, (800, 3000, 800))),
        )
        for along in np.arange(-6, 6, 0.2).tolist()
    ]  # fmt: skip


def _plate_spheroids(rng: np.random.Generator) -> list[Spheroid]:
    """The rim of a steel plate of 2 by 1.5 m."""
    common_am = rng.normal(0, 3000, 3)
    edges = [((0.0, side * 0.75, 0.0), _ALONG, 1.0) for side in (-1, 1)]
    edges += [((float(side), 0.0, 0.0), _ACROSS, 0.75) for side in (-1, 1)]
    return [
        Spheroid(centre, axis, half, 0.03, _magnetised(common_am + rng.normal(0, 1500, 3)))
        for centre, axis, half in edges
    ]


def _bolt_spheroids(rng: np.random.Generator) -> list[Spheroid]:
    """A nut, a bolt, a piece of wire, 2 to 8 cm long."""
    half_length, half_width = rng.uniform(0.01, 0.04), rng.uniform(0.004, 0.01)
    return [_loose(rng, 0.01, float(half_length), float(half_width), strongest=4.7)]


def _scrap_spheroids(rng: np.random.Generator) -> list[Spheroid]:
    """A piece of exhaust or a tool, 15 to 50 cm long."""
    half_length, half_width = rng.uniform(0.075, 0.25), rng.uniform(0.008, 0.02)
    return [_loose(rng, 0.02, float(half_length), float(half_width), strongest=4.5)]


def _loose(
    rng: np.random.Generator, up_m: float, half_length_m: float, half_width_m: float, *, strongest: float
) -> Spheroid:
    """A piece that lies in any direction, magnetised mostly along itself by 10^3 to 10^strongest A/m."""
    turn = rng.uniform(0, 2 * math.pi)
    axis = np.array([math.cos(turn), math.sin(turn), 0.0])
    permanent_am = 10 ** rng.uniform(3, strongest) * (axis + rng.normal(0, 0.3, 3))
    return Spheroid((0.0, 0.0, up_m), _magnetised(axis), half_length_m, half_width_m, _magnetised(permanent_am))


def _slab_joint_spheroids(rng: np.random.Generator) -> list[Spheroid]:
    """Thirteen dowels along the lane, 32 by 450 mm."""
    return [
        Spheroid((0.0, left, -0.12), _ALONG, 0.225, 0.016, _magnetised(rng.normal(0, (2000, 250, 250))))
        for left in np.arange(-1.8, 1.81, 0.3).tolist()
    ]


def _tram_rails_spheroids(rng: np.random.Generator) -> list[Spheroid]:
    """Two rails of 76 cm2, in pieces of a metre, each magnetised a little differently from the last."""
    pieces = []
    for left in (-0.7175, 0.7175):
        slow_am = np.cumsum(rng.normal(0, 120, (60, 3)), axis=0) + rng.normal(0, (1400, 450, 450))
        pieces += [
            Spheroid((at + 0.5, left, -0.06), _ALONG, 0.5, 0.06, _magnetised(one))
            for at, one in zip(range(-30, 30), slow_am, strict=True)
        ]
    return pieces


SHAPES: dict[str, Callable[[np.random.Generator], list[Spheroid]]] = {
    "car": _car_spheroids, "manhole cover": _cover_spheroids, "bridge joint": _joint_spheroids,
    "rebar": _rebar_spheroids, "steel plate": _plate_spheroids,
    "bolt": _bolt_spheroids, "scrap": _scrap_spheroids, "slab joint": _slab_joint_spheroids,
    "tram rails": _tram_rails_spheroids,
}  # fmt: skip
