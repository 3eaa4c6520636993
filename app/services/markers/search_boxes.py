"""Boxes that clients search in, as queries and bodies write them."""

from __future__ import annotations

from app.errors import InvalidParameter
from app.geodesy import check_lon_lat
from app.registry.spatial import Box

MAX_OVER_ANTIMERIDIAN_DEG = 180.0
"""Width of a box over the antimeridian. Source: RFC 7946 section 5.2 allows any; a wider one has its sides swapped."""


def parse_box(text: str) -> Box:
    """West, south, east, north as a query writes them."""
    return checked_box(*parse_numbers(text, "bbox", "west,south,east,north"))


def checked_box(west_deg: float, south_deg: float, east_deg: float, north_deg: float) -> Box:
    """A box; a west above the east spans the antimeridian.

    Raises
    ------
    InvalidParameter
        A side is out of range, the south is above the north, or the box over the antimeridian is wider than half the
        earth: its west and east are swapped.
    """
    check_lon_lat(west_deg, south_deg, field="bbox")
    check_lon_lat(east_deg, north_deg, field="bbox")
    if south_deg > north_deg:
        raise InvalidParameter(
            "bbox has its south above its north",
            field="bbox",
            limit="south <= north",
            cure="send west,south,east,north; only the longitudes may be the other way round, over the antimeridian",
        )
    if west_deg > east_deg and (width_deg := 360.0 + east_deg - west_deg) > MAX_OVER_ANTIMERIDIAN_DEG:
        raise InvalidParameter(
            f"bbox has its west above its east, so it spans {width_deg:.6g} degrees over the antimeridian",
            field="bbox",
            limit=f"{MAX_OVER_ANTIMERIDIAN_DEG:g} degrees over the antimeridian",
            cure="send west,south,east,north",
        )
    return Box(west_deg, south_deg, east_deg, north_deg)


def parse_numbers(text: str, field: str, *forms: str) -> list[float]:
    """Numbers between commas, as many as one of the forms has names; else InvalidParameter."""
    parts = text.split(",")
    if len(parts) not in [len(form.split(",")) for form in forms]:
        form = " or ".join(forms)
        raise InvalidParameter(f"{field} is {form}", field=field, limit=form, cure="separate the numbers by commas")
    try:
        return [float(part) for part in parts]
    except ValueError as error:
        raise InvalidParameter(f"{field} holds something that is not a number", field=field, limit=forms[0]) from error
