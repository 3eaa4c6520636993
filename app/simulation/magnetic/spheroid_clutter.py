"""The objects of `clutter` as prolate spheroids that the earth's field magnetises, in place of dipoles.

Sizes are those of the objects. Permanent magnetisations are drawn so that the fields are about those of the dipoles in
`clutter`, whose sources it names; all standard deviations in A/m are assumed. Flat objects are rows of bars, in which a
vertical field induces up to twice as much: a bar's demagnetising factor across is 1/2, a plate's 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from app.simulation.magnetic.clutter import Clutter
from app.simulation.magnetic.road import Road
from app.simulation.magnetic.spheroids import STEEL_SUSCEPTIBILITY, Spheroid, spheroid_dipoles

Floats = npt.NDArray[np.float64]
Vector = tuple[float, float, float]

_ALONG: Vector = (1.0, 0.0, 0.0)
_ACROSS: Vector = (0.0, 1.0, 0.0)
_BODY_FILL = 0.02
"""Share of a car's hull that is steel. Source: assumed, 0.9 t of steel in 6 m3."""


def spheroid_clutter(thing: Clutter, road: Road, rng: np.random.Generator, *, earth_ut: Vector) -> Floats:
    """Dipoles of an object made of spheroids, shape (N, 6): place and moment in lane coordinates. [m, A m2]

    Parameters
    ----------
    thing : Clutter
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


def _car(rng: np.random.Generator) -> list[Spheroid]:
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


def _cover(rng: np.random.Generator) -> list[Spheroid]:
    """Seven parallel bars that fill a disc of 60 cm, 70 kg."""
    common_am = rng.normal((0.0, 0.0, -900.0), 1200.0)
    return [
        Spheroid(
            (0.0, left, -0.03), _ALONG, math.sqrt(0.3**2 - left**2), 0.035,
            _magnetised(common_am + rng.normal(0, 600, 3)),
        )
        for left in (-0.24, -0.16, -0.08, 0.0, 0.08, 0.16, 0.24)
    ]  # fmt: skip


def _joint(rng: np.random.Generator) -> list[Spheroid]:
    """Two edges across the road, each of seven bars of a metre."""
    return [
        Spheroid((along, left, -0.03), _ACROSS, 0.5, 0.03, _magnetised(rng.normal(0, (1000, 2000, 1000))))
        for along in (-0.04, 0.04)
        for left in np.arange(-3.0, 3.1, 1.0).tolist()
    ]


def _rebar(rng: np.random.Generator) -> list[Spheroid]:
    """Twelve metres of bars across, 16 mm thick, one every 20 cm, 6 cm deep."""
    return [
        Spheroid(
            (along + float(rng.normal(0, 0.01)), 0.0, -0.06 + float(rng.normal(0, 0.005))), _ACROSS, 1.8, 0.008,
            _magnetised(rng.normal(0, (800, 3000, 800))),
        )
        for along in np.arange(-6, 6, 0.2).tolist()
    ]  # fmt: skip


def _plate(rng: np.random.Generator) -> list[Spheroid]:
    """The rim of a steel plate of 2 by 1.5 m."""
    common_am = rng.normal(0, 3000, 3)
    edges = [((0.0, side * 0.75, 0.0), _ALONG, 1.0) for side in (-1, 1)]
    edges += [((float(side), 0.0, 0.0), _ACROSS, 0.75) for side in (-1, 1)]
    return [
        Spheroid(centre, axis, half, 0.03, _magnetised(common_am + rng.normal(0, 1500, 3)))
        for centre, axis, half in edges
    ]


def _bolt(rng: np.random.Generator) -> list[Spheroid]:
    """A nut, a bolt, a piece of wire, 2 to 8 cm long."""
    half_length, half_width = rng.uniform(0.01, 0.04), rng.uniform(0.004, 0.01)
    return [_loose(rng, 0.01, float(half_length), float(half_width), strongest=4.7)]


def _scrap(rng: np.random.Generator) -> list[Spheroid]:
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


SHAPES: dict[str, Callable[[np.random.Generator], list[Spheroid]]] = {
    "car": _car, "manhole cover": _cover, "bridge joint": _joint, "rebar": _rebar, "steel plate": _plate,
    "bolt": _bolt, "scrap": _scrap,
}  # fmt: skip
