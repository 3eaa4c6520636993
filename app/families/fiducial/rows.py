"""The row of a fiducial sign as values of the core."""

from __future__ import annotations

from app.families.fiducial.documents import FiducialGeometryDocument
from app.markers.fiducial import FiducialCode, FiducialGeometry, KnownFiducial, Mounting
from app.registry.marker_rows import MarkerRow


def fiducial_code(row: MarkerRow) -> FiducialCode:
    """Code of a sign's row."""
    return FiducialCode.from_text(row.digits, row.scheme)


def fiducial_geometry(row: MarkerRow) -> FiducialGeometry:
    """Dimensions and mounting of a sign's row."""
    spec: FiducialGeometryDocument = row.spec
    return FiducialGeometry(spec["side_mm"], spec["quiet_mm"], Mounting(spec["mounting"]))


def known_fiducial(row: MarkerRow) -> KnownFiducial:
    """A sign's row as a decoder expects it."""
    return KnownFiducial(fiducial_code(row), fiducial_geometry(row))
