"""What is declared of a vehicle's track, and what reading one may cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import date

from app.errors import InvalidParameter, UploadTooLarge
from app.formats.format import Sample
from app.formats.log_report import LogReport
from app.formats.log_times import LogClock

FIELD = "poses"
ALIASES: dict[str, tuple[str, ...]] = {
    "time": (
        "time", "timestamp", "time_s", "t_s", "utc", "utc_time", "time_utc", "datetime", "date_time", "unix_time",
        "timestamp_ms", "time_ms", "t",
    ),
    "lon": ("longitude", "lon", "lng", "long", "lon_deg", "longitude_deg", "longitude_degrees"),
    "lat": ("latitude", "lat", "lat_deg", "latitude_deg", "latitude_degrees"),
    "heading": (
        "heading", "heading_deg", "true_heading", "true_heading_deg", "course", "course_deg", "cog", "cog_deg",
        "bearing", "bearing_deg", "azimuth", "azimuth_deg",
    ),
    "accuracy": (
        "accuracy", "accuracy_m", "horizontal_accuracy", "horizontal_accuracy_m", "hacc", "h_acc", "hacc_m", "h_acc_m",
        "sigma_m", "std_m", "horizontal_std_m",
    ),
    "crs": ("crs", "datum", "srs"),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class PoseDeclaration:
    """What the uploader declares of a track; everything is optional.

    Attributes
    ----------
    clock : LogClock
    columns : mapping of str to str
        Names of columns in place of the usual ones: time, lon, lat, heading, accuracy, crs.
    crs : str or None
        Coordinate reference system of the positions; WGS 84 without.
    date : date or None
        UTC date of the first position, for NMEA without dates.
    forward_m, left_m : float
        Position of the antenna from the vehicle's reference point (ISO 8855). [m]
    accuracy_m : float or None
        Standard deviation of a position where the track has none. [m]
    """

    clock: LogClock = field(default_factory=LogClock)
    columns: Mapping[str, str] = field(default_factory=dict)
    crs: str | None = None
    date: date | None = None
    forward_m: float = 0.0
    left_m: float = 0.0
    accuracy_m: float | None = None

    def __post_init__(self) -> None:
        unknown = sorted(set(self.columns) - set(ALIASES))
        if unknown:
            raise InvalidParameter(
                f"there is no quantity {unknown[0]!r} in a track", field="poses.columns", limit=", ".join(ALIASES)
            )


@dataclass(frozen=True, slots=True)
class PoseLimits:
    """What reading a track may cost: the largest file [byte], and most positions."""

    file_bytes: int = 32 * 1024**2
    points: int = 200_000


@dataclass(frozen=True, slots=True)
class PoseSource:
    """A track while it is read.

    Attributes
    ----------
    sample : Sample
        All of the file.
    declaration : PoseDeclaration
    limits : PoseLimits
    report : LogReport
        Filled while points are read.
    """

    sample: Sample
    declaration: PoseDeclaration
    limits: PoseLimits
    report: LogReport


def too_many_points(name: str, limits: PoseLimits) -> UploadTooLarge:
    """The error for a track with more positions than the limit."""
    return UploadTooLarge(
        f"{name} holds too many positions", field=FIELD, limit=f"{limits.points}", cure="cut the track, or thin it out"
    )
