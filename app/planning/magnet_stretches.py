"""Magnets of a plan as people drill them: tags with the lane around them, and lines at even distances."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np
from pyproj import Geod

from app.planning.alignment import Lane
from app.planning.plan import PlannedLineMagnet, PlannedMarker
from app.roads.lane_line import LaneLine
from app.values import Floats

_EVEN_M = 0.005  # [m] difference of neighbouring distances in one line; source: a drill's tolerance, METRO section 8.2
_MAX_LINE_M = 19_000.0  # [m] source: below `app.roads.lane_line.MAX_LENGTH_M`
_BEFORE_M, _AFTER_M = 20.0, 40.0  # [m] of lane that is kept around a tag; several tag lengths
_GEOD = Geod(ellps="WGS84")


def lane_around(lane: Lane, marker: PlannedMarker) -> tuple[Floats, Floats, float]:
    """Longitudes and latitudes of the lane around a tag [deg], and the tag's distance along them [m]."""
    first = max(marker.chainage_m - _BEFORE_M, 0.0)
    last = min(marker.chainage_m + _AFTER_M, lane.length_m)
    chainages = np.unique(np.concatenate([np.arange(first, last, lane.step_m), [marker.chainage_m, last]]))
    lon, lat = lane.position_at(chainages)
    before = chainages <= marker.chainage_m
    return lon, lat, float(_GEOD.line_length(lon[before], lat[before]))


def even_stretches(markers: Sequence[PlannedMarker], max_magnets: int) -> Iterator[list[PlannedMarker]]:
    """Stretches of line magnets at even distances, two or more each; a last one that is alone joins none.

    Parameters
    ----------
    markers : sequence of PlannedMarker
        Those of other kinds are left out.
    max_magnets : int
        Of one stretch.
    """
    lines = [marker for marker in markers if isinstance(marker.detail, PlannedLineMagnet)]
    for _, group in groupby(sorted(lines, key=_line_of), key=_line_of):
        yield from _stretches(sorted(group, key=lambda marker: marker.chainage_m), max_magnets)


def spacing_of(line: LaneLine) -> float:
    """Spacing at which a line through the magnets of a stretch has them at its vertices. [m]"""
    return float(np.diff(line.chainages_m).max()) + _EVEN_M / len(line.chainages_m)


def _stretches(line: list[PlannedMarker], max_magnets: int) -> Iterator[list[PlannedMarker]]:
    lon, lat = np.array([m.lon_deg for m in line]), np.array([m.lat_deg for m in line])
    apart = np.asarray(_GEOD.inv(lon[:-1], lat[:-1], lon[1:], lat[1:])[2])
    start = 0
    while start + 1 < len(line):
        end, length = start + 1, float(apart[start])
        while end + 1 < len(line) and abs(apart[end] - apart[start]) <= _EVEN_M and length < _MAX_LINE_M:
            if end - start + 1 >= max_magnets:
                break
            length += float(apart[end])
            end += 1
        yield line[start : end + 1]
        start = end + 1


def _line_of(marker: PlannedMarker) -> tuple[str, int, str]:
    detail = marker.detail
    assert isinstance(detail, PlannedLineMagnet)
    return marker.lane, int(detail.side), detail.tag.text
