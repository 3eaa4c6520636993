"""Positions in WGS 84, and the columns that keep them."""

from __future__ import annotations

from typing import Any

from app.errors import InvalidParameter
from app.families.inputs import PositionIn
from app.geodesy import PlacedPosition, place_position
from app.registry.grade_columns import grade_columns


def place_input(position: PositionIn, accuracy_m: float) -> PlacedPosition:
    """Bring a position to WGS 84 / ITRF; exact only by a transformation with a stated accuracy of `accuracy_m`.

    Raises
    ------
    InvalidParameter, ReferenceSystemError
        It is not one complete pair of coordinates, or not one of its CRS.
    """
    geographic = (position.lon_deg, position.lat_deg)
    projected = (position.easting_m, position.northing_m)
    pairs = [pair for pair in (geographic, projected) if pair != (None, None)]
    if len(pairs) != 1 or None in pairs[0]:
        raise InvalidParameter(
            "a position is lon_deg and lat_deg, or easting_m and northing_m with a projected crs",
            field="position",
            limit="one complete pair",
            cure="send both members of exactly one pair",
        )
    first, second = (value for value in pairs[0] if value is not None)
    return place_position(
        first,
        second,
        position.height_m,
        crs=position.crs,
        projected=pairs[0] is projected,
        realization=position.realization,
        epoch=position.epoch,
        ellipsoidal_height=position.vertical_datum in (None, "ellipsoid"),
        accuracy_m=accuracy_m,
    )


def position_columns(position: PositionIn, placed: PlacedPosition) -> dict[str, Any]:
    """Columns of a marker that keep its position and where it comes from."""
    return {
        "lon_deg": placed.lon_deg,
        "lat_deg": placed.lat_deg,
        "height_m": placed.height_m,
        "crs": placed.crs,
        "realization": placed.realization,
        "epoch": placed.epoch,
        "vertical_datum": position.vertical_datum or ("ellipsoid" if position.height_m is not None else None),
        "horizontal_rmse_m": position.horizontal_rmse_m,
        "vertical_rmse_m": position.vertical_rmse_m,
        "survey_method": position.survey_method,
        "check_points": position.check_points,
        "surveyor": position.surveyor,
        "instrument": position.instrument,
        "survey_file_sha256": position.survey_file_sha256,
        "original": position.model_dump(exclude_none=True),
        **grade_columns(position.horizontal_rmse_m, placed.transform_accuracy_m, placed.note),
    }
