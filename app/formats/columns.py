"""Columns of a table by name: which column holds which quantity."""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence

from app.errors import InvalidParameter

_MAX_SHOWN = 24  # names listed in a message; chosen by hand


def normal_name(name: str) -> str:
    """A column's name as names are compared: `Latitude [deg]` is `latitude_deg`."""
    return re.sub(r"[^a-z0-9]+", "_", name.strip().lower()).strip("_")


def match_columns(
    names: Sequence[str], aliases: Mapping[str, Sequence[str]], declared: Mapping[str, str]
) -> dict[str, int]:
    """Index of each quantity's column: the declared one, or else the first of its aliases that is present."""
    places: dict[str, int] = {}
    normal = [normal_name(name) for name in names]
    for quantity, wanted in aliases.items():
        if quantity in declared:
            name = declared[quantity]
            if name in names:
                places[quantity] = list(names).index(name)
            continue
        for alias in wanted:
            if alias in normal:
                places[quantity] = normal.index(alias)
                break
    return places


def repeated_names(names: Iterable[str], same: Callable[[str], str] = normal_name) -> list[str]:
    """Names of more than one column, sorted; `same` gives the form in which names are compared."""
    counts = Counter(map(same, names))
    return sorted(name for name, count in counts.items() if name and count > 1)


def require_columns(file_name: str, found: Sequence[str], wanted: Iterable[str], *, cure: str) -> None:
    """Refuse a file whose columns are missing; the message names the columns found and similar ones.

    Raises
    ------
    InvalidParameter
    """
    missing = [name for name in wanted if name not in found]
    if not missing:
        return
    similar = [n for n in found if n.lower() == missing[0].lower()] or difflib.get_close_matches(
        missing[0], [n for n in found if n], n=3, cutoff=0.5
    )
    raise InvalidParameter(
        f"{file_name} has no column {', '.join(map(repr, missing[:4]))}{' and more' if len(missing) > 4 else ''}"
        f"; its columns are {', '.join(map(repr, found[:_MAX_SHOWN]))}{' ...' if len(found) > _MAX_SHOWN else ''}"
        + (f"; near: {', '.join(map(repr, similar))}" if similar else ""),
        field=file_name,
        limit=", ".join(missing[:4]),
        cure=cure,
    )
