"""/v1/radio-checks: whether markers along a road can be read in time, and lawfully."""

from __future__ import annotations

from fastapi import Response
from pydantic import ConfigDict, Field, JsonValue

from app.api.http.dependencies import Caller, Number, Whole
from app.api.http.permissions import READERS
from app.api.http.responses import document_response, json_response
from app.api.http.routes import Router
from app.errors import naming
from app.families.documents import Flag, StrictModel
from app.planning.radio_checks import PreviewRule, RadioPlan
from app.radio.reception import MAX_MARKERS, Receiver, RoadMarkers
from app.radio.settings import Battery, RadioSettings, Region
from app.services.plans.documents import RadioCheckDocument, check_plan

router = Router("/v1/radio-checks", "cerpms")

_EXAMPLES: list[JsonValue] = [
    {"radio": {"spreading_factor": 7, "bandwidth_hz": 500_000, "interval_s": 2.0}, "design_speed_m_s": 13.4},
    {
        "region": "EU868",
        "radio": {"frequency_hz": 868_300_000, "bandwidth_hz": 125_000, "interval_s": 10.0, "power_dbm": 11.0},
        "road": {"spacing_m": 24.384, "sides": 1},
        "recommend": True,
    },
]


class EvenRoadIn(StrictModel):
    """A long road with a marker every so far."""

    spacing_m: Number = Field(12.192, description="1 to 1,000. [m]")
    sides: Whole = Field(2, description="Sides of the lane with markers: 1 or 2.")
    lane_width_m: Number = Field(3.6, description="1 to 20. [m]")


class PlacedMarkersIn(StrictModel):
    """Where markers stand along a road."""

    chainage_m: list[Number] = Field(min_length=1, max_length=MAX_MARKERS, description="Along the road. [m]")
    offset_m: list[Number] = Field(
        min_length=1, max_length=MAX_MARKERS, description="From the receiver's path, left positive. [m]"
    )


class PreviewIn(StrictModel):
    """How far ahead a marker must have been read: by default where the vehicle stops, and at least 31 m."""

    distance_m: Number | None = Field(None, description="Fixed, 1 to 2,000. [m]")
    reaction_s: Number = Field(2.5, description="0 to 10. [s]")
    deceleration_m_s2: Number = Field(3.4, description="0.5 to 10. [m/s2]")


class ReceiverIn(StrictModel):
    """The vehicle's receiver."""

    channels: Whole = Field(1, description="Channels received at once.")
    sensitivity_dbm: Number | None = Field(None, description="The chip's own if left out. [dBm]")
    capture_db: Number | None = Field(6.0, description="By which a packet outdoes others; null for none. [dB]")


class BatteryIn(StrictModel):
    """The marker's battery."""

    capacity_mah: Number = Field(1000.0, description="[mAh]")
    usable_share: Number = Field(0.8, description="Of the capacity.")
    sleep_ma: Number = Field(0.8, description="Between transmissions; of the paper's board as it is sold. [mA]")


class RadioCheckIn(StrictModel):
    """A plan to check."""

    model_config = ConfigDict(json_schema_extra={"examples": _EXAMPLES})

    radio: RadioSettings = Field(default_factory=RadioSettings)
    region: Region = Region.US915
    road: EvenRoadIn = Field(default_factory=lambda: EvenRoadIn())
    markers: PlacedMarkersIn | None = Field(None, description="In place of `road`: where each is.")
    design_speed_m_s: Number = Field(13.4, description="0.5 to 70. [m/s]")
    preview: PreviewIn = Field(default_factory=lambda: PreviewIn())
    receiver: ReceiverIn = Field(default_factory=lambda: ReceiverIn())
    battery: BatteryIn = Field(default_factory=lambda: BatteryIn())
    min_probability: Number = Field(0.99, description="That a marker is read in time, 0.5 to 0.9999.")
    min_battery_days: Number = Field(365.0, description="0 to 36,500. [day]")
    recommend: Flag = Field(False, description="Also search for lawful settings that reach it; takes a second or two.")

    def plan(self) -> RadioPlan:
        """The plan as `app.planning` defines it."""
        placed = self.markers
        markers = None if placed is None else RoadMarkers(placed.chainage_m, placed.offset_m)  # type: ignore[arg-type]
        with naming("receiver"):
            receiver = Receiver(**self.receiver.model_dump())
        with naming("battery"):
            battery = Battery(**self.battery.model_dump())
        return RadioPlan(
            self.radio,
            self.region,
            **self.road.model_dump(),
            markers=markers,
            design_speed_m_s=self.design_speed_m_s,
            preview=PreviewRule(**self.preview.model_dump()),
            receiver=receiver,
            battery=battery,
            min_probability=self.min_probability,
            min_battery_days=self.min_battery_days,
        )


@router.post("", READERS, expensive=True, responses=document_response(RadioCheckDocument))
def post_radio_check(wanted: RadioCheckIn, caller: Caller) -> Response:
    """Check the radios of CERPMs on a road.

    Law, link, collisions, reading in time, battery. Nothing is stored.
    """
    return json_response(check_plan(wanted.plan(), recommend=wanted.recommend))
