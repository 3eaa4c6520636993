"""Tags of a trace -> magnet markers of the registry and where the vehicle is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt
import sqlalchemy as sa

from app.decoders.magnet.readings import LineCrossing, MagnetReading, NoiseFinding, TagReading
from app.encoders.magnet import MagnetLayout
from app.geodesy import LocalizationGrade, wgs84_from_enu
from app.registry import markers as store
from app.registry.markers import MarkerFilter, Row
from app.registry.spatial import distance_m
from app.sensors.magnetometer_bar import MagnetometerBar
from app.services.decode_context import CoarsePosition
from app.services.fixes import ASSUMED_HORIZONTAL_RMSE_M, horizontal_rmse_m, position_doubts
from app.services.magnet_layouts import INFORMATION_TAG, layout_of

Floats = npt.NDArray[np.float64]

MAX_TAGS = 500
LATERAL_STD_M, LATERAL_STD_CLEARANCE_M = 0.003, 0.16
"""Lateral error of a magnet on the bar at METRO's clearance; it grows with the square of it. [m]"""
TAG_BEARING_STD_DEG = 0.1
"""Of a tag's direction in the road, by the drilling of its first and last magnet. [deg]"""
ODOMETER_SHARE, ODOMETER_SLACK_M = 0.03, 10.0
"""How far two tags' distance may be from the odometer's, when the odometer decides between equal tags."""


@dataclass(frozen=True, slots=True)
class NearbyTags:
    """The agency's information tags that the drive can have passed."""

    rows: tuple[Row, ...] = ()
    complete: bool = True

    @property
    def texts(self) -> tuple[str, ...]:
        """Their codes, without repetitions; none if there are too many to look for."""
        return tuple(dict.fromkeys(str(row["digits"]) for row in self.rows)) if self.complete else ()


@dataclass(frozen=True, slots=True)
class TagMatch:
    """The registered tag that was passed; without a row, none or several have this code."""

    row: Row | None
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


def find_nearby_tags(
    connection: sa.Connection, agency_id: str, position: CoarsePosition | None, reach_m: float
) -> NearbyTags:
    """Information tags of the agency within the coarse accuracy and the length of a drive."""
    if position is None:
        return NearbyTags()
    near = (position.lon_deg, position.lat_deg, position.accuracy_m + reach_m)
    rows = store.list_markers(
        connection, agency_id, MarkerFilter(near=near, family="magnet"), after=None, limit=4 * MAX_TAGS
    )
    tags = [row for row in rows if row["scheme"] == INFORMATION_TAG and row["status"] != "retired"]
    return NearbyTags(tuple(tags[:MAX_TAGS]), len(tags) <= MAX_TAGS and len(rows) < 4 * MAX_TAGS)


def match_tags(findings: Sequence[object], nearby: NearbyTags, bar: MagnetometerBar) -> ReadTrace:
    """Hold the tags of a trace against the registry, in the order they were passed."""
    readings = sorted((f for f in findings if isinstance(f, TagReading)), key=lambda tag: tag.start_s)
    tags: list[ReadTag] = []
    for reading in readings:
        match = _match(reading, nearby, tags)
        fix = None
        if match is not None and match.row is not None:
            fix = fix_from_tag(reading, match.row, layout_of(match.row), bar)
        tags.append(ReadTag(reading, match, fix))
    return ReadTrace(
        tuple(sorted((f for f in findings if isinstance(f, MagnetReading)), key=lambda f: f.t_s)),
        tuple(sorted((f for f in findings if isinstance(f, LineCrossing)), key=lambda f: f.t_s)),
        tuple(tags),
        tuple(sorted((f for f in findings if isinstance(f, NoiseFinding)), key=lambda f: f.t_s)),
    )


def _match(reading: TagReading, nearby: NearbyTags, before: Sequence[ReadTag]) -> TagMatch | None:
    if reading.tag is None or not nearby.rows:
        return None
    rows = [row for row in nearby.rows if row["digits"] == reading.tag.text]
    if len(rows) > 1:
        rows = _reachable(reading, rows, before) or rows
    if not rows:
        return TagMatch(None, note="no tag with this code is registered near by")
    if len(rows) > 1:
        note = f"ambiguous: {len(rows)} tags within reach have this code"
        return TagMatch(None, tuple(str(row["id"]) for row in rows), note)
    return TagMatch(rows[0])


