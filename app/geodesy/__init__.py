"""Coordinate reference systems, transformations with a stated accuracy, local frames and bearings."""

from app.geodesy.frames import check_lon_lat, enu_from_heading, enu_from_wgs84, lon_lat_from_enu, wgs84_from_enu
from app.geodesy.operations import decimal_year, move_to_epoch, plate_motion, use_grids
from app.geodesy.place import (
    UNFIT_TEXT,
    LocalizationGrade,
    PlacedPosition,
    PlacedPositions,
    grade_accuracy,
    place_position,
    place_positions,
    total_accuracy_m,
    worst_grade,
)
from app.geodesy.systems import normalize_crs, reference_system

__all__ = [
    "UNFIT_TEXT",
    "LocalizationGrade",
    "PlacedPosition",
    "PlacedPositions",
    "check_lon_lat",
    "decimal_year",
    "enu_from_heading",
    "enu_from_wgs84",
    "grade_accuracy",
    "lon_lat_from_enu",
    "move_to_epoch",
    "normalize_crs",
    "place_position",
    "place_positions",
    "plate_motion",
    "reference_system",
    "total_accuracy_m",
    "use_grids",
    "wgs84_from_enu",
    "worst_grade",
]
