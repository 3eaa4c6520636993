"""Drilling sheet -> GeoJSON (RFC 7946)."""

from __future__ import annotations

import math
from typing import Any

import orjson

from app.encoders.magnet.sheet import DrillingSheet
from app.markers.magnet import InformationTag

_DECIMALS = 9


def write_sheet_geojson(sheet: DrillingSheet) -> bytes:
    """Write the holes as points, with the layout, its checks and its bill as a foreign member.

    Positions are WGS 84, longitude first, to 0.1 mm.
    """
    return orjson.dumps(sheet_document(sheet), option=orjson.OPT_INDENT_2)


def sheet_document(sheet: DrillingSheet) -> dict[str, Any]:
    """The same as plain values."""
    layout = sheet.layout
    features = [
        {
            "type": "Feature",
            "id": hole.number,
            "geometry": {
                "type": "Point",
                "coordinates": [round(hole.lon_deg, _DECIMALS), round(hole.lat_deg, _DECIMALS)],
            },
            "properties": {
                "layout": layout.name,
                "code": layout.tag.text,
                "hole": hole.number,
                "chainage_m": round(hole.chainage_m, 4),
                "offset_m": round(hole.offset_m, 4),
                "from_first_m": round(hole.along_m, 4),
                "east_m": round(hole.east_m, 4),
                "north_m": round(hole.north_m, 4),
                "polarity": hole.polarity.value,
                "phi_deg": hole.orientation.phi_deg,
                "north_pole": hole.north_pole,
                "north_pole_bearing_deg": _rounded(hole.north_pole_bearing_deg),
            },
        }
        for hole in layout.holes
    ]
    return {"type": "FeatureCollection", "features": features, "waymark": _summary(sheet)}


def _summary(sheet: DrillingSheet) -> dict[str, Any]:
    layout, bill = sheet.layout, sheet.bill
    meaning = layout.meaning
    lon_deg, lat_deg, height_m = layout.lane.origin
    return {
        "layout": layout.name,
        "code": layout.tag.text,
        "kind": "information-tag" if isinstance(layout.tag, InformationTag) else "line",
        "meaning": None if meaning is None else {"kind": meaning.kind.value, "value": meaning.value},
        "bearing_deg": _rounded(layout.bearing_deg),
        "length_m": round(layout.length_m, 4),
        "origin": {"lon_deg": lon_deg, "lat_deg": lat_deg, "height_m": height_m},
        "passed": sheet.passed,
        "checks": [
            {
                "name": check.name,
                "figure": round(check.figure, 4),
                "relation": check.relation,
                "limit": round(check.limit, 4),
                "unit": check.unit,
                "passed": check.passed,
                "source": check.source,
                "note": check.note,
            }
            for check in sheet.checks
        ],
        "bill": {
            part: [
                {
                    "item": row.cost.item,
                    "quantity": row.quantity,
                    "unit": row.cost.unit,
                    "low_usd": row.low_usd,
                    "high_usd": row.high_usd,
                    "source": row.cost.source,
                }
                for row in rows
            ]
            for part, rows in (("materials", bill.materials), ("alternatives", bill.alternatives))
        },
    }


def _rounded(degrees: float | None) -> float | None:
    """A bearing below 360 also after rounding. [deg]"""
    return None if degrees is None else math.fmod(round(degrees, 3), 360.0)
