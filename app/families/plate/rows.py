"""The row of a plate as values of the core."""

from __future__ import annotations

from app.markers.plate import PlateCode, PlateGeometry, PlateScheme
from app.registry.marker_rows import MarkerRow


def plate_code(row: MarkerRow) -> PlateCode:
    """Code of a plate's row."""
    return PlateCode(row.digits, PlateScheme(row.scheme), row.n, row.check_digits or 1)


def plate_geometry(row: MarkerRow) -> PlateGeometry:
    """Geometry of a plate's row."""
    return PlateGeometry(row.n, row.unit_mm, row.gap_mm, row.thickness_mm)
