"""Positions as they are sent, and the columns that keep them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

from app.errors import InvalidParameter
from app.geodesy import PlacedPosition, place_position


@dataclass(frozen=True, slots=True)
class GivenPosition:
    """A position as it was sent: lon_deg and lat_deg, or easting_m and northing_m."""

    lon_deg: float | None = None
    lat_deg: float | None = None
    easting_m: float | None = None
    northing_m: float | None = None
    height_m: float | None = None
    crs: str | None = None
    realization: str | None = None
    epoch: float | None = None
    vertical_datum: str | None = None
    horizontal_rmse_m: float | None = None
    vertical_rmse_m: float | None = None
    survey_method: str | None = None
    check_points: int | None = None
    surveyor: str | None = None
    instrument: str | None = None
    survey_file_sha256: str | None = None


@contextmanager
def naming(part: str) -> Iterator[None]:
    """Complete the field of an error that a part of the request caused."""
    try:
        yield
    except InvalidParameter as error:
        if error.field is not None and not error.field.startswith(f"{part}."):
            error.field = f"{part}.{error.field}"
        raise


def place_given(given: GivenPosition, accuracy_m: float) -> PlacedPosition:
    """Bring a position to WGS 84 / ITRF; exact only by a transformation with a stated accuracy of `accuracy_m`.

    Raises
    ------
    InvalidParameter, ReferenceSystemError
        It is not one complete pair of coordinates, or not one of its CRS.
    """
    geographic = (given.lon_deg, given.lat_deg)
    projected = (given.easting_m, given.northing_m)
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
        given.height_m,
        crs=given.crs,
        projected=pairs[0] is projected,
        realization=given.realization,
        epoch=given.epoch,
        ellipsoidal_height=given.vertical_datum in (None, "ellipsoid"),
        accuracy_m=accuracy_m,
    )


def position_columns(given: GivenPosition, placed: PlacedPosition) -> dict[str, Any]:
    """Columns of a marker that keep its position and where it comes from."""
    return {
        "lon_deg": placed.lon_deg,
        "lat_deg": placed.lat_deg,
        "height_m": placed.height_m,
        "crs": placed.crs,
        "realization": placed.realization,
        "epoch": given.epoch,
        "vertical_datum": given.vertical_datum or ("ellipsoid" if given.height_m is not None else None),
        "horizontal_rmse_m": given.horizontal_rmse_m,
        "vertical_rmse_m": given.vertical_rmse_m,
        "survey_method": given.survey_method,
        "check_points": given.check_points,
        "surveyor": given.surveyor,
        "instrument": given.instrument,
        "survey_file_sha256": given.survey_file_sha256,
        "transform_accuracy_m": placed.transform_accuracy_m,
        "original": {name: value for name, value in asdict(given).items() if value is not None},
        "localization_grade": str(placed.grade),
        "transform_note": placed.note,
    }
