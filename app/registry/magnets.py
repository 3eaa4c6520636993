"""Where single magnets lie. Their rows follow from the layouts of their markers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import sqlalchemy as sa

from app.registry.rows import fetch_all, select_rows
from app.registry.spatial import Box, within_box
from app.registry.tables import magnets, markers
from app.registry.tenancy import seeing_every_agency


class MagnetRow(NamedTuple):
    """Where a magnet of a marker lies."""

    row: int
    marker_id: str
    number: int
    agency_id: str
    lon_deg: float
    lat_deg: float
    phi_deg: int


def replace_magnets(
    connection: sa.Connection, agency_id: str, marker_id: str, holes: Sequence[Mapping[str, Any]]
) -> None:
    """Store where the magnets of a marker lie: number, lon_deg, lat_deg, polarity, phi_deg of each."""
    connection.execute(
        sa.delete(magnets).where(magnets.c.marker_id == marker_id, magnets.c.agency_id == agency_id),
    )
    connection.execute(sa.insert(magnets), [{"marker_id": marker_id, "agency_id": agency_id, **hole} for hole in holes])


def list_magnets_in(connection: sa.Connection, box: Box, *, ignoring: str | None = None) -> list[MagnetRow]:
    """Magnets of any agency inside a box that may be in the road, but for those of one marker."""
    query = (
        select_rows(MagnetRow, magnets)
        .join(markers, markers.c.id == magnets.c.marker_id)
        .where(within_box(box, magnets), markers.c.status != "retired")
    )
    if ignoring is not None:
        query = query.where(magnets.c.marker_id != ignoring)
    with seeing_every_agency(connection):
        return fetch_all(connection, query, MagnetRow)
