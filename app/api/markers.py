"""/v1/markers: register, list, read and change markers."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field, JsonValue

from app.api.dependencies import (
    Caller,
    Idempotency,
    Identifier,
    Markers,
    Number,
    Text,
    Version,
    Whole,
    json_response,
    next_link,
)
from app.api.problems import problem_responses
from app.api.strict_json import StrictRoute
from app.errors import InvalidParameter
from app.geodesy import check_lon_lat
from app.markers.plate import PlateGeometry, PlateScheme
from app.registry.markers import MarkerFilter
from app.registry.spatial import Box
from app.services.markers import GivenCode, GivenPosition, MarkerChange, NewPlate, naming

router = APIRouter(prefix="/v1/markers", tags=["markers"], route_class=StrictRoute)

MAX_PAGE = 1000
MAX_RADIUS_M = 100_000.0
Status = Literal["planned", "built", "surveyed", "active", "suspect", "retired"]
Heading = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, lt=360)]
Accuracy = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=1e6)]
Metres = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1e8, le=1e8)]
Height = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-12_000, le=100_000)]
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


class _Placement(BaseModel):
    model_config = ConfigDict(extra="forbid")

    heading_deg: Heading | None = Field(None, description="Direction of travel, clockwise from true north. [deg]")
    heading_rmse_deg: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=180)] | None = None
    road: Text | None = Field(None, min_length=1, max_length=200, description="Road's name or number.")
    measure_m: Metres | None = Field(None, description="Chainage along the road. [m]")
    offset_m: Metres | None = Field(None, description="Offset from the road's axis, left positive. [m]")
    reason: Text | None = Field(None, min_length=1, max_length=500, description="Why; goes into the history.")


_POSITION_EXAMPLE: dict[str, JsonValue] = {
    "lon_deg": 114.179203,
    "lat_deg": 22.304161,
    "height_m": 5.21,
    "realization": "ITRF2014",
    "epoch": 2025.4,
    "horizontal_rmse_m": 0.012,
    "vertical_rmse_m": 0.02,
    "survey_method": "GNSS RTK, two occupations",
}
_NEW_EXAMPLES: list[JsonValue] = [
    {"position": _POSITION_EXAMPLE, "heading_deg": 78.5, "status": "surveyed", "road": "Cheong Wan Road"},
    {"position": _POSITION_EXAMPLE, "code": {"scheme": "position-check", "check_digits": 2}, "geometry": {"n": 10}},
    {"position": _POSITION_EXAMPLE, "code": {"scheme": "id"}},
    {"position": _POSITION_EXAMPLE, "code": {"digits": "023792168411", "allow_mismatched_digits": True}},
]


class MarkerIn(_Placement):
    """A plate to register."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": _NEW_EXAMPLES})

    family: Literal["plate"] = "plate"
    status: Status = "planned"
    position: PositionIn
    code: CodeIn = Field(default_factory=CodeIn)
    geometry: GeometryIn = Field(default_factory=GeometryIn)


class MarkerPatch(_Placement):
    """Members to change; a member that is null is cleared, one that is left out stays."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {"status": "surveyed", "position": _POSITION_EXAMPLE, "reason": "as-built survey"},
                {"status": "retired", "reason": "resurfaced"},
            ]
        },
    )

    status: Status = Field("planned", description="New status.")
    position: PositionIn = Field(default_factory=PositionIn, description="New position; replaces the whole of the old.")


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
    localization_grade: Literal["exact", "approximate, not for localization"]
    transform_note: str | None
    original: dict[str, Any]


class MarkerOut(BaseModel):
    """A marker."""

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


class MarkerPage(BaseModel):
    """A page of markers; the Link header leads to the next one."""

    items: list[MarkerOut]


class VersionOut(BaseModel):
    """One entry of a marker's history."""

    version: int
    at: str
    who: str
    why: str | None
    marker: MarkerOut


class VersionPage(BaseModel):
    """A page of a marker's history, oldest first."""

    items: list[VersionOut]


@router.post(
    "",
    status_code=201,
    response_class=Response,
    responses={201: {"model": MarkerOut, "description": "Registered"}, **problem_responses(409)},
)
def post_marker(marker: MarkerIn, caller: Caller, markers: Markers, idempotency: Idempotency) -> Response:
    """Register a plate. With an Idempotency-Key a repeated request gets the first answer again."""
    document, replayed = markers.register_plate(caller, _new_plate(marker), idempotency)
    headers = {"Location": f"/v1/markers/{document['id']}", "ETag": _etag(document)}
    if replayed:
        headers["Idempotency-Replayed"] = "true"
    return json_response(document, 201, headers)


