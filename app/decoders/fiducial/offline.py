"""Fiducial signs of a snapshot: what a vehicle without a connection expects and matches."""

from __future__ import annotations

from app.decoders.snapshot import Snapshot, SnapshotMarker
from app.markers.fiducial import FiducialCode, FiducialGeometry, KnownFiducial, Mounting

FAMILY = "fiducial"


def known_fiducials(snapshot: Snapshot, lon_deg: float, lat_deg: float, reach_m: float) -> tuple[KnownFiducial, ...]:
    """Signs for `decode_fiducials(..., known=)`, within a distance."""
    return tuple(_known(marker) for marker in snapshot.near(FAMILY, lon_deg, lat_deg, reach_m))


def match_fiducial(
    snapshot: Snapshot, code: FiducialCode, lon_deg: float, lat_deg: float, reach_m: float
) -> SnapshotMarker | None:
    """The nearest sign with a code within reach."""
    found = snapshot.near(FAMILY, lon_deg, lat_deg, reach_m)
    return next((marker for marker in found if marker.code == code.text), None)


def _known(marker: SnapshotMarker) -> KnownFiducial:
    kind = marker.kind
    geometry = FiducialGeometry(kind["side_mm"], kind["quiet_mm"], Mounting(kind["mounting"]))
    return KnownFiducial(FiducialCode.from_text(marker.code, kind["scheme"]), geometry)
