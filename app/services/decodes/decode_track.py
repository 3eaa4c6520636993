"""The vehicle's track as one decode shows it: fixes, poses of frames, receiver positions, dead reckoning from tags.

For display and export. A drive (`app.services.drives`) estimates the best track from several decodes.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from typing_extensions import TypedDict

from app.formats.spreadsheet import TableWriter
from app.geodesy.ellipsoid import metres_per_radian
from app.registry.decodes import DecodeRow
from app.services.decodes.decode_clock import DecodeTimes, clock_of, stamp
from app.services.decodes.kinds import DecodeKind
from app.tracks.files import gpx_document

CSV_COLUMNS = ("time", "time_s", "source", "lon_deg", "lat_deg", "heading_deg", "sigma_m", "after_gap")
MAX_STEP_S = 30.0
"""[s] between two positions that are joined by a line. Source: chosen by hand; a receiver's are 5 s apart."""
MAX_STRAIGHT_S = 3.0
"""[s] before the first and after the last tag for which its heading serves, where the recording has no headings.
Source: chosen by hand; 36 m in a town, less than a bend."""
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TrackPoint:
    """A position of the vehicle.

    Attributes
    ----------
    time_s : float or None
        By the decode's clock. [s]
    source : str
        ``fix``, ``pose``, ``motion`` or ``receiver``.
    """

    time_s: float | None
    lon_deg: float
    lat_deg: float
    source: str
    heading_deg: float | None = None
    sigma_m: float | None = None


class TrackGeometry(TypedDict):
    """GeoJSON geometry of positions."""

    type: Literal["Point", "LineString"]
    coordinates: list[float] | list[list[float]]


class TrackProperties(TypedDict):
    """Of a stretch: one value for each of its positions."""

    kind: Literal["track"]
    clock: str
    times: list[str | None]
    time_s: list[float | None]
    source: list[str]
    heading_deg: list[float | None]
    sigma_m: list[float | None]


class TrackFeature(TypedDict):
    """A stretch of a track, or a position that stands alone."""

    type: Literal["Feature"]
    geometry: TrackGeometry
    properties: TrackProperties


class TrackCollection(TypedDict):
    """A track, RFC 7946."""

    type: Literal["FeatureCollection"]
    features: list[TrackFeature]


def track_points(row: DecodeRow) -> list[TrackPoint]:
    """Positions of a decode that has a result, in the order of their times; empty if there are none."""
    result, clock = row.result or {}, clock_of(row)
    if row.kind == DecodeKind.TRACE:
        return _reckoned(result, clock)
    points = [] if row.kind == DecodeKind.PACKETS else list(_of_frames(result, clock))
    if not points:
        points = list(_of_receiver(result))
    return points


def track_geojson(row: DecodeRow) -> TrackCollection:
    """Lines between positions, with a time for each of their points, and the positions that stand alone."""
    clock, features = clock_of(row), list[TrackFeature]()
    for part in _stretches(track_points(row)):
        coordinates = [[round(point.lon_deg, 9), round(point.lat_deg, 9)] for point in part]
        features.append({
            "type": "Feature",
            "geometry": (
                {"type": "LineString", "coordinates": coordinates}
                if len(part) > 1
                else {"type": "Point", "coordinates": coordinates[0]}
            ),
            "properties": {
                "kind": "track",
                "clock": clock.clock,
                "times": [stamp(point.time_s, clock) for point in part],
                "time_s": [point.time_s for point in part],
                "source": [point.source for point in part],
                "heading_deg": [point.heading_deg for point in part],
                "sigma_m": [point.sigma_m for point in part],
            },
        })  # fmt: skip
    return {"type": "FeatureCollection", "features": features}


def track_csv(row: DecodeRow) -> str:
    """One row for each position."""
    clock, out = clock_of(row), io.StringIO()
    table = TableWriter(out)
    table.write_row(CSV_COLUMNS)
    for number, part in enumerate(_stretches(track_points(row))):
        for k, point in enumerate(part):
            place = (f"{point.lon_deg:.9f}", f"{point.lat_deg:.9f}")
            after_gap = "true" if number and not k else "false"
            table.write_row((
                stamp(point.time_s, clock), point.time_s, point.source, *place, point.heading_deg, point.sigma_m,
                after_gap,
            ))  # fmt: skip
    return out.getvalue()


def track_gpx(row: DecodeRow) -> str:
    """GPX 1.1 with a segment for each stretch; times where they are UTC."""
    clock = clock_of(row)
    segments = (
        [(point.lat_deg, point.lon_deg, stamp(point.time_s, clock)) for point in part]
        for part in _stretches(track_points(row))
    )
    return gpx_document(f"Decode {row.id}", segments)


# --- sources ----------------------------------------------------------------------------------------------------------


