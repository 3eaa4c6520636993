"""Limits how often the tags of CERPMs can be guessed by uploading packets."""

from __future__ import annotations

import math
from datetime import UTC, date, datetime, time, timedelta

from app.decoders.cerpm.verify import Verdict, Verification
from app.errors import TooManyRequests
from app.markers.cerpm_keys import MAX_INVALID_TAGS_PER_DAY, MAX_INVALID_TAGS_PER_LOG

_SUSPICIOUS = (Verdict.FORGED, Verdict.WRONG_KEY, Verdict.UNCHECKED)


class InvalidTagLimit:
    """Counts the invalid tags that each holder of a key has uploaded today (UTC), in this process."""

    def __init__(self, per_day: int = MAX_INVALID_TAGS_PER_DAY) -> None:
        self._per_day = per_day
        self._day = date.min
        self._counts: dict[str, int] = {}

    def left(self, holder_id: str, now: datetime) -> int:
        """Invalid tags that the next log of a holder may contain, at least one.

        Raises
        ------
        TooManyRequests
            There were too many today.
        """
        left = self._per_day - self._of(now).get(holder_id, 0)
        if left <= 0:
            tomorrow = datetime.combine(now.astimezone(UTC).date() + timedelta(days=1), time(), UTC)
            raise TooManyRequests(
                "too many packets with invalid tags were uploaded with this key today",
                limit=f"{self._per_day} invalid tags in a day (UTC)",
                cure="upload the log after midnight UTC, and look for the source of the packets: see docs/cerpms.md",
                retry_after_s=max(1, math.ceil((tomorrow - now).total_seconds())),
            )
        return min(left, MAX_INVALID_TAGS_PER_LOG)

    def add(self, holder_id: str, invalid_tags: int, now: datetime) -> None:
        """Count the invalid tags of a log."""
        if invalid_tags:
            counts = self._of(now)
            counts[holder_id] = counts.get(holder_id, 0) + invalid_tags

    def _of(self, now: datetime) -> dict[str, int]:
        day = now.astimezone(UTC).date()
        if day > self._day:
            self._day, self._counts = day, {}
        return self._counts


def forgery_detail(verification: Verification) -> dict[str, int] | None:
    """What the audit log records of a log with forged packets; None if there are none."""
    counts = verification.counts()
    if not any(counts[verdict] for verdict in _SUSPICIOUS):
        return None
    return {**{str(verdict): counts[verdict] for verdict in _SUSPICIOUS}, "invalid_tags": verification.invalid_tags}
