"""Readings of frames to registered markers, family by family."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import sqlalchemy as sa

from app.families import FAMILIES, get_family
from app.families.frames import FrameReader, FrameReading, Match, Nearby
from app.families.plate.frames import plate_codebook
from app.families.plate.plates import PLATE
from app.markers.plate import PlateCode
from app.registry import markers as store
from app.services.decodes.context import CoarsePosition

MAX_CODEBOOK = 500
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
        """Codes of the plates near by."""
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
