"""Roads for tests: straights, arcs and their like as lanes, without a file."""

from __future__ import annotations

import numpy as np
from pyproj import Geod

from app.formats.alignments.geometry import BoundaryStyle
from app.planning.alignment import Alignment, AvoidedArea, Lane, RoadEvent
from app.values import Floats

GEOD = Geod(ellps="WGS84")
START_DEG = (8.4, 49.0)


def lane_of_curvature(
    curvature_per_m: Floats,
    *,
    name: str = "1",
    start_deg: tuple[float, float] = START_DEG,
    heading_deg: float = 80.0,
    speed_kmh: float = 90.0,
    width_m: float = 3.5,
    grade: float = 0.0,
    styles: tuple[BoundaryStyle, BoundaryStyle] = (BoundaryStyle.DASHED, BoundaryStyle.SOLID),
) -> Lane:
    """A lane of 1 m steps with a curvature at each sample, left positive."""
    count = len(curvature_per_m)
    chainage = np.arange(count, dtype=float)
    heading = heading_deg - np.degrees(
        np.concatenate([[0.0], np.cumsum((curvature_per_m[1:] + curvature_per_m[:-1]) / 2)])
    )
    lon, lat = np.empty(count), np.empty(count)
    lon[0], lat[0] = start_deg
    middle = (heading[1:] + heading[:-1]) / 2
    for k in range(count - 1):
        lon[k + 1], lat[k + 1], _ = GEOD.fwd(lon[k], lat[k], middle[k], 1.0)
    even = np.ones(count)
    return Lane(
        name, "road", chainage, lon, lat, 100.0 + grade * chainage, heading % 360.0, curvature_per_m, even * grade,
        np.zeros(count), even * width_m, even * speed_kmh / 3.6, chainage, *styles,
    )  # fmt: skip


def straight(length_m: int, **more: object) -> Lane:
    """A straight lane."""
    return lane_of_curvature(np.zeros(length_m + 1), **more)  # type: ignore[arg-type]


def bend(radius_m: float, straight_m: int = 200, turn_deg: float = 60.0, **more: object) -> Lane:
    """A straight, an arc to the left without a spiral, a straight."""
    arc = round(radius_m * np.radians(turn_deg))
    curvature = np.concatenate([np.zeros(straight_m), np.full(arc, 1 / radius_m), np.zeros(straight_m)])
    return lane_of_curvature(curvature, **more)  # type: ignore[arg-type]


def opposite(lane: Lane, name: str) -> Lane:
    """The lane of the other direction, to the left of a lane; both share the line between them."""
    lon, lat = lane.position_at(lane.chainage_m, lane.width_m)
    backwards = slice(None, None, -1)
    return Lane(
        name, lane.road, lane.chainage_m, lon[backwards], lat[backwards], lane.height_m[backwards],
        (lane.heading_deg[backwards] + 180.0) % 360.0, lane.curvature_per_m[backwards], -lane.grade[backwards],
        -lane.superelevation_rad[backwards], lane.width_m, lane.design_speed_m_s[backwards], lane.station_m[backwards],
        lane.left_style, lane.right_style,
    )  # fmt: skip


def road(*lanes: Lane, events: tuple[RoadEvent, ...] = (), areas: tuple[AvoidedArea, ...] = ()) -> Alignment:
    """An alignment of lanes."""
    return Alignment("test road", lanes, events, areas)
