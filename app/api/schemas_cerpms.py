"""Schemas of CERPMs."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue

from app.api.dependencies import Number, Whole
from app.api.schemas_markers import Headed, PositionIn, PositionOut, Status
from app.markers.cerpm import MAX_NUMBER, MAX_SPEED_LIMIT, LaneSide, SpeedLimit, SpeedUnit
from app.services.cerpm_markers import Beacon, NewCerpm
from app.services.positions import GivenPosition, naming

Side = Literal["left", "right", "unknown"]
DevEui = Annotated[str, Field(pattern=r"^[0-9a-fA-F]{16}$")]


class SpeedLimitIn(BaseModel):
    """A speed limit as it is posted."""

    model_config = ConfigDict(extra="forbid")

    value: Annotated[int, Field(strict=True, ge=1, le=MAX_SPEED_LIMIT)]
    unit: SpeedUnit = SpeedUnit.KM_H


class BeaconIn(BaseModel):
    """How the marker sends."""

    model_config = ConfigDict(extra="forbid")

    interval_s: Number = Field(2.0, description="From one transmission to the next, 0.1 to 86 400. [s]")
    spreading_factor: Whole = Field(7, description="6 to 12.")
    bandwidth_hz: Whole = Field(500_000, description="125000, 250000 or 500000. [Hz]")
    frequency_hz: Whole = Field(915_000_000, description="Carrier. [Hz]")
    tx_power_dbm: Number = Field(14.0, description="Radiated, -10 to 30. [dBm]")

    def given(self) -> Beacon:
        """The radio as the use cases know it."""
        with naming("beacon"):
            return Beacon(**self.model_dump())


CERPM_EXAMPLES: list[JsonValue] = [
    {
        "family": "cerpm",
        "position": {
            "lon_deg": -85.6436,
            "lat_deg": 42.2531,
            "height_m": 236.4,
            "realization": "ITRF2014",
            "horizontal_rmse_m": 0.02,
            "vertical_rmse_m": 0.02,
            "survey_method": "GNSS RTK",
        },
        "number": 17,
        "side": "right",
        "speed_limit": {"value": 25, "unit": "mph"},
        "beacon": {"interval_s": 2.0, "spreading_factor": 7, "bandwidth_hz": 500_000},
        "status": "surveyed",
        "road": "Parkview Campus Drive",
    }
]


class CerpmMarkerIn(Headed):
    """A chip-enabled raised pavement marker to register."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": CERPM_EXAMPLES})

    family: Literal["cerpm"]
    status: Status = "planned"
    position: PositionIn
    number: Annotated[int, Field(strict=True, ge=1, le=MAX_NUMBER)] | None = Field(
        None, description="Within the agency; the next free one if left out."
    )
    side: Side = Field("unknown", description="Boundary of the lane that it stands on, in the direction of travel.")
    speed_limit: SpeedLimitIn | None = Field(None, description="As it is posted; nothing where none is.")
    dev_eui: DevEui | None = Field(None, description="LoRaWAN DevEUI, where the marker joins a network.")
    beacon: BeaconIn = Field(default_factory=lambda: BeaconIn())

    def given(self) -> NewCerpm:
        """The marker as the use cases know it."""
        return NewCerpm(
            position=GivenPosition(**self.position.model_dump()),
            side=LaneSide[self.side.upper()],
            speed_limit=SpeedLimit(self.speed_limit.value, self.speed_limit.unit) if self.speed_limit else None,
            beacon=self.beacon.given(),
            dev_eui=self.dev_eui.lower() if self.dev_eui is not None else None,
            **self.model_dump(exclude={"family", "position", "side", "speed_limit", "beacon", "dev_eui"}),
        )


class NumberOut(BaseModel):
    """What a CERPM is known by."""

    scheme: Literal["cerpm"]
    text: str
    number: int


class CerpmMarkerOut(BaseModel):
    """A CERPM."""

    id: str
    family: Literal["cerpm"]
    status: Status
    version: int
    code: NumberOut
    side: Side
    speed_limit: dict[str, Any] | None
    dev_eui: str | None
    beacon: dict[str, Any]
    position: PositionOut
    heading_deg: float | None
    heading_rmse_deg: float | None
    road: str | None
    measure_m: float | None
    offset_m: float | None
    created_at: str
    updated_at: str
