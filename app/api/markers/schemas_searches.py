"""Schemas of searches for markers."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field

from app.api.http.dependencies import Number, Text
from app.api.http.schemas_geojson import AnyPolygon, GeoLineIn
from app.families import FamilyName
from app.families.inputs import Metres, StrictModel
from app.markers.status import Status

MAX_PAGE = 1000
MAX_RADIUS_M = 100_000.0
MAX_CORRIDOR_M = 2_000.0

Nearest = Annotated[int, Field(strict=True, ge=1, le=MAX_PAGE)]
Radius = Annotated[float, Field(allow_inf_nan=False, ge=0, le=MAX_RADIUS_M)]


class PlaceIn(StrictModel):
    """A place to search from."""

    lon_deg: Number = Field(description="Longitude. [deg]")
    lat_deg: Number = Field(description="Latitude. [deg]")


class AlongIn(StrictModel):
    """A corridor along a line."""

    geometry: GeoLineIn = Field(description="In the direction of travel, in longitude and latitude.")
    corridor_m: Annotated[float, Field(allow_inf_nan=False, gt=0, le=MAX_CORRIDOR_M)] = Field(
        description="Width: half of it to each side. [m]"
    )


class SearchIn(StrictModel):
    """What to search for; each member narrows further."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "polygon": {
                        "type": "Polygon",
                        "coordinates": [[[8.40, 49.00], [8.44, 49.00], [8.42, 49.02], [8.40, 49.00]]],
                    },
                    "family": "plate",
                },
                {"near": {"lon_deg": 114.1792, "lat_deg": 22.3041}, "nearest": 10, "status": "active"},
                {
                    "along": {
                        "geometry": {"type": "LineString", "coordinates": [[8.40, 49.00], [8.44, 49.01]]},
                        "corridor_m": 20,
                    }
                },
            ]
        },
    )

    bbox: Annotated[list[Number], Field(min_length=4, max_length=4)] | None = Field(
        None, description="west, south, east, north; a west above the east spans the antimeridian. [deg]"
    )
    polygon: AnyPolygon | None = Field(None, description="Markers inside or on the edge; up to 10 000 vertices.")
    near: PlaceIn | None = Field(None, description="With `radius_m`, `nearest` or both.")
    radius_m: Radius | None = Field(None, description="Geodesic distance from `near`. [m]")
    nearest: Nearest | None = Field(None, description="How many of the nearest to `near`, nearest first.")
    along: AlongIn | None = Field(None, description="Markers in the order of a line.")
    road: Text | None = Field(None, min_length=1, max_length=200)
    from_m: Metres | None = Field(None, description="Least measure on the road. [m]")
    to_m: Metres | None = Field(None, description="Greatest measure on the road. [m]")
    code: Text | None = Field(None, min_length=1, max_length=64)
    status: Status | None = None
    family: FamilyName | None = None
