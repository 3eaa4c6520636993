"""Planned magnets as rows of the registry: a tag is a marker, and so is a line of magnets at even distances."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from app.families.inputs import PositionIn
from app.families.magnet.columns import magnet_columns
from app.families.magnet.layouts import MAX_MAGNETS, LaneInput, PlacedLine, PlacedTag
from app.families.magnet.registration import LineInput, NewMagnets, TagInput
from app.families.planned import PLAN_METHOD, Commitment, PlannedMarkers, PlannedRow
from app.markers.magnet import LineStyle
from app.planning.magnet_stretches import even_stretches, lane_around, spacing_of
from app.planning.plan import PlannedLineMagnet, PlannedMarker, PlannedTag
from app.roads.lane_line import LaneLine


class PlannedMagnets(PlannedMarkers):
    """Tags and lines of magnets."""

    needs_index = True

    def rows(self, commitment: Commitment, markers: Sequence[PlannedMarker]) -> Iterator[PlannedRow]:
        """One row for each tag, and one for each stretch of a line."""
        for marker in markers:
            if isinstance(marker.detail, PlannedTag):
                yield self._tag(commitment, marker, marker.detail)
        for stretch in even_stretches(markers, MAX_MAGNETS):
            yield self._line(commitment, stretch)

    def _tag(self, commitment: Commitment, marker: PlannedMarker, detail: PlannedTag) -> PlannedRow:
        lon, lat, along_m = lane_around(commitment.alignment.lane(marker.lane), marker)
        lane_input = _lane_input(commitment, lon.tolist(), lat.tolist(), marker.height_m)
        place = PlacedTag(along_m, marker.offset_m)
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
        spacing_m = spacing_of(line)
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
