"""When each frame of a drive was taken, and where the vehicle was: by a list, a track, EXIF, or a frame rate."""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from typing import Literal

import numpy as np
from typing_extensions import TypedDict

from app.decoding.declarations import MAX_ACCURACY_M, CoarsePosition, DeclaredFrames, DecodeContext
from app.formats.frame_list import FrameList, ListedFrame
from app.formats.images import PicturePosition
from app.formats.logs import LogReport, describe_rollover, has_zone
from app.formats.text import TableWriter
from app.geodesy.frames import metres_per_radian
from app.registry.decodes import DecodeRow, StoredResult
from app.sensors.pose_track import PoseTrack
from app.services.decodes.context import DecodeKind, DecodeTimes, clock_of, stamp
from app.services.documents import listed
from app.tracks.files import gpx_document
from app.values import Floats

# === Positions of the vehicle's own receiver, as a decode keeps them for the track of its drive.


EVERY_S = 5.0
"""[s] between two positions that are kept. Positions of one minute share their error."""
MAX_POSITIONS = 20_000
"""Positions of a decode at most; of more, fewer are kept. 27 hours."""


class ReceiverPositions(TypedDict):
    """Positions of the vehicle's own receiver, at most one in five seconds.

    `time_s` are seconds since 1970-01-01 UTC; `accuracy_m` is the horizontal standard deviation that the receiver
    states, null where it states none.
    """

    time_s: list[float]
    lon_deg: list[float]
    lat_deg: list[float]
    accuracy_m: list[float | None]


def receiver_positions(track: PoseTrack | None) -> ReceiverPositions | None:
    """The first position of each interval of a track; None without a track."""
    if track is None or not len(track.time_s):
        return None
    every_s = max(EVERY_S, float(track.time_s[-1] - track.time_s[0]) / MAX_POSITIONS)
    kept = np.unique(np.floor((track.time_s - track.time_s[0]) / every_s), return_index=True)[1]
    return {
        "time_s": np.round(track.time_s[kept], 3).tolist(),
        "lon_deg": np.round(track.lon_deg[kept], 9).tolist(),
        "lat_deg": np.round(track.lat_deg[kept], 9).tolist(),
        "accuracy_m": listed(track.accuracy_m[kept], 3),
    }


# === When each frame of a drive was taken, and where the vehicle was.


RADIUS_SIGMAS, LEAST_RADIUS_M = 4.0, 5.0
"""[1, m] radius round a pose that holds the vehicle with near certainty, over its standard deviation, and the least. 4
sigma holds 99.97 % of a normal distribution in two dimensions."""
UNKNOWN_RADIUS_M = 30.0
"""[m] the same of a pose without an accuracy. A satellite receiver between buildings."""
MAX_BRIDGE_S = 3.0
"""[s] between two positions of a track across which the vehicle's position is interpolated."""
MAX_BEYOND_S = 0.5
"""[s] before the first and after the last position of a track for which that position serves."""
MIN_SPEED_TIME_S, MAX_SPEED_TIME_S = 0.4, 3.0
"""[s] over which a speed is taken from two positions. Shorter ones are the receiver's noise."""
MAX_SPEED_M_S = 90.0
"""[m/s] of a vehicle, 324 km/h."""
MIN_COURSE_SPEED_M_S = 2.0
"""[m/s] from which the direction of travel is the vehicle's heading."""
GAP_S, GAP_FACTOR = 1.0, 5.0
"""[s, 1] least gap between the times of two frames that is stated, and over the usual interval."""


@dataclass(frozen=True, slots=True)
class FrameLists:
    """What files beside the frames hold; the first of each kind counts."""

    frames: FrameList | None = None
    track: PoseTrack | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class FramePose:
    """Where the vehicle was when a frame was taken, by anything but the frame."""

    source: str  # ``list``, ``track``, ``context`` or ``exif``
    # `lon_deg`, `lat_deg`: [deg] WGS 84
    lon_deg: float
    lat_deg: float
    # `heading_deg`, `accuracy_m`: clockwise from true north; standard deviation of the position. [deg, m]
    heading_deg: float | None
    accuracy_m: float | None
    speed_m_s: float | None
    radius_m: float  # [m] that holds the vehicle with near certainty

    @property
    def coarse_position(self) -> CoarsePosition:
        """The position to look for markers from."""
        return CoarsePosition(lon_deg=self.lon_deg, lat_deg=self.lat_deg, accuracy_m=self.radius_m)