@router.get("", response_class=Response, responses={200: {"model": MarkerPage}, **problem_responses()})
def list_markers(
    request: Request,
    caller: Caller,
    markers: Markers,
    bbox: Annotated[Text | None, Query(max_length=200, examples=["114.1,22.2,114.3,22.4"])] = None,
    near: Annotated[Text | None, Query(max_length=200, examples=["114.179,22.304,500"])] = None,
    code: Annotated[Text | None, Query(min_length=1, max_length=64, description="All digits of a plate.")] = None,
    status: Status | None = None,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = 100,
    after: Annotated[Identifier | None, Query(description="Last id of the page before.")] = None,
) -> Response:
    """Markers in the order they were registered. `bbox` is west,south,east,north; `near` is lon,lat,radius_m."""
    narrowed = MarkerFilter(
        box=_box(bbox) if bbox is not None else None,
        near=_circle(near) if near is not None else None,
        digits=code,
        status=status,
    )
    page, last = markers.page(caller, narrowed, after=after, limit=limit)
    return json_response({"items": page}, headers=next_link(request, after=last) if last else None)


@router.get("/{marker_id}", response_class=Response, responses={200: {"model": MarkerOut}, **problem_responses(404)})
def get_marker(marker_id: MarkerId, request: Request, caller: Caller, markers: Markers) -> Response:
    """One marker, with its version as ETag."""
    document = markers.get(caller, marker_id)
    etag = {"ETag": _etag(document)}
    if request.headers.get("if-none-match") == etag["ETag"]:
        return Response(status_code=304, headers=etag)
    return json_response(document, headers=etag)


@router.patch(
    "/{marker_id}",
    response_class=Response,
    responses={200: {"model": MarkerOut}, **problem_responses(404, 409, 412, 428)},
)
def patch_marker(
    marker_id: MarkerId, patch: MarkerPatch, caller: Caller, markers: Markers, version: Version
) -> Response:
    """Change a marker that is still at the version named by If-Match."""
    document = markers.change(caller, marker_id, _change(patch), version)
    return json_response(document, headers={"ETag": _etag(document)})


@router.get(
    "/{marker_id}/versions", response_class=Response, responses={200: {"model": VersionPage}, **problem_responses(404)}
)
def list_marker_versions(
    marker_id: MarkerId,
    request: Request,
    caller: Caller,
    markers: Markers,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = 100,
    after: Annotated[int, Query(ge=0, lt=2**31, description="Last version of the page before.")] = 0,
) -> Response:
    """The marker's history, oldest first."""
    page, last = markers.history(caller, marker_id, after=after, limit=limit)
    return json_response({"items": page}, headers=next_link(request, after=last) if last else None)


def _etag(document: dict[str, Any]) -> str:
    return f'"{document["version"]}"'


def _new_plate(marker: MarkerIn) -> NewPlate:
    code = marker.code
    return NewPlate(
        position=GivenPosition(**marker.position.model_dump()),
        code=GivenCode(
            PlateScheme(code.scheme), code.digits, code.check_digits, code.registry_number, code.allow_mismatched_digits
        ),
        geometry=_geometry(marker.geometry),
        **marker.model_dump(exclude={"family", "position", "code", "geometry"}),
    )


def _geometry(given: GeometryIn) -> PlateGeometry:
    with naming("geometry"):
        return PlateGeometry(given.n, given.unit_mm, given.gap_mm, given.thickness_mm)


def _change(patch: MarkerPatch) -> MarkerChange:
    named = patch.model_fields_set
    values = patch.model_dump(include=named - {"position", "reason"})
    position = GivenPosition(**patch.position.model_dump()) if "position" in named else None
    if not values and position is None:
        raise InvalidParameter(
            "the patch changes nothing", field="body", limit="at least one member", cure="name what to change"
        )
    return MarkerChange(values, position, patch.reason)


def _numbers(text: str, field: str, form: str) -> list[float]:
    parts = text.split(",")
    if len(parts) != len(form.split(",")):
        raise InvalidParameter(f"{field} is {form}", field=field, limit=form, cure="separate the numbers by commas")
    try:
        return [float(part) for part in parts]
    except ValueError as error:
        raise InvalidParameter(f"{field} holds something that is not a number", field=field, limit=form) from error


def _box(text: str) -> Box:
    west, south, east, north = _numbers(text, "bbox", "west,south,east,north")
    check_lon_lat(west, south, field="bbox")
    check_lon_lat(east, north, field="bbox")
    if south > north:
        raise InvalidParameter("bbox has its south above its north", field="bbox", limit="south <= north")
    return Box(west, south, east, north)


def _circle(text: str) -> tuple[float, float, float]:
    lon_deg, lat_deg, radius_m = _numbers(text, "near", "lon,lat,radius_m")
    check_lon_lat(lon_deg, lat_deg, field="near")
    if not 0 <= radius_m <= MAX_RADIUS_M:
        raise InvalidParameter(
            f"a radius of {radius_m:g} m is too large or negative", field="near", limit=f"0 to {MAX_RADIUS_M:g} m"
        )
    return lon_deg, lat_deg, radius_m
