"""What is declared of a survey: CRS, datum, units, columns and checks, which most files do not contain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, Field, model_validator, with_config

from app.errors import InvalidParameter, ReferenceSystemError
from app.geodesy.systems import (
    ELLIPSOID,
    VERTICAL_RULE,
    HeightSystem,
    VerticalDatum,
    normalize_vertical_datum,
    split_heights,
)
from app.inputs import INPUT, Flag, Number, Text
from app.markers.reading import Status

FIXED_LAYOUTS = {
    "pnezd": ("point", "northing", "easting", "height", "description"),
    "penzd": ("point", "easting", "northing", "height", "description"),
    "nezd": ("northing", "easting", "height", "description"),
    "enzd": ("easting", "northing", "height", "description"),
}
"""Columns by position, by the name that survey software has for them."""
Unit = Literal["m", "ft-us", "ft-intl"]
METRES: dict[str, float] = {"m": 1.0, "ft-us": 1200.0 / 3937.0, "ft-intl": 0.3048}
"""Metres to a unit of length: US survey foot and international foot (NIST SP 811)."""
FEET = "ft"
"""Unit of a file that does not state which foot."""
FOOT_NAMES = ("ft-us", "ft-intl")
TEXT_ROLES = ("point", "code", "description", "road", "side", "status")
NUMBER_ROLES = ("heading_deg", "measure_m", "offset_m", "horizontal_rmse_m", "vertical_rmse_m")
COORDINATE_ROLES = ("lon_deg", "lat_deg", "easting", "northing", "height")
ROLES = (*COORDINATE_ROLES, *TEXT_ROLES, *NUMBER_ROLES)
MAX_AREA_DEG = 30.0
"""Largest side of a declared area: a larger one would check nothing. [deg]"""


def choose_foot(declared: str | None, crs_unit_m: float) -> tuple[str, bool]:
    """The foot of a file that does not state which: the declared one, else that of the CRS, else the international one.

    Parameters
    ----------
    declared : str or None
        The declared unit.
    crs_unit_m : float
        Length of the unit of the CRS. [m]

    Returns
    -------
    foot : str
        ``ft-us`` or ``ft-intl``.
    of_crs : bool
        Whether it is that of the CRS.
    """
    if declared in FOOT_NAMES:
        return declared, False
    own = next((foot for foot in FOOT_NAMES if abs(crs_unit_m / METRES[foot] - 1) < 1e-9), None)
    return own or "ft-intl", own is not None


def choose_datum(declared: str | None, heights: HeightSystem, system: str) -> str:
    """The vertical datum of heights in a system that states what they are above.

    Parameters
    ----------
    declared : str or None
        The declared one, as `normalize_vertical_datum` writes it.
    system : str
        Whose heights they are, for people.

    Raises
    ------
    InvalidParameter
        The two differ, the system's is not known and none is declared, or the heights are depths.
    """
    if heights.is_depth:
        raise InvalidParameter(
            f"the heights in {system[:60]} are depths: {heights.name[:60]}",
            field="vertical_datum",
            limit="heights upwards",
            cure="write heights with the opposite sign and declare their datum and the horizontal CRS",
        )
    if declared is None and heights.datum is None:
        raise InvalidParameter(
            f"the heights in {system[:60]} are above {heights.name[:60]!r}, a vertical datum that is not known here",
            field="vertical_datum",
            limit=VERTICAL_RULE,
            cure="declare vertical_datum, and height_unit where they are in feet",
        )
    is_level = heights.datum not in (None, ELLIPSOID)  # programs also write three axes for other heights
    if declared is not None and is_level and declared != heights.datum:
        raise InvalidParameter(
            f"the heights in {system[:60]} are above {heights.datum} ({heights.name[:60]}),"
            f" the declaration has {declared}",
            field="vertical_datum",
            limit=str(heights.datum),
            cure="leave vertical_datum out, or declare only the horizontal CRS if the heights are above another datum",
        )
    return declared or str(heights.datum)


_Name = Annotated[Text, Field(min_length=1, max_length=200)]
Accuracy = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=1e6)]


@with_config(INPUT)
@dataclass(frozen=True, slots=True)
class ControlPoint:
    """A point that is known in a local grid and in the declared CRS."""

    point: Annotated[_Name, Field(description="Its point number.")]
    easting: Annotated[Number, Field(description="In the CRS and its unit.")]
    northing: Annotated[Number, Field(description="In the CRS and its unit.")]
    # `local_easting`, `local_northing`: in the local grid, in the unit of the file
    local_easting: Annotated[Number | None, Field(description="That of the row with this point number without.")] = None
    local_northing: Annotated[Number | None, Field(description="That of the row with this point number without.")] = (
        None
    )


@with_config(INPUT)
@dataclass(frozen=True, slots=True)
class LocalGrid:
    """How coordinates of a local grid are transformed: a similarity transformation by least squares."""

    control_points: Annotated[tuple[ControlPoint, ...], Field(min_length=2, max_length=100)]
    scale: Annotated[Literal["fixed", "free"], Field(description="1, or estimated of at least three points.")] = "fixed"
    limit_m: Annotated[Number, Field(gt=0, le=10, description="Largest residual of a control point. [m]")] = 0.05

    def __post_init__(self) -> None:
        needed = 2 if self.scale == "fixed" else 3
        if len(self.control_points) < needed:
            raise InvalidParameter(
                f"{len(self.control_points)} control points leave no residuals to check",
                field="local_grid.control_points",
                limit=f"at least {needed} with scale {self.scale}",
                cure="declare further control points",
            )
        names = [control.point for control in self.control_points]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InvalidParameter(
                f"the control point {twice[:40]!r} is declared twice",
                field="local_grid.control_points",
                limit="each point once",
                cure="leave one of the two out",
            )


@with_config(INPUT)
@dataclass(frozen=True, slots=True)
class SurveyIn:
    """Who surveyed, how, and how well."""

    horizontal_rmse_m: Annotated[Accuracy | None, Field(description="Horizontal accuracy, RMSE. [m]")] = None
    vertical_rmse_m: Annotated[Accuracy | None, Field(description="Vertical accuracy, RMSE. [m]")] = None
    survey_method: Annotated[_Name | None, Field(description="How it was surveyed.")] = None
    surveyor: Annotated[_Name | None, Field(description="Who surveyed.")] = None
    instrument: Annotated[_Name | None, Field(description="With what.")] = None
    check_points: Annotated[
        int | None, Field(strict=True, ge=0, le=10**6, description="Points that the accuracy was checked at.")
    ] = None


class ImportDeclaration(BaseModel):
    """What is declared of a survey."""

    model_config = INPUT | {"frozen": True}

    format: (
        Literal["csv", "geojson", "gpkg", "shapefile", "kml", "kmz", "gpx", "landxml", "jobxml", "dxf", "gsi"] | None
    ) = Field(None, description="Detected without.")
    # one of `FIXED_LAYOUTS` (no header needed), or named columns
    layout: Literal["named", "pnezd", "penzd", "nezd", "enzd"] | None = Field(
        None, description="Columns of CSV; detected without."
    )
    columns: dict[_Name, Annotated[Text, Field(max_length=200)] | None] = Field(
        default_factory=dict,
        max_length=20,
        description="Role to column; null or an empty text where no column has the role.",
    )
    layer: _Name | None = Field(None, description="Of a GeoPackage or a DXF.")
    decimal: Literal[".", ","] | None = Field(None, description="Of CSV; detected without.")
    delimiter: Literal[",", ";", "\t", "|", "space"] | None = Field(None, description="Of CSV; detected without.")
    encoding: (
        Literal["utf-8", "utf-16", "windows-1252", "iso-8859-1", "iso-8859-2", "windows-1250", "cp437", "cp850"] | None
    ) = Field(None, description="Of CSV and GSI; detected without: UTF-8, UTF-16 or Windows-1252.")
    crs: Annotated[Text, Field(max_length=100)] | None = Field(None, description="EPSG code or URN.")
    realization: Annotated[Text, Field(min_length=1, max_length=64)] | None = None
    epoch: Annotated[Number, Field(ge=1900, le=2200)] | None = None
    vertical_datum: VerticalDatum | None = Field(
        None, description="`ellipsoid`, or the datum of the heights; needed where there are any."
    )
    unit: Unit | None = Field(None, description="Of projected coordinates; the CRS's own without.")
    height_unit: Unit | None = None
    local_grid: LocalGrid | None = Field(None, description="Where easting and northing are of a local grid.")
    ignore_heights: Flag = False
    area_deg: tuple[Number, Number, Number, Number] | None = Field(
        None, description="west, south, east, north that all rows lie in. [deg]"
    )
    height_range_m: tuple[Number, Number] | None = Field(None, description="Lowest and highest height that can be. [m]")
    family: str = "plate"
    status: Status | None = None
    road: _Name | None = None
    compare: Flag = Field(
        False, description="The survey measures registered markers: residuals, and a new version of each."
    )
    duplicates: Literal["refuse", "store"] = Field(
        "refuse", description="Whether rows that are already registered, and a file that was imported, are refused."
    )
    match: Literal["code", "nearest"] = "code"
    tolerance_m: Annotated[Number, Field(gt=0, le=100)] = 0.1
    survey: SurveyIn = Field(default_factory=SurveyIn)
    leave_out: tuple[Annotated[int, Field(strict=True, ge=1, le=1_000_000)], ...] = Field(
        (), max_length=1000, description="Numbers of rows that are neither checked nor stored."
    )

    @model_validator(mode="before")
    @classmethod
    def _without_heights_in_crs(cls, data: Any) -> Any:
        """A compound system is a horizontal one with a vertical datum."""
        if not isinstance(data, dict) or not isinstance(data.get("crs"), str):
            return data
        try:
            crs, heights = split_heights(data["crs"])
            declared = data.get("vertical_datum")
            datum = normalize_vertical_datum(declared) if isinstance(declared, str) else None
        except ReferenceSystemError:
            return data  # refused by its own field
        if heights is None or data.get("ignore_heights"):
            return {**data, "crs": crs} if heights is not None else data
        return {**data, "crs": crs, "vertical_datum": choose_datum(datum, heights, data["crs"])}

    @model_validator(mode="after")
    def _fits(self) -> Self:
        unknown = next((role for role in self.columns if role not in ROLES), None)
        if unknown is not None:
            raise InvalidParameter(
                f"there is no role {unknown[:40]!r}", field="columns", limit=", ".join(ROLES), cure=_CURE
            )
        _check_area(self.area_deg)
        if self.height_range_m is not None and not self.height_range_m[0] < self.height_range_m[1]:
            raise InvalidParameter(
                "the lowest height is not below the highest", field="height_range_m", limit="low < high", cure=_CURE
            )
        return self


_CURE = "docs/imports.md lists what can be declared"


def _check_area(area: tuple[float, float, float, float] | None) -> None:
    if area is None:
        return
    west, south, east, north = area
    fits = -180 <= west < east <= 180 and -90 <= south < north <= 90
    if not fits or max(east - west, north - south) > MAX_AREA_DEG:
        raise InvalidParameter(
            "area_deg is no box of west, south, east, north, or one too large to check anything",
            field="area_deg",
            limit=f"west < east, south < north, at most {MAX_AREA_DEG:g} degrees wide",
            cure="send the box of the project; split a survey that crosses the antimeridian",
        )
