"""Positions over time from NMEA 0183, as receivers in vehicles write it."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, time, timedelta
from functools import reduce
from operator import xor
from typing import Any, NamedTuple

import numpy as np

from app.errors import InvalidParameter, ReferenceSystemError
from app.formats.logs import ROLLOVER_CURE, LogClock, LogReport
from app.formats.text import numbered_lines
from app.sensors.pose_track import PosePoint

_SENTENCE = re.compile(r"\$([A-Z]{2})([A-Z]{3}),([^*$\r\n]{0,200})(?:\*([0-9A-Fa-f]{2}))?")
_POSITIONS = ("RMC", "GGA", "GNS", "GLL")
_UNTIMED = ("HDT", "THS", "VTG")
_READ = (*_POSITIONS, *_UNTIMED, "GST", "ZDA", "DTM")
_MIN_SPEED_KN = 2.0
"""Below this speed the course over ground is noise, not the heading. [kn]"""
_HALF_DAY_S = 43_200.0
_SAME_DEG = 2e-4  # [deg] above the rounding to hundredths of a minute of a receiver's different sentences
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


def read_nmea(text: str, clock: LogClock, day: date | None, report: LogReport) -> Iterator[PosePoint]:
    """Points of a log in the order of the file.

    Parameters
    ----------
    clock : LogClock
        The vehicle's.
    day : date or None
        UTC date of the first position, for a log without a date in any sentence.
    report : LogReport
        Filled while points are read.

    Raises
    ------
    ReferenceSystemError
        A DTM sentence names another datum.
    InvalidParameter
        Times have no date, and none was declared.
    """
    import pynmeagps  # here: only a decoder process reads files

    reading = _Reading(report)
    if "$PUBX,00" in text and not _SENTENCE.search(text):
        raise InvalidParameter(
            "the log holds u-blox's own sentences (PUBX) only, which are not read",
            field="poses",
            limit=", ".join(_POSITIONS),
            cure="switch RMC or GGA on in the receiver",
        )
    sentences = list(_of_one_solution(list(_find_sentences(text, report)), report))
    rmc_times_s = {
        _second_of_day(kind, sentence)
        for _entry, kind, sentence in sentences
        if kind == "RMC" and _field(sentence, 2) == "A"
    }
    for entry, kind, sentence in sentences:
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
    yield from _points(reading.epochs, clock, day, report)


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


def _of_one_solution(
    sentences: Sequence[tuple[int, str, str, str]], report: LogReport
) -> Iterator[tuple[int, str, str]]:
    """Sentences without those of further talkers of the same kind and time.

    The combined solution (GN) counts, else the most frequent talker of the kind. A receiver that sees satellites of
    one system only goes over to that system's talker, so that the talker may change from time to time.
    """
    counts: dict[str, Counter[str]] = {}
    times: list[int] = []  # of each sentence the number of its time, counted from 0
    at_s, number = math.nan, 0
    for _entry, talker, kind, sentence in sentences:
        second_s = _second_of_day(kind, sentence) if kind not in _UNTIMED else math.nan
        if not math.isnan(second_s) and second_s != at_s:
            at_s, number = second_s, number + 1
        times.append(number)
        if kind in _POSITIONS or kind == "GST":
            counts.setdefault(kind, Counter())[talker] += 1
    ranks = {
        kind: {talker: (talker == "GN", count) for talker, count in found.items()} for kind, found in counts.items()
    }
    best: dict[tuple[int, str], str] = {}
    for number, (_entry, talker, kind, _sentence) in zip(times, sentences, strict=True):
        rank = ranks.get(kind)
        if rank is not None and ((number, kind) not in best or rank[talker] > rank[best[number, kind]]):
            best[number, kind] = talker
    used: dict[str, set[str]] = {}
    for (_number, kind), talker in best.items():
        used.setdefault(kind, set()).add(talker)
    for kind, talkers in used.items():
        if len(talkers) > 1:
            report.warn(
                f"{kind} sentences come from {' and '.join(sorted(talkers))} at different times: they were taken to be "
                "of one receiver; send the log of one receiver if there were several"
            )
    for number, (entry, talker, kind, sentence) in zip(times, sentences, strict=True):
        if best.get((number, kind), talker) == talker:
            yield entry, kind, sentence


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
        epoch.accuracy_m = math.hypot(north_m, east_m)
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
        if max(abs(lon_deg - epoch.lon_deg), abs(lat_deg - epoch.lat_deg)) > _SAME_DEG:
            reading.report.warn(
                "sentences of one time have different positions, of which the last one was used; send the log of one "
                "receiver if there were several"
            )
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
    if first is not None:
        current = _day_of_first(epochs, first, epochs[first].day)
    else:
        placed = next((i for i, epoch in enumerate(epochs) if not epoch.void and not math.isnan(epoch.lon_deg)), 0)
        current = _day_of_first(epochs, placed, day)
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


def _day_of_first(epochs: list[_Epoch], dated: int, day: date | None) -> date | None:
    """The date of the first epoch, counted back from another one that has a date."""
    for later, earlier in zip(reversed(epochs[1 : dated + 1]), reversed(epochs[:dated]), strict=True):
        if day is not None and earlier.second_s - later.second_s > _HALF_DAY_S:
            day -= timedelta(days=1)
    return day
