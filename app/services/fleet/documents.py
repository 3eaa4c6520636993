"""What the API returns about vehicles, calibrations and the keys of snapshots."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field, JsonValue
from typing_extensions import TypedDict

from app.calibration.board_view import CalibratedCamera, Coverage, Intrinsics, ViewReport
from app.markers.snapshot import VERSION, Trust
from app.sensors.camera import CalibrationBoard

VehicleStatus = Literal["active", "retired"]


class VehicleKey(TypedDict):
    """A key that speaks for a vehicle."""

    id: str
    label: str
    prefix: str
    scope: str
    expires_at: datetime | None
    last_used_at: datetime | None


class VehicleDocument(TypedDict):
    """A vehicle; `driven_km` is summed over its decodes, see docs/fleet.md."""

    id: str
    name: str
    status: VehicleStatus
    note: str | None
    profile: Annotated[dict[str, JsonValue], Field(description="Sections of the profile, as they were sent.")]
    version: int
    created_at: datetime
    updated_at: datetime
    last_seen_at: datetime | None
    uploads: int
    driven_km: float
    keys: list[VehicleKey]


class VehiclePage(TypedDict):
    """A page of vehicles; the Link header leads to the next one."""

    items: list[VehicleDocument]


class VehicleVersion(TypedDict):
    """A vehicle as one version has it: what it did since is not part of a version."""

    id: str
    name: str
    status: VehicleStatus
    note: str | None
    profile: dict[str, JsonValue]
    version: int
    created_at: datetime
    updated_at: datetime


class VehicleVersionDocument(TypedDict):
    """One entry of a vehicle's history."""

    version: int
    at: datetime
    who: str
    why: str | None
    vehicle: VehicleVersion


class VehicleVersionPage(TypedDict):
    """A page of a vehicle's history, oldest first."""

    items: list[VehicleVersionDocument]


class CalibrationDocument(TypedDict):
    """A calibrated camera."""

    id: str
    created_at: datetime
    who: str
    decoder: str
    summary: str
    camera: CalibratedCamera
    sigma: Annotated[Intrinsics, Field(description="Standard deviations of the parameters.")]
    rms_px: Annotated[float, Field(description="Reprojection error over all views. [px]")]
    coverage: Coverage
    tilt_spread_deg: Annotated[float, Field(description="Largest angle between two views of the board. [deg]")]
    board: CalibrationBoard
    views: list[ViewReport]


class CalibrationPage(TypedDict):
    """A page of calibrations, newest first; the Link header leads to the next one."""

    items: list[CalibrationDocument]


class TrustDocument(TypedDict):
    """What vehicles verify an agency's snapshots with, as a trust file contains it."""

    algorithm: Literal["Ed25519"]
    agency_id: str
    public_keys: Annotated[
        list[str],
        Field(description="One or two keys of 32 bytes, hexadecimal; that of the key that signs first."),
    ]
    snapshot_version: Annotated[int, Field(description="Version of the format.")]


def trust_document(trust: Trust) -> TrustDocument:
    """The trust file of an agency."""
    return {
        "algorithm": "Ed25519",
        "agency_id": trust.agency_id,
        "public_keys": [key.hex() for key in trust.public_keys],
        "snapshot_version": VERSION,
    }
