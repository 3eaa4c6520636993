"""A vehicle's own track: CSV, GPX and NMEA 0183."""

from __future__ import annotations

import datetime as dt
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import cached_property
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from pydantic import Field, field_validator

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.format import Confidence, Format, Sample, Use, detect_format, list_accepted
from app.formats.logs import ACCEPTED_TIMES, HEMISPHERES, LogClock, LogReport, check_datum, in_hemisphere
from app.formats.nmea import looks_like_nmea, read_nmea
from app.formats.text import clean_text, read_number
from app.inputs import Declaration, Name, Number
from app.sensors.pose_track import FASTEST_M_S, PosePoint, PoseTrack, find_jumps
from app.values import Floats

if TYPE_CHECKING:
    import gpxpy.gpx


# === What is declared of a vehicle's track, and what reading one may cost.


FIELD = "poses"
ALIASES: dict[str, tuple[str, ...]] = {
    "time": (
        "time", "timestamp", "time_s", "t_s", "utc", "utc_time", "time_utc", "datetime", "date_time", "unix_time",
        "timestamp_ms", "time_ms", "t", "zeit", "zeitstempel",
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
    **HEMISPHERES,
}  # fmt: skip


class PoseDeclaration(Declaration):
    """What is declared of the vehicle's track."""

    clock: LogClock | None = None
    columns: dict[Name, Name] | None = Field(
        None, max_length=12, description="Names of columns: time, lon, lat, heading, accuracy, crs."
    )
    crs: Name | None = Field(None, description="WGS 84 if left out; others are refused.")
    date: dt.date | None = Field(None, description="UTC date of the first position, for NMEA without dates.")
    forward_m: Number | None = Field(
        None, ge=-100, le=100, description="Of what was positioned, ahead of the vehicle's reference point. [m]"
    )
    left_m: Number | None = Field(
        None, ge=-100, le=100, description="Of what was positioned, left of the vehicle's reference point. [m]"
    )
    accuracy_m: Number | None = Field(
        None, gt=0, le=1000, description="Standard deviation of a position where the track has none. [m]"
    )

    @field_validator("columns")
    @classmethod
    def _quantities(cls, columns: dict[str, str] | None) -> dict[str, str] | None:
        if unknown := sorted(set(columns or ()) - set(ALIASES)):
            raise InvalidParameter(f"there is no quantity {unknown[0]!r} in a track", limit=", ".join(ALIASES))
        return columns

    @cached_property
    def times(self) -> LogClock:
        """How its times are read."""
        return self.clock or LogClock()

    @property
    def frame_times(self) -> LogClock:
        """How times of pictures, and of a list of them without positions, are read: `offset_s` is of the track."""
        return self.times.model_copy(update={"offset_s": 0.0})


@dataclass(frozen=True, slots=True)
class PoseLimits:
    """What reading a track may cost: the largest file [byte], and most positions."""

    file_bytes: int = 32 * 1024**2
    points: int = 200_000


@dataclass(frozen=True, slots=True)
class PoseSource:
    """A track while it is read."""

    sample: Sample  # all of the file
    declaration: PoseDeclaration
    limits: PoseLimits
    report: LogReport  # filled while points are read


def too_many_points(name: str, limits: PoseLimits) -> UploadTooLarge:
    """The error for a track with more positions than the limit."""
    return UploadTooLarge(
        f"{name} holds too many positions", field=FIELD, limit=f"{limits.points}", cure="cut the track, or thin it out"
    )


# === Points of a track in the order of the file, and the track that they form.


def track_of(name: str, points: Iterable[PosePoint], report: LogReport) -> PoseTrack:
    """Points in the order of time, without those that are no positions.

    Raises
    ------
    UnreadableUpload
        No point is left.
    InvalidParameter
        Longitude and latitude are swapped.
    """
    listed = list(points)
    table = np.array(
        [(p.time_s, p.lon_deg, p.lat_deg, p.heading_deg, p.accuracy_m, p.entry) for p in listed], float
    ).reshape(-1, 6)
    _check_swapped(name, table[:, 1], table[:, 2])
    table = _keep(table, np.isfinite(table[:, 1:3]).all(axis=1), "no-position", "there is no position", report)
    inside = (np.abs(table[:, 1]) <= 180) & (np.abs(table[:, 2]) <= 90)
    table = _keep(table, inside, "off-globe", "the position is out of range", report)
    table = _keep(table, (table[:, 1:3] != 0).any(axis=1), "null-island", "0, 0: the receiver had no position", report)
    table = _keep(table, np.isfinite(table[:, 0]), "no-time", "there is no time between 2000 and 2100", report)
    if not len(table):
        first = f"; entry {report.left_out[0].entry}: {report.left_out[0].reason}" if report.left_out else ""
        raise UnreadableUpload(
            f"{name} holds no position with a time{first}",
            field="poses",
            limit="at least one",
            cure="export the track with times; without them the positions cannot be matched with packets",
        )
    if (np.diff(table[:, 0]) < 0).any():
        report.warn("positions were not in the order of their times; they were sorted")
        table = table[np.argsort(table[:, 0], kind="stable")]
    new = np.diff(table[:, 0], prepend=-np.inf) > 0
    table = _keep(table, new, "same-time", "another position has the same time", report)
    table = _keep(table, ~find_jumps(table), "jump", f"faster than {FASTEST_M_S:g} m/s from both sides", report)
    heading = np.where(np.isfinite(table[:, 3]), table[:, 3], np.nan) % 360.0
    accuracy = np.where((table[:, 4] > 0) & np.isfinite(table[:, 4]), table[:, 4], np.nan)
    return PoseTrack(table[:, 0], table[:, 1], table[:, 2], heading, accuracy)


def _keep(table: Floats, good: npt.NDArray[np.bool_], kind: str, reason: str, report: LogReport) -> Floats:
    for entry in table[~good, 5]:
        report.leave_out(int(entry), kind, reason)
    return table[good]


def _check_swapped(name: str, lon_deg: Floats, lat_deg: Floats) -> None:
    with np.errstate(invalid="ignore"):
        bad = (np.abs(lat_deg) > 90) & (np.abs(lat_deg) <= 180) & (np.abs(lon_deg) <= 90)
    if len(bad) and 2 * bad.sum() > len(bad):
        first = int(np.flatnonzero(bad)[0])
        raise InvalidParameter(
            f"latitudes of {name} are out of range (the first is {lat_deg[first]:.6f}), and the longitudes would fit: "
            "the two are swapped",
            field="poses",
            limit="latitude -90 to 90 deg",
            cure="exchange the columns, or declare which is which",
        )


# === Tracks as delimited text with a header.


NEEDED = ("time", "lon", "lat")


def read_csv(source: PoseSource) -> Iterator[PosePoint]:
    """Points of the rows; a row that cannot be read is left out.

    Raises
    ------
    InvalidParameter
        A column is missing.
    ReferenceSystemError
        A row has another datum.
    """
    name, log, report, declaration = source.sample.name, source.sample.log, source.report, source.declaration
    places = log.places(ALIASES, declaration.columns or {})
    missing = [quantity for quantity in NEEDED if quantity not in places]
    if missing:
        shown = ", ".join(repr(clean_text(c, 40)) for c in log.columns[:24])
        raise InvalidParameter(
            f"{name} has no column of the {missing[0]}; its columns are {shown}",
            field=f"poses.columns.{missing[0]}",
            limit=", ".join(ALIASES[missing[0]]),
            cure="name the columns so, or declare their names",
        )
    datums: set[str] = set()
    clock = declaration.times.of_column(
        (cells[places["time"]] for cells in log.rows() if cells is not None), "poses.clock.day_first"
    )
    for entry, cells in enumerate(log.rows()):
        report.entries += 1
        if cells is None:
            report.leave_out(entry, "malformed", log.bad_row())
            continue
        try:
            point = _point_of(entry, cells, places, clock, log.dialect.decimal)
        except (ValueError, OverflowError):
            report.leave_out(entry, "malformed", "the row holds text where numbers or hemispheres are expected")
            continue
        if math.isnan(point.time_s) and cells[places["time"]].strip():
            written = clean_text(cells[places["time"]], 40)
            report.leave_out(entry, "no-time", f"{written!r} is no time between 2000 and 2100 ({ACCEPTED_TIMES})")
            continue
        if "crs" in places and cells[places["crs"]] not in datums:
            if not math.isnan(point.lon_deg):
                check_datum(cells[places["crs"]], point.lon_deg, point.lat_deg)
            datums.add(cells[places["crs"]])
        report.note_zone(cells[places["time"]], declaration.times)
        yield point


def _point_of(entry: int, cells: list[str], places: Mapping[str, int], clock: LogClock, decimal: str) -> PosePoint:
    def figure(quantity: str) -> float:
        place = places.get(quantity)
        value = math.nan if place is None else read_number(cells[place], decimal)
        side = f"{quantity}_hemisphere"
        return in_hemisphere(value, cells[places[side]], side) if side in places and not math.isnan(value) else value

    written = cells[places["time"]]
    at_s = clock.read(written.replace(",", ".") if decimal == "," else written)
    return PosePoint(entry, at_s, figure("lon"), figure("lat"), figure("heading"), figure("accuracy"))


# === Tracks as GPX 1.0 and 1.1.


_HEAD_CHARS = 1 << 14  # [character] in which the root element stands
_GPX_LEAP_SECOND = re.compile(r"(\d{4}-\d\d-\d\dT(?:[01]\d|2[0-3]):[0-5]\d):60((?:\.\d+)?(?:Z|[+-]\d\d:?\d\d)?\s*<)")
_GPX_PREFIX = re.compile(r"<(\w+):gpx[\s>]")
_COURSES = ("heading", "course", "bearing")
"""Names in extensions, those of a compass first."""


def is_gpx(text: str) -> bool:
    """Whether XML has the root element of GPX."""
    return re.search(r"<(?:\w+:)?gpx[\s>]", text[:_HEAD_CHARS]) is not None


def read_gpx(source: PoseSource) -> Iterator[PosePoint]:
    """Points of all tracks, in the order of the file.

    Raises
    ------
    UnreadableUpload
        It has a document type or entities, or is not well-formed.
    UnsupportedUpload
        It is other XML.
    UploadTooLarge
        It has more points than the limit.
    """
    name, text, report = source.sample.name, source.sample.text, source.report
    if re.search(r"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise UnreadableUpload(
            f"{name} has a document type or entities", field=FIELD, limit="plain GPX", cure="export the track again"
        )
    if prefix := _GPX_PREFIX.search(text[:_HEAD_CHARS]):  # gpxpy knows elements of the default namespace only
        text = re.sub(rf"(</?){prefix[1]}:", r"\1", text).replace(f"xmlns:{prefix[1]}=", "xmlns=", 1)
    if text.count("<trkpt") > source.limits.points:
        raise too_many_points(name, source.limits)
    if not is_gpx(text):
        raise UnsupportedUpload(
            f"{name} is XML, but no GPX", field=FIELD, limit="GPX 1.0 or 1.1", cure="export the track as GPX"
        )
    import gpxpy  # here: only a decoder process reads files
    import gpxpy.gpx

    try:
        if ":60" in text:  # leap seconds, which `datetime` does not have
            text = _GPX_LEAP_SECOND.sub(
                lambda found: f"{(datetime.fromisoformat(found[1]) + timedelta(minutes=1)).isoformat()}{found[2]}", text
            )
        gpx = gpxpy.parse(re.sub(r"\A\s*<\?xml[^>]*\?>", "", text.lstrip("\ufeff")))
    except (gpxpy.gpx.GPXException, ValueError, TypeError, LookupError, RecursionError) as error:
        raise UnreadableUpload(
            f"{name} is broken: {str(error)[:160]}", field=FIELD, limit="GPX 1.0 or 1.1", cure="export the track again"
        ) from error
    if not any(segment.points for track in gpx.tracks for segment in track.segments):
        raise UnreadableUpload(
            f"{name} has no track, but {len(gpx.routes)} routes and {len(gpx.waypoints)} waypoints",
            field=FIELD,
            limit="track points (trkpt) with times",
            cure="export the recorded track; a route has no times",
        )
    points = (point for track in gpx.tracks for segment in track.segments for point in segment.points)
    for entry, point in enumerate(points):
        report.entries += 1
        at = point.time
        written = None if at is None else at.isoformat()
        report.note_zone(written, source.declaration.times)
        yield PosePoint(
            entry, source.declaration.times.read(written), float(point.longitude), float(point.latitude), _course(point)
        )


def _course(point: gpxpy.gpx.GPXTrackPoint) -> float:
    """Of GPX 1.0, or of the extensions that receivers write in 1.1."""
    course: float | None = getattr(point, "course", None)
    if course is not None:
        return float(course)
    nodes: list[Any] = list(point.extensions or ())
    for node in nodes[:20]:
        nodes += list(node)[:20]
    named = {str(node.tag).rsplit("}", 1)[-1].lower(): node.text for node in reversed(nodes[:200])}
    try:
        return next((read_number(named[name]) for name in _COURSES if name in named), math.nan)
    except ValueError:
        return math.nan


# === Formats of tracks: how each is detected and read.


PoseReader = Callable[[PoseSource], Iterable[PosePoint]]


def _detect_gpx(sample: Sample) -> Confidence:
    found = sample.is_text and sample.start.startswith("<")
    return Confidence.CERTAIN if found else Confidence.NONE


def _detect_nmea(sample: Sample) -> Confidence:
    if not sample.is_text:
        return Confidence.NONE
    if looks_like_nmea(sample.text):
        return Confidence.CERTAIN
    return Confidence.LIKELY if sample.start.startswith(("$G", "$P", "!")) else Confidence.NONE


def _read_nmea(source: PoseSource) -> Iterator[PosePoint]:
    declaration = source.declaration
    return read_nmea(source.sample.text, declaration.times, declaration.date, source.report)


def _detect_csv(sample: Sample) -> Confidence:
    if not sample.is_text:
        return Confidence.NONE
    places = sample.log.places(ALIASES, sample.declared)
    if "lon" in places and "lat" in places:
        return Confidence.LIKELY
    return Confidence.POSSIBLE if sample.declared or any(name in places for name in NEEDED) else Confidence.NONE


POSE_FORMATS: tuple[Format[PoseReader], ...] = (
    Format("gpx", Use.POSES, "GPX with times", _detect_gpx, read_gpx),
    Format("nmea", Use.POSES, "NMEA 0183", _detect_nmea, _read_nmea),
    Format(
        "csv", Use.POSES, "CSV with a header line (time, longitude, latitude, heading, accuracy)", _detect_csv, read_csv
    ),
)


# === A vehicle's own track, with its positions over time: CSV, GPX or NMEA 0183, detected by content.


EXPECTED = list_accepted(POSE_FORMATS)
_MISFIT_DEG = 30.0  # [deg] above the drift angle of a vehicle, below a quarter turn


def read_poses(
    name: str, data: bytes, declaration: PoseDeclaration | None = None, limits: PoseLimits | None = None
) -> tuple[PoseTrack, LogReport]:
    """Read a track of any known format.

    Parameters
    ----------
    name : str
        Of the file, for messages only.

    Returns
    -------
    PoseTrack
        In the order of time. Headings of NMEA and GPX without a compass are courses over ground.
    LogReport
        What was left out, and why.

    Raises
    ------
    UploadTooLarge
        More bytes or positions than the limits.
    UnsupportedUpload
        The format is unknown; the message lists the accepted ones.
    UnreadableUpload
        Empty, broken, with a document type or entities (GPX), or without a single position that has a time.
    ReferenceSystemError
        Positions of another datum.
    InvalidParameter
        Longitude and latitude are swapped, no date is known, or a declared column is not there.
    """
    declaration, limits = declaration or PoseDeclaration(), limits or PoseLimits()
    name = clean_text(name) or "the track"
    if not data.strip(b" \t\r\n"):
        raise UnreadableUpload(f"{name} is empty", field=FIELD, limit=EXPECTED, cure="send the track whole")
    if len(data) > limits.file_bytes:
        raise UploadTooLarge(f"{name} has {len(data)} bytes", field=FIELD, limit=f"{limits.file_bytes} bytes")
    report = LogReport()
    source = PoseSource(Sample(name, data, declaration.columns or {}), declaration, limits, report)
    points = list(islice(_read_any(source), limits.points + 1))
    if len(points) > limits.points:
        raise too_many_points(name, limits)
    if declaration.crs and points:
        check_datum(declaration.crs, points[0].lon_deg, points[0].lat_deg)
    track = track_of(name, points, report)
    if declaration.accuracy_m is not None:
        known = np.isfinite(track.accuracy_m)
        track = replace(track, accuracy_m=np.where(known, track.accuracy_m, declaration.accuracy_m))
    if (misfit_deg := track.heading_misfit_deg()) > _MISFIT_DEG:
        report.warn(
            f"headings and the direction of travel are {misfit_deg:.0f} degrees apart (median): headings are expected "
            "clockwise from true north in degrees; check their unit, their origin and the antenna's mounting"
        )
    if declaration.forward_m or declaration.left_m:
        if not np.isfinite(track.heading_deg).any():
            report.warn("there is no heading: positions stay where they were measured, off the vehicle's reference")
        track = track.moved(-(declaration.forward_m or 0.0), -(declaration.left_m or 0.0))
    return track, report


def _read_any(source: PoseSource) -> Iterable[PosePoint]:
    sample = source.sample
    found = detect_format(sample, POSE_FORMATS) if sample.is_text else None
    if found is None:
        raise UnsupportedUpload(
            f"{sample.name} has no format that tracks are read in",
            field=FIELD,
            limit=EXPECTED,
            cure="export it in one of these formats",
        )
    if sample.decoded[1] is not None:
        source.report.warn(sample.decoded[1])
    source.report.format = found.name
    return found.read(source)
