"""What the API returns about vehicles, calibrations and the keys of snapshots."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field, JsonValue
from typing_extensions import TypedDict

from app.markers.snapshot import VERSION, Trust

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


class CalibratedCamera(TypedDict):
    """Intrinsics and distortion, in the members of a decode's camera; pixel centres at integers."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: list[float]


class CameraSigma(TypedDict):
    """Standard deviations of the parameters."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: list[float]


class Coverage(TypedDict):
    """Cells of the image, 6 rows of 8, that have a corner in them."""

    share: float
    cells: list[list[int]]


class Board(TypedDict):
    """A calibration board."""

    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    dictionary: str


class CalibrationView(TypedDict):
    """A photo: whether it was used, or the reason why it was not."""

    photo: int
    name: str
    used: bool
    reason: str | None
    detail: str | None
    corners: int
    rms_px: float | None
    tilt_deg: float | None
    edge_width_px: float | None


class CalibrationResult(TypedDict):
    """What is stored of a calibration."""

    decoder: str
    summary: str
    camera: CalibratedCamera
    sigma: CameraSigma
    rms_px: float
    coverage: Coverage
    tilt_spread_deg: float
    board: Board
    views: list[CalibrationView]


class CalibrationDocument(CalibrationResult):
    """A calibrated camera."""

    id: str
    created_at: datetime
    who: str


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
