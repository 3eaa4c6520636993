"""Markers as clients see them. Built by hand: pages of a thousand go through here."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from app.markers.plate import PlateCode, PlateScheme
from app.registry.markers import Row


def marker_document(row: Row | dict[str, Any]) -> dict[str, Any]:
    """A marker."""
    n, unit_mm, gap_mm = row["n"], row["unit_mm"], row["gap_mm"]
    return {
        "id": row["id"],
        "family": row["family"],
        "status": row["status"],
        "version": row["version"],
        "code": {
            "scheme": row["scheme"],
            "digits": row["digits"],
            "check_digits": row["check_digits"],
            "registry_number": _registry_number(row["digits"], n) if row["scheme"] == "id" else None,
            "digits_match_position": row["digits_match_position"],
        },
        "geometry": {
            "n": n,
            "unit_mm": unit_mm,
            "gap_mm": gap_mm,
            "thickness_mm": row["thickness_mm"],
            "side_mm": n * unit_mm + (n + 1) * gap_mm,
        },
        "position": {
            "lon_deg": row["lon_deg"],
            "lat_deg": row["lat_deg"],
            "height_m": row["height_m"],
            "crs": row["crs"],
            "realization": row["realization"],
            "epoch": row["epoch"],
            "vertical_datum": row["vertical_datum"],
            "horizontal_rmse_m": row["horizontal_rmse_m"],
            "vertical_rmse_m": row["vertical_rmse_m"],
            "survey_method": row["survey_method"],
            "localization_grade": row["localization_grade"],
            "transform_note": row["transform_note"],
            "original": row["original"],
        },
        "heading_deg": row["heading_deg"],
        "heading_rmse_deg": row["heading_rmse_deg"],
        "road": row["road"],
        "measure_m": row["measure_m"],
        "offset_m": row["offset_m"],
        "created_at": row["created_at"],
        "updated_at": row["updated_at"],
    }


@lru_cache(maxsize=2**16)
def _registry_number(digits: str, n: int) -> int:
    return PlateCode(digits, PlateScheme.ID, n).registry_number


def version_document(row: Row) -> dict[str, Any]:
    """An entry of a marker's history."""
    return {
        "version": row["version"],
        "at": row["at"],
        "who": row["who"],
        "why": row["why"],
        "marker": marker_document(row["marker"]),
    }
