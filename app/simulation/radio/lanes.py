"""Lanes with a known centre line: between two boundaries, or made of clothoids."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt
import pymap3d
import scipy

from app.errors import InvalidParameter
from app.lanes.cross_sections import cut_lane, direction_rad
from app.lanes.types import MarkerPlace
from app.markers.cerpm import DEGREE_STEP, LaneSide, SpeedLimit
from app.values import Floats, Ints

Origin = tuple[float, float, float]

STEP_M = 0.25  # [m] between stations; an eighth of the smoothing of 2.2 m
_MAX_CURVATURE_PER_M = 0.04  # [1/m] a radius of 25 m
_CAR_SMOOTHING_M = 3.0  # [m] about a wheelbase
_MAX_TURN_RAD = 2.2  # [rad] of the direction against the first one, so that lanes do not cross themselves


@dataclass(frozen=True, slots=True, eq=False)
class TrueLane:
    """The truth about a lane."""

    origin: Origin  # lon_deg, lat_deg, height_m of the local frame
    chainage_m: Floats  # shape (N,): [m] along the centre line, even steps
    # `centre_m`, `left_m`, `right_m`: shape (N, 2): [m] east and north; the centre is halfway between the boundaries
    centre_m: Floats
    left_m: Floats
    right_m: Floats
    # `yaw_rad`, `curvature_per_m`: shape (N,): anticlockwise from east, unwrapped; positive to the left. On lanes from
    # polylines, over a Gaussian of 2.2 m.
    yaw_rad: Floats
    curvature_per_m: Floats

    @property
    def length_m(self) -> float:
        """Of the centre line. [m]"""
        return float(self.chainage_m[-1])

    @property
    def width_m(self) -> Floats:
        """Between the boundaries, shape (N,). [m]"""
        return np.asarray(np.linalg.norm(self.left_m - self.right_m, axis=1))

    def points_m(self, chainage_m: npt.ArrayLike, left_m: npt.ArrayLike = 0.0) -> Floats:
        """East and north beside the centre line as a car follows it, shape (K, 2). [m]

        A car does not follow kinks: the line is smoothed over 3 m. The lane is straight beyond its ends.
        """
        at, aside = np.broadcast_arrays(np.asarray(chainage_m, float), np.asarray(left_m, float))
        line, yaw = self._driven()
        inside = np.clip(at, 0.0, self.length_m)
        turn = np.interp(inside, self.chainage_m, yaw)
        ahead = np.stack([np.cos(turn), np.sin(turn)], -1)
        on = np.stack([np.interp(inside, self.chainage_m, line[:, k]) for k in range(2)], -1)
        beside = aside[..., None] * np.stack([-ahead[..., 1], ahead[..., 0]], -1)
        return np.asarray(on + (at - inside)[..., None] * ahead + beside)

    def _driven(self) -> tuple[Floats, Floats]:
        """The centre line without kinks: integrated from its smoothed direction, drift taken out; and its direction."""
        step = float(self.chainage_m[1])
        yaw = direction_rad(self.centre_m, step, _CAR_SMOOTHING_M)
        mid = (yaw[1:] + yaw[:-1]) / 2
        path = np.concatenate([[[0.0, 0.0]], np.cumsum(step * np.stack([np.cos(mid), np.sin(mid)], 1), axis=0)])
        return path + _smoothed(self.centre_m - path, step), yaw

    def enu_from_wgs84(self, lon_deg: npt.ArrayLike, lat_deg: npt.ArrayLike) -> Floats:
        """East and north of positions on the lane's ground, shape (K, 2). [m]"""
        lon0, lat0, height = self.origin
        east, north, _up = pymap3d.geodetic2enu(np.asarray(lat_deg), np.asarray(lon_deg), height, lat0, lon0, height)
        return np.stack([east, north], -1)

    def wgs84_from_enu(self, points_m: Floats) -> tuple[Floats, Floats]:
        """Longitude and latitude of points on the ground, each shape (K,). [deg]"""
        lon0, lat0, height = self.origin
        lat, lon, _height = pymap3d.enu2geodetic(points_m[..., 0], points_m[..., 1], 0.0, lat0, lon0, height)
        return (np.asarray(lon) + 180.0) % 360.0 - 180.0, np.asarray(lat)


def lane_between(left_m: npt.ArrayLike, right_m: npt.ArrayLike, origin: Origin) -> TrueLane:
    """The lane between two boundaries as polylines.

    Parameters
    ----------
    left_m, right_m : array_like, shape (L, 2) and (R, 2)
        East and north from the origin, in direction of travel. [m]
    origin : tuple of float
        lon_deg, lat_deg, height_m.

    Raises
    ------
    InvalidParameter
        They are not the boundaries of a lane: see `cut_lane`.
    """
    cut = cut_lane(left_m, right_m, step_m=STEP_M)
    return TrueLane(origin, cut.chainage_m, cut.centre_m, cut.left_m, cut.right_m, cut.yaw_rad, cut.curvature_per_m)


