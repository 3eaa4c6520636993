"""Schemas of requests that register or change markers: what every family shares."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, JsonValue

from app.errors import ReferenceSystemError
from app.families.new_marker import NewMarker
from app.geodesy.vertical import normalize_vertical_datum
from app.markers.status import Status


def _plain_text(text: str) -> str:
    if "\x00" in text:
        raise ValueError("a text holds no NUL")
    return text


def _vertical_datum(text: str) -> str:
    try:
        return normalize_vertical_datum(text)
    except ReferenceSystemError as error:
        error.field = None  # the place in the request is
        raise


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Whole = Annotated[int, Field(strict=True)]
Flag = Annotated[bool, Field(strict=True)]
Text = Annotated[str, AfterValidator(_plain_text)]
Identifier = Annotated[str, Field(pattern=r"^[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}$")]
VerticalDatum = Annotated[Text, Field(min_length=1, max_length=64), AfterValidator(_vertical_datum)]
VersionKind = Literal["as-planned", "as-built", "resurvey", "correction", "change"]
Heading = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, lt=360)]
Accuracy = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=1e6)]
Metres = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1e8, le=1e8)]
Height = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-12_000, le=100_000)]
CheckPoints = Annotated[int, Field(strict=True, ge=0, le=10**6)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class StrictModel(BaseModel):
    """Base of every part of a request: members that it does not know are refused."""

    model_config = ConfigDict(extra="forbid")


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

    def new(self) -> NewMarker:
        """The marker as the use cases know it."""
        raise NotImplementedError

    def shared(self) -> dict[str, Any]:
        """Members that markers of every family have, for `NewMarker`."""
        return self.model_dump(
            include={"status", "heading_rmse_deg", "road", "measure_m", "offset_m", "kind", "reason"}
        )


class FamilyChange(BaseModel):
    """Members of a change that only one family has; they are kept in the marker's spec."""

    def spec_changes(self, named: set[str]) -> dict[str, Any]:
        """Members of the spec that a change replaces, of those that the request names."""
        raise NotImplementedError


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
