"""Position and heading of the vehicle from one matched information tag."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.readings import TagReading
from app.decoders.magnet.registered_tag import RegisteredTag
from app.geodesy import LocalizationGrade, enu_from_wgs84, wgs84_from_enu
from app.sensors.magnetometer_bar import MagnetometerBar

Floats = npt.NDArray[np.float64]

LATERAL_STD_M, LATERAL_STD_CLEARANCE_M = 0.003, 0.16
"""Lateral error of a magnet on the bar, and the clearance at which it is so large; it grows with the square of the
clearance. [m] Source: `python -m benchmarks.magnets lateral` (docs/benchmarks.md): 0.30 cm at 16 cm, 1.00 cm at 30
cm."""
MIN_CLEARANCE_RATIO = 0.5
"""Smallest clearance for that, over `LATERAL_STD_CLEARANCE_M`. Source: chosen by hand."""
TAG_BEARING_STD_DEG = 0.1
"""Error of a tag's direction in the road. [deg] Source: chosen by hand; two holes 4 m apart, each drilled within 5
mm."""
ASSUMED_HORIZONTAL_RMSE_M = 1.0
"""Error of a tag's position without a stated one, both axes together. [m] Source: chosen by hand."""
MAX_DRIFT = 0.9
"""Largest lateral drift over a tag per metre, of which the arc sine is the heading. Source: chosen by hand."""
DISTINCT_RATIO, DISTINCT_M2 = 4.0, 1e-4
"""The second best choice of holes must fit so many times worse, and by a sum of squares more. [1, m2] Source: by
hand."""


@dataclass(frozen=True, slots=True)
class TagFix:
    """Where the vehicle was when the bar passed a tag's last magnet.

    Attributes
    ----------
    t_s : float
        Time in the trace. [s]
    lon_deg, lat_deg, heading_deg : float
        Of the vehicle's reference point. [deg]
    covariance : ndarray, shape (3, 3)
        East, north, heading. [m, m, rad]
    along_std_m, across_std_m : float
        Along and across the lane. [m]
    across_m : float
        Of the bar's middle from the tag's line, left positive. [m]
    grade : LocalizationGrade
    notes : tuple of str
    """

    t_s: float
    lon_deg: float
    lat_deg: float
    heading_deg: float
    covariance: Floats
    along_std_m: float
    across_std_m: float
    across_m: float
    grade: LocalizationGrade
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Passage:
    """A tag's magnets as they were passed, K of them, in the lane's east and north.

    along_m, lateral_m (K,): odometer, and place on the bar to the left; holes_m (K, 2): where the magnets are;
    span_m: from the first to the last hole; bearing_rad: of legal travel along the tag.
    """

    along_m: Floats
    lateral_m: Floats
    holes_m: Floats
    span_m: float
    bearing_rad: float
    wrong_way: bool

    @property
    def drift(self) -> float:
        """Slope of the lateral place over the distance driven, by least squares."""
        along = self.along_m - self.along_m.mean()
        return float((along * (self.lateral_m - self.lateral_m.mean())).sum() / (along**2).sum())

    @property
    def heading_rad(self) -> float:
        """Heading: magnets in a row drift to the left on the bar of a vehicle that heads right of it."""
        turn = math.asin(float(np.clip(self.drift, -MAX_DRIFT, MAX_DRIFT)))
        return self.bearing_rad + (math.pi if self.wrong_way else 0.0) + turn


