"""The planned place of a marker on a boundary of a lane."""

from __future__ import annotations

from dataclasses import dataclass

from app.markers.cerpm import LaneSide


@dataclass(frozen=True, slots=True)
class MarkerPlace:
    """The place of one marker.

    Attributes
    ----------
    side : LaneSide
        LEFT or RIGHT.
    chainage_m : float
        Along the lane's centre line; the same for both of a pair. [m]
    point_m : tuple of float
        East and north in the frame of the boundaries, on the boundary. [m]
    heading_deg : float
        Direction of travel there, clockwise from north of the frame. [deg]
    """

    side: LaneSide
    chainage_m: float
    point_m: tuple[float, float]
    heading_deg: float