class GapDocument(TypedDict):
    """A stretch of a drive without frames, or whose frames were left out."""

    after_frame: int | None
    before_frame: int | None
    seconds: float | None
    reason: str


class FramePlaces:
    """Times and places of the frames of one drive."""

    def __init__(
        self, context: DecodeContext, lists: FrameLists | None = None, observed_at: datetime | None = None
    ) -> None:
        self._context, self._frames = context, context.frames or DeclaredFrames()
        self._lists = lists or FrameLists()
        self._listed: Mapping[str, ListedFrame] = self._lists.frames.frames if self._lists.frames else {}
        self._track = self._lists.track or _track_of_list(self._listed)
        self.warnings = list(self._lists.warnings)
        self._is_outside_noted = False
        if self._track is not None and len(self._track.time_s) and observed_at is not None:
            rollover = describe_rollover(float(self._track.time_s[0]), observed_at.timestamp())
            self.warnings += [rollover] if rollover else []

    @property
    def receiver(self) -> ReceiverPositions | None:
        """The vehicle's positions by the list or the track."""
        return receiver_positions(self._track)

    def check_names(self, names: Sequence[str]) -> None:
        """Warn of rows without a picture, pictures without a row, and names of more than one picture."""
        if not self._listed:
            return
        counts = Counter(names)
        twice = {name for name, count in counts.items() if count > 1 and name in self._listed}
        if twice:
            self._listed = {name: row for name, row in self._listed.items() if name not in twice}
            self.warnings.append(f"{_some(twice)}: several pictures have the name, so that its row is not used")
        if missing := [name for name in self._listed if name not in counts]:
            self.warnings.append(f"the list of frames names pictures that are not in the archive: {_some(missing)}")
        if left := [name for name in counts if name not in self._listed and name not in twice]:
            self.warnings.append(f"pictures that the list of frames does not name: {_some(left)}")

    def time_of(self, ordinal: int, name: str = "", taken: str | None = None) -> datetime | None:
        """When a frame was taken: by the list, by the declared rate, or by its EXIF.

        Parameters
        ----------
        ordinal : int
            Number of the frame among the frames of the drive, from 0.
        taken : str, optional
            Its EXIF's time.
        """
        row = self._listed.get(name)
        if row is not None and math.isfinite(row.time_s):
            return datetime.fromtimestamp(row.time_s, UTC)
        if self._frames.rate_hz is not None:
            captured_at = self._context.captured_at
            return captured_at + timedelta(seconds=ordinal / self._frames.rate_hz) if captured_at else None
        if taken is None:
            return None
        clock = self._frames.track.frame_times
        if not has_zone(taken) and not clock.utc_offset_s:
            self._warn("times of the pictures' EXIF without a zone were taken as UTC; declare frames.poses.clock")
        time_s = clock.read(taken)
        return datetime.fromtimestamp(time_s, UTC) if math.isfinite(time_s) else None

    def pose_of(self, at: datetime | None, name: str = "", taken_at: PicturePosition | None = None) -> FramePose | None:
        """Where the vehicle was: by the list, by the track at that time, as the context states for all frames, or by
        the picture's EXIF."""
        row = self._listed.get(name)
        moving = self._on_track(at) if at is not None else None
        if row is not None and row.has_position:
            heading = row.heading_deg if math.isfinite(row.heading_deg) else moving.heading_deg if moving else None
            accuracy = row.accuracy_m if math.isfinite(row.accuracy_m) else None
            speed = moving.speed_m_s if moving else None
            return FramePose("list", row.lon_deg, row.lat_deg, heading, accuracy, speed, _radius_m(accuracy))
        if moving is not None:
            return moving
        coarse, heading_deg = self._context.coarse_position, self._context.heading_deg
        if coarse is None:
            return None if taken_at is None else _pose_of_picture(taken_at, heading_deg)
        return FramePose("context", coarse.lon_deg, coarse.lat_deg, heading_deg, None, None, coarse.accuracy_m)

    def context_at(self, pose: FramePose | None) -> DecodeContext:
        """The context of one frame."""
        if pose is None or pose.source == "context":
            return self._context
        return self._context.model_copy(
            update={"coarse_position": pose.coarse_position, "heading_deg": pose.heading_deg}
        )

    def _warn_of_times(self, track: PoseTrack, at: datetime) -> None:
        """Warn, once a drive, that a frame was taken before or after the track: often a clock in local time."""
        if not self._is_outside_noted:
            self._is_outside_noted = True
            first, last = (datetime.fromtimestamp(float(track.time_s[k]), UTC) for k in (0, -1))
            self.warnings.append(
                f"the track is from {first:%Y-%m-%dT%H:%M:%SZ} to {last:%Y-%m-%dT%H:%M:%SZ}, and a frame was taken at "
                f"{at:%Y-%m-%dT%H:%M:%SZ}: such frames have no position of the track. If one of the clocks shows "
                "local time, declare frames.poses.clock.utc_offset_s"
            )

    def _warn(self, text: str) -> None:
        if text not in self.warnings:
            self.warnings.append(text)

    def _on_track(self, at: datetime) -> FramePose | None:
        track = self._track
        if track is None or not len(track.time_s):
            return None
        time_s = at.timestamp()
        after = int(np.searchsorted(track.time_s, time_s))
        before = max(after - 1, 0)
        after = min(after, len(track.time_s) - 1)
        between_s = float(track.time_s[after] - track.time_s[before])
        beyond_s = max(float(track.time_s[0]) - time_s, time_s - float(track.time_s[-1]))
        if beyond_s > MAX_BEYOND_S:
            self._warn_of_times(track, at)
            return None
        if beyond_s <= 0 and between_s > MAX_BRIDGE_S:
            return None
        share = min(max((time_s - float(track.time_s[before])) / between_s, 0.0), 1.0) if between_s else 0.0
        lon = np.unwrap(track.lon_deg[[before, after]], period=360.0)
        speed, course = _motion(track, time_s)
        heading = _heading(track, before, after, share)
        accuracies = track.accuracy_m[[before, after]]
        accuracy = float(np.nanmax(accuracies)) if np.isfinite(accuracies).any() else None
        return FramePose(
            "list" if self._lists.track is None else "track",
            float((lon[0] + share * (lon[1] - lon[0]) + 180) % 360 - 180),
            float(track.lat_deg[before] + share * (track.lat_deg[after] - track.lat_deg[before])),
            heading if heading is not None else course,
            accuracy,
            speed,
            _radius_m(accuracy),
        )