def fix_from_tag(reading: TagReading, tag: RegisteredTag, bar: MagnetometerBar) -> TagFix | None:
    """Vehicle's position and heading from one matched tag; None where the magnets fit several of its holes."""
    frame = (tag.lane_lon_deg, tag.lane_lat_deg, tag.height_m or 0.0)
    first_m = enu_from_wgs84(tag.lon_deg, tag.lat_deg, frame[2], frame)
    passage = _passage(reading, tag, first_m[:2])
    if passage is None:
        return None
    forward = np.array([math.sin(passage.heading_rad), math.cos(passage.heading_rad)])
    left = np.array([-forward[1], forward[0]])
    # the tag's own length takes the scale of the vehicle's speed out
    along_m = passage.along_m
    left_over_m = (along_m[-1] - along_m) * passage.span_m / (along_m[-1] - along_m[0])
    # each magnet shows where the bar's middle is at the last one
    middles_m = passage.holes_m + left_over_m[:, None] * forward - passage.lateral_m[:, None] * left
    array = bar.positions_m[bar.array]
    bar_m = np.array([array[:, 0].mean(), (array[:, 1].max() + array[:, 1].min()) / 2])
    place = middles_m.mean(axis=0) - bar_m[0] * forward - bar_m[1] * left
    lon_deg, lat_deg, _height = wgs84_from_enu(np.array([*place, first_m[2]]), frame)
    along_std_m, across_std_m, heading_std = _standard_errors(reading, tag, passage)
    axes = np.stack([forward, left], axis=1)
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = axes @ np.diag([along_std_m**2, across_std_m**2]) @ axes.T
    covariance[2, 2] = heading_std**2
    lane_left = np.array([-math.cos(passage.bearing_rad), math.sin(passage.bearing_rad)])
    return TagFix(
        t_s=reading.end_s,
        lon_deg=lon_deg,
        lat_deg=lat_deg,
        heading_deg=math.degrees(passage.heading_rad) % 360.0,
        covariance=covariance,
        along_std_m=along_std_m,
        across_std_m=across_std_m,
        across_m=float((middles_m.mean(axis=0) - passage.holes_m[-1]) @ lane_left),
        grade=LocalizationGrade.UNFIT if tag.localization_warnings else LocalizationGrade(tag.grade),
        notes=tag.localization_warnings,
    )


def _passage(reading: TagReading, tag: RegisteredTag, first_m: Floats) -> _Passage | None:
    """The reading's magnets with their holes; None where several choices of holes fit."""
    bearing = math.radians(tag.bearing_deg)
    holes_m = np.array(tag.tag.offsets_m)
    places_m = first_m + holes_m[:, None] * np.array([math.sin(bearing), math.cos(bearing)])
    if reading.wrong_way:
        holes_m, places_m = holes_m[::-1], places_m[::-1]
    along_m = np.array([magnet.odometer_m for magnet in reading.magnets])
    chosen = _choose_holes(along_m - along_m[0], np.abs(holes_m - holes_m[0]))
    if chosen is None:
        return None
    return _Passage(
        along_m=along_m,
        lateral_m=np.array([magnet.lateral_cm for magnet in reading.magnets]) / 100,
        holes_m=places_m[list(chosen)],
        span_m=abs(float(holes_m[chosen[-1]] - holes_m[chosen[0]])),
        bearing_rad=bearing,
        wrong_way=reading.wrong_way,
    )


def _standard_errors(reading: TagReading, tag: RegisteredTag, passage: _Passage) -> tuple[float, float, float]:
    """Standard errors along and across the lane [m] and of the heading [rad], the survey's with them."""
    count, along_m = len(reading.magnets), passage.along_m
    survey_m = (tag.horizontal_rmse_m or ASSUMED_HORIZONTAL_RMSE_M) / math.sqrt(2)
    clearance_m = float(np.median([magnet.clearance_cm for magnet in reading.magnets])) / 100
    lateral_std_m = LATERAL_STD_M * max(clearance_m / LATERAL_STD_CLEARANCE_M, MIN_CLEARANCE_RATIO) ** 2
    spread_m = math.sqrt(float(((along_m - along_m.mean()) ** 2).sum()))
    heading_std = math.hypot(lateral_std_m / spread_m, math.radians(TAG_BEARING_STD_DEG))
    along_std_m = math.hypot(float(np.mean([m.along_std_m for m in reading.magnets])), survey_m)  # they share stamps
    turned_m = 0.5 * abs(along_m[-1] - along_m[0]) * heading_std
    return along_std_m, math.hypot(lateral_std_m / math.sqrt(count), survey_m, turned_m), heading_std


def _choose_holes(met_m: Floats, holes_m: Floats) -> tuple[int, ...] | None:
    """Which holes the magnets are, both measured from the first, by the best fit of a common shift."""
    if not 2 <= len(met_m) <= len(holes_m):
        return None
    fits = []
    for chosen in combinations(range(len(holes_m)), len(met_m)):
        off = holes_m[list(chosen)] - met_m
        fits.append((float(((off - off.mean()) ** 2).sum()), chosen))
    fits.sort()
    if len(fits) > 1 and fits[1][0] < DISTINCT_RATIO * fits[0][0] + DISTINCT_M2:
        return None
    return fits[0][1]
