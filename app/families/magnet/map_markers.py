"""Magnets in HD maps: each magnet of a tag or of a line is one point."""

from __future__ import annotations

from app.families.magnet.layouts import layout_of
from app.markers.magnet import LineTag
from app.planning.outputs.hd_map import MapMarker
from app.registry.marker_rows import MarkerRow
from app.roads.lane_line import bearing_deg


def magnets_of_map(row: MarkerRow) -> list[MapMarker]:
    """The magnets of a marker; the height that was surveyed is that of the first one, and holds for a tag only."""
    layout = layout_of(row.id, row.spec)
    is_line = isinstance(layout.tag, LineTag)
    return [
        MapMarker(
            f"{row.id}.{hole.number}", row.family, row.digits, hole.lon_deg, hole.lat_deg,
            None if is_line else row.height_m,
            bearing_deg(layout.lane.direction_at(hole.chainage_m)) if is_line else layout.bearing_deg % 360.0,
            "line" if is_line else "information", vertical_datum=row.vertical_datum,
        )
        for hole in layout.holes
    ]  # fmt: skip
