"""Matching of a trace's tags with registered ones.

The same on the server, from the registry, and on board, from a snapshot. The position that follows is in `localize`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pyproj import Geod

from app.decoders.magnet.identify import TagCandidates, TagFormat
from app.decoders.magnet.localize import TagFix, fix_from_tag
from app.decoders.magnet.readings import LineCrossing, MagnetReading, NoiseFinding, TagReading
from app.decoders.magnet.registered_tag import RegisteredTag
from app.sensors.magnetometer_bar import MagnetometerBar

Floats = npt.NDArray[np.float64]

MAX_TAGS = 500
"""With more registered tags within reach the decoder takes formats instead. Source: chosen by hand for speed."""
_ODOMETER_ERROR = 0.03  # share by which an odometer's distance may be off; source: by hand
_ODOMETER_SPARE_M = 10.0  # [m] more that it may be off; source: by hand
_MIN_STRAIGHT_SHARE = 0.6  # straight distance between two tags over the way driven, at least; source: by hand
_GEOD = Geod(ellps="WGS84")


def tag_candidates(tags: Sequence[RegisteredTag], formats: Iterable[TagFormat]) -> TagCandidates:
    """Tags that may be on the road; formats where none is registered, or too many are."""
    different = tuple(dict.fromkeys(tag.tag for tag in tags))
    if 0 < len(tags) <= MAX_TAGS:
        return TagCandidates(tags=different)
    return TagCandidates(formats=tuple(dict.fromkeys(formats)))


@dataclass(frozen=True, slots=True)
class TagMatch:
    """The registered tag that was passed; without it, none or several have this code."""

    tag: RegisteredTag | None
    others: tuple[str, ...] = ()
    note: str = ""


@dataclass(frozen=True, slots=True)
class ReadTag:
    """A tag with its match in the registry and the position that follows."""

    reading: TagReading
    match: TagMatch | None = None
    fix: TagFix | None = None


@dataclass(frozen=True, slots=True)
class ReadTrace:
    """All readings of a trace, its tags matched."""

    magnets: tuple[MagnetReading, ...]
    crossings: tuple[LineCrossing, ...]
    tags: tuple[ReadTag, ...]
    noise: tuple[NoiseFinding, ...]


def match_tags(findings: Sequence[object], nearby: Sequence[RegisteredTag], bar: MagnetometerBar) -> ReadTrace:
    """Match the tags of a trace with the registered ones within reach, in the order in which they were passed."""
    readings = sorted((f for f in findings if isinstance(f, TagReading)), key=lambda tag: tag.start_s)
    tags: list[ReadTag] = []
    for reading in readings:
        match = _match(reading, nearby, tags)
        fix = None
        if match is not None and match.tag is not None:
            fix = fix_from_tag(reading, match.tag, bar)
        tags.append(ReadTag(reading, match, fix))
    return ReadTrace(
        tuple(sorted((f for f in findings if isinstance(f, MagnetReading)), key=lambda f: f.t_s)),
        tuple(sorted((f for f in findings if isinstance(f, LineCrossing)), key=lambda f: f.t_s)),
        tuple(tags),
        tuple(sorted((f for f in findings if isinstance(f, NoiseFinding)), key=lambda f: f.t_s)),
    )


def _match(reading: TagReading, nearby: Sequence[RegisteredTag], before: Sequence[ReadTag]) -> TagMatch | None:
    if reading.tag is None or not nearby:
        return None
    found = [tag for tag in nearby if tag.tag == reading.tag]
    if len(found) > 1:
        found = _reachable(reading, found, before) or found
    if not found:
        return TagMatch(None, note="no tag with this code is registered near by")
    if len(found) > 1:
        note = f"ambiguous: {len(found)} tags within reach have this code"
        return TagMatch(None, tuple(tag.marker_id for tag in found), note)
    return TagMatch(found[0])


def _reachable(reading: TagReading, among: Sequence[RegisteredTag], before: Sequence[ReadTag]) -> list[RegisteredTag]:
    """Those whose distance from the last tag that was matched fits the odometer."""
    known = next((tag for tag in reversed(before) if tag.match is not None and tag.match.tag is not None), None)
    if known is None or known.match is None or known.match.tag is None:
        return []
    driven_m = reading.magnets[0].odometer_m - known.reading.magnets[0].odometer_m
    last = known.match.tag
    slack_m = _ODOMETER_ERROR * driven_m + _ODOMETER_SPARE_M
    reachable = []
    for tag in among:
        away_m = float(_GEOD.inv(last.lon_deg, last.lat_deg, tag.lon_deg, tag.lat_deg)[2])
        # a road bends: the way is at least as long as the straight line
        if _MIN_STRAIGHT_SHARE * driven_m - slack_m <= away_m <= driven_m + slack_m:
            reachable.append(tag)
    return reachable
