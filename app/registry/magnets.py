"""Where single magnets lie. Their rows follow from the layouts of their markers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import sqlalchemy as sa

from app.registry.spatial import Box, within_box
from app.registry.tables import magnets, markers
from app.registry.tenancy import seeing_every_agency

Row = sa.RowMapping


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
    query = (
        sa.select(magnets)
        .join(markers, markers.c.id == magnets.c.marker_id)
        .where(within_box(box, magnets), markers.c.status != "retired")
    )
    if ignoring is not None:
        query = query.where(magnets.c.marker_id != ignoring)
    with seeing_every_agency(connection):
        return list(connection.execute(query).mappings())
