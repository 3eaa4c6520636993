"""Information tags of the registry as the decoder of traces takes them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import sqlalchemy as sa

from app.decoders.magnet.match import MAX_TAGS
from app.decoders.magnet.registered_tag import RegisteredTag
from app.families.magnet.layouts import INFORMATION_TAG
from app.families.magnet.spec import MagnetSpec, meaning_of
from app.markers.magnet import InformationTag, parse_tag
from app.registry import markers as store
from app.registry.marker_rows import MarkerRow
from app.registry.markers import MarkerFilter
from app.services.decodes.context import CoarsePosition
from app.services.decodes.fixes import horizontal_rmse_m, marker_at, position_warnings


@dataclass(frozen=True, slots=True)
class NearbyTags:
    """The agency's information tags that the drive can have passed."""

    tags: tuple[RegisteredTag, ...] = ()
    complete: bool = True

    @property
    def texts(self) -> tuple[str, ...]:
        """Their codes, without repetitions; none if there are too many to look for."""
        return tuple(dict.fromkeys(tag.tag.text for tag in self.tags)) if self.complete else ()


def find_nearby_tags(
    connection: sa.Connection, agency_id: str, position: CoarsePosition | None, reach_m: float, epoch: float
) -> NearbyTags:
    """Information tags within the coarse accuracy and the length of a drive, where they are at an epoch."""
    if position is None:
        return NearbyTags()
    near = (position.lon_deg, position.lat_deg, position.accuracy_m + reach_m)
    rows = store.list_markers(
        connection, agency_id, MarkerFilter(near=near, family="magnet"), after=None, limit=4 * MAX_TAGS
    )
    tags = [row for row in rows if row.scheme == INFORMATION_TAG and row.status != "retired"]
    complete = len(tags) <= MAX_TAGS and len(rows) < 4 * MAX_TAGS
    return NearbyTags(tuple(registered_tag(row, epoch) for row in tags[:MAX_TAGS]), complete)


def registered_tag(stored: MarkerRow, epoch: float) -> RegisteredTag:
    """The information tag of a magnet marker's row, where it is at an epoch [decimal year]."""
    row = marker_at(stored, epoch)
    tag, spec = parse_tag(row.digits), cast(MagnetSpec, row.spec)
    assert isinstance(tag, InformationTag)
    assert row.heading_deg is not None
    lane_lon_deg, lane_lat_deg = spec["lane"]["points_deg"][0][:2]
    lane_lon_deg += row.lon_deg - stored.lon_deg
    lane_lat_deg += row.lat_deg - stored.lat_deg
    return RegisteredTag(
        row.id, row.status, tag, row.lon_deg, row.lat_deg, row.height_m, row.heading_deg,
        lane_lon_deg, lane_lat_deg, horizontal_rmse_m(row), row.localization_grade,
        tuple(position_warnings(row, "tag")), meaning_of(spec),
    )  # fmt: skip
