"""Places of markers in many circles."""

from __future__ import annotations

from collections.abc import Iterable

import sqlalchemy as sa

from app.registry.markers import MarkerFilter, conditions_of
from app.registry.spatial import box_around, within_box
from app.registry.tables import markers


def list_places(
    connection: sa.Connection,
    agency_id: str,
    filtered: MarkerFilter,
    circles: Iterable[tuple[float, float, float]],
    *,
    limit: int,
) -> list[tuple[str, float, float]]:
    """Id, longitude and latitude of the markers in the boxes of circles (lon_deg, lat_deg, radius_m), each once.

    No more than about `limit` are read.
    """
    places = sa.select(markers.c.id, markers.c.lon_deg, markers.c.lat_deg).where(
        markers.c.agency_id == agency_id, *conditions_of(filtered)
    )
    found: dict[str, tuple[str, float, float]] = {}
    for circle in circles:
        query = places.where(within_box(box_around(*circle))).limit(limit)
        found.update({row[0]: (row[0], row[1], row[2]) for row in connection.execute(query)})
        if len(found) >= limit:
            break
    return list(found.values())
