"""Schemas of imports: what is declared of a survey, and the report on it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, create_model

from app.api.http.dependencies import Number, Text
from app.families import FAMILIES, FamilyName
from app.families.documents import Accuracy, StrictModel, VerticalDatum
from app.markers.reading import Status
from app.services.surveys.import_report import MAX_ROWS_LISTED

Unit = Literal["m", "ft-us", "ft-intl"]
Name = Annotated[Text, Field(min_length=1, max_length=200)]
DECLARATION_EXAMPLE: dict[str, Any] = {
    "layout": "pnezd",
    "crs": "EPSG:25832",
    "epoch": 2025.4,
    "vertical_datum": "ellipsoid",
    "family": "cerpm",
    "columns": {"code": "point"},
    "side": "left",
    "area_deg": [8.3, 48.9, 8.6, 49.1],
    "survey": {"horizontal_rmse_m": 0.015, "survey_method": "GNSS RTK", "surveyor": "A. Muster"},
    "dry_run": True,
}


class SurveyIn(StrictModel):
    """Who surveyed, how, and how well."""

    horizontal_rmse_m: Accuracy | None = Field(None, description="Horizontal accuracy, RMSE. [m]")
    vertical_rmse_m: Accuracy | None = Field(None, description="Vertical accuracy, RMSE. [m]")
    survey_method: Name | None = Field(None, description="How it was surveyed.")
    surveyor: Name | None = Field(None, description="Who surveyed.")
    instrument: Name | None = Field(None, description="With what.")
    check_points: Annotated[int, Field(strict=True, ge=0, le=10**6)] | None = Field(
        None, description="Points that the accuracy was checked at."
    )


class ControlPointIn(StrictModel):
    """A point that is known in a local grid and in the declared CRS."""

    point: Name = Field(description="Its point number.")
    easting: Number = Field(description="In the CRS and its unit.")
    northing: Number = Field(description="In the CRS and its unit.")
    local_easting: Number | None = Field(None, description="That of the row with this point number without.")
    local_northing: Number | None = Field(None, description="That of the row with this point number without.")


class LocalGridIn(StrictModel):
    """How coordinates of a local grid are transformed: a similarity transformation by least squares."""

    control_points: Annotated[list[ControlPointIn], Field(min_length=2, max_length=100)]
    scale: Literal["fixed", "free"] = Field("fixed", description="1, or estimated of at least three points.")
    limit_m: Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, le=10)] = Field(
        0.05, description="Largest residual of a control point. [m]"
    )


if TYPE_CHECKING:

    class _FamilyMembers(BaseModel):
        """Members of a declaration that only one family has, of all families."""

else:
    _FamilyMembers = create_model(
        "_FamilyMembers", __base__=tuple(family.survey.members for family in FAMILIES if family.survey is not None)
    )


class DeclarationIn(_FamilyMembers):
    """What is declared of a survey."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [DECLARATION_EXAMPLE]})

    format: (
        Literal["csv", "geojson", "gpkg", "shapefile", "kml", "kmz", "gpx", "landxml", "jobxml", "dxf", "gsi"] | None
    ) = Field(None, description="Detected without.")
    layout: Literal["named", "pnezd", "penzd", "nezd", "enzd"] | None = Field(
        None, description="Columns of CSV; detected without."
    )
    columns: dict[Name, Annotated[Text, Field(max_length=200)] | None] = Field(
        default_factory=dict,
        max_length=20,
        description="Role to column; null or an empty text where no column has the role.",
    )
    layer: Name | None = Field(None, description="Of a GeoPackage or a DXF.")
    decimal: Literal[".", ","] | None = Field(None, description="Of CSV; detected without.")
    delimiter: Literal[",", ";", "\t", "|", "space"] | None = Field(None, description="Of CSV; detected without.")
    encoding: (
        Literal["utf-8", "utf-16", "windows-1252", "iso-8859-1", "iso-8859-2", "windows-1250", "cp437", "cp850"] | None
    ) = Field(None, description="Of CSV and GSI; detected without: UTF-8, UTF-16 or Windows-1252.")
    crs: Annotated[Text, Field(max_length=100)] | None = Field(None, description="EPSG code or URN.")
    realization: Annotated[Text, Field(min_length=1, max_length=64)] | None = None
    epoch: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1900, le=2200)] | None = None
    vertical_datum: VerticalDatum | None = Field(
        None, description="`ellipsoid`, or the datum of the heights; needed where there are any."
    )
    unit: Unit | None = Field(None, description="Of projected coordinates; the CRS's own without.")
    height_unit: Unit | None = None
    local_grid: LocalGridIn | None = Field(None, description="Where easting and northing are of a local grid.")
    ignore_heights: Annotated[bool, Field(strict=True)] = False
    area_deg: Annotated[list[Number], Field(min_length=4, max_length=4)] | None = Field(
        None, description="west, south, east, north that all rows lie in. [deg]"
    )
    height_range_m: Annotated[list[Number], Field(min_length=2, max_length=2)] | None = Field(
        None, description="Lowest and highest height that can be. [m]"
    )
    family: FamilyName = "plate"
    status: Status | None = None
    road: Name | None = None
    compare: Annotated[bool, Field(strict=True)] = Field(
        False, description="The survey measures registered markers: residuals, and a new version of each."
    )
    duplicates: Literal["refuse", "store"] = Field(
        "refuse", description="Whether rows that are already registered, and a file that was imported, are refused."
    )
    match: Literal["code", "nearest"] = "code"
    tolerance_m: Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, le=100)] = 0.1
    survey: SurveyIn = Field(default_factory=SurveyIn)
    dry_run: Annotated[bool, Field(strict=True)] = Field(False, description="Report only; nothing is stored.")
    mode: Literal["all", "good"] = Field("all", description="Store all rows or none, or the good ones.")
    warnings: Literal["store", "refuse"] = Field(
        "store", description="What a warning means: its row is stored, or refused as a faulty one is."
    )
    leave_out: list[Annotated[int, Field(strict=True, ge=1, le=1_000_000)]] = Field(
        default_factory=list, max_length=1000, description="Numbers of rows that are neither checked nor stored."
    )
    list_rows: Annotated[int, Field(strict=True, ge=0, le=MAX_ROWS_LISTED)] = Field(
        0, description="Rows that the report lists with their positions, those with faults first."
    )
    reason: Annotated[Text, Field(min_length=1, max_length=500)] | None = None

    def declared(self) -> dict[str, Any]:
        """JSON with every member, as `app.services.surveys.import_report.import_input` takes it."""
        return self.model_dump(mode="json")
