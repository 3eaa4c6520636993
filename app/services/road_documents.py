"""Roads as clients see them."""

from __future__ import annotations

from typing import Any

from app.registry.roads import Row
from app.services.road_routes import Route, route_of


def road_document(row: Row | dict[str, Any]) -> dict[str, Any]:
    """A road with its geometry and its calibration."""
    several = row["given"]["several"] or len(row["parts"]) > 1
    return {
        **road_summary(row),
        "geometry": {
            "type": "MultiLineString" if several else "LineString",
            "coordinates": row["parts"] if several else row["parts"][0],
        },
        "calibration": [
            {name: point[name] for name in ("part", "chainage_m", "measure_m", "ahead_m")}
            for point in row["calibration"]
        ],
        **sections_document(route_of(row)),
    }


def road_summary(row: Row | dict[str, Any]) -> dict[str, Any]:
    """A road without its geometry."""
    plain = ("id", "name", "version", "length_m", "from_m", "to_m", "localization_grade", "transform_note")
    return {
        **{name: row[name] for name in plain},
        "crs": row["given"]["crs"],
        "realization": row["given"]["realization"],
        "epoch": row["given"]["epoch"],
        "created_at": row["created_at"],
        "updated_at": row["updated_at"],
    }


def sections_document(route: Route) -> dict[str, Any]:
    """Where the measures of a road are unique."""
    return {
        "sections": [
            {
                "part": section.part,
                "from_m": float(section.measures_m[0]),
                "to_m": float(section.measures_m[-1]),
                "length_m": float(section.chainages_m[-1] - section.chainages_m[0]),
            }
            for section in route.measures.sections
        ]
    }
