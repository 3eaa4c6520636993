"""Magnets of other markers near a layout: too near is a conflict, near is a check's warning."""

from __future__ import annotations

import numpy as np
import scipy
import sqlalchemy as sa

from app.encoders.magnet import MagnetLayout
from app.errors import Conflict
from app.markers.magnet import MIN_GAP_M, Orientation
from app.planning.magnet_checks import HALF_BAR_M, Neighbour
from app.registry.magnets import MagnetRow, list_magnets_in
from app.registry.spatial import Box, box_around

NEAR_M = HALF_BAR_M + MIN_GAP_M
"""Beyond it no check of a layout asks. [m]"""
_TOLERANCE_M = 0.0005
_HOLES_IN_A_BOX = 20
_STRANGER = "a marker of another agency"


def find_neighbours(
    connection: sa.Connection, agency_id: str, layout: MagnetLayout, *, ignoring: str
) -> tuple[Neighbour, ...]:
    """The nearest magnet near by of each orientation; names of other agencies' markers are kept back.

    Raises
    ------
    Conflict
        It is so near that the fields of both would be read as one.
    """
    rows = _list_near(connection, layout, ignoring)
    if not rows:
        return ()
    holes = scipy.spatial.cKDTree([hole.point_enu_m[:2] for hole in layout.holes])
    points = [layout.lane.from_position(row.lon_deg, row.lat_deg)[:2] for row in rows]
    distances_m = np.asarray(holes.query(np.array(points))[0], dtype=np.float64)
    nearest: dict[int, tuple[float, MagnetRow]] = {}
    for distance_m, row in zip(distances_m.tolist(), rows, strict=True):
        if distance_m < nearest.get(row.phi_deg, (NEAR_M, row))[0]:
            nearest[row.phi_deg] = (distance_m, row)
    for distance_m, row in nearest.values():
        if distance_m < MIN_GAP_M - _TOLERANCE_M:
            raise Conflict(
                f"a magnet would lie {distance_m:.3f} m from one of {_name(row, agency_id)}",
                field="lane",
                limit=f"{MIN_GAP_M:g} m between magnets: METRO figure 17a",
                cure="choose another chainage or offset, or retire the other marker",
            )
    return tuple(
        Neighbour(_name(row, agency_id), row.lon_deg, row.lat_deg, Orientation(row.phi_deg))
        for _, (_, row) in sorted(nearest.items())
    )


def _name(row: MagnetRow, agency_id: str) -> str:
    return f"marker {row.marker_id}" if row.agency_id == agency_id else _STRANGER


def _list_near(connection: sa.Connection, layout: MagnetLayout, ignoring: str) -> list[MagnetRow]:
    """Magnets in boxes around a few holes each: one box around a long line would hold a town."""
    found: dict[int, MagnetRow] = {}
    for start in range(0, len(layout.holes), _HOLES_IN_A_BOX):
        holes = layout.holes[start : start + _HOLES_IN_A_BOX]
        for row in list_magnets_in(
            connection, _box(holes[0].lon_deg, [(h.lon_deg, h.lat_deg) for h in holes]), ignoring=ignoring
        ):
            found[row.row] = row
    return list(found.values())


def _box(around_deg: float, places: list[tuple[float, float]]) -> Box:
    """Box around a few places near each other, over the antimeridian too."""
    boxes = [box_around(lon, lat, NEAR_M) for lon, lat in places]
    south, north = min(box.south_deg for box in boxes), max(box.north_deg for box in boxes)
    if any(box.east_deg - box.west_deg == 360.0 for box in boxes):  # at a pole
        return Box(-180.0, south, 180.0, north)

    def turned(lon_deg: float) -> float:
        return (lon_deg - around_deg + 180.0) % 360.0 - 180.0

    west = min(turned(box.west_deg) for box in boxes) + around_deg
    east = max(turned(box.east_deg) for box in boxes) + around_deg
    wrapped = [(lon + 180.0) % 360.0 - 180.0 for lon in (west, east)]
    return Box(wrapped[0], south, wrapped[1], north)
