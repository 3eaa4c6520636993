"""Rows of markers outside the registry."""

from __future__ import annotations

from datetime import datetime
from typing import Any, NamedTuple

from app.geodesy.place import Grade
from app.markers.reading import Status
from app.registry.column_types import columns_of, select_rows
from app.registry.tables import markers


class MarkerRow(NamedTuple):
    """A marker of any family. `check_digits` to `thickness_mm` are of plates, and None in the rows of other families.

    `original` is the position as it was sent; `spec` is what else a family stores, in the shape that it declares.
    """

    id: str
    family: str
    status: Status
    scheme: str
    digits: str
    check_digits: int | None
    digits_match_position: bool | None
    n: int
    unit_mm: float
    gap_mm: float
    thickness_mm: float
    lon_deg: float
    lat_deg: float
    height_m: float | None
    heading_deg: float | None
    heading_rmse_deg: float | None
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
    transform_accuracy_m: float | None
    original: dict[str, object]
    localization_grade: Grade
    transform_note: str | None
    road: str | None
    measure_m: float | None
    offset_m: float | None
    spec: Any
    version: int
    created_at: datetime
    updated_at: datetime


class CodeRow(NamedTuple):
    """What is known of a marker of any agency that carries a code."""

    id: str
    agency_id: str
    digits: str
    n: int
    scheme: str
    status: Status
    lon_deg: float
    lat_deg: float
    digits_match_position: bool | None


class VersionRow(NamedTuple):
    """One entry of a marker's history."""

    version: int
    at: datetime
    who: str
    why: str | None
    kind: str
    sha256: str
    audit_number: int
    marker: MarkerRow


PUBLIC = columns_of(MarkerRow, markers)
MARKERS = select_rows(MarkerRow, markers)