def _of_frames(result: Mapping[str, Any], clock: DecodeTimes) -> Iterator[TrackPoint]:
    """The fix of each frame, else its pose; a coarse position of the whole upload is none."""
    found = []
    for frame in result.get("frames", ()):
        fix, pose, time_s = frame.get("fix"), frame.get("pose"), clock.frame_s(frame)
        if fix is not None:
            sigma_m = math.hypot(fix["sigma"]["east_m"], fix["sigma"]["north_m"])
            point = TrackPoint(time_s, fix["lon_deg"], fix["lat_deg"], "fix", fix["heading_deg"], round(sigma_m, 4))
        elif pose is not None and pose["source"] != "context":
            point = TrackPoint(
                time_s, pose["lon_deg"], pose["lat_deg"], "pose", pose["heading_deg"], pose["accuracy_m"]
            )
        else:
            continue
        found.append(point)
    yield from sorted(found, key=lambda point: (point.time_s is None, point.time_s or 0.0))


def _of_receiver(result: Mapping[str, Any]) -> Iterator[TrackPoint]:
    positions = result.get("receiver") or {}
    names = ("time_s", "lon_deg", "lat_deg", "accuracy_m")
    for time_s, lon_deg, lat_deg, accuracy_m in zip(*(positions.get(name, ()) for name in names), strict=True):
        yield TrackPoint(time_s, lon_deg, lat_deg, "receiver", None, accuracy_m)


def _reckoned(result: Mapping[str, Any], clock: DecodeTimes) -> list[TrackPoint]:
    """Speed and heading over time, placed by the fixes at tags: between two, their disagreement is spread evenly."""
    fixes = sorted((tag["fix"] for tag in result.get("tags", ()) if tag.get("fix")), key=lambda fix: float(fix["t_s"]))
    motion = result.get("motion") or {}
    count = len(motion.get("speed_m_s", ()))
    at_fixes = [_of_fix(fix, clock) for fix in fixes]
    if not fixes or not count:
        return at_fixes
    speed, heading = (_column(motion.get(name, ()), count) for name in ("speed_m_s", "heading_deg"))
    at_s: Floats = float(motion["start_s"]) + float(motion["step_s"]) * np.arange(count, dtype=np.float64)
    if not np.isfinite(heading).any():
        heading = _between_fixes(at_s, fixes)
    known = np.isfinite(speed) & np.isfinite(heading)
    turn = np.radians(np.where(known, heading, 0.0))
    step_m = np.where(known, speed, 0.0) * float(motion["step_s"])
    east_m, north_m = np.cumsum(step_m * np.sin(turn)), np.cumsum(step_m * np.cos(turn))
    fix_s = np.array([fix["t_s"] for fix in fixes], float)
    lat_rad = math.radians(fixes[0]["lat_deg"])
    east_per_rad, north_per_rad = (float(value) for value in metres_per_radian(np.array(lat_rad)))
    lon_off = [fix["lon_deg"] - _degrees(np.interp(fix["t_s"], at_s, east_m), east_per_rad) for fix in fixes]
    lat_off = [fix["lat_deg"] - _degrees(np.interp(fix["t_s"], at_s, north_m), north_per_rad) for fix in fixes]
    lon_deg = np.degrees(east_m / east_per_rad) + np.interp(at_s, fix_s, lon_off)
    lat_deg = np.degrees(north_m / north_per_rad) + np.interp(at_s, fix_s, lat_off)
    points = [
        TrackPoint(
            clock.trace_s(float(at_s[k])), float(lon_deg[k]), float(lat_deg[k]), "motion", round(float(heading[k]), 2)
        )
        for k in np.flatnonzero(known)
    ]
    return sorted([*points, *at_fixes], key=lambda point: point.time_s or 0.0)


def _column(values: Sequence[float | None], count: int) -> Floats:
    """Values as an array of a length; NaN where there is none."""
    column = np.full(count, math.nan)
    known = [math.nan if value is None else value for value in values[:count]]
    column[: len(known)] = known
    return column


def _between_fixes(at_s: Floats, fixes: Sequence[Mapping[str, Any]]) -> Floats:
    """Headings of a recording without any: those of the fixes, and what lies between two; NaN far from all. [deg]"""
    fix_s = np.array([fix["t_s"] for fix in fixes], float)
    turned = np.unwrap([fix["heading_deg"] for fix in fixes], period=360.0)
    near = (at_s >= fix_s[0] - MAX_STRAIGHT_S) & (at_s <= fix_s[-1] + MAX_STRAIGHT_S)
    return np.where(near, np.interp(at_s, fix_s, turned) % 360.0, math.nan)


def _of_fix(fix: Mapping[str, Any], clock: DecodeTimes) -> TrackPoint:
    sigma_m = math.hypot(fix["sigma"]["along_m"], fix["sigma"]["across_m"])
    return TrackPoint(
        clock.trace_s(float(fix["t_s"])), fix["lon_deg"], fix["lat_deg"], "fix", fix["heading_deg"], round(sigma_m, 4)
    )


def _degrees(metres: float, per_rad: float) -> float:
    return math.degrees(metres / per_rad)


def _stretches(points: Sequence[TrackPoint]) -> Iterator[list[TrackPoint]]:
    """Positions that are joined: not across a long time, nor across the antimeridian."""
    if not points:
        return
    part = [points[0]]
    for before, point in pairwise(points):
        apart_s = 0.0 if before.time_s is None or point.time_s is None else point.time_s - before.time_s
        if apart_s > MAX_STEP_S or abs(point.lon_deg - before.lon_deg) > 180.0:
            yield part
            part = []
        part.append(point)
    yield part
