"""Tags of a trace held against registered ones: which tag was passed, and where the vehicle was then.

The same on the server, from the registry, and on board, from a snapshot.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt
from pyproj import Geod

from app.decoders.magnet.book import TagBook, TagFormat
from app.decoders.magnet.readings import LineCrossing, MagnetReading, NoiseFinding, TagReading
from app.geodesy import LocalizationGrade, enu_from_wgs84, wgs84_from_enu
from app.markers.magnet import InformationTag
from app.markers.magnet_codebook import Meaning
from app.sensors.magnetometer_bar import MagnetometerBar

Floats = npt.NDArray[np.float64]

MAX_TAGS = 500
"""Beyond so many registered tags within reach a book holds formats instead."""
LATERAL_STD_M, LATERAL_STD_CLEARANCE_M = 0.003, 0.16
"""Lateral error of a magnet on the bar at METRO's clearance; it grows with the square of it. [m]"""
TAG_BEARING_STD_DEG = 0.1
"""Of a tag's direction in the road, by the drilling of its first and last magnet. [deg]"""
ODOMETER_SHARE, ODOMETER_SLACK_M = 0.03, 10.0
"""How far two tags' distance may be from the odometer's, when the odometer decides between equal tags."""
ASSUMED_HORIZONTAL_RMSE_M = 1.0
"""Of a tag without a stated accuracy. [m]"""
_GEOD = Geod(ellps="WGS84")


@dataclass(frozen=True, slots=True)
class RegisteredTag:
    """What the registry knows of an information tag.

    Attributes
    ----------
    marker_id, status : str
    tag : InformationTag
    lon_deg, lat_deg : float
        Of its first magnet, WGS 84 / ITRF. [deg]
    height_m : float or None
    bearing_deg : float
        Of the tag in the east, north, up frame at `lane_lon_deg`, `lane_lat_deg`; clockwise from north. [deg]
    lane_lon_deg, lane_lat_deg : float
        Where its lane begins. [deg]
    horizontal_rmse_m : float or None
        Of both axes together; None where it is not stated. [m]
    grade : str
        A `LocalizationGrade`.
    doubts : tuple of str
        What makes its position unfit for localization.
    meaning : Meaning or None
    """

    marker_id: str
    status: str
    tag: InformationTag
    lon_deg: float
    lat_deg: float
    height_m: float | None
    bearing_deg: float
    lane_lon_deg: float
    lane_lat_deg: float
    horizontal_rmse_m: float | None
    grade: str
    doubts: tuple[str, ...] = ()
    meaning: Meaning | None = None


def tag_book(tags: Sequence[RegisteredTag], formats: Iterable[TagFormat]) -> TagBook:
    """The designs to look for; formats where there is none, or too many."""
    designs = tuple(dict.fromkeys(tag.tag for tag in tags))
    if 0 < len(tags) <= MAX_TAGS:
        return TagBook(designs=designs)
    return TagBook(formats=tuple(dict.fromkeys(formats)))


@dataclass(frozen=True, slots=True)
class TagMatch:
    """The registered tag that was passed; without it, none or several have this code."""

    tag: RegisteredTag | None
    others: tuple[str, ...] = ()
    note: str = ""


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


@dataclass(frozen=True, slots=True)
class ReadTag:
    """A tag with what the registry made of it."""

    reading: TagReading
    match: TagMatch | None = None
    fix: TagFix | None = None


@dataclass(frozen=True, slots=True)
class ReadTrace:
    """Everything that a trace says."""

    magnets: tuple[MagnetReading, ...]
    crossings: tuple[LineCrossing, ...]
    tags: tuple[ReadTag, ...]
    noise: tuple[NoiseFinding, ...]


def match_tags(findings: Sequence[object], nearby: Sequence[RegisteredTag], bar: MagnetometerBar) -> ReadTrace:
    """Hold the tags of a trace against the registered ones within reach, in the order they were passed."""
    readings = sorted((f for f in findings if isinstance(f, TagReading)), key=lambda tag: tag.start_s)
    tags: list[ReadTag] = []
    for reading in readings:
        match = _match(reading, nearby, tags)
        fix = None
        if match is not None and match.tag is not None:
            fix = fix_from_tag(reading, match.tag, bar)
        tags.append(ReadTag(reading, match, fix))
    return ReadTrace(
        tuple(sorted((f for f in findings if isinstance(f, MagnetReading)), key=lambda f: f.t_s)),
        tuple(sorted((f for f in findings if isinstance(f, LineCrossing)), key=lambda f: f.t_s)),
        tuple(tags),
        tuple(sorted((f for f in findings if isinstance(f, NoiseFinding)), key=lambda f: f.t_s)),
    )


def _match(reading: TagReading, nearby: Sequence[RegisteredTag], before: Sequence[ReadTag]) -> TagMatch | None:
    if reading.tag is None or not nearby:
        return None
    found = [tag for tag in nearby if tag.tag == reading.tag]
    if len(found) > 1:
        found = _reachable(reading, found, before) or found
    if not found:
        return TagMatch(None, note="no tag with this code is registered near by")
    if len(found) > 1:
        note = f"ambiguous: {len(found)} tags within reach have this code"
        return TagMatch(None, tuple(tag.marker_id for tag in found), note)
    return TagMatch(found[0])


