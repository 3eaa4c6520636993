"""Points over time from NMEA 0183 of a vehicle's receiver."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, time, timedelta
from typing import Any

from app.errors import InvalidParameter, ReferenceSystemError
from app.formats.log_report import LogReport
from app.formats.log_times import LogClock
from app.formats.poses.declaration import PoseSource
from app.formats.poses.points import PosePoint
from app.formats.text import numbered_lines

_SENTENCE = re.compile(r"\$([A-Z]{2})([A-Z]{3}),([^*$\r\n]{0,200})(?:\*([0-9A-Fa-f]{2}))?")
_POSITIONS = ("RMC", "GGA", "GNS", "GLL")
_READ = (*_POSITIONS, "VTG", "HDT", "THS", "GST", "ZDA", "DTM")
_MIN_SPEED_KN = 2.0
"""Below this speed the course over ground is noise, not the heading. [kn] Chosen by hand."""
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
    yield from _points(reading.epochs, declaration.clock, declaration.date, report)


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


def _heading_of_ths(sentence: Any) -> object:
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
