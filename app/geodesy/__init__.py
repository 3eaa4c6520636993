"""Coordinate reference systems, transformations with a stated accuracy, local frames and bearings."""

from app.geodesy.frames import check_lon_lat, enu_from_heading, enu_from_wgs84, lon_lat_from_enu, wgs84_from_enu
from app.geodesy.operations import use_grids
from app.geodesy.place import (
    LocalizationGrade,
    PlacedPosition,
    PlacedPositions,
    place_position,
    place_positions,
)
from app.geodesy.systems import normalize_crs, reference_system

__all__ = [
    "LocalizationGrade",
    "PlacedPosition",
    "PlacedPositions",
    "check_lon_lat",
    "enu_from_heading",
    "enu_from_wgs84",
    "lon_lat_from_enu",
    "normalize_crs",
    "place_position",
    "place_positions",
    "reference_system",
    "use_grids",
    "wgs84_from_enu",
]
