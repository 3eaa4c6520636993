"""Where a page ended, as the link to the next page has it."""

from __future__ import annotations

import math
import re

from app.errors import InvalidParameter

_ID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")
_PLACE = re.compile(r"(-?[0-9]{1,9}(?:\.[0-9]{1,20})?(?:e-[0-9]{1,3})?),([0-9a-f-]{36})")


def checked_id(after: str | None) -> str | None:
    """The last id of a page in the order of ids.

    Raises
    ------
    InvalidParameter
        It is no id.
    """
    if after is not None and not _ID.fullmatch(after):
        raise _no_cursor()
    return after


def cursor_of(after: str | None) -> tuple[float, str] | None:
    """The last distance or measure [m], and its id, of a page in the order of these.

    Raises
    ------
    InvalidParameter
        It is not where a page ended.
    """
    if after is None:
        return None
    found = _PLACE.fullmatch(after)
    if found is None or not math.isfinite(float(found[1])):
        raise _no_cursor()
    return float(found[1]), found[2]


def _no_cursor() -> InvalidParameter:
    return InvalidParameter(
        "this is not where a page of this list ended",
        field="after",
        limit="as the link to the next page has it",
        cure="start without after, and follow the links",
    )
