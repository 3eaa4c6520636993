"""Schemas of requests that register or change CERPMs."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, JsonValue

from app.errors import naming
from app.families.cerpm.registration import NewCerpm
from app.families.inputs import FamilyChange, Flag, Headed, MarkerIn, Number, PositionIn, StrictModel, Whole
from app.markers.cerpm import MAX_NUMBER, MAX_SPEED_LIMIT, LaneSide, SpeedLimit, SpeedUnit
from app.radio.settings import RadioSettings

Side = Literal["left", "right", "unknown"]
DevEui = Annotated[str, Field(pattern=r"^[0-9a-fA-F]{16}$")]


class SpeedLimitIn(StrictModel):
    """A speed limit as it is posted."""

    value: Annotated[int, Field(strict=True, ge=1, le=MAX_SPEED_LIMIT)]
    unit: SpeedUnit = SpeedUnit.KM_H


class RadioIn(StrictModel):
    """How the marker's radio is set."""

    frequency_hz: Whole = Field(915_000_000, description="Carrier, or the first of several. [Hz]")
    spreading_factor: Whole = Field(7, description="7 to 12, or 6 without a header.")
    bandwidth_hz: Whole = Field(500_000, description="125000, 250000 or 500000. [Hz]")
    interval_s: Number = Field(1.6, description="From one transmission to the next on average. [s]")
    jitter_share: Number = Field(0.2, description="Each interval is drawn evenly around that, this share to each side.")
    power_dbm: Number = Field(
        20.0, description="At the antenna's connector, -4 to 20; above 17 it may send 1 % of the time. [dBm]"
    )
    antenna_gain_dbi: Number = Field(2.15, description="-10 to 6. [dBi]")
    channels: Whole = Field(1, description="Over which packets are spread, 1 to 128.")
    hopping: Flag = Field(False, description="Every marker uses all channels in turn; else each has one.")
    coding_rate: Whole = Field(5, description="5 to 8: 4/5 to 4/8.")
    preamble_symbols: Whole = Field(8, description="Length of the preamble.")
    explicit_header: Flag = Field(True, description="Whether packets have a header.")
    crc: Flag = Field(True, description="Whether packets have a checksum of the radio.")
    lorawan: Flag = Field(False, description="The message travels in a LoRaWAN frame.")

    def settings(self) -> RadioSettings:
        """The radio as the encoders know it."""
        with naming("radio"):
            return RadioSettings(**self.model_dump())


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
        "radio": {"interval_s": 2.0, "spreading_factor": 7, "bandwidth_hz": 500_000},
        "status": "surveyed",
        "road": "Parkview Campus Drive",
    }
]


class CerpmIn(Headed, MarkerIn):
    """A chip-enabled raised pavement marker to register."""

    model_config = ConfigDict(json_schema_extra={"examples": CERPM_EXAMPLES})

    family: Literal["cerpm"]
    position: PositionIn
    number: Annotated[int, Field(strict=True, ge=1, le=MAX_NUMBER)] | None = Field(
        None, description="Within the agency; the next free one if left out."
    )
    side: Side = Field("unknown", description="Boundary of the lane that it stands on, in the direction of travel.")
    speed_limit: SpeedLimitIn | None = Field(None, description="As it is posted; nothing where none is.")
    dev_eui: DevEui | None = Field(None, description="LoRaWAN DevEUI, where the marker joins a network.")
    radio: RadioIn = Field(default_factory=lambda: RadioIn())

    def new(self) -> NewCerpm:
        """The marker as the use cases know it."""
        return NewCerpm(
            position=self.position,
            number=self.number,
            side=LaneSide[self.side.upper()],
            speed_limit=SpeedLimit(self.speed_limit.value, self.speed_limit.unit) if self.speed_limit else None,
            radio=self.radio.settings(),
            dev_eui=self.dev_eui.lower() if self.dev_eui is not None else None,
            heading_deg=self.heading_deg,
            **self.shared(),
        )


class CerpmChange(FamilyChange):
    """Members of a change that CERPMs have."""

    side: Side = Field("unknown", description="Of a CERPM.")
    speed_limit: SpeedLimitIn | None = Field(None, description="Of a CERPM.")
    dev_eui: DevEui | None = Field(None, description="Of a CERPM.")
    radio: RadioIn = Field(default_factory=lambda: RadioIn(), description="Of a CERPM; replaces the whole of the old.")

    def spec_changes(self, named: set[str]) -> dict[str, Any]:
        """Side, speed limit, DevEUI and radio where the request names them."""
        limit = self.speed_limit
        spec: dict[str, Any] = {
            "side": self.side,
            "speed_limit": None if limit is None else limit.model_dump(mode="json"),
            "dev_eui": self.dev_eui.lower() if self.dev_eui is not None else None,
        }
        spec = {name: value for name, value in spec.items() if name in named}
        return {**spec, "radio": asdict(self.radio.settings())} if "radio" in named else spec
