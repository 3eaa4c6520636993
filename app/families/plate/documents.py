"""Plates as clients see them."""

from __future__ import annotations

from functools import lru_cache

from typing_extensions import TypedDict

from app.families.documents import MarkerDocument, marker_head, marker_place
from app.markers.plate import PlateCode, PlateScheme
from app.registry.marker_rows import MarkerRow


class PlateCodeDocument(TypedDict):
    """A plate's code."""

    scheme: str
    digits: str
    check_digits: int | None
    registry_number: int | None
    digits_match_position: bool | None


class PlateGeometryDocument(TypedDict):
    """Dimensions of a plate."""

    n: int
    unit_mm: float
    gap_mm: float
    thickness_mm: float
    side_mm: float


class PlateDocument(MarkerDocument):
    """A plate."""

    code: PlateCodeDocument
    geometry: PlateGeometryDocument


def plate_document(row: MarkerRow) -> PlateDocument:
    """A plate's row as clients see it."""
    n, unit_mm, gap_mm = row.n, row.unit_mm, row.gap_mm
    return {
        **marker_head(row),
        "code": {
            "scheme": row.scheme,
            "digits": row.digits,
            "check_digits": row.check_digits,
            "registry_number": _registry_number(row.digits, n) if row.scheme == "id" else None,
            "digits_match_position": row.digits_match_position,
        },
        "geometry": {
            "n": n,
            "unit_mm": unit_mm,
            "gap_mm": gap_mm,
            "thickness_mm": row.thickness_mm,
            "side_mm": n * unit_mm + (n + 1) * gap_mm,
        },
        **marker_place(row),
    }


@lru_cache(maxsize=2**16)
def _registry_number(digits: str, n: int) -> int:
    return PlateCode(digits, PlateScheme.ID, n).registry_number