def lane_from_wgs84(left_deg: npt.ArrayLike, right_deg: npt.ArrayLike, *, height_m: float = 0.0) -> TrueLane:
    """The lane between two boundaries in longitude and latitude, each shape (N, 2); the origin is on the left one.

    Raises
    ------
    InvalidParameter
        They are not the boundaries of a lane: see `cut_lane`.
    """
    left, right = np.asarray(left_deg, float), np.asarray(right_deg, float)
    for name, line in (("left_deg", left), ("right_deg", right)):
        if line.ndim != 2 or line.shape[1] != 2 or len(line) < 2:
            raise InvalidParameter(
                f"{name} is no line", field=name, limit="longitude and latitude of two points or more"
            )
    lon0, lat0 = float(left[0, 0]), float(left[0, 1])
    sides = [
        np.stack(pymap3d.geodetic2enu(line[:, 1], line[:, 0], height_m, lat0, lon0, height_m)[:2], -1)
        for line in (left, right)
    ]
    return lane_between(sides[0], sides[1], (lon0, lat0, height_m))


def make_lane(
    rng: np.random.Generator,
    *,
    length_m: float = 500.0,
    max_curvature_per_m: float = _MAX_CURVATURE_PER_M,
    width_m: tuple[float, float] = (2.7, 3.6),
    origin: Origin = (-83.7, 42.3, 250.0),
) -> TrueLane:
    """A lane of straights, clothoids and arcs, whose width changes along it.

    Parameters
    ----------
    rng : numpy.random.Generator
        Draws bends, width and direction.
    length_m : float
        Of the centre line, 50 m to 2,000 km. [m]
    max_curvature_per_m : float
        Sharpest bend; half of the bends are below a third of it. [1/m]
    width_m : tuple of float
        Minimum and maximum width. [m]

    Raises
    ------
    InvalidParameter
        A value is out of its range.
    """
    low, high = width_m
    if not (50 <= length_m <= 2e6 and 0 <= max_curvature_per_m <= 0.1 and 1.5 <= low <= high <= 12):
        raise InvalidParameter(
            f"a lane of {length_m:g} m, {max_curvature_per_m:g} 1/m, {low:g} to {high:g} m wide",
            limit="50 m to 2,000 km long, at most 0.1 1/m, 1.5 to 12 m wide",
        )
    knots = _bends(rng, length_m, max_curvature_per_m)
    count = round(length_m / STEP_M) + 1
    at = np.asarray(np.arange(count) * STEP_M, np.float64)
    curvature = np.interp(at, knots[:, 0], knots[:, 1])
    turned = np.concatenate([[0.0], np.cumsum((curvature[1:] + curvature[:-1]) / 2 * STEP_M)])
    yaw = float(rng.uniform(-math.pi, math.pi)) + turned
    mid = (yaw[1:] + yaw[:-1]) / 2
    centre = np.zeros((count, 2))
    centre[1:] = np.cumsum(STEP_M * np.stack([np.cos(mid), np.sin(mid)], 1), axis=0)
    width = _widths(rng, at, low, high)
    aside = np.stack([-np.sin(yaw), np.cos(yaw)], 1) * width[:, None] / 2
    return TrueLane(origin, at, centre, centre + aside, centre - aside, yaw, curvature)


def _bends(rng: np.random.Generator, length_m: float, sharpest_per_m: float) -> Floats:
    """Chainage and curvature where clothoids begin and end, shape (K, 2); curvature is linear between. [m, 1/m]"""
    knots = [(0.0, 0.0)]
    heading = 0.0
    while knots[-1][0] < length_m:
        start = knots[-1][0] + float(rng.uniform(5, 60))
        size = sharpest_per_m * (float(rng.uniform(0.33, 1)) if rng.random() < 0.5 else float(rng.uniform(0.02, 0.33)))
        clothoid = max(float(rng.uniform(10, 40)), 600 * size)
        arc = min(float(rng.uniform(10, 120)), max(1.8 / max(size, 1e-9) - clothoid, 5.0))
        sign = 1.0 if rng.random() < 0.5 else -1.0
        if abs(heading + sign * size * (arc + clothoid)) > _MAX_TURN_RAD:
            sign = -math.copysign(1.0, heading)
        heading += sign * size * (arc + clothoid)
        for more, value in ((0.0, 0.0), (clothoid, sign * size), (arc, sign * size), (clothoid, 0.0)):
            start += more
            knots.append((start, value))
    return np.array(knots)


def _widths(rng: np.random.Generator, at_m: Floats, low: float, high: float) -> Floats:
    """Widths that change over 60 to 200 m, shape (N,). [m]"""
    knots = [0.0]
    while knots[-1] < at_m[-1]:
        knots.append(knots[-1] + float(rng.uniform(60, 200)))
    values = rng.uniform(low, high, len(knots))
    k = np.clip(np.searchsorted(knots, at_m, side="right") - 1, 0, len(knots) - 2)
    share = (at_m - np.array(knots)[k]) / np.diff(knots)[k]
    return np.asarray(values[k] + (values[k + 1] - values[k]) * (1 - np.cos(np.pi * share)) / 2)


