"""A vehicle's own track -> its positions over time: CSV, GPX or NMEA 0183, told apart by content."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import date
from itertools import islice
from typing import Any

import gpxpy
import gpxpy.gpx
import numpy as np

from app.decoders.cerpm.log_report import LogReport
from app.decoders.cerpm.log_text import (
    clean_text,
    decode_text,
    find_table,
    is_text,
    match_columns,
    numbered_lines,
    read_number,
)
from app.decoders.cerpm.log_times import LogClock, has_zone
from app.decoders.cerpm.pose_points import PosePoint, track_of
from app.decoders.cerpm.poses_nmea import looks_like_nmea, read_nmea
from app.errors import InvalidParameter, ReferenceSystemError, UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.geodesy import LocalizationGrade, place_position
from app.sensors.pose_track import PoseTrack

FIELD = "poses"
EXPECTED = "CSV with a header line (time, longitude, latitude, heading, accuracy), GPX with times, or NMEA 0183"
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
_WGS84_NAME = re.compile(r"(WGS[ _-]?(19)?84|ITRF|IGS|W84)", re.IGNORECASE)
_EPSG_NUMBER = re.compile(r"\d{4,6}\Z", re.ASCII)
_CURE_DATUM = "transform the track to WGS 84 (EPSG:4326) with a stated accuracy before it is sent"


@dataclass(frozen=True, slots=True)
class PoseDeclaration:
    """What the uploader says of a track; all of it may be left out.

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
        Of what was positioned, from the vehicle's reference point (ISO 8855). [m]
    accuracy_m : float or None
        Standard deviation of a position where the track does not say. [m]
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


