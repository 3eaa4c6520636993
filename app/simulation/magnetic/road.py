"""The road and what lies in it: magnets as they were really placed, in world coordinates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from app.markers.magnet import HALF_HEIGHT_M, MOMENT_AM2, InformationTag, Orientation, Polarity
from app.values import Floats

_STEP_M = 0.25  # [m] between points of the centre line; 4 mm of sagitta at 2 m radius


class Road:
    """A lane's centre line from curvatures.

    Parameters
    ----------
    length_m : float
        Of the lane. [m]
    bends : sequence of (start_m, end_m, radius_m)
        Stretches with a constant radius; positive turns left. [m]
    heading_deg : float
        At chainage 0, clockwise from north. [deg]
    """

    def __init__(
        self, length_m: float, bends: Sequence[tuple[float, float, float]] = (), *, heading_deg: float = 30.0
    ) -> None:
        self._at = np.arange(-50.0, length_m + 50.0, _STEP_M)
        curvature = np.zeros_like(self._at)
        for start, end, radius in bends:
            curvature[(self._at >= start) & (self._at < end)] = 1 / radius
        turned = np.concatenate([[0], np.cumsum(curvature[:-1]) * _STEP_M])
        self._yaw = math.radians(90 - heading_deg) + turned - np.interp(0, self._at, turned)
        mid = (self._yaw[1:] + self._yaw[:-1]) / 2
        self._east = np.concatenate([[0], np.cumsum(np.cos(mid)) * _STEP_M])
        self._north = np.concatenate([[0], np.cumsum(np.sin(mid)) * _STEP_M])
        self.length_m = length_m

    def yaw_rad(self, chainage_m: Floats) -> Floats:
        """Direction of the lane, anticlockwise from east. [rad]"""
        return np.asarray(np.interp(chainage_m, self._at, self._yaw))

    def world_m(self, chainage_m: Floats, left_m: Floats | float = 0.0) -> Floats:
        """East and north of points beside the lane, shape (N, 2). [m]"""
        yaw = self.yaw_rad(chainage_m)
        east = np.interp(chainage_m, self._at, self._east) - np.asarray(left_m) * np.sin(yaw)
        north = np.interp(chainage_m, self._at, self._north) + np.asarray(left_m) * np.cos(yaw)
        return np.stack([east, north], -1)


@dataclass(frozen=True, slots=True)
class RoadMagnet:
    """A magnet as designed: where, and which way its north pole points in the direction of legal travel."""

    # `chainage_m`, `left_m`: [m] along the lane and left of its centre
    chainage_m: float
    left_m: float
    polarity: Polarity
    orientation: Orientation
    tag: int = -1  # number of the information tag that it belongs to, -1 for a line's magnet
    depth_m: float = -HALF_HEIGHT_M  # [m] of its centre below the road; without, it lies on the road


@dataclass(frozen=True, slots=True)
class PlacedTag:
    """An information tag at a chainage of the lane."""

    tag: InformationTag
    chainage_m: float
    left_m: float = 0.0
    depth_m: float = -HALF_HEIGHT_M  # [m] as of `RoadMagnet`


@dataclass(frozen=True, slots=True)
class Spread:
    """Standard deviations between a magnet as designed and as it lies."""

    moment: float = 0.03  # share of the moment
    tilt_deg: float = 3.0  # [deg] about each of two axes
    # `placement_m`, `depth_m`: [m] along and across; up and down
    placement_m: float = 0.002
    depth_m: float = 0.003


def tag_magnets(tags: Sequence[PlacedTag]) -> list[RoadMagnet]:
    """Magnets of information tags, tag by tag."""
    return [
        RoadMagnet(
            placed.chainage_m + m.along_m,
            placed.left_m + m.lateral_m,
            m.polarity,
            m.orientation,
            number,
            placed.depth_m,
        )
        for number, placed in enumerate(tags)
        for m in placed.tag.magnets
    ]


def line_magnets(start_m: float, end_m: float, spacing_m: float, left_m: float, polarity: Polarity) -> list[RoadMagnet]:
    """Magnets of a line, from start to before end."""
    return [RoadMagnet(float(at), left_m, polarity, Orientation.UP) for at in np.arange(start_m, end_m, spacing_m)]


def place_magnets(
    magnets: Sequence[RoadMagnet],
    road: Road,
    spread: Spread,
    rng: np.random.Generator,
    *,
    moment_am2: float = MOMENT_AM2,
) -> tuple[Floats, Floats]:
    """Dipoles of magnets as they lie: (N, 6) place and moment in the world (east, north, up), and their chainage."""
    n = len(magnets)
    off = rng.normal(0, 1, (n, 3)) * (spread.placement_m, spread.placement_m, spread.depth_m)
    chainage = np.array([m.chainage_m for m in magnets]) + off[:, 0]
    left = np.array([m.left_m for m in magnets]) + off[:, 1]
    upright = np.array([m.orientation is Orientation.UP for m in magnets], bool)
    sign = np.array([m.polarity.sign for m in magnets], float)
    tilt = np.radians(rng.normal(0, spread.tilt_deg, (n, 2)))
    axis = np.where(
        upright[:, None],
        np.stack([np.sin(tilt[:, 0]), np.sin(tilt[:, 1]), np.ones(n)], 1),
        np.stack([np.ones(n), np.sin(tilt[:, 0]), np.sin(tilt[:, 1])], 1),
    )
    axis *= (sign * moment_am2 * (1 + rng.normal(0, spread.moment, n)) / np.linalg.norm(axis, axis=1))[:, None]
    dipoles = np.empty((n, 6))
    dipoles[:, :2] = road.world_m(chainage, left)
    dipoles[:, 2] = off[:, 2] - [m.depth_m for m in magnets]
    turned_to_world(axis, road.yaw_rad(chainage), out=dipoles[:, 3:])
    return dipoles, chainage


def turned_to_world(vectors: Floats, yaw_rad: Floats, out: Floats) -> None:
    """Vectors along, left and up of a lane as east, north, up."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    out[:, 0] = c * vectors[:, 0] - s * vectors[:, 1]
    out[:, 1] = s * vectors[:, 0] + c * vectors[:, 1]
    out[:, 2] = vectors[:, 2]
