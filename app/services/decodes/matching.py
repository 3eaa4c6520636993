"""What the registry knows of the markers that an upload can have read."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import sqlalchemy as sa

from app.decoders.cerpm.verify import SequenceSpan, Verification
from app.decoding.declarations import CoarsePosition
from app.decoding.frames import MAX_CODEBOOK, Match, Nearby, plate_codebook
from app.decoding.recordings import MAX_MAGNET_ROWS, KnownMarkers, NearbyTags
from app.families import FAMILIES, get_family
from app.families.family import FrameReader, FrameReading
from app.families.plate.plates import PLATE
from app.markers.plate import PlateCode
from app.registry import markers
from app.registry import markers as store
from app.registry.markers import MarkerFilter, SpanRow
from app.services.access.agency_secrets import AgencySecrets

FRAME_READERS: Mapping[str, FrameReader[FrameReading, object]] = {
    family.name: family.frames for family in FAMILIES if family.frames is not None
}
"""Families whose markers are read in camera frames."""


@dataclass(frozen=True, slots=True)
class NearbyMarkers:
    """The agency's markers that could be in view, by family."""

    by_family: Mapping[str, Nearby] = field(default_factory=dict)

    def of(self, family: str) -> Nearby:
        """Those of one family; none where no position is known."""
        return self.by_family.get(family, Nearby())

    @property
    def codebook(self) -> tuple[PlateCode, ...]:
        """Codes of the plates nearby."""
        return plate_codebook(self.of(PLATE.name))


def find_nearby_markers(connection: sa.Connection, agency_id: str, position: CoarsePosition | None) -> NearbyMarkers:
    """Markers of the agency within the coarse accuracy and the range of view."""
    if position is None:
        return NearbyMarkers()
    names = tuple(FRAME_READERS)
    rows = store.list_near(
        connection, agency_id, names, position.lon_deg, position.lat_deg, position.reach_m, limit=MAX_CODEBOOK + 1
    )
    complete = len(rows) <= MAX_CODEBOOK
    return NearbyMarkers(
        {name: Nearby(tuple(row for row in rows[:MAX_CODEBOOK] if row.family == name), complete) for name in names}
    )


def match_reading(
    connection: sa.Connection,
    agency_id: str,
    reading: FrameReading,
    position: CoarsePosition | None,
    nearby: NearbyMarkers,
) -> Match | None:
    """The registered marker of a reading; None where nothing was read or there is no position to look from."""
    reader = get_family(reading.family).frames
    assert reader is not None
    return reader.match(connection, agency_id, reading, position, nearby.of(reading.family))


def find_nearby_tags(
    connection: sa.Connection, agency_id: str, position: CoarsePosition | None, reach_m: float, epoch: float
) -> NearbyTags:
    """Information tags within the coarse accuracy and the length of a drive, where they are at an epoch."""
    if position is None:
        return NearbyTags()
    near = (position.lon_deg, position.lat_deg, position.accuracy_m + reach_m)
    filtered = MarkerFilter(near=near, family="magnet")
    return NearbyTags.of(store.list_markers(connection, agency_id, filtered, after=None, limit=MAX_MAGNET_ROWS), epoch)


def find_known(
    connection: sa.Connection, agency_id: str, secrets: AgencySecrets, numbers: list[int], before: str | None = None
) -> KnownMarkers:
    """Markers, key and earlier drives of an agency; of a decode that is done again, those before it."""
    spans = markers.list_spans(connection, agency_id, numbers, before)
    return KnownMarkers(
        markers.list_by_number(connection, agency_id, numbers),
        secrets.find_key(connection, agency_id),
        {number: [_span(row) for row in rows] for number, rows in spans.items()},
        markers.newest_row(spans),
    )


def spans_of(verification: Verification) -> list[dict[str, object]]:
    """The accepted transmissions, as the registry stores them."""
    return [
        {
            "number": number,
            "first_sequence": span.first_sequence,
            "last_sequence": span.last_sequence,
            "first_heard_s": span.first_heard_s if math.isfinite(span.first_heard_s) else None,
            "last_heard_s": span.last_heard_s if math.isfinite(span.last_heard_s) else None,
        }
        for number, spans in verification.spans.items()
        for span in spans
    ]


def _span(row: SpanRow) -> SequenceSpan:
    first, last = row.first_heard_s, row.last_heard_s
    return SequenceSpan(
        row.first_sequence,
        row.last_sequence,
        math.nan if first is None else first,
        math.nan if last is None else last,
    )
