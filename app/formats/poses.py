"""A vehicle's own track: CSV, GPX and NMEA 0183."""

from __future__ import annotations

import datetime as dt
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime, time, timedelta
from functools import cached_property
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from pydantic import Field, field_validator

from app.errors import InvalidParameter, ReferenceSystemError, UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.format import Confidence, Format, Sample, Use, detect_format, list_accepted
from app.formats.logs import LogClock, LogReport, has_zone
from app.formats.text import clean_text, numbered_lines, read_number
from app.geodesy import place_position, reference_system
from app.geodesy.systems import is_global
from app.inputs import Declaration, Name, Number
from app.sensors.pose_track import PoseTrack
from app.values import Floats

if TYPE_CHECKING:
    import gpxpy.gpx


# === The datum of a track: positions must be in WGS 84 / ITRF.


_WGS84_NAME = re.compile(r"(WGS[ _-]?(19)?84|ITRF|IGS|W84)", re.IGNORECASE)
_EPSG_NUMBER = re.compile(r"\d{4,6}\Z", re.ASCII)
_CURE_DATUM = "transform the track to WGS 84 (EPSG:4326) with a stated accuracy before it is sent"


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
        place_position(lon_deg, lat_deg, crs=name)
        known = is_global(reference_system(name))
    except InvalidParameter as error:
        raise ReferenceSystemError(with_cure, field="poses.crs", limit="WGS 84", cure=_CURE_DATUM) from error
    if not known:
        raise ReferenceSystemError(with_cure, field="poses.crs", limit="WGS 84", cure=_CURE_DATUM)


# === What is declared of a vehicle's track, and what reading one may cost.


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


FASTEST_M_S = 150.0
"""A point that can only be reached faster than this, from both sides, is an outlier. [m/s] 540 km/h."""
_SLACK_M = 30.0  # [m] jump of a receiver that is no outlier
_M_PER_DEG = 111_195.0  # [m/deg] on a sphere of 6371 km, the Earth's mean radius


@dataclass(frozen=True, slots=True)
class PosePoint:
    """One position."""

    entry: int  # row, line or point of the file, from 0
    time_s: float  # [s] seconds since 1970-01-01 UTC; NaN where it is not known
    # `lon_deg`, `lat_deg`, `heading_deg`, `accuracy_m`: as in `PoseTrack`
    lon_deg: float
    lat_deg: float
    heading_deg: float = math.nan
    accuracy_m: float = math.nan


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


def find_jumps(table: Floats) -> npt.NDArray[np.bool_]:
    """Which rows (time [s], longitude, latitude [deg], ...) can only be reached too fast, from both sides."""
    if len(table) < 3:
        return np.zeros(len(table), bool)
    east = (np.diff(table[:, 1]) + 180) % 360 - 180
    step_m = _M_PER_DEG * np.hypot(east * np.cos(np.radians(table[:-1, 2])), np.diff(table[:, 2]))
    fast = step_m > FASTEST_M_S * np.diff(table[:, 0]) + _SLACK_M
    across = _M_PER_DEG * np.hypot(
        ((table[2:, 1] - table[:-2, 1] + 180) % 360 - 180) * np.cos(np.radians(table[:-2, 2])),
        table[2:, 2] - table[:-2, 2],
    )
    direct = across <= FASTEST_M_S * (table[2:, 0] - table[:-2, 0]) + _SLACK_M
    return np.concatenate(([False], fast[:-1] & fast[1:] & direct, [False]))


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
    zoned = True
    for entry, cells in enumerate(log.rows()):
        report.entries += 1
        if cells is None:
            report.leave_out(entry, "malformed", log.bad_row())
            continue
        try:
            point = _point_of(entry, cells, places, declaration.times, log.dialect.decimal)
        except (ValueError, OverflowError):
            report.leave_out(entry, "malformed", "the row holds text where numbers are expected")
            continue
        if "crs" in places and cells[places["crs"]] not in datums:
            if not math.isnan(point.lon_deg):
                check_datum(cells[places["crs"]], point.lon_deg, point.lat_deg)
            datums.add(cells[places["crs"]])
        zoned = zoned and (":" not in cells[places["time"]] or has_zone(cells[places["time"]]))
        yield point
    if not zoned and not declaration.times.utc_offset_s:
        report.warn("times without a zone were taken as UTC; declare the zone's offset if they are local")


