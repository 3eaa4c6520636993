"""Logs in general: the report about reading one, its times as seconds since 1970-01-01 UTC, and its datum."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from itertools import chain, islice

from pydantic import Field

from app.errors import InvalidParameter, ReferenceSystemError
from app.formats.text import clean_text
from app.geodesy import place_position, reference_system
from app.geodesy.systems import is_global
from app.inputs import Declaration, Flag, Number

# === The report about reading an uploaded log: entries, entries left out, warnings.


MAX_LISTED = 200
"""Entries and warnings beyond this number are only counted."""


@dataclass(frozen=True, slots=True)
class LeftOutEntry:
    """An entry that is not in the result."""

    entry: int  # which row, line or event it is, from 0
    reason: str


@dataclass(slots=True)
class LogReport:
    """About reading a log."""

    format: str = ""  # name of the detected format
    entries: int = 0  # rows, lines or events in it
    left_out: list[LeftOutEntry] = field(default_factory=list)  # the first ones
    left_out_count: int = 0
    reasons: dict[str, int] = field(default_factory=dict)  # entries left out, by kind
    unread_time: str | None = None  # the first text that was expected to be a time and is none
    warnings: list[str] = field(default_factory=list)

    def leave_out(self, entry: int, kind: str, reason: str) -> None:
        """Count an entry, and list it if there is room."""
        self.left_out_count += 1
        self.reasons[kind] = self.reasons.get(kind, 0) + 1
        if len(self.left_out) < MAX_LISTED:
            self.left_out.append(LeftOutEntry(entry, reason))

    def warn(self, text: str) -> None:
        """Add a warning for the uploader, once."""
        if text not in self.warnings and len(self.warnings) < MAX_LISTED:
            self.warnings.append(text)

    def note_zone(self, value: object, clock: LogClock) -> None:
        """Warn if a text with a time names no zone, and none is declared."""
        if isinstance(value, str) and ":" in value and not clock.utc_offset_s and not has_zone(value):
            self.warn("times without a zone were taken as UTC; declare the zone's offset if they are local")

    def note_unread_time(self, value: object, time_s: float) -> bool:
        """Keep the first value that should be a time and cannot be read, `time_s` being NaN; True if it is this one."""
        text = "" if value is None else clean_text(str(value), 40)
        if not text or self.unread_time is not None or not math.isnan(time_s):
            return False
        self.unread_time = text
        return True


# === Times of logs, converted to seconds since 1970-01-01 UTC.


GPS_EPOCH_S = 315_964_800.0
"""1980-01-06, the start of GPS time. [s]"""
_LEAP_SECONDS = (
    46_828_800, 78_364_801, 109_900_802, 173_059_203, 252_028_804, 315_187_205, 346_723_206, 393_984_007, 425_520_008,
    457_056_009, 504_489_610, 551_750_411, 599_184_012, 820_108_813, 914_803_214, 1_025_136_015, 1_119_744_016,
    1_167_264_017,
)  # fmt: skip
"""GPS times of the leap seconds, after which UTC is behind by one more second (IERS bulletin C; none since 2017)."""
_EARLIEST_S, _LATEST_S = 946_684_800.0, 4_102_444_800.0  # [s] the years 2000 to 2100
_LEAP_SECOND = re.compile(r"(:\d\d):60(?=\D|$)")
_LOCAL_DATE = re.compile(
    r"(?:(?P<year>\d{4})(?P<s>[./])(?P<month>\d{1,2})(?P=s)(?P<day>\d{1,2})"
    r"|(?P<first>\d{1,2})(?P<sign>[./-])(?P<second>\d{1,2})(?P=sign)(?P<last>\d{4}))[,.]?\s+"
    r"(?P<h>\d{1,2}):(?P<m>\d\d)(?::(?P<sec>\d\d(?:[.,]\d{1,9})?))?(?:\s*(?P<half>[AP])\.?M\.?)?"
    r"\s*(?P<zone>Z|[+-]\d\d:?\d\d)?\Z",
    re.IGNORECASE,
)
"""A time as spreadsheets and browsers write it: 31.05.2026 08:00, 5/31/2026, 8:00:00 AM, 2026/05/31 08:00."""
ACCEPTED_TIMES = "RFC 3339 such as 2026-06-01T08:00:00Z, 01.06.2026 08:00:00, or numbers since 1970"
_COLUMN_HEAD = 20  # rows that show whether a column of times holds local dates
_NUMBER = re.compile(r"[+-]?\d+(?:\.\d*)?(?:[eE][+-]?\d{1,2})?\Z")
_ROLLOVER_BEFORE_S, _ROLLOVER_AFTER_S = 366 * 86_400.0, 2 * 86_400.0  # [s] a track is uploaded at most a year later
_MAX_TEXT = 64  # [character] longest time that is read
NOWHEN = math.nan


class TimeScale(StrEnum):
    """Unit and epoch of times that are numbers; texts in RFC 3339 are read whatever the scale."""

    AUTO = "auto"
    UNIX_S = "unix-s"
    UNIX_MS = "unix-ms"
    UNIX_US = "unix-us"
    UNIX_NS = "unix-ns"
    GPS_S = "gps-s"
    GPS_MS = "gps-ms"


_SCALE_S = {
    TimeScale.UNIX_S: 1.0,
    TimeScale.UNIX_MS: 1e-3,
    TimeScale.UNIX_US: 1e-6,
    TimeScale.UNIX_NS: 1e-9,
    TimeScale.GPS_S: 1.0,
    TimeScale.GPS_MS: 1e-3,
}


class LogClock(Declaration):
    """How the times of a file are read."""

    scale: TimeScale = Field(
        TimeScale.AUTO,
        description="Of times that are numbers; `auto` distinguishes s, ms, us and ns since 1970 by their size.",
    )
    offset_s: Number = Field(0.0, description="Added to each time: the true time less the log's clock. [s]")
    utc_offset_s: Number = Field(
        0.0,
        ge=-14 * 3600,
        le=14 * 3600,
        description="Of times without a zone: local time less UTC, e.g. -18000 for UTC-5. [s]",
    )
    day_first: Flag | None = Field(
        None,
        description="Whether 01/06/2026 is 1 June. Only needed if no date of the file shows it; 01.06.2026 always is.",
    )

    def of_column(self, texts: Iterable[str], field: str) -> LogClock:
        """This clock, with the order of day and month that the dates of a column show.

        Raises
        ------
        InvalidParameter
            They do not show it, or contradict each other.
        """
        if self.day_first is not None:
            return self
        written = (text for text in texts if text.strip())
        head = list(islice(written, _COLUMN_HEAD))
        if not any(_is_local_date(text) for text in head):
            return self
        unclear: str | None = None
        orders: dict[bool, str] = {}
        for text in chain(head, written):
            found = _LOCAL_DATE.match(text.strip())
            if found is None or found["year"] or found["sign"] == ".":
                continue
            first, second = int(found["first"]), int(found["second"])
            if max(first, second) > 12:
                orders.setdefault(first > 12, text)
            elif first != second:
                unclear = unclear or text
        if len(orders) == 1 or (not orders and unclear is None):
            return self.model_copy(update={"day_first": next(iter(orders), True)})
        shown = " and ".join(repr(text.strip()[:_MAX_TEXT]) for text in orders.values()) or repr(unclear)
        raise InvalidParameter(
            f"the dates of the file do not show whether the day or the month comes first: {shown}",
            field=field,
            limit="true (day first) or false (month first)",
            cure="declare day_first of the clock, or write times as 2026-06-01T08:00:00Z",
        )

    def read(self, value: object) -> float:
        """Seconds since 1970-01-01 UTC; NaN where there is no time between 2000 and 2100. [s]"""
        if isinstance(value, bool) or value is None:
            return NOWHEN
        if isinstance(value, int | float):
            seconds = self._from_number(value)
        elif isinstance(value, str) and len(value) <= _MAX_TEXT:
            text = value.strip()
            seconds = self._from_number(float(text)) if _NUMBER.match(text) else self.from_text(text)
        else:
            return NOWHEN
        seconds += self.offset_s
        return seconds if _EARLIEST_S <= seconds <= _LATEST_S else NOWHEN

    def _from_number(self, value: float) -> float:
        if not -1e20 < value < 1e20:  # also refuses NaN
            return NOWHEN
        scale = self.scale
        if scale is TimeScale.AUTO:
            size = abs(value)
            scale = (
                TimeScale.UNIX_S if size < 1e11
                else TimeScale.UNIX_MS if size < 1e14
                else TimeScale.UNIX_US if size < 1e17
                else TimeScale.UNIX_NS
            )  # fmt: skip
        seconds = value * _SCALE_S[scale]
        return utc_from_gps_s(seconds) if scale in (TimeScale.GPS_S, TimeScale.GPS_MS) else seconds

    def from_text(self, text: str) -> float:
        """Seconds since 1970-01-01 UTC of a text that is no number, of any year; NaN where it is no time. [s]"""
        if len(text) < 10:
            return NOWHEN
        if text[-1] == "z":  # RFC 3339, section 5.6
            text = f"{text[:-1]}Z"
        leap = ":60" in text and _LEAP_SECOND.search(text) is not None
        try:
            at = datetime.fromisoformat(_LEAP_SECOND.sub(r"\1:59", text) if leap else text)
            if at.tzinfo is None:
                return at.replace(tzinfo=UTC).timestamp() - self.utc_offset_s + leap
            return at.timestamp() + leap
        except (ValueError, OverflowError):
            return self._from_local_date(text)

    def _from_local_date(self, text: str) -> float:
        found = _LOCAL_DATE.match(text)
        if found is None:
            return NOWHEN
        if found["year"]:
            year, month, day = int(found["year"]), int(found["month"]), int(found["day"])
        else:
            year, first, second = int(found["last"]), int(found["first"]), int(found["second"])
            day_first = True if found["sign"] == "." or first == second else self.day_first
            if day_first is None and max(first, second) > 12:
                day_first = first > 12
            if day_first is None:
                return NOWHEN
            day, month = (first, second) if day_first else (second, first)
        hour = int(found["h"])
        if found["half"]:
            if not 1 <= hour <= 12:
                return NOWHEN
            hour = hour % 12 + (12 if found["half"] in "pP" else 0)
        try:
            at = datetime(year, month, day, hour, int(found["m"]), tzinfo=UTC) + timedelta(
                seconds=float((found["sec"] or "0").replace(",", "."))
            )
        except (ValueError, OverflowError):
            return NOWHEN
        zone_s = _zone_s(found["zone"]) if found["zone"] else self.utc_offset_s
        return at.timestamp() - zone_s


def _is_local_date(text: str) -> bool:
    """Whether a text is a date in digits in which either the day or the month may come first."""
    found = _LOCAL_DATE.match(text.strip()) if "/" in text or "-" in text else None
    return found is not None and not found["year"] and found["sign"] != "."


def _zone_s(zone: str) -> float:
    if zone in "zZ":
        return 0.0
    return (1 if zone[0] == "+" else -1) * (3600.0 * int(zone[1:3]) + 60.0 * int(zone[-2:]))


def utc_from_gps_s(gps_s: float) -> float:
    """Seconds since 1970-01-01 UTC of seconds since the start of GPS time. [s]

    A leap second is that which follows it, as in texts and in POSIX: 23:59:60 is the next day's 00:00:00.
    """
    return gps_s + GPS_EPOCH_S - sum(gps_s >= leap + 1 for leap in _LEAP_SECONDS)


_WEEK_S = 7 * 86_400.0
ROLLOVER_CURE = (
    "receivers that missed a rollover of the GPS week counter are 1024 or 2048 weeks behind: declare clock.offset_s "
    "619315200 or 1238630400 of the poses"
)


def describe_rollover(time_s: float, reference_s: float) -> str | None:
    """A warning, if a track is dated so as receivers do that missed a rollover of the GPS week counter; else None.

    Parameters
    ----------
    time_s, reference_s : float
        When the track began by its own times, and when it was uploaded or captured. The number of the week has 10 bits
        (IS-GPS-200, 20.3.3.3.1.1), so that such receivers are 1024 or 2048 weeks behind. [s]
    """
    for weeks in (1024, 2048):
        true_s = time_s + weeks * _WEEK_S
        if reference_s - _ROLLOVER_BEFORE_S <= true_s <= reference_s + _ROLLOVER_AFTER_S:
            dated, true = (datetime.fromtimestamp(at, UTC).date() for at in (time_s, true_s))
            return (
                f"the track is dated {dated}, and with {weeks} weeks added {true}: its receiver seems to have missed a "
                f"rollover of the GPS week counter; declare clock.offset_s {weeks * _WEEK_S:.0f} of the poses, or "
                "update the receiver's firmware"
            )
    return None


def has_zone(text: str) -> bool:
    """Whether a text with a time of day names its zone, also by hours alone, as PostgreSQL writes it."""
    return re.search(r"(?:[zZ]|[ Tt]\d\d.*[+-]\d\d(?::?\d\d)?)\s*\Z", text) is not None


# === Positions in logs: degrees with a column of hemispheres.


HEMISPHERES: dict[str, tuple[str, ...]] = {
    "lat_hemisphere": (
        "n_s", "ns", "lat_hemisphere", "latitude_hemisphere", "lat_ns", "lat_n_s", "lat_ref", "latref", "latituderef",
        "latitude_ref", "lat_dir", "latdir", "latitude_direction", "lat_direction",
    ),
    "lon_hemisphere": (
        "e_w", "ew", "lon_hemisphere", "longitude_hemisphere", "lon_ew", "lon_e_w", "lon_ref", "lonref", "longituderef",
        "longitude_ref", "lon_dir", "londir", "longitude_direction", "lon_direction",
    ),
}  # fmt: skip
"""Names of columns that hold N or S, E or W, beside degrees without a sign."""
_SIGNS = {"lat_hemisphere": {"N": 1.0, "S": -1.0}, "lon_hemisphere": {"E": 1.0, "W": -1.0}}


def in_hemisphere(value_deg: float, letter: object, quantity: str) -> float:
    """Degrees with the sign of their hemisphere.

    Raises
    ------
    ValueError
        The letter is none of the two, or the degrees have a sign already.
    """
    sign = _SIGNS[quantity].get(str(letter).strip().upper())
    if sign is None or value_deg < 0:
        raise ValueError(f"{letter!r} is no hemisphere of degrees without a sign")
    return sign * value_deg


# === The datum of positions in logs: they must be in WGS 84 / ITRF.


_WGS84_NAME = re.compile(r"(WGS[ _-]?(19)?84|ITRF|IGS|W84)", re.IGNORECASE)
_EPSG_NUMBER = re.compile(r"\d{4,6}\Z", re.ASCII)


def check_datum(crs: str, lon_deg: float = 0.0, lat_deg: float = 0.0) -> None:
    """Refuse a coordinate reference system of a track that is not WGS 84 / ITRF.

    Raises
    ------
    ReferenceSystemError
    """
    text = crs.strip()
    if not text or _WGS84_NAME.match(text):
        return
    name = f"EPSG:{text}" if _EPSG_NUMBER.match(text) else text
    refusal = ReferenceSystemError(
        f"positions are in {text[:60]!r}, which is not WGS 84 / ITRF",
        field="poses.crs",
        limit="WGS 84",
        cure="transform the track to WGS 84 (EPSG:4326) with a stated accuracy before it is sent",
    )
    try:
        place_position(lon_deg, lat_deg, crs=name)
        known = is_global(reference_system(name))
    except InvalidParameter as error:
        raise refusal from error
    if not known:
        raise refusal
