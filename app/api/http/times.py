"""Times in addresses."""

from __future__ import annotations

import re
from datetime import UTC, datetime

from app.errors import InvalidParameter

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
