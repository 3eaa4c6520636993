"""A plan with its markers where they were surveyed, to check it again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pyproj import Geod

from app.planning.plan import Plan, PlannedLineMagnet, PlannedMarker, PlannedPlate, PlannedTag

_OFFSET_STEP_M = 0.01  # [m] of a plate's offset, because cameras are computed for each offset; source: a survey's error
_GEOD = Geod(ellps="WGS84")


class SurveyedPlace(NamedTuple):
    """Where a marker of a plan was surveyed; `heading_deg` is None where it was not."""

    lon_deg: float
    lat_deg: float
    heading_deg: float | None = None


class Residual(NamedTuple):
    """A surveyed marker against its planned place. [m, deg]

    Attributes
    ----------
    along_m : float
        Ahead of its planned place in the direction of travel.
    across_m : float
        To the left of it.
    heading_deg : float or None
        Clockwise of the planned heading, -180 to 180.
    """

    along_m: float
    across_m: float
    heading_deg: float | None


def residual_of(marker: PlannedMarker, surveyed: SurveyedPlace) -> Residual:
    """Residual of a surveyed marker along and across the direction of travel."""
    azimuth, _, distance = _GEOD.inv(marker.lon_deg, marker.lat_deg, surveyed.lon_deg, surveyed.lat_deg)
    angle = np.radians(azimuth - marker.heading_deg)
    turned = None
    if surveyed.heading_deg is not None:
        turned = (surveyed.heading_deg - marker.heading_deg + 180.0) % 360.0 - 180.0
    return Residual(float(distance * np.cos(angle)), float(-distance * np.sin(angle)), turned)


def plan_as_built(plan: Plan, surveyed: Mapping[int, SurveyedPlace]) -> Plan:
    """The plan with surveyed positions in place of planned ones, without findings.

    Parameters
    ----------
    plan : Plan
    surveyed : mapping of int to SurveyedPlace
        By the markers' numbers; markers that are not in it stay where they are planned.

    Notes
    -----
    Chainage and offset change by the residual along and across. The magnets of a tag move with the first one. A line of
    magnets has no single place that could be surveyed, so its magnets stay.
    """
    markers = [
        _moved(plan, marker, surveyed[marker.number])
        if marker.number in surveyed and not isinstance(marker.detail, PlannedLineMagnet)
        else marker
        for marker in plan.markers
    ]
    return replace(plan, markers=tuple(markers), findings=())


def _moved(plan: Plan, marker: PlannedMarker, surveyed: SurveyedPlace) -> PlannedMarker:
    lane = plan.alignment.lane(marker.lane)
    residual = residual_of(marker, surveyed)
    offset_m = marker.offset_m + residual.across_m
    detail = marker.detail
    if isinstance(detail, PlannedPlate):
        offset_m = round(offset_m / _OFFSET_STEP_M) * _OFFSET_STEP_M
    if isinstance(detail, PlannedTag):
        chainages = np.array([chainage for chainage, _, _ in detail.magnets]) + residual.along_m
        lon, lat = lane.position_at(chainages, offset_m)
        detail = replace(detail, magnets=tuple(zip(chainages.tolist(), lon.tolist(), lat.tolist(), strict=True)))
    chainage = min(max(marker.chainage_m + residual.along_m, 0.0), lane.length_m)
    return replace(
        marker,
        lon_deg=surveyed.lon_deg,
        lat_deg=surveyed.lat_deg,
        heading_deg=marker.heading_deg if surveyed.heading_deg is None else surveyed.heading_deg,
        chainage_m=chainage,
        station_m=float(lane.value_at(lane.station_m, chainage)),
        offset_m=offset_m,
        detail=detail,
    )
