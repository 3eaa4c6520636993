"""A vehicle's own track: CSV, GPX and NMEA 0183."""

from __future__ import annotations

import datetime as dt
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime, time, timedelta
from functools import cached_property, reduce
from itertools import islice
from operator import xor
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field, field_validator

from app.errors import InvalidParameter, ReferenceSystemError, UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.format import Confidence, Format, Sample, Use, detect_format, list_accepted
from app.formats.logs import ACCEPTED_TIMES, ROLLOVER_CURE, LogClock, LogReport, check_datum, has_zone
from app.formats.text import clean_text, numbered_lines, read_number
from app.inputs import Declaration, Name, Number
from app.sensors.pose_track import FASTEST_M_S, PoseTrack, find_jumps
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
            report.leave_out(entry, "malformed", "the row holds text where numbers are expected")
            continue
        if math.isnan(point.time_s) and cells[places["time"]].strip():
            written = clean_text(cells[places["time"]], 40)
            report.leave_out(entry, "no-time", f"{written!r} is no time between 2000 and 2100 ({ACCEPTED_TIMES})")
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
_GPX_LEAP_SECOND = re.compile(r"(\d{4}-\d\d-\d\dT(?:[01]\d|2[0-3]):[0-5]\d):60((?:\.\d+)?(?:Z|[+-]\d\d:?\d\d)?\s*<)")


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
        if ":60" in text:  # leap seconds, which `datetime` does not have
            text = _GPX_LEAP_SECOND.sub(
                lambda found: f"{(datetime.fromisoformat(found[1]) + timedelta(minutes=1)).isoformat()}{found[2]}", text
            )
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
_UNTIMED = ("HDT", "THS", "VTG")
_READ = (*_POSITIONS, *_UNTIMED, "GST", "ZDA", "DTM")
_MIN_SPEED_KN = 2.0
"""Below this speed the course over ground is noise, not the heading. [kn]"""
_HALF_DAY_S = 43_200.0
_TURNED_DEG = 5.0  # [deg] a heading that changes more from one sentence to the next depends on its epoch
_CLOCK_TIME = re.compile(r"([01]\d|2[0-3])([0-5]\d)([0-5]\d|60)(?:\.\d*)?\Z", re.ASCII)
_TIME_FIELDS = {"GLL": 5}  # field of a sentence that holds its time, where it is not the first
_MODE_FIELDS = {"RMC": 12, "GGA": 6, "GNS": 6, "GLL": 7, "VTG": 9}  # of the mode of position or motion


@dataclass(slots=True)
class _Epoch:
    """Values of the sentences of one time."""

    entry: int
    second_s: float  # [s] after midnight; 86,400 and more in a leap second
    day: date | None = None
    lon_deg: float = math.nan
    lat_deg: float = math.nan
    heading_deg: float = math.nan
    course_deg: float = math.nan
    accuracy_m: float = math.nan
    void: bool = False


class _Untimed(NamedTuple):
    """A heading or a course, whose sentence has no time."""

    kind: str
    quantity: str  # of the epoch
    value_deg: float
    began: int  # how many epochs began before it


@dataclass(slots=True)
class _Reading:
    """The epochs read so far."""

    report: LogReport
    epochs: list[_Epoch] = field(default_factory=list)
    waiting: list[_Untimed] = field(default_factory=list)  # since the last sentence that has a time
    between: list[_Untimed] = field(default_factory=list)  # after the last sentence of one epoch, before the next one
    inside: set[tuple[str, int]] = field(default_factory=set)  # kinds that stand within an epoch, and which epoch

    def take_untimed(self, kind: str, quantity: str, value_deg: float) -> None:
        """Keep a value until it is known whether its epoch goes on."""
        self.waiting.append(_Untimed(kind, quantity, value_deg, len(self.epochs)))

    def epoch_at(self, entry: int, second_s: float) -> _Epoch:
        """That of a time; sentences of one time come one after the other."""
        if self.epochs and self.epochs[-1].second_s == second_s:
            for one in self.waiting:
                self._place(one, len(self.epochs) - 1)
                self.inside.add((one.kind, one.began - 1))
        else:
            self.between += self.waiting
            self.epochs.append(_Epoch(entry, second_s))
        self.waiting.clear()
        return self.epochs[-1]

    def _place(self, one: _Untimed, place: int) -> None:
        if not math.isnan(one.value_deg):
            setattr(self.epochs[place], one.quantity, one.value_deg)

    def place_between(self, *, is_cut: bool) -> None:
        """Put what stands between two epochs into one of them: the order is the receiver's, the same in all epochs.

        A log that begins with such a sentence has it at the beginning of its epochs, one that ends with it at their
        end. In a log that was cut within an epoch both or neither may hold; then the end is assumed.
        """
        self.between += self.waiting
        for kind in _UNTIMED:
            found = [one for one in self.between if one.kind == kind]
            if not found or len(found) < sum(inside == kind for inside, _place in self.inside):
                continue  # within epochs as a rule: around these a sentence was lost
            at_start = found[0].began == 0 and not is_cut
            at_end = found[-1].began == len(self.epochs)
            begins = at_start and not at_end
            steps_deg = (np.diff([one.value_deg for one in found]) + 180) % 360 - 180
            if at_start == at_end and (np.abs(steps_deg) > _TURNED_DEG).any():
                self.report.warn(
                    f"{kind} sentences have no time, and the log does not show whether an epoch begins or ends with "
                    "them: they were taken to be at its end, so that headings may be one epoch early"
                )
            for one in found if begins else reversed(found):  # of several, the one beside the epoch's other sentences
                place = one.began if begins else one.began - 1
                if 0 <= place < len(self.epochs) and (kind, place) not in self.inside:
                    self._place(one, place)


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
    rmc_times_s = {
        _second_of_day(kind, sentence)
        for _entry, talker, kind, sentence in sentences
        if kind == "RMC" and chosen["RMC"] == talker and _field(sentence, 2) == "A"
    }
    for entry, talker, kind, sentence in sentences:
        if chosen.get(kind, talker) != talker:
            continue
        if _is_estimated(kind, sentence):
            report.warn("positions were estimated by dead reckoning in places")
        second_s = _second_of_day(kind, sentence)
        if (
            kind in _POSITIONS[1:] and second_s in rmc_times_s and not math.isnan(second_s)
        ):  # RMC has the same position, and the date
            reading.epoch_at(entry, second_s)
            continue
        try:
            parsed = pynmeagps.NMEAReader.parse(sentence, validate=pynmeagps.VALNONE)
        except (pynmeagps.NMEAParseError, pynmeagps.NMEATypeError, pynmeagps.NMEAMessageError, ValueError) as error:
            report.leave_out(entry, "malformed", f"a {kind} sentence that cannot be read: {str(error)[:120]}")
            continue
        if parsed is None:
            continue
        try:
            _take(entry, kind, second_s, parsed, reading)
        except AttributeError:  # a cut sentence has no such field
            report.leave_out(entry, "malformed", f"a {kind} sentence with fields missing")
    first_line = text.lstrip("\ufeff \t\r\n").split("\n", 1)[0]
    reading.place_between(is_cut=_SENTENCE.search(first_line[:1024]) is None)
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