def _pose_of_picture(taken_at: PicturePosition, heading_deg: float | None) -> FramePose:
    error_m = taken_at.error_m
    return FramePose("exif", taken_at.lon_deg, taken_at.lat_deg, heading_deg, error_m, None, _radius_m(error_m))


def find_gaps(times: Sequence[tuple[int, datetime | None]]) -> tuple[list[GapDocument], list[str]]:
    """Gaps between the times of the frames, and warnings about times that go back or stand still.

    Parameters
    ----------
    times : sequence of (int, datetime or None)
        Number and time of each frame, in the order of the drive.
    """
    known = [(index, at.timestamp()) for index, at in times if at is not None]
    steps = np.diff([at for _index, at in known])
    if not len(steps):
        return [], []
    usual = float(np.percentile(steps[steps > 0], 25, method="lower")) if (steps > 0).any() else 0.0
    gaps = [
        GapDocument(
            after_frame=known[k][0],
            before_frame=known[k + 1][0],
            seconds=round(float(steps[k]), 3),
            reason="no frames in between",
        )
        for k in np.flatnonzero(steps > max(GAP_S, GAP_FACTOR * usual))
    ]
    warnings = []
    for wrong, text in (
        (steps < 0, "lies before that of the frame before it"),
        (steps == 0, "is that of the one before it"),
    ):
        if wrong.any():
            first = known[int(np.flatnonzero(wrong)[0]) + 1][0]
            count = int(wrong.sum())
            others = f", and those of {count - 1} more frames" if count > 1 else ""
            warnings.append(f"the time of frame {first} {text}{others}: its clock jumped, or frames are out of order")
    return gaps, warnings


def describe_report(name: str, report: LogReport) -> list[str]:
    """Warnings of reading a list or a track."""
    notes = [f"{name}: {warning}" for warning in report.warnings]
    if report.left_out_count:
        first = report.left_out[0]
        notes.append(f"{name}: {report.left_out_count} rows were left out; row {first.entry}: {first.reason}")
    return notes


def _track_of_list(listed: Mapping[str, ListedFrame]) -> PoseTrack | None:
    rows = sorted(
        (row for row in listed.values() if row.has_position and math.isfinite(row.time_s)), key=lambda row: row.time_s
    )
    rows = [row for k, row in enumerate(rows) if k == 0 or row.time_s > rows[k - 1].time_s]
    if not rows:
        return None
    table = np.array([(r.time_s, r.lon_deg, r.lat_deg, r.heading_deg, r.accuracy_m) for r in rows])
    return PoseTrack(*table.T)


