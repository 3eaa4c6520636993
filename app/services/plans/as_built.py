"""A committed plan beside what was built: residuals along and across the direction of travel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pyproj import Geod

from app.planning.plan import Plan
from app.registry.plans import BuiltRow
from app.services.plans.documents import AsBuiltDocument, BuiltMarker

MAX_LISTED = 1000
"""Markers that the comparison lists; all are counted. Source: chosen by hand."""
_SURVEYED = ("surveyed", "active", "suspect")
_GEOD = Geod(ellps="WGS84")


def compare_as_built(plan: Plan, built: Sequence[BuiltRow]) -> AsBuiltDocument:
    """Residuals of the surveyed markers, and which of them are out of tolerance."""
    planned = {marker.number: marker for marker in plan.markers}
    tolerances = plan.rules.tolerances
    surveyed = [row for row in built if row.status in _SURVEYED]
    markers: list[BuiltMarker] = []
    for row in surveyed:
        marker = planned[row.number]
        azimuth, _, distance = _GEOD.inv(marker.lon_deg, marker.lat_deg, row.lon_deg, row.lat_deg)
        angle = np.radians(azimuth - marker.heading_deg)
        along, across = float(distance * np.cos(angle)), float(-distance * np.sin(angle))
        turned = None
        if row.heading_deg is not None:
            turned = (row.heading_deg - marker.heading_deg + 180.0) % 360.0 - 180.0
        within = (
            abs(along) <= tolerances.along_m
            and abs(across) <= tolerances.across_m
            and (turned is None or abs(turned) <= tolerances.heading_deg)
        )
        markers.append(
            BuiltMarker(
                number=row.number, marker_id=row.marker_id, status=row.status, along_m=along, across_m=across,
                heading_deg=turned, in_tolerance=within,
            )
        )  # fmt: skip
    markers.sort(key=lambda found: (found["in_tolerance"], -max(abs(found["along_m"]), abs(found["across_m"]))))
    return {
        "surveyed": len(surveyed),
        "not_surveyed": len(built) - len(surveyed),
        "out_of_tolerance": sum(not found["in_tolerance"] for found in markers),
        "tolerances": tolerances.model_dump(),
        "rms_along_m": _rms([found["along_m"] for found in markers]),
        "rms_across_m": _rms([found["across_m"] for found in markers]),
        "markers": markers[:MAX_LISTED],
    }


def _rms(values: Sequence[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None
