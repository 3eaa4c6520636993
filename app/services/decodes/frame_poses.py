"""When each frame of a drive was taken, and where the vehicle was: by a list, a track, EXIF, or a frame rate."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from typing import ClassVar

import numpy as np
from typing_extensions import TypedDict

from app.formats.frame_list import FrameList, ListedFrame
from app.formats.log_report import LogReport
from app.formats.log_times import LogClock, has_zone
from app.formats.poses.declaration import PoseDeclaration, PoseLimits
from app.geodesy.ellipsoid import metres_per_radian
from app.sensors.pose_track import PoseTrack
from app.services.decoder_processes import Task
from app.services.decodes.context import MAX_ACCURACY_M, CoarsePosition, DecodeContext
from app.services.decodes.frame_terms import frame_terms
from app.services.decodes.receiver_positions import ReceiverPositions, receiver_positions

RADIUS_SIGMAS, LEAST_RADIUS_M = 4.0, 5.0
"""[1, m] radius round a pose that holds the vehicle with near certainty, over its standard deviation, and the least.
Source: chosen by hand; 4 sigma holds 99.97 % of a normal distribution in two dimensions."""
UNKNOWN_RADIUS_M = 30.0
"""[m] the same of a pose without an accuracy. Source: chosen by hand, a satellite receiver between buildings."""
MAX_BRIDGE_S = 3.0
"""[s] between two positions of a track across which the vehicle's position is interpolated. Source: chosen by hand."""
MAX_BEYOND_S = 0.5
"""[s] before the first and after the last position of a track for which that position serves. Source: by hand."""
MIN_SPEED_TIME_S, MAX_SPEED_TIME_S = 0.4, 3.0
"""[s] over which a speed is taken from two positions. Source: chosen by hand: shorter ones are the receiver's noise."""
MAX_SPEED_M_S = 90.0
"""[m/s] of a vehicle, 324 km/h. Source: chosen by hand."""
MIN_COURSE_SPEED_M_S = 2.0
"""[m/s] from which the direction of travel is the vehicle's heading. Source: chosen by hand."""
GAP_S, GAP_FACTOR = 1.0, 5.0
"""[s, 1] least gap between the times of two frames that is stated, and over the usual interval. Source: by hand."""


@dataclass(frozen=True, slots=True)
class FrameLists:
    """What files beside the frames hold; the first of each kind counts."""

    frames: FrameList | None = None
    track: PoseTrack | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class FrameListTask(Task[FrameLists]):
    """Files beside the frames to read: name and content of each."""

    is_long: ClassVar[bool] = False

    files: tuple[tuple[str, bytes], ...]
    declaration: PoseDeclaration
    limits: PoseLimits = field(default_factory=PoseLimits)


@dataclass(frozen=True, slots=True)
class FramePose:
    """Where the vehicle was when a frame was taken, by anything but the frame.

    Attributes
    ----------
    source : str
        ``list``, ``track`` or ``context``.
    lon_deg, lat_deg : float
        WGS 84. [deg]
    heading_deg, accuracy_m : float or None
        Clockwise from true north; standard deviation of the position. [deg, m]
    speed_m_s : float or None
        [m/s]
    radius_m : float
        That holds the vehicle with near certainty. [m]
    """

    source: str
    lon_deg: float
    lat_deg: float
    heading_deg: float | None
    accuracy_m: float | None
    speed_m_s: float | None
    radius_m: float

    @property
    def coarse_position(self) -> CoarsePosition:
        """The position to look for markers from."""
        return CoarsePosition(self.lon_deg, self.lat_deg, self.radius_m)


class GapDocument(TypedDict):
    """A stretch of a drive without frames, or whose frames were left out."""

    after_frame: int | None
    before_frame: int | None
    seconds: float | None
    reason: str


class FramePlaces:
    """Times and places of the frames of one drive.

    Parameters
    ----------
    context : DecodeContext
    lists : FrameLists
    """

    def __init__(self, context: DecodeContext, lists: FrameLists | None = None) -> None:
        self._context, self._terms = context, frame_terms(context.frames or {})
        self._lists = lists or FrameLists()
        self._listed: Mapping[str, ListedFrame] = self._lists.frames.frames if self._lists.frames else {}
        self._track = self._lists.track or _track_of_list(self._listed)
        self.warnings = list(self._lists.warnings)

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
        name : str
        taken : str, optional
            Its EXIF's time.
        """
        row = self._listed.get(name)
        if row is not None and math.isfinite(row.time_s):
            return datetime.fromtimestamp(row.time_s, UTC)
        if self._terms.rate_hz is not None:
            captured_at = self._context.captured_at
            return captured_at + timedelta(seconds=ordinal / self._terms.rate_hz) if captured_at else None
        if taken is None:
            return None
        clock: LogClock = self._terms.poses.clock
        if not has_zone(taken) and not clock.utc_offset_s:
            self._warn("times of the pictures' EXIF without a zone were taken as UTC; declare frames.poses.clock")
        time_s = clock.read(taken)
        return datetime.fromtimestamp(time_s, UTC) if math.isfinite(time_s) else None

    def pose_of(self, at: datetime | None, name: str = "") -> FramePose | None:
        """Where the vehicle was: by the list, by the track at that time, or as the context states for all frames."""
        row = self._listed.get(name)
        moving = self._on_track(at) if at is not None else None
        if row is not None and row.has_position:
            heading = row.heading_deg if math.isfinite(row.heading_deg) else moving.heading_deg if moving else None
            accuracy = row.accuracy_m if math.isfinite(row.accuracy_m) else None
            speed = moving.speed_m_s if moving else None
            return FramePose("list", row.lon_deg, row.lat_deg, heading, accuracy, speed, _radius_m(accuracy))
        if moving is not None:
            return moving
        coarse = self._context.coarse_position
        if coarse is None:
            return None
        heading_deg = self._context.heading_deg
        return FramePose("context", coarse.lon_deg, coarse.lat_deg, heading_deg, None, None, coarse.accuracy_m)

    def context_at(self, pose: FramePose | None) -> DecodeContext:
        """The context of one frame."""
        if pose is None or pose.source == "context":
            return self._context
        return replace(self._context, coarse_position=pose.coarse_position, heading_deg=pose.heading_deg)

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
        if beyond_s > MAX_BEYOND_S or (beyond_s <= 0 and between_s > MAX_BRIDGE_S):
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
        _gap(known[k][0], known[k + 1][0], float(steps[k]), "no frames in between")
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


def _gap(after: int, before: int, seconds: float, reason: str) -> GapDocument:
    return {"after_frame": after, "before_frame": before, "seconds": round(seconds, 3), "reason": reason}


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