def _reachable(reading: TagReading, rows: Sequence[Row], before: Sequence[ReadTag]) -> list[Row]:
    """Those whose distance from the last tag that was matched fits the odometer."""
    known = next((tag for tag in reversed(before) if tag.match is not None and tag.match.row is not None), None)
    if known is None or known.match is None or known.match.row is None:
        return []
    driven_m = reading.magnets[0].odometer_m - known.reading.magnets[0].odometer_m
    last = layout_of(known.match.row).holes[0]
    slack_m = ODOMETER_SHARE * driven_m + ODOMETER_SLACK_M
    away_m = {str(row["id"]): distance_m(last.lon_deg, last.lat_deg, row["lon_deg"], row["lat_deg"]) for row in rows}
    # a road bends: the way is at least as long as the straight line
    return [
        row
        for row in rows
        if away_m[str(row["id"])] <= driven_m + slack_m and away_m[str(row["id"])] >= 0.6 * driven_m - slack_m
    ]


def fix_from_tag(reading: TagReading, row: Row, layout: MagnetLayout, bar: MagnetometerBar) -> TagFix | None:
    """Vehicle's position and heading from one matched tag; None where its magnets cannot be told apart."""
    holes = layout.holes[::-1] if reading.wrong_way else layout.holes
    along_m = np.array([magnet.odometer_m for magnet in reading.magnets])
    chosen = _choose_holes(along_m - along_m[0], np.abs([hole.along_m - holes[0].along_m for hole in holes]))
    if chosen is None:
        return None
    lateral_m = np.array([magnet.lateral_cm for magnet in reading.magnets]) / 100
    points_m = np.array([holes[k].point_enu_m[:2] for k in chosen])
    middle = lateral_m.mean(), along_m.mean()
    spread_m2 = float(((along_m - middle[1]) ** 2).sum())
    # magnets in a row drift to the left on the bar of a vehicle that heads right of it
    turn = math.asin(float(np.clip(((along_m - middle[1]) * (lateral_m - middle[0])).sum() / spread_m2, -0.9, 0.9)))
    bearing_deg = layout.bearing_deg + (180.0 if reading.wrong_way else 0.0)
    heading = math.radians(bearing_deg) + turn
    forward = np.array([math.sin(heading), math.cos(heading)])
    left = np.array([-forward[1], forward[0]])
    # the tag's own length takes the scale of the vehicle's speed out
    span_m = abs(holes[chosen[-1]].along_m - holes[chosen[0]].along_m)
    left_over_m = (along_m[-1] - along_m) * span_m / (along_m[-1] - along_m[0])
    # each magnet tells where the bar's middle is at the last one
    middles = points_m + left_over_m[:, None] * forward - lateral_m[:, None] * left
    array = bar.positions_m[bar.array]
    bar_m = np.array([array[:, 0].mean(), (array[:, 1].max() + array[:, 1].min()) / 2])
    place = middles.mean(axis=0) - bar_m[0] * forward - bar_m[1] * left
    notes = position_doubts(row, "tag")
    survey_m = float(horizontal_rmse_m(row) or ASSUMED_HORIZONTAL_RMSE_M) / math.sqrt(2)
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
    lon_deg, lat_deg, _height = wgs84_from_enu(np.array([*place, holes[0].up_m]), layout.lane.origin)
    lane_left = np.array([-math.cos(math.radians(layout.bearing_deg)), math.sin(math.radians(layout.bearing_deg))])
    return TagFix(
        reading.end_s, lon_deg, lat_deg, math.degrees(heading) % 360.0, covariance, along_std_m, across_std_m,
        float((middles.mean(axis=0) - points_m[-1]) @ lane_left),
        LocalizationGrade.APPROXIMATE if notes else LocalizationGrade.EXACT, tuple(notes),
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


def trace_observations(decode_id: str, trace: ReadTrace, seen_at: datetime) -> list[dict[str, Any]]:
    """One row a registered tag; of one that was passed twice the surer reading counts."""
    rows: dict[str, dict[str, Any]] = {}
    for tag in sorted(trace.tags, key=lambda tag: -tag.reading.confidence):
        if tag.match is None or tag.match.row is None:
            continue
        reading = tag.reading
        row = {
            "decode_id": decode_id,
            "marker_id": str(tag.match.row["id"]),
            "frame": 0,
            "at": seen_at,
            "what": "wrong-way" if reading.wrong_way else "seen",
            "detail": {
                "confidence": float(reading.confidence),
                "missing_magnets": reading.missing,
                "extra_magnets": reading.extra,
                "lateral_cm": round(float(reading.lateral_cm), 2),
            },
        }
        rows.setdefault(str(row["marker_id"]), row)
    return list(rows.values())
