"""Logs in general: the report about reading one, and its times as seconds since 1970-01-01 UTC."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum

from pydantic import Field

from app.inputs import Declaration, Number

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


# === Times of logs, converted to seconds since 1970-01-01 UTC.


GPS_EPOCH_S = 315_964_800.0
"""1980-01-06, the start of GPS time. [s]"""
_LEAP_SECONDS = (
    46_828_800, 78_364_801, 109_900_802, 173_059_203, 252_028_804, 315_187_205, 346_723_206, 393_984_007, 425_520_008,
    457_056_009, 504_489_610, 551_750_411, 599_184_012, 820_108_813, 914_803_214, 1_025_136_015, 1_119_744_016,
    1_167_264_017,
)  # fmt: skip
"""GPS times after which UTC is behind by one more second (IERS bulletin C, up to 2017; none since)."""
_EARLIEST_S, _LATEST_S = 946_684_800.0, 4_102_444_800.0  # [s] the years 2000 to 2100
_LEAP_SECOND = re.compile(r"(:\d\d):60(?=\D|$)")
_NUMBER = re.compile(r"[+-]?\d+(?:\.\d*)?(?:[eE][+-]?\d{1,2})?\Z")
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

    def read(self, value: object) -> float:
        """Seconds since 1970-01-01 UTC; NaN where there is no time between 2000 and 2100. [s]"""
        if isinstance(value, bool) or value is None:
            return NOWHEN
        if isinstance(value, int | float):
            seconds = self._from_number(value)
        elif isinstance(value, str) and len(value) <= _MAX_TEXT:
            text = value.strip()
            seconds = self._from_number(float(text)) if _NUMBER.match(text) else self._from_text(text)
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

    def _from_text(self, text: str) -> float:
        if len(text) < 10:
            return NOWHEN
        leap = ":60" in text and _LEAP_SECOND.search(text) is not None
        try:
            at = datetime.fromisoformat(_LEAP_SECOND.sub(r"\1:59", text) if leap else text)
            if at.tzinfo is None:
                return at.replace(tzinfo=UTC).timestamp() - self.utc_offset_s + leap
            return at.timestamp() + leap
        except (ValueError, OverflowError):
            return NOWHEN


def utc_from_gps_s(gps_s: float) -> float:
    """Seconds since 1970-01-01 UTC of seconds since the start of GPS time. [s]"""
    return gps_s + GPS_EPOCH_S - sum(gps_s >= leap for leap in _LEAP_SECONDS)


def has_zone(text: str) -> bool:
    """Whether a text in RFC 3339 names its zone."""
    return re.search(r"(?:[zZ]|[+-]\d\d:?\d\d)\s*\Z", text) is not None
