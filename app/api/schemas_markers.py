"""Schemas of markers: what every family shares, and plates."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import Path
from pydantic import BaseModel, ConfigDict, Field, JsonValue

from app.api.dependencies import Identifier, Number, Text, Whole

Status = Literal["planned", "built", "surveyed", "active", "suspect", "retired"]
VersionKind = Literal["as-planned", "as-built", "resurvey", "correction", "change"]
Heading = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, lt=360)]
Accuracy = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=1e6)]
Metres = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1e8, le=1e8)]
Height = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-12_000, le=100_000)]
CheckPoints = Annotated[int, Field(strict=True, ge=0, le=10**6)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
MarkerId = Annotated[Identifier, Path(description="Id of the marker.")]


class PositionIn(BaseModel):
    """Longitude and latitude, or easting and northing of a projected CRS, with where they come from."""

    model_config = ConfigDict(extra="forbid")

    lon_deg: Number | None = Field(None, description="Longitude, -180 to 180. [deg]")
    lat_deg: Number | None = Field(None, description="Latitude, -90 to 90. [deg]")
    easting_m: Metres | None = Field(None, description="Easting in a projected CRS. [m]")
    northing_m: Metres | None = Field(None, description="Northing in a projected CRS. [m]")
    height_m: Height | None = Field(None, description="Height above the vertical datum. [m]")
    crs: Text | None = Field(None, max_length=100, description="EPSG code or URN; WGS 84 if left out.")
    realization: Text | None = Field(None, min_length=1, max_length=64, description="Reference frame, e.g. ITRF2014.")
    epoch: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1900, le=2200)] | None = Field(
        None, description="Coordinate epoch. [decimal year]"
    )
    vertical_datum: Text | None = Field(
        None,
        min_length=1,
        max_length=64,
        description="`ellipsoid` (default) or the datum of the height, e.g. EPSG:5703.",
    )
    horizontal_rmse_m: Accuracy | None = Field(None, description="Horizontal accuracy, RMSE. [m]")
    vertical_rmse_m: Accuracy | None = Field(None, description="Vertical accuracy, RMSE. [m]")
    survey_method: Text | None = Field(None, min_length=1, max_length=200, description="How it was surveyed.")
    check_points: CheckPoints | None = Field(None, description="Independent points that the RMSE was tested at.")
    surveyor: Text | None = Field(None, min_length=1, max_length=200, description="Who surveyed.")
    instrument: Text | None = Field(None, min_length=1, max_length=200, description="With what.")
    survey_file_sha256: Sha256 | None = Field(None, description="SHA-256 of the survey's file, lower-case hex.")


class CodeIn(BaseModel):
    """The plate's code; without digits they follow from the position or the registry number."""

    model_config = ConfigDict(extra="forbid")

    scheme: Literal["position", "position-check", "id"] = "position"
    digits: Text | None = Field(None, min_length=1, max_length=64, description="Digits to use instead of derived ones.")
    check_digits: Annotated[int, Field(strict=True, ge=1, le=2)] | None = Field(
        None, description="For `position-check`: 1 (default) or 2."
    )
    registry_number: Annotated[int, Field(strict=True, ge=0, lt=2**64)] | None = Field(
        None, description="For `id`: the number; allocated if left out."
    )
    allow_mismatched_digits: Annotated[bool, Field(strict=True)] = Field(
        False, description="Store digits that do not fit the position; such a plate is found through the registry only."
    )


class GeometryIn(BaseModel):
    """Dimensions of the plate."""

    model_config = ConfigDict(extra="forbid")

    n: Whole = Field(8, description="Units along a side: 8, 10 or 12.")
    unit_mm: Number = Field(35.0, description="Side of a unit, 20 to 50. [mm]")
    gap_mm: Number = Field(5.0, description="Gap between units and round the border, 2 to 10. [mm]")
    thickness_mm: Number = Field(20.0, description="Thickness of the base plate, 5 to 50. [mm]")


class PlacementIn(BaseModel):
    """Where along a road, and how well the heading is known."""

    model_config = ConfigDict(extra="forbid")

    heading_rmse_deg: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=180)] | None = None
    road: Text | None = Field(None, min_length=1, max_length=200, description="Road's name or number.")
    measure_m: Metres | None = Field(None, description="Chainage along the road. [m]")
    offset_m: Metres | None = Field(None, description="Offset from the road's axis, left positive. [m]")
    kind: VersionKind | None = Field(
        None, description="Kind of this version in the history; told by the status and by what changes without."
    )
    reason: Text | None = Field(None, min_length=1, max_length=500, description="Why; goes into the history.")


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
PLATE_EXAMPLES: list[JsonValue] = [
    {"position": POSITION_EXAMPLE, "heading_deg": 78.5, "status": "surveyed", "road": "Cheong Wan Road"},
    {"position": POSITION_EXAMPLE, "code": {"scheme": "position-check", "check_digits": 2}, "geometry": {"n": 10}},
    {"position": POSITION_EXAMPLE, "code": {"scheme": "id"}},
    {"position": POSITION_EXAMPLE, "code": {"digits": "023792168411", "allow_mismatched_digits": True}},
]


class MarkerIn(Headed):
    """A plate to register."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": PLATE_EXAMPLES})

    family: Literal["plate"] = "plate"
    status: Status = "planned"
    position: PositionIn
    code: CodeIn = Field(default_factory=CodeIn)
    geometry: GeometryIn = Field(default_factory=GeometryIn)


class CodeOut(BaseModel):
    """A plate's code."""

    scheme: str
    digits: str
    check_digits: int | None
    registry_number: int | None
    digits_match_position: bool | None


class GeometryOut(BaseModel):
    """Dimensions of a plate."""

    n: int
    unit_mm: float
    gap_mm: float
    thickness_mm: float
    side_mm: float


class PositionOut(BaseModel):
    """A position in WGS 84 / ITRF, and `original` as it was given."""

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
    localization_grade: Literal["exact", "approximate, not for localization"]
    transform_accuracy_m: float | None
    transform_note: str | None
    original: dict[str, Any]


class MarkerOut(BaseModel):
    """A plate."""

    id: str
    family: str
    status: Status
    version: int
    code: CodeOut
    geometry: GeometryOut
    position: PositionOut
    heading_deg: float | None
    heading_rmse_deg: float | None
    road: str | None
    measure_m: float | None
    offset_m: float | None
    created_at: str
    updated_at: str


class _Tested(BaseModel):
    is_tested: bool
    needed_check_points: int
    source: str


class NssdaOut(_Tested):
    """Accuracy at 95 % confidence. [m]"""

    horizontal_95_m: float | None
    vertical_95_m: float | None
    statement: str | None


class AsprsOut(_Tested):
    """Accuracy classes. [cm]"""

    horizontal_class_cm: float | None
    vertical_class_cm: float | None


class AccuracyOut(BaseModel):
    """Accuracy figures of a survey, each with its source."""

    horizontal_rmse_m: float | None
    vertical_rmse_m: float | None
    check_points: int | None
    nssda: NssdaOut
    asprs_2014: AsprsOut
    asprs_2023: AsprsOut