def _point_of(entry: int, cells: list[str], places: Mapping[str, int], clock: LogClock, decimal: str) -> PosePoint:
    def figure(quantity: str) -> float:
        place = places.get(quantity)
        return math.nan if place is None else read_number(cells[place], decimal)

    written = cells[places["time"]]
    at_s = clock.read(written.replace(",", ".") if decimal == "," else written)
    return PosePoint(entry, at_s, figure("lon"), figure("lat"), figure("heading"), figure("accuracy"))


# === Tracks as GPX 1.0 and 1.1.


_HEAD_CHARS = 1 << 14  # [character] in which the root element stands


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
    if text.count("<trkpt") > source.limits.points:
        raise too_many_points(name, source.limits)
    if not is_gpx(text):
        raise UnsupportedUpload(
            f"{name} is XML, but no GPX", field=FIELD, limit="GPX 1.0 or 1.1", cure="export the track as GPX"
        )
    import gpxpy  # here: only a decoder process reads files
    import gpxpy.gpx

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
    for node in nodes[:200]:
        if str(node.tag).rsplit("}", 1)[-1].lower() in ("heading", "course", "bearing"):
            try:
                return read_number(node.text)
            except ValueError:
                return math.nan
    return math.nan


# === Points over time from NMEA 0183 of a vehicle's receiver.


_SENTENCE = re.compile(r"\$([A-Z]{2})([A-Z]{3}),([^*$\r\n]{0,200})(?:\*([0-9A-Fa-f]{2}))?")
_POSITIONS = ("RMC", "GGA", "GNS", "GLL")
_READ = (*_POSITIONS, "VTG", "HDT", "THS", "GST", "ZDA", "DTM")
_MIN_SPEED_KN = 2.0
"""Below this speed the course over ground is noise, not the heading. [kn]"""
_HALF_DAY = timedelta(hours=12)


@dataclass(slots=True)
class _Epoch:
    """Values of the sentences of one time."""

    entry: int
    at: time
    day: date | None = None
    lon_deg: float = math.nan
    lat_deg: float = math.nan
    heading_deg: float = math.nan
    course_deg: float = math.nan
    accuracy_m: float = math.nan
    void: bool = False


@dataclass(slots=True)
class _Reading:
    """The epochs read so far."""

    report: LogReport
    epochs: list[_Epoch] = field(default_factory=list)

    def epoch_at(self, entry: int, at: time) -> _Epoch:
        """That of a time; sentences of one time come one after the other."""
        if not self.epochs or self.epochs[-1].at != at:
            self.epochs.append(_Epoch(entry, at))
        return self.epochs[-1]


def looks_like_nmea(text: str) -> bool:
    """Whether the first lines hold sentences."""
    return any(found[2] in _READ or found[1] in ("GP", "GN") for found in _SENTENCE.finditer(text[:4096]))


def read_nmea(source: PoseSource) -> Iterator[PosePoint]:
    """Points of a log in the order of the file; without a date in any sentence, from the declared date on.

    Raises
    ------
    ReferenceSystemError
        A DTM sentence names another datum.
    InvalidParameter
        Times have no date, and none was declared.
    """
    import pynmeagps  # here: only a decoder process reads files

    text, declaration, report = source.sample.text, source.declaration, source.report
    reading = _Reading(report)
    sentences = list(_find_sentences(text, report))
    chosen = _choose_talkers(sentences)
    rmc_times = {
        _field(sentence, 1)
        for _entry, talker, kind, sentence in sentences
        if kind == "RMC" and chosen["RMC"] == talker and _field(sentence, 2) == "A"
    }
    for entry, talker, kind, sentence in sentences:
        if chosen.get(kind, talker) != talker:
            continue
        if (
            kind in _POSITIONS[1:] and _field(sentence, 5 if kind == "GLL" else 1) in rmc_times
        ):  # RMC has the same position, and the date
            continue
        try:
            parsed = pynmeagps.NMEAReader.parse(sentence, validate=pynmeagps.VALNONE)
        except (pynmeagps.NMEAParseError, pynmeagps.NMEATypeError, pynmeagps.NMEAMessageError, ValueError) as error:
            report.leave_out(entry, "malformed", f"a {kind} sentence that cannot be read: {str(error)[:120]}")
            continue
        if parsed is None:
            continue
        try:
            _take(entry, kind, parsed, reading)
        except AttributeError:  # a cut sentence has no such field
            report.leave_out(entry, "malformed", f"a {kind} sentence with fields missing")
    yield from _points(reading.epochs, declaration.times, declaration.date, report)


