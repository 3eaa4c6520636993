"""Markers as clients see them and send them: what every family has in common."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal, NotRequired

from pydantic import BaseModel, Field, JsonValue
from typing_extensions import ReadOnly, TypedDict

from app.errors import InvalidParameter
from app.families.surveys import ColumnValues
from app.geodesy import PlacedPosition, place_position
from app.geodesy.place import Grade
from app.geodesy.systems import VerticalDatum as VerticalDatum
from app.inputs import Number, StrictModel, Text
from app.markers.reading import MarkerRow, Status
from app.registry.conditions import grade_columns


class PositionDocument(TypedDict):
    """A position in WGS 84 / ITRF, and `original` as it was sent."""

    lon_deg: float
    lat_deg: float
    height_m: float | None
    crs: str
    realization: str | None
    epoch: float | None
    vertical_datum: str | None
    horizontal_rmse_m: float | None
    vertical_rmse_m: float | None
    survey_method: str | None
    check_points: int | None
    surveyor: str | None
    instrument: str | None
    survey_file_sha256: str | None
    localization_grade: Grade
    transform_accuracy_m: float | None
    transform_note: str | None
    original: dict[str, object]


class WarningDocument(TypedDict):
    """Something in a position that is probably wrong, though it can be stored."""

    field: str
    code: str
    message: str
    proposal: str | None


class MarkerHead(TypedDict):
    """Which marker it is."""

    id: str
    status: Status
    version: int


class MarkerPlace(TypedDict):
    """Where a marker is, and since when.

    `position_warnings` are in the response to a request that registers or moves the marker, if there are any.
    """

    position: PositionDocument
    heading_deg: float | None
    heading_rmse_deg: float | None
    road: str | None
    measure_m: float | None
    offset_m: float | None
    created_at: datetime
    updated_at: datetime
    position_warnings: NotRequired[list[WarningDocument]]


class MarkerDocument(MarkerHead, MarkerPlace):
    """What markers of every family have; each family adds its name, its code and what else it has."""

    family: ReadOnly[str]


def marker_head(row: MarkerRow) -> MarkerHead:
    """Id, status and version of a row."""
    return {"id": row.id, "status": row.status, "version": row.version}


def marker_place(row: MarkerRow) -> MarkerPlace:
    """Position, heading, place on the road and times of a row."""
    return {
        "position": {
            "lon_deg": row.lon_deg,
            "lat_deg": row.lat_deg,
            "height_m": row.height_m,
            "crs": row.crs,
            "realization": row.realization,
            "epoch": row.epoch,
            "vertical_datum": row.vertical_datum,
            "horizontal_rmse_m": row.horizontal_rmse_m,
            "vertical_rmse_m": row.vertical_rmse_m,
            "survey_method": row.survey_method,
            "check_points": row.check_points,
            "surveyor": row.surveyor,
            "instrument": row.instrument,
            "survey_file_sha256": row.survey_file_sha256,
            "localization_grade": row.localization_grade,
            "transform_accuracy_m": row.transform_accuracy_m,
            "transform_note": row.transform_note,
            "original": row.original,
        },
        "heading_deg": row.heading_deg,
        "heading_rmse_deg": row.heading_rmse_deg,
        "road": row.road,
        "measure_m": row.measure_m,
        "offset_m": row.offset_m,
        "created_at": row.created_at,
        "updated_at": row.updated_at,
    }


# === Schemas of requests that register or change markers: what every family shares.


VersionKind = Literal["as-planned", "as-built", "resurvey", "correction", "change"]
Heading = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, lt=360)]
Accuracy = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=1e6)]
Metres = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1e8, le=1e8)]
Height = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-12_000, le=100_000)]
CheckPoints = Annotated[int, Field(strict=True, ge=0, le=10**6)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class _CoordinatesIn(StrictModel):
    lon_deg: Number | None = Field(None, description="Longitude, -180 to 180. [deg]")
    lat_deg: Number | None = Field(None, description="Latitude, -90 to 90. [deg]")
    easting_m: Metres | None = Field(None, description="Easting in a projected CRS. [m]")
    northing_m: Metres | None = Field(None, description="Northing in a projected CRS. [m]")


class ProvenanceIn(StrictModel):
    """Reference system of a place, and how it was surveyed."""

    height_m: Height | None = Field(None, description="Height above the vertical datum. [m]")
    crs: Text | None = Field(None, max_length=100, description="EPSG code or URN; WGS 84 if left out.")
    realization: Text | None = Field(None, min_length=1, max_length=64, description="Reference frame, e.g. ITRF2014.")
    epoch: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1900, le=2200)] | None = Field(
        None, description="Coordinate epoch. [decimal year]"
    )
    vertical_datum: VerticalDatum | None = Field(
        None, description="`ellipsoid` (default) or the datum of the height, e.g. EPSG:5703."
    )
    horizontal_rmse_m: Accuracy | None = Field(None, description="Horizontal accuracy, RMSE. [m]")
    vertical_rmse_m: Accuracy | None = Field(None, description="Vertical accuracy, RMSE. [m]")
    survey_method: Text | None = Field(None, min_length=1, max_length=200, description="How it was surveyed.")
    check_points: CheckPoints | None = Field(None, description="Independent points that the RMSE was tested at.")
    surveyor: Text | None = Field(None, min_length=1, max_length=200, description="Who surveyed.")
    instrument: Text | None = Field(None, min_length=1, max_length=200, description="With what.")
    survey_file_sha256: Sha256 | None = Field(None, description="SHA-256 of the survey's file, lower-case hex.")


class PositionIn(ProvenanceIn, _CoordinatesIn):
    """Longitude and latitude, or easting and northing of a projected CRS, with where they come from."""


class PlacementIn(StrictModel):
    """Where along a road, and how well the heading is known."""

    heading_rmse_deg: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=180)] | None = None
    road: Text | None = Field(None, min_length=1, max_length=200, description="Road's name or number.")
    measure_m: Metres | None = Field(None, description="Chainage along the road. [m]")
    offset_m: Metres | None = Field(None, description="Offset from the road's axis, left positive. [m]")
    kind: VersionKind | None = Field(
        None,
        description="Kind of this version in the history; if left out, the change decides.",
    )
    reason: Text | None = Field(None, min_length=1, max_length=500, description="Why; goes into the history.")


class MarkerIn(PlacementIn):
    """A marker to register; each family adds its own members."""

    family: str
    status: Status = "planned"

    @property
    def part_count(self) -> int:
        """Things in the road that the marker has at most, e.g. magnets: what its registration costs."""
        return 1


class FamilyChange(BaseModel):
    """Members of a change that only one family has; they are kept in the marker's spec."""


class Headed(PlacementIn):
    """Markers with a direction of travel of their own."""

    heading_deg: Heading | None = Field(
        None,
        description="Direction of travel, clockwise from true north; that of magnets follows from their lane. [deg]",
    )


POSITION_EXAMPLE: dict[str, JsonValue] = {
    "lon_deg": 114.179203,
    "lat_deg": 22.304161,
    "height_m": 5.21,
    "realization": "ITRF2014",
    "epoch": 2025.4,
    "horizontal_rmse_m": 0.012,
    "vertical_rmse_m": 0.02,
    "survey_method": "GNSS RTK, two occupations",
}


# === Positions in WGS 84, and the columns that keep them.


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


def position_columns(position: ProvenanceIn, placed: PlacedPosition) -> ColumnValues:
    """Columns of a marker that keep its position, or the first one of its lane, and where it comes from."""
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
        "original": position.model_dump(exclude_none=True, exclude={"geometry", "points_m"}),
        **grade_columns(position.horizontal_rmse_m, placed.transform_accuracy_m, placed.note),
    }
