"""Markers as clients see them: what every family has in common. Built by hand: pages of a thousand go through here."""

from __future__ import annotations

from datetime import datetime
from typing import Any, NotRequired

from typing_extensions import TypedDict

from app.geodesy.grades import Grade
from app.markers.status import Status
from app.registry.marker_rows import MarkerRow


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
    original: dict[str, Any]


class WarningDocument(TypedDict):
    """Something in a position that is probably wrong, though it can be stored."""

    field: str
    code: str
    message: str
    proposal: str | None


class MarkerHead(TypedDict):
    """Which marker it is."""

    id: str
    family: str
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
    """What markers of every family have; each family adds its code and what else it has."""


def marker_head(row: MarkerRow) -> MarkerHead:
    """Id, family, status and version of a row."""
    return {"id": row.id, "family": row.family, "status": row.status, "version": row.version}


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