def _find_sentences(text: str, report: LogReport) -> Iterator[tuple[int, str, str, str]]:
    for entry, line in numbered_lines(text):
        report.entries += 1
        found = _SENTENCE.search(line[:1024])
        if found is None:
            if "$" in line[:1024] and "$P" not in line[:1024]:
                report.leave_out(entry, "malformed", "a line that holds no sentence of NMEA 0183")
            continue
        talker, kind, _rest, checksum = found.groups()
        if kind not in _READ:
            continue
        content = found[0][1:].split("*")[0]
        if checksum is None or int(checksum, 16) != _checksum(content):
            what = "has no checksum" if checksum is None else "has a wrong checksum"
            report.leave_out(entry, "checksum", f"a {kind} sentence {what}")
            continue
        yield entry, talker, kind, found[0]


def _field(sentence: str, place: int) -> str:
    fields = sentence.split(",", place + 1)
    return fields[place] if place < len(fields) else ""


def _checksum(content: str) -> int:
    value = 0
    for byte in content.encode("ascii", "replace"):
        value ^= byte
    return value


def _choose_talkers(sentences: Iterable[tuple[int, str, str, str]]) -> dict[str, str]:
    """Talker of each kind of sentence: the combined solution (GN), or else the most frequent."""
    counts: dict[str, Counter[str]] = {}
    for _entry, talker, kind, _sentence in sentences:
        if kind in _POSITIONS or kind == "GST":
            counts.setdefault(kind, Counter())[talker] += 1
    return {kind: "GN" if "GN" in found else found.most_common(1)[0][0] for kind, found in counts.items()}


def _take(entry: int, kind: str, sentence: Any, reading: _Reading) -> None:
    if kind == "DTM":
        _check_datum(entry, sentence)
    elif kind in ("HDT", "THS") and reading.epochs:
        heading = getattr(sentence, "headingT", None) if kind == "HDT" else _heading_of_ths(sentence)
        reading.epochs[-1].heading_deg = _figure(heading)
    elif kind == "VTG" and reading.epochs:
        if _figure(sentence.sogn) >= _MIN_SPEED_KN:
            reading.epochs[-1].course_deg = _figure(sentence.cogt)
    elif kind == "ZDA" and isinstance(sentence.time, time):
        epoch = reading.epoch_at(entry, sentence.time)
        try:
            epoch.day = date(int(sentence.year), int(sentence.month), int(sentence.day))
        except (ValueError, TypeError, OverflowError):
            reading.report.leave_out(entry, "malformed", "a ZDA sentence without a date")
    elif isinstance(getattr(sentence, "time", None), time):
        _take_position(entry, kind, sentence, reading)


def _take_position(entry: int, kind: str, sentence: Any, reading: _Reading) -> None:
    epoch = reading.epoch_at(entry, sentence.time)
    if kind == "GST":
        north_m, east_m = _figure(sentence.stdLat), _figure(sentence.stdLong)
        epoch.accuracy_m = math.sqrt((north_m**2 + east_m**2) / 2)
        return
    if kind == "RMC":
        if isinstance(sentence.date, date):
            epoch.day = sentence.date
        if _figure(sentence.spd) >= _MIN_SPEED_KN:
            epoch.course_deg = _figure(sentence.cog)
    lon_deg, lat_deg = _figure(sentence.lon), _figure(sentence.lat)
    if not _has_fix(kind, sentence):
        epoch.void = True
    elif not (math.isnan(lon_deg) or math.isnan(lat_deg)):
        epoch.lon_deg, epoch.lat_deg = lon_deg, lat_deg
    if kind == "GGA" and sentence.quality == 6:
        reading.report.warn("positions were estimated by dead reckoning in places (GGA quality 6)")


def _has_fix(kind: str, sentence: Any) -> bool:
    if kind == "GGA":
        return sentence.quality in (1, 2, 3, 4, 5, 6, 9)
    mode = str(getattr(sentence, "posMode", "A"))
    if kind == "GNS":
        return bool(mode.strip("N"))
    return sentence.status == "A" and mode not in ("N", "S", "M")  # none, simulated, typed in by hand


def _heading_of_ths(sentence: object) -> object:
    """Heading of a THS sentence; None if it is simulated, estimated or typed in."""
    if getattr(sentence, "mi", "A") != "A":
        return None
    return getattr(sentence, "headt", getattr(sentence, "headingT", None))