def _reachable(reading: TagReading, among: Sequence[RegisteredTag], before: Sequence[ReadTag]) -> list[RegisteredTag]:
    """Those whose distance from the last tag that was matched fits the odometer."""
    known = next((tag for tag in reversed(before) if tag.match is not None and tag.match.tag is not None), None)
    if known is None or known.match is None or known.match.tag is None:
        return []
    driven_m = reading.magnets[0].odometer_m - known.reading.magnets[0].odometer_m
    last = known.match.tag
    slack_m = ODOMETER_SHARE * driven_m + ODOMETER_SLACK_M
    reachable = []
    for tag in among:
        away_m = float(_GEOD.inv(last.lon_deg, last.lat_deg, tag.lon_deg, tag.lat_deg)[2])
        # a road bends: the way is at least as long as the straight line
        if 0.6 * driven_m - slack_m <= away_m <= driven_m + slack_m:
            reachable.append(tag)
    return reachable


def fix_from_tag(reading: TagReading, tag: RegisteredTag, bar: MagnetometerBar) -> TagFix | None:
    """Vehicle's position and heading from one matched tag; None where its magnets cannot be told apart."""
    frame = (tag.lane_lon_deg, tag.lane_lat_deg, tag.height_m or 0.0)
    first_m = enu_from_wgs84(tag.lon_deg, tag.lat_deg, frame[2], frame)
    bearing = math.radians(tag.bearing_deg)
    holes_m = np.array(tag.tag.offsets_m)
    holes_enu_m = first_m[:2] + holes_m[:, None] * np.array([math.sin(bearing), math.cos(bearing)])
    if reading.wrong_way:
        holes_m, holes_enu_m = holes_m[::-1], holes_enu_m[::-1]
    along_m = np.array([magnet.odometer_m for magnet in reading.magnets])
    chosen = _choose_holes(along_m - along_m[0], np.abs(holes_m - holes_m[0]))
    if chosen is None:
        return None
    lateral_m = np.array([magnet.lateral_cm for magnet in reading.magnets]) / 100
    points_m = holes_enu_m[list(chosen)]
    middle = lateral_m.mean(), along_m.mean()
    spread_m2 = float(((along_m - middle[1]) ** 2).sum())
    # magnets in a row drift to the left on the bar of a vehicle that heads right of it
    turn = math.asin(float(np.clip(((along_m - middle[1]) * (lateral_m - middle[0])).sum() / spread_m2, -0.9, 0.9)))
    heading = bearing + (math.pi if reading.wrong_way else 0.0) + turn
    forward = np.array([math.sin(heading), math.cos(heading)])
    left = np.array([-forward[1], forward[0]])
    # the tag's own length takes the scale of the vehicle's speed out
    span_m = abs(float(holes_m[chosen[-1]] - holes_m[chosen[0]]))
    left_over_m = (along_m[-1] - along_m) * span_m / (along_m[-1] - along_m[0])
    # each magnet tells where the bar's middle is at the last one
    middles = points_m + left_over_m[:, None] * forward - lateral_m[:, None] * left
    array = bar.positions_m[bar.array]
    bar_m = np.array([array[:, 0].mean(), (array[:, 1].max() + array[:, 1].min()) / 2])
    place = middles.mean(axis=0) - bar_m[0] * forward - bar_m[1] * left
    survey_m = (tag.horizontal_rmse_m or ASSUMED_HORIZONTAL_RMSE_M) / math.sqrt(2)
    clearance_m = float(np.median([magnet.clearance_cm for magnet in reading.magnets])) / 100
    lateral_std_m = LATERAL_STD_M * max(clearance_m / LATERAL_STD_CLEARANCE_M, 0.5) ** 2
    count = len(reading.magnets)
    turn_std = math.hypot(lateral_std_m / math.sqrt(spread_m2), math.radians(TAG_BEARING_STD_DEG))
    along_std_m = math.hypot(float(np.mean([m.along_std_m for m in reading.magnets])) / math.sqrt(count), survey_m)
    across_std_m = math.hypot(
        lateral_std_m / math.sqrt(count), survey_m, 0.5 * abs(along_m[-1] - along_m[0]) * turn_std
    )
    axes = np.stack([forward, left], axis=1)
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = axes @ np.diag([along_std_m**2, across_std_m**2]) @ axes.T
    covariance[2, 2] = turn_std**2
    lon_deg, lat_deg, _height = wgs84_from_enu(np.array([*place, first_m[2]]), frame)
    lane_left = np.array([-math.cos(bearing), math.sin(bearing)])
    return TagFix(
        reading.end_s, lon_deg, lat_deg, math.degrees(heading) % 360.0, covariance, along_std_m, across_std_m,
        float((middles.mean(axis=0) - points_m[-1]) @ lane_left),
        LocalizationGrade.APPROXIMATE if tag.doubts else LocalizationGrade.EXACT, tag.doubts,
    )  # fmt: skip


def _choose_holes(met_m: Floats, holes_m: Floats) -> tuple[int, ...] | None:
    """Which holes the magnets are, both measured from the first, by the best fit of a common shift."""
    if not 2 <= len(met_m) <= len(holes_m):
        return None
    fits = []
    for chosen in combinations(range(len(holes_m)), len(met_m)):
        off = holes_m[list(chosen)] - met_m
        fits.append((float(((off - off.mean()) ** 2).sum()), chosen))
    fits.sort()
    if len(fits) > 1 and fits[1][0] < 4 * fits[0][0] + 1e-4:
        return None
    return fits[0][1]
