"""Lanes by the figures that describe them: bends, hairpins, widening, tapers, lay-bys, merges and shifts."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from app.errors import InvalidParameter
from app.radio.settings import check_between
from app.simulation.radio.lanes import STEP_M, Origin, TrueLane, lane_between
from app.values import Floats

MICHIGAN: Origin = (-83.7, 42.3, 250.0)
"""Where the lanes lie: the CERPM paper's drives were in Michigan."""


@dataclass(frozen=True, slots=True)
class RoadShape:
    """A lane of two bends, whose boundaries part where lanes open, merge or shift. Angles are of the centre line."""

    length_m: float = 400.0  # [m] of the centre line before boundaries part
    # `radius_m`, `turn_deg`, `clothoid_m`: of the first bend: at its tightest, its direction after it against before,
    # and of each of its clothoids. Above 180 degrees a hairpin. [m, deg, m]
    radius_m: float = 200.0
    turn_deg: float = 40.0
    clothoid_m: float = 30.0
    # `second_radius_m`, `second_turn_deg`: of a bend to the other side after it. [m, deg]
    second_radius_m: float = 300.0
    second_turn_deg: float = 30.0
    straight_m: float = 60.0  # [m] before the first bend and between the two
    turns_left: bool = True  # the first bend
    width_m: float = 3.3  # [m] on straights
    widening_m2: float = 0.0  # [m2] extra width in bends is this over the radius
    # `extra_m`, `extra_start`, `extra_length_m`, `taper_m`: extra width on one side: how much, where its taper begins
    # as a share of the length, how long it keeps its width, and the length of a taper. [m, 1, m, m]
    extra_m: float = 0.0
    extra_start: float = 0.5
    extra_length_m: float = 60.0
    taper_m: float = 40.0
    # `extra_on_left`, `extra_stays`: its side, and whether it goes on to the end: without it, it ends in a taper too
    extra_on_left: bool = False
    extra_stays: bool = False
    # `shift_m`, `shift_length_m`, `shift_start`: both boundaries shift to the left by so much, over a length, from a
    # share of the lane's length on. [m, m, 1]
    shift_m: float = 0.0
    shift_length_m: float = 40.0
    shift_start: float = 0.3
    heading_deg: float = 30.0  # [deg] of the first straight

    def __post_init__(self) -> None:
        for one in fields(self):
            if not math.isfinite(getattr(self, one.name)):
                raise InvalidParameter(f"{one.name} is not finite", field=one.name, limit="a finite value")
        for name, low, high, unit in (
            ("length_m", 50.0, 5000.0, "m"), ("radius_m", 6.0, 1e6, "m"), ("second_radius_m", 6.0, 1e6, "m"),
            ("turn_deg", 0.0, 250.0, "deg"), ("second_turn_deg", 0.0, 250.0, "deg"), ("clothoid_m", 1.0, 500.0, "m"),
            ("width_m", 2.0, 6.0, "m"), ("taper_m", 5.0, 500.0, "m"), ("shift_length_m", 5.0, 500.0, "m"),
            ("extra_m", 0.0, 5.0, "m"), ("widening_m2", 0.0, 100.0, "m2"),
        ):  # fmt: skip
            check_between(name, getattr(self, name), low, high, unit)


def lane_of_shape(shape: RoadShape) -> TrueLane:
    """The lane of a shape.

    Raises
    ------
    InvalidParameter
        Its boundaries cross, as where a bend is tighter than half its width.
    """
    at = np.arange(0.0, shape.length_m + STEP_M / 2, STEP_M)
    curvature = _curvature_per_m(shape, at)
    turned = np.concatenate([[0.0], np.cumsum((curvature[1:] + curvature[:-1]) / 2 * STEP_M)])
    yaw = math.pi / 2 - math.radians(shape.heading_deg) + turned
    mid = (yaw[1:] + yaw[:-1]) / 2
    step = STEP_M * np.stack([np.cos(mid), np.sin(mid)], 1)
    centre = np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)])
    normal = np.stack([-np.sin(yaw), np.cos(yaw)], 1)
    start = shape.shift_start * shape.length_m
    aside = shape.shift_m * _ramp((at - start) / shape.shift_length_m)
    half = (shape.width_m + shape.widening_m2 * np.abs(curvature)) / 2
    extra = _extra_m(shape, at)
    left = aside + half + (extra if shape.extra_on_left else 0.0)
    right = aside - half - (0.0 if shape.extra_on_left else extra)
    return lane_between(centre + normal * left[:, None], centre + normal * right[:, None], MICHIGAN)


def _curvature_per_m(shape: RoadShape, at_m: Floats) -> Floats:
    """Positive to the left, linear along clothoids, shape (N,). [1/m]"""
    sign, start, knots = (1.0 if shape.turns_left else -1.0), shape.straight_m, [(0.0, 0.0)]
    for radius, turn in ((shape.radius_m, shape.turn_deg), (shape.second_radius_m, shape.second_turn_deg)):
        clothoid, angle = shape.clothoid_m, math.radians(turn)
        arc = max(angle * radius - clothoid, 0.0)
        peak = angle / (arc + clothoid)
        for more, value in ((0.0, 0.0), (clothoid, sign * peak), (arc, sign * peak), (clothoid, 0.0)):
            start += more
            knots.append((start, value))
        sign, start = -sign, start + shape.straight_m
    chainage, value = np.array(knots).T
    return np.asarray(np.interp(at_m, chainage, value))


def _extra_m(shape: RoadShape, at_m: Floats) -> Floats:
    start = shape.extra_start * shape.length_m
    opened = _ramp((at_m - start) / shape.taper_m)
    end = start + shape.taper_m + shape.extra_length_m
    closed = 0.0 if shape.extra_stays else _ramp((at_m - end) / shape.taper_m)
    return np.asarray(shape.extra_m * (opened - closed))


def _ramp(share: Floats) -> Floats:
    """From 0 at 0 to 1 at 1, as a straight painted taper with its corners rounded over a tenth."""
    inner = np.clip(share, 0.0, 1.0)
    smooth: Floats = inner * inner * (3 - 2 * inner)
    return 0.8 * inner + 0.2 * smooth