def _motion(track: PoseTrack, time_s: float) -> tuple[float | None, float | None]:
    """Speed and course from the positions about a time."""
    at = track.time_s
    for reach_s in (MIN_SPEED_TIME_S / 2, MAX_SPEED_TIME_S / 2):
        first = max(int(np.searchsorted(at, time_s - reach_s, "right")) - 1, 0)
        last = min(int(np.searchsorted(at, time_s + reach_s)), len(at) - 1)
        duration_s = float(at[last] - at[first])
        if MIN_SPEED_TIME_S <= duration_s <= MAX_SPEED_TIME_S + 2 * MAX_BRIDGE_S:
            break
    else:
        return None, None
    east_per_rad, north_per_rad = metres_per_radian(np.radians(track.lat_deg[first : first + 1]))
    lon = np.radians((track.lon_deg[last] - track.lon_deg[first] + 180) % 360 - 180)
    lat = np.radians(track.lat_deg[last] - track.lat_deg[first])
    east_m, north_m = float(lon * east_per_rad[0]), float(lat * north_per_rad[0])
    speed = math.hypot(east_m, north_m) / duration_s
    if speed > MAX_SPEED_M_S:
        return None, None
    return speed, math.degrees(math.atan2(east_m, north_m)) % 360.0 if speed > MIN_COURSE_SPEED_M_S else None


def _heading(track: PoseTrack, before: int, after: int, share: float) -> float | None:
    headings = track.heading_deg[[before, after]]
    if not np.isfinite(headings).all():
        known = headings[np.isfinite(headings)]
        return float(known[0]) if len(known) else None
    first, last = np.unwrap(headings, period=360.0)
    return float((first + share * (last - first)) % 360.0)


def _radius_m(accuracy_m: float | None) -> float:
    if accuracy_m is None:
        return UNKNOWN_RADIUS_M
    return min(max(RADIUS_SIGMAS * accuracy_m, LEAST_RADIUS_M), MAX_ACCURACY_M)


def _some(names: Sequence[str] | set[str]) -> str:
    shown = sorted(names)[:5]
    return ", ".join(shown) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


# === The vehicle's track as one decode shows it: fixes, poses of frames, receiver positions, dead reckoning from tags.
#
# For display and export. A drive (`app.services.drives`) estimates the best track from several decodes.


CSV_COLUMNS = ("time", "time_s", "source", "lon_deg", "lat_deg", "heading_deg", "sigma_m", "after_gap")
MAX_STEP_S = 30.0
"""[s] between two positions that are joined by a line. A receiver's are 5 s apart."""
MAX_STRAIGHT_S = 3.0
"""[s] before the first and after the last tag for which its heading serves, where the recording has no headings. 36 m
in a town, less than a bend."""


@dataclass(frozen=True, slots=True)
class TrackPoint:
    """A position of the vehicle."""

    time_s: float | None  # [s] by the decode's clock
    lon_deg: float
    lat_deg: float
    source: str  # ``fix``, ``pose``, ``motion`` or ``receiver``
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
        features.append(
            {
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
            }
        )
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


def _of_frames(result: StoredResult, clock: DecodeTimes) -> Iterator[TrackPoint]:
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


def _of_receiver(result: StoredResult) -> Iterator[TrackPoint]:
    positions = result.get("receiver") or {}
    names = ("time_s", "lon_deg", "lat_deg", "accuracy_m")
    for time_s, lon_deg, lat_deg, accuracy_m in zip(*(positions.get(name, ()) for name in names), strict=True):
        yield TrackPoint(time_s, lon_deg, lat_deg, "receiver", None, accuracy_m)


def _reckoned(result: StoredResult, clock: DecodeTimes) -> list[TrackPoint]:
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


def _between_fixes(at_s: Floats, fixes: Sequence[StoredResult]) -> Floats:
    """Headings of a recording without any: those of the fixes, and what lies between two; NaN far from all. [deg]"""
    fix_s = np.array([fix["t_s"] for fix in fixes], float)
    turned = np.unwrap([fix["heading_deg"] for fix in fixes], period=360.0)
    near = (at_s >= fix_s[0] - MAX_STRAIGHT_S) & (at_s <= fix_s[-1] + MAX_STRAIGHT_S)
    return np.where(near, np.interp(at_s, fix_s, turned) % 360.0, math.nan)


def _of_fix(fix: StoredResult, clock: DecodeTimes) -> TrackPoint:
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