def read_poses(
    name: str, data: bytes, declaration: PoseDeclaration | None = None, limits: PoseLimits | None = None
) -> tuple[PoseTrack, LogReport]:
    """Read a track of any known format.

    Parameters
    ----------
    name : str
        Of the file, for messages only.
    data : bytes
    declaration : PoseDeclaration, optional
    limits : PoseLimits, optional

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
        No known format; says what is expected.
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
    points = list(islice(_read_any(name, data, declaration, limits, report), limits.points + 1))
    if len(points) > limits.points:
        raise _too_many(name, limits)
    if declaration.crs and points:
        check_datum(declaration.crs, points[0].lon_deg, points[0].lat_deg)
    track = track_of(name, points, report)
    if declaration.accuracy_m is not None:
        known = np.isfinite(track.accuracy_m)
        track = replace(track, accuracy_m=np.where(known, track.accuracy_m, declaration.accuracy_m))
    if declaration.forward_m or declaration.left_m:
        if not np.isfinite(track.heading_deg).any():
            report.warn("there is no heading: positions stay where they were measured, off the vehicle's reference")
        track = track.moved(-declaration.forward_m, -declaration.left_m)
    return track, report


def check_datum(crs: str, lon_deg: float = 0.0, lat_deg: float = 0.0) -> None:
    """Refuse a coordinate reference system that is not WGS 84 / ITRF.

    Raises
    ------
    ReferenceSystemError
    """
    text = crs.strip()
    if not text or _WGS84_NAME.match(text):
        return
    name = f"EPSG:{text}" if _EPSG_NUMBER.match(text) else text
    with_cure = f"positions are in {text[:60]!r}, which is not WGS 84 / ITRF"
    try:
        placed = place_position(lon_deg, lat_deg, crs=name)
    except InvalidParameter as error:
        raise ReferenceSystemError(with_cure, field="poses.crs", limit="WGS 84", cure=_CURE_DATUM) from error
    if placed.grade is not LocalizationGrade.EXACT or placed.transform_accuracy_m != 0.0:
        raise ReferenceSystemError(with_cure, field="poses.crs", limit="WGS 84", cure=_CURE_DATUM)


def _read_any(
    name: str, data: bytes, declaration: PoseDeclaration, limits: PoseLimits, report: LogReport
) -> Iterator[PosePoint]:
    if not is_text(data):
        raise _unsupported(name)
    text, note = decode_text(name, data)
    if note:
        report.warn(note)
    if text.lstrip("\ufeff \t\r\n").startswith("<"):
        report.format = "gpx"
        return _read_gpx(name, text, declaration.clock, limits, report)
    if looks_like_nmea(text):
        report.format = "nmea"
        return read_nmea(text, declaration.clock, declaration.date, report)
    report.format = "csv"
    return _read_csv(name, text, declaration, report)


# --- CSV ----------------------------------------------------------------------------------------------------------


def _read_csv(name: str, text: str, declaration: PoseDeclaration, report: LogReport) -> Iterator[PosePoint]:
    lines = numbered_lines(text)
    _number, header = next(lines, (0, ""))
    table = find_table(header[: 1 << 16])
    places = match_columns(table.columns, ALIASES, declaration.columns)
    missing = [quantity for quantity in ("time", "lon", "lat") if quantity not in places]
    if missing:
        if not declaration.columns and len(missing) == 3:
            raise _unsupported(name)
        shown = ", ".join(repr(clean_text(c, 40)) for c in table.columns[:24])
        raise InvalidParameter(
            f"{name} has no column of the {missing[0]}; its columns are {shown}",
            field=f"poses.columns.{missing[0]}",
            limit=", ".join(ALIASES[missing[0]]),
            cure="name the columns so, or declare their names",
        )
    datums: set[str] = set()
    zoned = True
    for entry, (_number, line) in enumerate(lines):
        report.entries += 1
        cells = table.cells(line) if len(line) <= 1 << 16 else None
        if cells is None:
            report.leave_out(entry, "malformed", f"the row does not have {len(table.columns)} cells that can be read")
            continue
        try:
            point = _point_of(entry, cells, places, declaration.clock, table.decimal_comma)
        except (ValueError, OverflowError):
            report.leave_out(entry, "malformed", "the row holds text where numbers are expected")
            continue
        if "crs" in places and cells[places["crs"]] not in datums:
            if not math.isnan(point.lon_deg):
                check_datum(cells[places["crs"]], point.lon_deg, point.lat_deg)
            datums.add(cells[places["crs"]])
        zoned = zoned and (":" not in cells[places["time"]] or has_zone(cells[places["time"]]))
        yield point
    if not zoned and not declaration.clock.utc_offset_s:
        report.warn("times without a zone were taken as UTC; declare the zone's offset if they are local")


def _point_of(
    entry: int, cells: list[str], places: Mapping[str, int], clock: LogClock, decimal_comma: bool
) -> PosePoint:
    def figure(quantity: str) -> float:
        place = places.get(quantity)
        return math.nan if place is None else read_number(cells[place], decimal_comma=decimal_comma)

    written = cells[places["time"]]
    at_s = clock.read(written.replace(",", ".") if decimal_comma else written)
    return PosePoint(entry, at_s, figure("lon"), figure("lat"), figure("heading"), figure("accuracy"))


# --- GPX ----------------------------------------------------------------------------------------------------------


def _read_gpx(name: str, text: str, clock: LogClock, limits: PoseLimits, report: LogReport) -> Iterator[PosePoint]:
    if re.search(r"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise UnreadableUpload(
            f"{name} has a document type or entities", field=FIELD, limit="plain GPX", cure="export the track again"
        )
    if text.count("<trkpt") > limits.points:
        raise _too_many(name, limits)
    if re.search(r"<(?:\w+:)?gpx[\s>]", text[: 1 << 14]) is None:
        raise _unsupported(name)
    try:
        gpx = gpxpy.parse(re.sub(r"\A\s*<\?xml[^>]*\?>", "", text.lstrip("\ufeff")))
    except (gpxpy.gpx.GPXException, ValueError, TypeError, LookupError, RecursionError) as error:
        raise UnreadableUpload(
            f"{name} is broken: {str(error)[:160]}", field=FIELD, limit="GPX 1.0 or 1.1", cure="export the track again"
        ) from error
    points = (point for track in gpx.tracks for segment in track.segments for point in segment.points)
    for entry, point in enumerate(points):
        report.entries += 1
        at = point.time
        written = None if at is None else at.isoformat()
        yield PosePoint(entry, clock.read(written), float(point.longitude), float(point.latitude), _course(point))


def _course(point: gpxpy.gpx.GPXTrackPoint) -> float:
    """Of GPX 1.0, or of the extensions that receivers write in 1.1."""
    course: float | None = getattr(point, "course", None)
    if course is not None:
        return float(course)
    nodes: list[Any] = list(point.extensions or ())
    for node in nodes[:20]:
        nodes += list(node)[:20]
    for node in nodes[:200]:
        if str(node.tag).rsplit("}", 1)[-1].lower() in ("heading", "course", "bearing"):
            try:
                return read_number(node.text)
            except ValueError:
                return math.nan
    return math.nan


def _unsupported(name: str) -> UnsupportedUpload:
    return UnsupportedUpload(
        f"{name} is no track that is known here", field=FIELD, limit=EXPECTED, cure="export it in one of these formats"
    )


def _too_many(name: str, limits: PoseLimits) -> UploadTooLarge:
    return UploadTooLarge(
        f"{name} holds too many positions", field=FIELD, limit=f"{limits.points}", cure="cut the track, or thin it out"
    )