def _figure(value: object) -> float:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan


def _check_datum(entry: int, sentence: Any) -> None:
    offsets = (_figure(sentence.latOfset), _figure(sentence.lonOfset))
    if str(sentence.datum).upper() in ("W84", "") and not any(offset > 0 for offset in offsets):
        return
    raise ReferenceSystemError(
        f"line {entry + 1} declares that positions are in datum {str(sentence.datum)[:8]!r} (DTM sentence)",
        field="poses",
        limit="W84: WGS 84",
        cure="set the receiver to WGS 84, or transform the track to WGS 84 before it is sent",
    )


def _points(epochs: list[_Epoch], clock: LogClock, day: date | None, report: LogReport) -> Iterator[PosePoint]:
    first = next((i for i, epoch in enumerate(epochs) if epoch.day is not None), None)
    if day is None and first is None and epochs:
        raise InvalidParameter(
            "no sentence has a date (RMC or ZDA)", field="poses.date", cure="declare the UTC date of the first position"
        )
    current = _day_of_first(epochs, first) if first is not None else day
    last: time | None = None
    for epoch in epochs:
        if epoch.day is not None:
            current = epoch.day
        elif last is not None and current is not None and _since_midnight(last) - _since_midnight(epoch.at) > _HALF_DAY:
            current += timedelta(days=1)  # past midnight, and no sentence with a date yet
        last = epoch.at
        if epoch.void or math.isnan(epoch.lon_deg):
            if epoch.void:
                report.leave_out(epoch.entry, "no-fix", "the receiver reports that it has no position")
            continue
        assert current is not None
        heading_deg = epoch.course_deg if math.isnan(epoch.heading_deg) else epoch.heading_deg
        at_s = clock.read(datetime.combine(current, epoch.at, UTC).isoformat())
        yield PosePoint(epoch.entry, at_s, epoch.lon_deg, epoch.lat_deg, heading_deg, epoch.accuracy_m)


def _day_of_first(epochs: list[_Epoch], dated: int) -> date | None:
    """The date of the first epoch, counted back from the first epoch that has one."""
    day = epochs[dated].day
    for later, earlier in zip(reversed(epochs[1 : dated + 1]), reversed(epochs[:dated]), strict=True):
        if day is not None and _since_midnight(earlier.at) - _since_midnight(later.at) > _HALF_DAY:
            day -= timedelta(days=1)
    return day


def _since_midnight(at: time) -> timedelta:
    return timedelta(hours=at.hour, minutes=at.minute, seconds=at.second, microseconds=at.microsecond)


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


def _detect_csv(sample: Sample) -> Confidence:
    if not sample.is_text:
        return Confidence.NONE
    places = sample.log.places(ALIASES, sample.declared)
    if "lon" in places and "lat" in places:
        return Confidence.LIKELY
    return Confidence.POSSIBLE if sample.declared or any(name in places for name in NEEDED) else Confidence.NONE


POSE_FORMATS: tuple[Format[PoseReader], ...] = (
    Format("gpx", Use.POSES, "GPX with times", _detect_gpx, read_gpx),
    Format("nmea", Use.POSES, "NMEA 0183", _detect_nmea, read_nmea),
    Format(
        "csv", Use.POSES, "CSV with a header line (time, longitude, latitude, heading, accuracy)", _detect_csv, read_csv
    ),
)


# === A vehicle's own track, with its positions over time: CSV, GPX or NMEA 0183, detected by content.


EXPECTED = list_accepted(POSE_FORMATS)


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
    if declaration.forward_m or declaration.left_m:
        if not np.isfinite(track.heading_deg).any():
            report.warn("there is no heading: positions stay where they were measured, off the vehicle's reference")
        track = track.moved(-(declaration.forward_m or 0.0), -(declaration.left_m or 0.0))
    return track, report


def _read_any(source: PoseSource) -> Iterable[PosePoint]:
    sample = source.sample
    if not sample.is_text:
        raise _unsupported(sample.name)
    if sample.decoded[1] is not None:
        source.report.warn(sample.decoded[1])
    found = detect_format(sample, POSE_FORMATS)
    if found is None:
        raise _unsupported(sample.name)
    source.report.format = found.name
    return found.read(source)


def _unsupported(name: str) -> UnsupportedUpload:
    return UnsupportedUpload(
        f"{name} has no format that tracks are read in",
        field=FIELD,
        limit=EXPECTED,
        cure="export it in one of these formats",
    )
