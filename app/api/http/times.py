"""Times in addresses, queries and bodies."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import Annotated

from pydantic import AfterValidator, AwareDatetime

from app.errors import InvalidParameter

MIN_YEAR, MAX_YEAR = 1900, 2200
"""Years of times in requests. Source: by hand, so that no offset and no length of a recording leads out of the calendar
of Python and PostgreSQL."""

_RFC3339 = re.compile(
    r"[0-9]{4}-[0-9]{2}-[0-9]{2}[Tt ][0-9]{2}:[0-9]{2}:[0-9]{2}(\.[0-9]{1,6})?([Zz]|[+-][0-9]{2}:[0-9]{2})"
)


def parse_time(text: str, field: str) -> datetime:
    """A time with its zone (RFC 3339).

    Raises
    ------
    InvalidParameter
        It is none.
    """
    try:
        if _RFC3339.fullmatch(text):
            return datetime.fromisoformat(text.upper()).astimezone(UTC)
    except (ValueError, OverflowError):
        pass
    raise InvalidParameter(
        f"{text[:40]!r} is no time",
        field=field,
        limit="RFC 3339 with a zone and at most six decimals, years 1 to 9999",
        cure="write 2026-03-04T05:06:07Z; a + in an address is written %2B",
    )


def _check_year(time: datetime) -> datetime:
    if not MIN_YEAR <= time.year < MAX_YEAR:
        raise InvalidParameter(
            "the time is too far away",
            limit=f"years {MIN_YEAR} to {MAX_YEAR - 1}",
            cure="send an RFC 3339 time with its offset, e.g. 2026-03-04T05:06:07Z",
        )
    return time


Time = Annotated[AwareDatetime, AfterValidator(_check_year)]
"""A time with its zone in a query or a body."""
