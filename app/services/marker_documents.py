"""Markers as clients see them. Built by hand: pages of a thousand go through here."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from app.encoders.magnet import DrillingSheet
from app.encoders.magnet.sheet_geojson import sheet_document
from app.markers.magnet import LineTag, parse_tag
from app.markers.magnet_codebook import Meaning
from app.markers.plate import PlateCode, PlateScheme
from app.registry.markers import Row


def plate_document(row: Row | dict[str, Any]) -> dict[str, Any]:
    """A plate."""
    n, unit_mm, gap_mm = row["n"], row["unit_mm"], row["gap_mm"]
    return {
        **_head(row),
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
        **_place(row),
    }


def _head(row: Row | dict[str, Any]) -> dict[str, Any]:
    return {name: row[name] for name in ("id", "family", "status", "version")}


def _place(row: Row | dict[str, Any]) -> dict[str, Any]:
    """What every family says of where a marker is, and since when."""
    return {
        "position": _position(row),
        "heading_deg": row["heading_deg"],
        "heading_rmse_deg": row["heading_rmse_deg"],
        "road": row["road"],
        "measure_m": row["measure_m"],
        "offset_m": row["offset_m"],
        "created_at": row["created_at"],
        "updated_at": row["updated_at"],
    }


def _position(row: Row | dict[str, Any]) -> dict[str, Any]:
    return {
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
        "check_points": row["check_points"],
        "surveyor": row["surveyor"],
        "instrument": row["instrument"],
        "survey_file_sha256": row["survey_file_sha256"],
        "localization_grade": row["localization_grade"],
        "transform_accuracy_m": row["transform_accuracy_m"],
        "transform_note": row["transform_note"],
        "original": row["original"],
    }


@lru_cache(maxsize=2**16)
def _registry_number(digits: str, n: int) -> int:
    return PlateCode(digits, PlateScheme.ID, n).registry_number


def version_document(row: Row, marker: dict[str, Any]) -> dict[str, Any]:
    """An entry of a marker's history."""
    return {
        "version": row["version"],
        "at": row["at"],
        "who": row["who"],
        "why": row["why"],
        "kind": row["kind"],
        "sha256": row["sha256"],
        "audit_number": row["audit_number"],
        "marker": marker,
    }


def magnet_document(row: Row | dict[str, Any]) -> dict[str, Any]:
    """A magnet marker as lists and histories show it: all but what follows from its layout."""
    spec = row["spec"]
    return {
        **_head(row),
        "code": _tag_document(spec),
        "layout": spec["place"],
        **_place(row),
    }


_OF_THE_SHEET = ("layout", "code", "hole")


def magnet_detail(row: Row | dict[str, Any], sheet: DrillingSheet) -> dict[str, Any]:
    """A magnet marker by itself: with its lane, its magnets, what was checked and what it costs."""
    written = sheet_document(sheet)
    summary, spec = written["waymark"], row["spec"]
    magnets = [
        {
            **{name: _plain(value) for name, value in hole["properties"].items() if name not in _OF_THE_SHEET},
            "number": hole["id"],
            "lon_deg": hole["geometry"]["coordinates"][0],
            "lat_deg": hole["geometry"]["coordinates"][1],
        }
        for hole in written["features"]
    ]
    return {
        **magnet_document(row),
        "length_m": summary["length_m"],
        "lane": {
            "geometry": {"type": "LineString", "coordinates": spec["lane"]["points_deg"]},
            "length_m": round(sheet.layout.lane.length_m, 4),
            "height_m": spec["lane"]["height_m"],
            "given": spec["lane"]["given"],
        },
        "site": spec["site"],
        "magnets": magnets,
        "passed": summary["passed"],
        "checks": summary["checks"],
        "warnings": [check["name"] for check in summary["checks"] if not check["passed"]],
        "bill": {**summary["bill"], "total_usd": sheet.bill.total_usd},
    }


def _tag_document(spec: dict[str, Any]) -> dict[str, Any]:
    tag = parse_tag(spec["tag"])
    code = {"scheme": spec["kind"], "text": tag.text, "tuple": tag.tuple_text}
    if isinstance(tag, LineTag):
        return {**code, "style": tag.style.value}
    return {
        **code,
        "polarities": "".join(tag.polarities),
        "length_m": tag.length_m,
        "segment_m": tag.segment_m,
        "gaps_m": list(tag.gaps_m),
        "ratios": list(tag.ratios),
        "codebook_id": spec["codebook_id"],
        "meaning": meaning_document(Meaning(**spec["meaning"])) if spec["meaning"] is not None else None,
    }


def _plain(value: Any) -> Any:
    """The value without a negative zero."""
    return 0.0 if value == 0 and isinstance(value, float) else value


def meaning_document(meaning: Meaning) -> dict[str, Any]:
    """What a code tells: its kind, its value, and both for people."""
    return {"kind": meaning.kind.value, "value": meaning.value, "unit": meaning.unit, "text": meaning.text}


def cerpm_document(row: Row | dict[str, Any]) -> dict[str, Any]:
    """A CERPM."""
    spec = row["spec"]
    return {
        **_head(row),
        "code": {"scheme": row["scheme"], "text": row["digits"], "number": int(row["digits"])},
        "side": spec["side"],
        "speed_limit": spec["speed_limit"],
        "dev_eui": spec["dev_eui"],
        "radio": spec["radio"],
        **_place(row),
    }