def _smoothed(points_m: Floats, step_m: float) -> Floats:
    return np.stack(
        [scipy.ndimage.gaussian_filter1d(points_m[:, k], _CAR_SMOOTHING_M / step_m, mode="nearest") for k in range(2)],
        1,
    )


# === Installed markers of a lane: true and surveyed positions, and missing markers.


SURVEY_SD_M = 0.02  # [m] of a surveyed coordinate, each axis; source: Trimble Catalyst DA2, CERPM paper, section 2.2
_PLACING_SD_M = 0.01  # [m] of placing a marker, each axis; assumed


@dataclass(frozen=True, slots=True, eq=False)
class InstalledMarkers:
    """Markers of a lane, by chainage."""

    number: Ints  # shape (N,): within the agency
    side: Ints  # shape (N,): True `LaneSide`, whatever the marker sends
    chainage_m: Floats  # shape (N,): [m] along the lane's centre line
    point_m: Floats  # shape (N, 2): [m] True position: east and north
    # `lon_deg`, `lat_deg`: shape (N,): [deg] surveyed position, in steps of 1e-7 degrees
    lon_deg: Floats
    lat_deg: Floats
    broadcast_side: Ints  # shape (N,): `LaneSide` that it is programmed with
    speed_limit: SpeedLimit | None = None

    def __len__(self) -> int:
        return len(self.number)

    def chosen(self, which: npt.NDArray[np.bool_] | Ints) -> InstalledMarkers:
        """Some of them, by mask or index."""
        arrays = {f.name: getattr(self, f.name)[which] for f in fields(self) if f.name != "speed_limit"}
        return InstalledMarkers(**arrays, speed_limit=self.speed_limit)

    def without_sides(self) -> InstalledMarkers:
        """The same, programmed without their sides."""
        return replace(self, broadcast_side=np.full(len(self), int(LaneSide.UNKNOWN)))


def install_markers(
    lane: TrueLane,
    places: Sequence[MarkerPlace],
    rng: np.random.Generator,
    *,
    survey_sd_m: float = SURVEY_SD_M,
    first_number: int = 1,
    speed_limit: SpeedLimit | None = None,
) -> InstalledMarkers:
    """Install markers near places, within a centimetre, and survey them.

    Parameters
    ----------
    places : sequence of MarkerPlace
        In the lane's local frame, as `app.planning.cerpm_placement.place_markers` gives them.
    rng : numpy.random.Generator
        Draws positions, survey errors and the order of numbers.
    survey_sd_m : float
        Standard deviation of a surveyed coordinate, each axis. [m]
    first_number : int
        Lowest number; numbers are in random order along the road.
    speed_limit : SpeedLimit, optional
        That all of them broadcast.

    Raises
    ------
    InvalidParameter
        The survey's standard deviation is not from 0 to 100 m.
    """
    if not 0 <= survey_sd_m <= 100:
        raise InvalidParameter(f"a survey of {survey_sd_m:g} m", field="survey_sd_m", limit="0 to 100 m")
    count = len(places)
    point = np.array([place.point_m for place in places]).reshape(-1, 2) + rng.normal(0, _PLACING_SD_M, (count, 2))
    lon, lat = lane.wgs84_from_enu(point + rng.normal(0, 1, (count, 2)) * survey_sd_m)
    side = np.array([int(place.side) for place in places], int)
    return InstalledMarkers(
        number=first_number + rng.permutation(count),
        side=side,
        chainage_m=np.array([place.chainage_m for place in places], float),
        point_m=point,
        lon_deg=np.round(lon / DEGREE_STEP) * DEGREE_STEP,
        lat_deg=np.round(lat / DEGREE_STEP) * DEGREE_STEP,
        broadcast_side=side.copy(),
        speed_limit=speed_limit,
    )


def lose_share(markers: InstalledMarkers, share: float, rng: np.random.Generator) -> InstalledMarkers:
    """Markers without a share of them, drawn anywhere on both sides.

    Raises
    ------
    InvalidParameter
        The share is not from 0 to 1.
    """
    if not 0 <= share <= 1:
        raise InvalidParameter(f"a share of {share:g}", field="share", limit="0 to 1")
    keep = np.ones(len(markers), bool)
    keep[rng.choice(len(markers), round(share * len(markers)), replace=False)] = False
    return markers.chosen(keep)


def lose_row(
    markers: InstalledMarkers, count: int, rng: np.random.Generator, side: LaneSide | None = None
) -> InstalledMarkers:
    """Markers without some neighbours on one side; its first and last marker stay.

    Raises
    ------
    InvalidParameter
        The side has fewer than two markers more than are to be lost.
    """
    which = side if side is not None else LaneSide(int(rng.integers(1, 3)))
    row = np.flatnonzero(markers.side == which)
    if not 0 <= count <= len(row) - 2:
        raise InvalidParameter(
            f"{count} of {len(row)} markers on a side", field="count", limit="two less than the side has"
        )
    start = int(rng.integers(1, len(row) - count))
    keep = np.ones(len(markers), bool)
    keep[row[start : start + count]] = False
    return markers.chosen(keep)
