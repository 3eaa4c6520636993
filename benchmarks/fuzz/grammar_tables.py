"""Times and delimited text as programs write them, for the grammars of packet logs, tracks and traces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TypeVar

from app.formats.logs import LogClock, TimeScale
from benchmarks.fuzz.grammar import Rng

T = TypeVar("T")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_GPS_EPOCH_S = 315_964_800  # 1980-01-06
_LEAPS = ((datetime(2017, 1, 1, tzinfo=UTC), 18), (datetime(2015, 7, 1, tzinfo=UTC), 17))
"""From when on GPS time is so many seconds ahead of UTC (IERS bulletins C 49 and 52)."""
LEAP_SECOND = datetime(2016, 12, 31, 23, 59, 59, tzinfo=UTC)  # one second before it


def pick(rng: Rng, *options: T) -> T:
    """One of several values, each as likely."""
    return options[int(rng.integers(len(options)))]


def chance(rng: Rng, share: float = 0.5) -> bool:
    """True in a share of the cases."""
    return bool(rng.random() < share)


# === Times. An instant is a number of microseconds of GPS time, which has no leap seconds.


@dataclass(frozen=True, slots=True)
class Instant:
    """A time as UTC shows it: microseconds since 1970, where 23:59:60 is the second that follows it as well."""

    utc_us: int
    is_leap: bool = False
    gps_us: int = 0  # since 1980-01-06

    @property
    def seconds(self) -> float:
        """Seconds since 1970."""
        return self.utc_us / 1e6


def instants(begins: datetime, steps_us: Sequence[int]) -> list[Instant]:
    """Times so many microseconds after a beginning."""
    ahead_s = next((ahead_s for since, ahead_s in _LEAPS if begins >= since), 16)
    start_us = _us(begins) + (ahead_s - _GPS_EPOCH_S) * 1_000_000
    return [_of_gps(start_us + step_us) for step_us in steps_us]


def _us(at: datetime) -> int:
    return (at - _EPOCH) // timedelta(microseconds=1)


def _of_gps(gps_us: int) -> Instant:
    since_1970_us = gps_us + _GPS_EPOCH_S * 1_000_000
    for since, ahead_s in _LEAPS:
        utc_us = since_1970_us - ahead_s * 1_000_000
        if utc_us >= _us(since):
            return Instant(utc_us, gps_us=gps_us)
        if utc_us >= _us(since) - 1_000_000:
            return Instant(utc_us + 1_000_000, True, gps_us)
    return Instant(since_1970_us - 16_000_000, gps_us=gps_us)


@dataclass(frozen=True, slots=True)
class TimeForm:
    """A way to write times: text, or numbers of some unit."""

    write: Callable[[Instant], str]
    clock: LogClock | None = None
    names_zone: bool = True
    has_leap_seconds: bool = False
    is_number: bool = False


def calendar_text(at: Instant, form: str, digits: int = 0, zone_s: int = 0, point: str = ".") -> str:
    """Date and time of a zone; `form` as of strftime, where %S gets the fraction and 60 in a leap second."""
    moment = _EPOCH + timedelta(microseconds=at.utc_us - 1_000_000 * at.is_leap, seconds=zone_s)
    seconds = f"{60 if at.is_leap else moment.second:02d}"
    if digits:
        seconds += point + f"{moment.microsecond:06d}000"[:digits]
    return moment.strftime(form.replace("%S", "@")).replace("@", seconds)


def zone_text(zone_s: int, colon: str = ":") -> str:
    """Offset from UTC as RFC 3339 has it."""
    sign, minutes = "-" if zone_s < 0 else "+", abs(zone_s) // 60
    return f"{sign}{minutes // 60:02d}{colon}{minutes % 60:02d}"


def draw_time_form(rng: Rng, digits: int, *, point: str = ".") -> TimeForm:
    """A way to write times of so many decimals of a second: 0, 3 or 6."""
    kind = str(
        pick(
            rng, "rfc", "rfc zone", "rfc space", "postgres", "local", "utc assumed", "german", "us", "british",
            "slashes", "unix s", "unix ms", "unix us", "unix ns", "gps s", "gps ms", "slow clock",
        )
    )  # fmt: skip
    zone_s = int(rng.integers(-11, 14)) * 3600 + int(pick(rng, 0, 0, 1800))
    own = pick(rng, digits, 9) if digits else 0  # nanoseconds, with zeros
    if kind in ("rfc", "rfc zone", "rfc space"):
        middle = " " if kind == "rfc space" else pick(rng, "T", "T", "t")
        zone = zone_text(zone_s, pick(rng, ":", ":", "")) if kind != "rfc" else pick(rng, "Z", "Z", "z", "+00:00")
        shift_s = zone_s if kind != "rfc" else 0
        return TimeForm(
            lambda at: calendar_text(at, f"%Y-%m-%d{middle}%H:%M:%S", own, shift_s, point) + zone,
            has_leap_seconds=True,
        )
    if kind == "postgres":
        hour_s = zone_s // 3600 * 3600
        zone = zone_text(hour_s)[:3]
        return TimeForm(lambda at: calendar_text(at, "%Y-%m-%d %H:%M:%S", own, hour_s, point) + zone)
    if kind in ("local", "utc assumed"):
        shift_s = zone_s if kind == "local" else 0
        middle = pick(rng, " ", "T")
        clock = LogClock(utc_offset_s=zone_s) if kind == "local" else None
        return TimeForm(
            lambda at: calendar_text(at, f"%Y-%m-%d{middle}%H:%M:%S", own, shift_s, point), clock, names_zone=False
        )
    if kind in ("german", "us", "british", "slashes"):
        return _date_form(rng, kind, own, zone_s, point)
    if kind == "slow clock":
        offset_s = int(rng.integers(-5000, 5000))
        return TimeForm(
            lambda at: calendar_text(at, "%Y-%m-%dT%H:%M:%SZ", own, -offset_s, point), LogClock(offset_s=offset_s)
        )
    return _number_form(kind, digits, point)


def _date_form(rng: Rng, kind: str, digits: int, zone_s: int, point: str) -> TimeForm:
    """Dates as spreadsheets write them; the zone is declared, the order of day and month only where it has to be."""
    form = {
        "german": "%d.%m.%Y %H:%M:%S", "us": "%m/%d/%Y %I:%M:%S %p", "british": "%d/%m/%Y %H:%M:%S",
        "slashes": "%Y/%m/%d %H:%M:%S",
    }[kind]  # fmt: skip
    if kind in ("german", "us") and chance(rng):
        form = form.replace("%d", "%-d").replace("%m", "%-m").replace("%I", "%-I").replace("%H", "%-H")
    if kind == "us" and chance(rng):
        form = form.replace("%Y ", "%Y, ")  # browsers
    day_first = {"us": False, "british": True}.get(kind)
    clock = LogClock(utc_offset_s=zone_s, day_first=day_first)
    return TimeForm(lambda at: calendar_text(at, form, digits, zone_s, point), clock, names_zone=False)


def _number_form(kind: str, digits: int, point: str) -> TimeForm:
    """Seconds and smaller units since 1970, or since 1980 in GPS time, which has to be declared."""
    scale, unit = kind.split()
    per_s = {"s": 0, "ms": 3, "us": 6, "ns": 9}[unit]
    decimals = max(digits - per_s, 0)
    clock = LogClock(scale=TimeScale(f"gps-{unit}")) if scale == "gps" else None

    def write(at: Instant) -> str:
        count = str((at.gps_us if scale == "gps" else at.utc_us) * 1000).zfill(10)
        whole, rest = count[: len(count) - 9 + per_s], count[len(count) - 9 + per_s :]
        return whole + (point + rest[:decimals] if decimals else "")

    return TimeForm(write, clock, has_leap_seconds=scale == "gps", is_number=True)


# === Delimited text.


@dataclass(frozen=True, slots=True)
class TableForm:
    """How a table is written."""

    delimiter: str
    point: str  # decimal sign
    line_end: str
    quotes: bool  # around every cell that is text
    encoding: str

    def number(self, value: float, decimals: int) -> str:
        """With the decimal sign."""
        return f"{value:.{decimals}f}".replace(".", self.point)

    def write(self, header: Sequence[str], rows: Sequence[Sequence[str]]) -> bytes:
        """The file."""
        lines = [self.delimiter.join(map(self._cell, row)) for row in (header, *rows)]
        return (self.line_end.join(lines) + self.line_end).encode(self.encoding)

    def _cell(self, text: str) -> str:
        if self.delimiter in text or '"' in text or (self.quotes and not text.replace(".", "").isdigit()):
            return '"' + text.replace('"', '""') + '"'
        return text


def draw_table_form(rng: Rng) -> TableForm:
    """Delimiters and decimal signs as they go together: no decimal commas beside commas."""
    delimiter = str(pick(rng, ",", ";", "\t", "|"))
    point = str(pick(rng, ".", ",")) if delimiter != "," else "."
    return TableForm(
        delimiter, point, str(pick(rng, "\n", "\r\n")), chance(rng, 0.2),
        str(pick(rng, "utf-8", "utf-8", "utf-8", "utf-8-sig", "utf-16")),
    )  # fmt: skip


def draw_name(rng: Rng, *names: str) -> str:
    """A name of a column in the spelling of some program: `lat_deg`, `Lat Deg`, `LAT [deg]`."""
    name = str(pick(rng, *names))
    if chance(rng, 0.3):
        name = name.replace("_", " ")
    return str(pick(rng, name, name, name.title(), name.upper()))