def _second_of_day(kind: str, sentence: str) -> float:
    """Time of a sentence after midnight; NaN if it has none. [s]"""
    written = _field(sentence, _TIME_FIELDS.get(kind, 1)).split("*")[0]
    if not _CLOCK_TIME.match(written):
        return math.nan
    return 3600.0 * int(written[:2]) + 60.0 * int(written[2:4]) + float(written[4:])


def _is_estimated(kind: str, sentence: str) -> bool:
    """Whether a receiver reports that it estimates its position or motion, by dead reckoning."""
    mode = _field(sentence, _MODE_FIELDS[kind]).split("*")[0] if kind in _MODE_FIELDS else ""
    if kind == "GGA":
        return mode == "6"
    return "E" in mode and not mode.strip("EN")  # GNS has a mode of each satellite system


def _checksum(content: str) -> int:
    return reduce(xor, content.encode("ascii", "replace"), 0)


def _choose_talkers(sentences: Iterable[tuple[int, str, str, str]]) -> dict[str, str]:
    """Talker of each kind of sentence: the combined solution (GN), or else the most frequent."""
    counts: dict[str, Counter[str]] = {}
    for _entry, talker, kind, _sentence in sentences:
        if kind in _POSITIONS or kind == "GST":
            counts.setdefault(kind, Counter())[talker] += 1
    return {kind: "GN" if "GN" in found else found.most_common(1)[0][0] for kind, found in counts.items()}


def _take(entry: int, kind: str, second_s: float, sentence: Any, reading: _Reading) -> None:
    if kind == "DTM":
        _check_datum(entry, sentence)
    elif kind in ("HDT", "THS"):
        heading = getattr(sentence, "headingT", None) if kind == "HDT" else _heading_of_ths(sentence)
        reading.take_untimed(kind, "heading_deg", _figure(heading))
    elif kind == "VTG":
        moves = _figure(sentence.sogn) >= _MIN_SPEED_KN
        reading.take_untimed(kind, "course_deg", _figure(sentence.cogt) if moves else math.nan)
    elif math.isnan(second_s):
        return
    elif kind == "ZDA":
        epoch = reading.epoch_at(entry, second_s)
        try:
            epoch.day = date(int(sentence.year), int(sentence.month), int(sentence.day))
        except (ValueError, TypeError, OverflowError):
            reading.report.leave_out(entry, "malformed", "a ZDA sentence without a date")
    else:
        _take_position(entry, kind, second_s, sentence, reading)


def _take_position(entry: int, kind: str, second_s: float, sentence: Any, reading: _Reading) -> None:
    epoch = reading.epoch_at(entry, second_s)
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
    last_s = midnight_s = math.nan
    dated: date | None = None
    for epoch in epochs:
        if epoch.day is not None:
            current = epoch.day
        elif current is not None and last_s - epoch.second_s > _HALF_DAY_S:
            current += timedelta(days=1)  # past midnight, and no sentence with a date yet
        last_s = epoch.second_s
        if epoch.void or math.isnan(epoch.lon_deg):
            if epoch.void:
                report.leave_out(epoch.entry, "no-fix", "the receiver reports that it has no position")
            continue
        if current is not None and current != dated:
            dated, midnight_s = current, clock.read(datetime.combine(current, time(), UTC).isoformat())
        if math.isnan(midnight_s):
            report.leave_out(epoch.entry, "no-time", f"{current} is not between 2000 and 2100; {ROLLOVER_CURE}")
            continue
        heading_deg = epoch.course_deg if math.isnan(epoch.heading_deg) else epoch.heading_deg
        at_s = midnight_s + epoch.second_s
        yield PosePoint(epoch.entry, at_s, epoch.lon_deg, epoch.lat_deg, heading_deg, epoch.accuracy_m)


def _day_of_first(epochs: list[_Epoch], dated: int) -> date | None:
    """The date of the first epoch, counted back from the first epoch that has one."""
    day = epochs[dated].day
    for later, earlier in zip(reversed(epochs[1 : dated + 1]), reversed(epochs[:dated]), strict=True):
        if day is not None and earlier.second_s - later.second_s > _HALF_DAY_S:
            day -= timedelta(days=1)
    return day


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
