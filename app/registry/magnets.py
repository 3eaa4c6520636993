"""Where single magnets lie. Their rows follow from the layouts of their markers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import sqlalchemy as sa

from app.registry.spatial import Box
from app.registry.tables import magnets, markers

Row = sa.RowMapping

magnets_rtree = sa.table(
    "magnets_rtree",
    *(sa.column(name, sa.Double) for name in ("row", "min_lon", "max_lon", "min_lat", "max_lat")),
)


def replace_magnets(
    connection: sa.Connection, agency_id: str, marker_id: str, holes: Sequence[Mapping[str, Any]]
) -> None:
    """Store where the magnets of a marker lie: number, lon_deg, lat_deg, polarity, phi_deg of each."""
    connection.execute(
        sa.delete(magnets).where(magnets.c.marker_id == marker_id, magnets.c.agency_id == agency_id),
    )
    connection.execute(sa.insert(magnets), [{"marker_id": marker_id, "agency_id": agency_id, **hole} for hole in holes])


def list_magnets_in(connection: sa.Connection, box: Box, *, ignoring: str | None = None) -> list[Row]:
    """Magnets of any agency inside a box that may be in the road, but for those of one marker."""
    inside = (
        sa.and_(
            magnets.c.row.in_(
                sa.select(magnets_rtree.c.row).where(
                    magnets_rtree.c.max_lon >= part.west_deg,
                    magnets_rtree.c.min_lon <= part.east_deg,
                    magnets_rtree.c.max_lat >= part.south_deg,
                    magnets_rtree.c.min_lat <= part.north_deg,
                )
            ),
            magnets.c.lon_deg.between(part.west_deg, part.east_deg),
            magnets.c.lat_deg.between(part.south_deg, part.north_deg),
        )
        for part in box.parts
    )
    query = (
        sa.select(magnets)
        .join(markers, markers.c.id == magnets.c.marker_id)
        .where(sa.or_(*inside), markers.c.status != "retired")
    )
    if ignoring is not None:
        query = query.where(magnets.c.marker_id != ignoring)
    return list(connection.execute(query).mappings())
