"""Planned magnets as rows of the registry: a tag is a marker, and so is a line of magnets at even distances."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np
from pyproj import Geod

from app.families.inputs import PositionIn
from app.families.magnet.columns import magnet_columns
from app.families.magnet.layouts import MAX_MAGNETS, LaneInput, PlacedLine, PlacedTag
from app.families.magnet.registration import LineInput, NewMagnets, TagInput
from app.families.planned import PLAN_METHOD, Commitment, PlannedMarkers, PlannedRow
from app.markers.magnet import LineStyle
from app.planning.alignment import Floats
from app.planning.plan import PlannedLineMagnet, PlannedMarker, PlannedTag
from app.roads.lane_line import LaneLine

_EVEN_M = 0.005  # [m] difference of neighbouring distances in one line; source: a drill's tolerance, METRO section 8.2
_MAX_LINE_M = 19_000.0  # [m] source: below `app.roads.lane_line.MAX_LENGTH_M`
_BEFORE_M, _AFTER_M = 20.0, 40.0  # [m] of lane that is kept around a tag; source: chosen by hand, several tag lengths
_GEOD = Geod(ellps="WGS84")


class PlannedMagnets(PlannedMarkers):
    """Tags and lines of magnets."""

    needs_index = True

    def rows(self, commitment: Commitment, markers: Sequence[PlannedMarker]) -> Iterator[PlannedRow]:
        """One row for each tag, and one for each stretch of a line."""
        for marker in markers:
            if isinstance(marker.detail, PlannedTag):
                yield self._tag(commitment, marker, marker.detail)
        lines = [marker for marker in markers if isinstance(marker.detail, PlannedLineMagnet)]
        for _, group in groupby(sorted(lines, key=_line_of), key=_line_of):
            for stretch in _even_stretches(list(group)):
                yield self._line(commitment, stretch)

    def _tag(self, commitment: Commitment, marker: PlannedMarker, detail: PlannedTag) -> PlannedRow:
        lane = commitment.alignment.lane(marker.lane)
        first = max(marker.chainage_m - _BEFORE_M, 0.0)
        last = min(marker.chainage_m + _AFTER_M, lane.length_m)
        chainages = np.unique(np.concatenate([np.arange(first, last, lane.step_m), [marker.chainage_m, last]]))
        lon, lat = lane.position_at(chainages)
        lane_input = _lane_input(commitment, lon.tolist(), lat.tolist(), marker.height_m)
        along_m = _GEOD.line_length(lon[chainages <= marker.chainage_m], lat[chainages <= marker.chainage_m])
        place = PlacedTag(float(along_m), marker.offset_m)
        what = TagInput(place, code=detail.tag.text, codebook_id=commitment.codebook_id)
        columns = magnet_columns(
            NewMagnets(lane=lane_input, what=what), detail.tag, detail.meaning, commitment.rules, commitment.now
        )
        return PlannedRow(marker.number, columns | {"original": commitment.original(marker)})

    def _line(self, commitment: Commitment, stretch: Sequence[PlannedMarker]) -> PlannedRow:
        lon, lat = [marker.lon_deg for marker in stretch], [marker.lat_deg for marker in stretch]
        lane_input = _lane_input(commitment, lon, lat, stretch[0].height_m)
        detail = stretch[0].detail
        assert isinstance(detail, PlannedLineMagnet)
        line = LaneLine.from_lon_lat(list(zip(lon, lat, strict=True)), stretch[0].height_m or 0.0)
        spacing_m = float(np.diff(line.chainages_m).max()) + _EVEN_M / len(stretch)
        style = LineStyle.SOLID if detail.tag.style is LineStyle.SOLID else LineStyle.DASHED
        what = LineInput(PlacedLine(spacing_m=spacing_m), style)
        columns = magnet_columns(
            NewMagnets(lane=lane_input, what=what), detail.tag, None, commitment.rules, commitment.now
        )
        return PlannedRow(stretch[0].number, columns | {"original": commitment.original(stretch[0])}, len(stretch))


def _lane_input(commitment: Commitment, lon: list[float], lat: list[float], height_m: float | None) -> LaneInput:
    road = commitment.alignment
    provenance = PositionIn(
        height_m=height_m,
        realization=road.realization,
        epoch=road.epoch,
        vertical_datum=road.vertical_datum if height_m is not None else None,
        survey_method=PLAN_METHOD,
    )
    return LaneInput(tuple(zip(lon, lat, strict=True)), False, "points_deg", provenance)


def _line_of(marker: PlannedMarker) -> tuple[str, int, str]:
    detail = marker.detail
    assert isinstance(detail, PlannedLineMagnet)
    return marker.lane, int(detail.side), detail.tag.text


def _even_stretches(line: list[PlannedMarker]) -> Iterator[list[PlannedMarker]]:
    """Stretches of two magnets or more at even distances; a last one that is alone joins none and is left out."""
    line.sort(key=lambda marker: marker.chainage_m)
    apart = _apart_m(line)
    start = 0
    while start + 1 < len(line):
        end, length = start + 1, float(apart[start])
        while end + 1 < len(line) and abs(apart[end] - apart[start]) <= _EVEN_M and length < _MAX_LINE_M:
            if end - start + 1 >= MAX_MAGNETS:
                break
            length += float(apart[end])
            end += 1
        yield line[start : end + 1]
        start = end + 1


def _apart_m(line: Sequence[PlannedMarker]) -> Floats:
    lon, lat = np.array([m.lon_deg for m in line]), np.array([m.lat_deg for m in line])
    return np.asarray(_GEOD.inv(lon[:-1], lat[:-1], lon[1:], lat[1:])[2])
