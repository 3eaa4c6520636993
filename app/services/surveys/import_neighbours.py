"""Registered markers around a survey, which its rows are compared with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sqlalchemy as sa

from app.formats.surveys.table import Floats
from app.registry import bulk
from app.registry.bulk import PlaceRow
from app.registry.marker_rows import MarkerRow
from app.registry.spatial import Box
from app.surveys.duplicates import RegisteredPoints
from app.surveys.georeference import GeoreferencedSurvey
from app.surveys.location_checks import NEAR_M, Neighbours

MAX_NEIGHBOURS = 50_000
"""Registered markers that a survey is compared with at most. Chosen by hand, to bound memory."""
_MARGIN_DEG = NEAR_M / 90_000.0


def survey_box(survey: GeoreferencedSurvey) -> Box | None:
    """The box of the middle nine tenths of the rows, widened: one row far away must not stretch it."""
    placed = survey.placed
    if not placed.placed.any():
        return None
    west, east = np.quantile(placed.lon_deg[placed.placed], [0.05, 0.95])
    south, north = np.quantile(placed.lat_deg[placed.placed], [0.05, 0.95])
    wide, high = _MARGIN_DEG * 2 + (east - west) / 8, _MARGIN_DEG + (north - south) / 8
    clipped = np.clip([west - wide, east + wide], -180.0, 180.0), np.clip([south - high, north + high], -90.0, 90.0)
    return Box(float(clipped[0][0]), float(clipped[1][0]), float(clipped[0][1]), float(clipped[1][1]))


def list_neighbours(
    connection: sa.Connection, agency_id: str, survey: GeoreferencedSurvey
) -> tuple[Neighbours, RegisteredPoints]:
    """The agency's markers around a survey: their places, and the rows of surveys that they come from."""
    box = survey_box(survey)
    found = bulk.list_places_in(connection, agency_id, box, limit=MAX_NEIGHBOURS) if box is not None else []
    lon, lat, height = places_of(found)
    registered = RegisteredPoints(
        lon,
        lat,
        tuple(row.id for row in found),
        tuple(row.family for row in found),
        tuple(row.point for row in found),
        tuple(row.survey_file_sha256 for row in found),
    )
    return Neighbours(lon, lat, height, tuple(row.vertical_datum for row in found)), registered


def places_of(rows: Sequence[MarkerRow | PlaceRow]) -> tuple[Floats, Floats, Floats]:
    """Longitude, latitude and height of markers, each of shape (N,); NaN where there is no height."""
    values = [(row.lon_deg, row.lat_deg, np.nan if row.height_m is None else row.height_m) for row in rows]
    array = np.array(values, dtype=np.float64).reshape(-1, 3)
    return array[:, 0], array[:, 1], array[:, 2]
