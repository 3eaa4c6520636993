"""Schemas of imports: what is declared of a survey, and the report on it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from app.api.dependencies import Number, Text, Whole
from app.api.schemas_cerpms import SpeedLimitIn
from app.api.schemas_markers import Accuracy, AccuracyOut, GeometryIn, Status
from app.errors import InvalidParameter
from app.markers.cerpm import LaneSide, SpeedLimit, SpeedUnit
from app.markers.plate import PlateGeometry, PlateScheme
from app.registry.exchange.declaration import ImportDeclaration
from app.services.import_rows import MarkerDefaults
from app.services.imports import GivenImport
from app.services.positions import naming

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


class SurveyIn(BaseModel):
    """Who surveyed, how, and how well."""

    model_config = ConfigDict(extra="forbid")

    horizontal_rmse_m: Accuracy | None = Field(None, description="Horizontal accuracy, RMSE. [m]")
    vertical_rmse_m: Accuracy | None = Field(None, description="Vertical accuracy, RMSE. [m]")
    survey_method: Name | None = Field(None, description="How it was surveyed.")
    surveyor: Name | None = Field(None, description="Who surveyed.")
    instrument: Name | None = Field(None, description="With what.")
    check_points: Annotated[int, Field(strict=True, ge=0, le=10**6)] | None = Field(
        None, description="Points that the accuracy was checked at."
    )


class DeclarationIn(BaseModel):
    """What is declared of a survey."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [DECLARATION_EXAMPLE]})

    format: Literal["csv", "geojson", "gpkg", "shapefile", "kml", "landxml", "dxf"] | None = Field(
        None, description="Told by the content without."
    )
    layout: Literal["named", "pnezd", "penzd"] = Field("named", description="Columns of CSV.")
    columns: dict[Name, Name] = Field(default_factory=dict, max_length=20, description="Role to column.")
    layer: Name | None = Field(None, description="Of a GeoPackage or a DXF.")
    decimal: Literal[".", ","] = "."
    delimiter: Literal[",", ";", "\t", "space"] | None = None
    crs: Annotated[Text, Field(max_length=100)] | None = Field(None, description="EPSG code or URN.")
    realization: Annotated[Text, Field(min_length=1, max_length=64)] | None = None
    epoch: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1900, le=2200)] | None = None
    vertical_datum: Annotated[Text, Field(min_length=1, max_length=64)] | None = Field(
        None, description="`ellipsoid`, or the datum of the heights; needed where there are any."
    )
    unit: Unit | None = Field(None, description="Of projected coordinates; the CRS's own without.")
    height_unit: Unit | None = None
    ignore_heights: Annotated[bool, Field(strict=True)] = False
    area_deg: Annotated[list[Number], Field(min_length=4, max_length=4)] | None = Field(
        None, description="west, south, east, north that all rows lie in. [deg]"
    )
    height_range_m: Annotated[list[Number], Field(min_length=2, max_length=2)] | None = Field(
        None, description="Lowest and highest height that can be. [m]"
    )
    family: Literal["plate", "magnet", "cerpm"] = "plate"
    status: Status | None = None
    road: Name | None = None
    compare: Annotated[bool, Field(strict=True)] = Field(
        False, description="The survey measures registered markers: residuals, and a new version of each."
    )
    match: Literal["code", "nearest"] = "code"
    tolerance_m: Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, le=100)] = 0.1
    survey: SurveyIn = Field(default_factory=SurveyIn)
    scheme: Literal["position", "position-check", "id"] = Field("position", description="Of plates.")
    check_digits: Annotated[int, Field(strict=True, ge=1, le=2)] | None = None
    geometry: GeometryIn = Field(default_factory=GeometryIn, description="Of plates.")
    side: Literal["unknown", "left", "right"] = Field("unknown", description="Of CERPMs without one of their own.")
    speed_limit: SpeedLimitIn | None = Field(None, description="Of CERPMs.")
    dry_run: Annotated[bool, Field(strict=True)] = Field(False, description="Report only; nothing is stored.")
    mode: Literal["all", "good"] = Field("all", description="Store all rows or none, or the good ones.")
    warnings: Literal["store", "refuse"] = Field(
        "store", description="What a warning means: its row is stored, or refused as a faulty one is."
    )
    reason: Annotated[Text, Field(min_length=1, max_length=500)] | None = None

    def given(self, data: bytes) -> GivenImport:
        """The import as the use case knows it."""
        limit = self.speed_limit
        own = {
            "scheme",
            "check_digits",
            "geometry",
            "side",
            "speed_limit",
            "dry_run",
            "mode",
            "reason",
            "survey",
            "warnings",
        }
        values = self.model_dump(exclude=own)
        for name in ("area_deg", "height_range_m"):
            values[name] = tuple(values[name]) if values[name] is not None else None
        with naming("declaration"):
            if self.check_digits is not None and self.scheme != "position-check":
                raise InvalidParameter(
                    "check_digits means nothing in this scheme", field="check_digits", limit="position-check"
                )
            defaults = MarkerDefaults(
                PlateScheme(self.scheme),
                self.check_digits,
                PlateGeometry(self.geometry.n, self.geometry.unit_mm, self.geometry.gap_mm, self.geometry.thickness_mm),
                LaneSide[self.side.upper()],
                SpeedLimit(limit.value, SpeedUnit(limit.unit)) if limit is not None else None,
            )
            declaration = ImportDeclaration(**values, survey=self.survey.model_dump())
        strict = self.warnings == "refuse"
        return GivenImport(data, declaration, defaults, self.dry_run, self.mode, self.reason, strict)


def parse_declaration(document: dict[str, Any], data: bytes) -> GivenImport:
    """The import of a file that was kept with what was declared of it."""
    return DeclarationIn.model_validate(document).given(data)


class FaultOut(BaseModel):
    """Something wrong with a row, or with the file where row is null."""

    row: int | None
    field: str
    code: str
    message: str
    proposal: str | None
    severity: Literal["refused", "warning"]


class ImportReportOut(BaseModel):
    """What was found in a survey, and what became of it."""

    outcome: Literal["checked", "stored", "refused"]
    dry_run: bool
    mode: str
    warnings: str
    format: str
    file_sha256: str
    crs: str
    localization_grade: str
    transform_note: str | None
    accuracy: AccuracyOut = Field(description="Of the RMSE that was declared for the whole survey.")
    rows: Whole
    good_rows: Whole
    refused_rows: Whole
    warned_rows: Whole
    stored: Whole
    extent_deg: list[float] | None
    counts: dict[str, int] = Field(description="Faults by code.")
    comparison: dict[str, Any] | None = Field(
        description="Figures, residuals row by row, and `map_svg`, a map of them."
    )
    faults: list[FaultOut] = Field(description="The first thousand, refusals first.")
    faults_left_out: int


class ImportJobSummary(BaseModel):
    """An import that is or was a job, without its report."""

    id: str
    state: Literal["queued", "running", "done", "failed", "cancelled"]
    progress: float = Field(description="0 to 1.")
    attempts: int
    cancel_requested: bool = Field(description="It was called off; a running one stops before it stores anything.")
    created_at: str
    finished_at: str | None
    error: dict[str, Any] | None = Field(description="Why the file or its declaration cannot be used.")
    links: dict[str, str]


class ImportJobOut(ImportJobSummary):
    """An import that is or was a job."""

    report: ImportReportOut | None


class ImportJobPage(BaseModel):
    """A page of imports, newest first; the Link header leads to the next one."""

    items: list[ImportJobSummary]
