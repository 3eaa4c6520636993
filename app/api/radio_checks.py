"""/v1/radio-checks: whether markers along a road can be read in time, and lawfully."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from fastapi import APIRouter, Response
from pydantic import BaseModel, ConfigDict, Field, JsonValue

from app.api.dependencies import Caller, Number, Whole, json_response
from app.api.problems import problem_responses
from app.api.schemas_cerpms import Flag, RadioIn
from app.api.strict_json import StrictRoute
from app.encoders.cerpm.battery import Battery
from app.encoders.cerpm.collisions import Receiver
from app.encoders.cerpm.hearing import MAX_MARKERS, RoadMarkers
from app.encoders.cerpm.lorawan import Region
from app.encoders.cerpm.radio import PreviewRule, RadioCheck, RadioPlan, check_radio
from app.encoders.cerpm.recommend import Recommendation, recommend_settings
from app.services.positions import naming

router = APIRouter(prefix="/v1/radio-checks", tags=["cerpms"], route_class=StrictRoute)

_EXAMPLES: list[JsonValue] = [
    {"radio": {"spreading_factor": 7, "bandwidth_hz": 500_000, "interval_s": 2.0}, "design_speed_mps": 13.4},
    {
        "region": "EU868",
        "radio": {"frequency_hz": 868_300_000, "bandwidth_hz": 125_000, "interval_s": 10.0, "power_dbm": 11.0},
        "road": {"spacing_m": 24.384, "sides": 1},
        "recommend": True,
    },
]


class EvenRoadIn(BaseModel):
    """A long road with a marker every so far."""

    model_config = ConfigDict(extra="forbid")

    spacing_m: Number = Field(12.192, description="1 to 1,000. [m]")
    sides: Whole = Field(2, description="Sides of the lane with markers: 1 or 2.")
    lane_width_m: Number = Field(3.6, description="1 to 20. [m]")


class PlacedMarkersIn(BaseModel):
    """Where markers stand along a road."""

    model_config = ConfigDict(extra="forbid")

    chainage_m: list[Number] = Field(min_length=1, max_length=MAX_MARKERS, description="Along the road. [m]")
    offset_m: list[Number] = Field(
        min_length=1, max_length=MAX_MARKERS, description="From the receiver's path, left positive. [m]"
    )


class PreviewIn(BaseModel):
    """How far ahead a marker must have been read: by default where the vehicle stops, and at least 31 m."""

    model_config = ConfigDict(extra="forbid")

    distance_m: Number | None = Field(None, description="Fixed, 1 to 2,000. [m]")
    reaction_s: Number = Field(2.5, description="0 to 10. [s]")
    deceleration_mps2: Number = Field(3.4, description="0.5 to 10. [m/s2]")


class ReceiverIn(BaseModel):
    """The vehicle's receiver."""

    model_config = ConfigDict(extra="forbid")

    channels: Whole = Field(1, description="Channels heard at once.")
    sensitivity_dbm: Number | None = Field(None, description="The chip's own if left out. [dBm]")
    capture_db: Number | None = Field(6.0, description="By which a packet outdoes others; null for none. [dB]")


class BatteryIn(BaseModel):
    """The marker's battery."""

    model_config = ConfigDict(extra="forbid")

    capacity_mah: Number = Field(1000.0, description="[mAh]")
    usable_share: Number = Field(0.8, description="Of the capacity.")
    sleep_ma: Number = Field(0.8, description="Between transmissions; of the paper's board as it is sold. [mA]")


class RadioCheckIn(BaseModel):
    """A plan to check."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": _EXAMPLES})

    radio: RadioIn = Field(default_factory=RadioIn)
    region: Region = Region.US915
    road: EvenRoadIn = Field(default_factory=lambda: EvenRoadIn())
    markers: PlacedMarkersIn | None = Field(None, description="In place of `road`: where each stands.")
    design_speed_mps: Number = Field(13.4, description="0.5 to 70. [m/s]")
    preview: PreviewIn = Field(default_factory=lambda: PreviewIn())
    receiver: ReceiverIn = Field(default_factory=lambda: ReceiverIn())
    battery: BatteryIn = Field(default_factory=lambda: BatteryIn())
    least_probability: Number = Field(0.99, description="That a marker is read in time, 0.5 to 0.9999.")
    least_battery_days: Number = Field(365.0, description="0 to 36,500. [day]")
    recommend: Flag = Field(False, description="Also search for lawful settings that reach it; takes a second or two.")

    def plan(self) -> RadioPlan:
        """The plan as the encoders know it."""
        settings = self.radio.given()
        placed = self.markers
        markers = None if placed is None else RoadMarkers(placed.chainage_m, placed.offset_m)  # type: ignore[arg-type]
        with naming("receiver"):
            receiver = Receiver(**self.receiver.model_dump())
        with naming("battery"):
            battery = Battery(**self.battery.model_dump())
        return RadioPlan(
            settings,
            self.region,
            **self.road.model_dump(),
            markers=markers,
            design_speed_mps=self.design_speed_mps,
            preview=PreviewRule(**self.preview.model_dump()),
            receiver=receiver,
            battery=battery,
            least_probability=self.least_probability,
            least_battery_days=self.least_battery_days,
        )


class FindingOut(BaseModel):
    """One check: its figure, the limit, where that comes from, and what follows."""

    name: str
    verdict: str
    figure: float
    relation: str
    limit: float
    unit: str
    source: str
    sentence: str


class RadioCheckOut(BaseModel):
    """What comes of a radio plan."""

    verdict: str
    time_on_air_s: float
    range_m: float
    preview_m: float
    packet_success: float
    read_probability: float
    battery_days: float
    checks: list[FindingOut]
    road: dict[str, list[float | None]]
    recommendation: dict[str, Any] | None


@router.post("", response_class=Response, responses={200: {"model": RadioCheckOut}, **problem_responses()})
def post_radio_check(wanted: RadioCheckIn, caller: Caller) -> Response:
    """Check radios of CERPMs on a road: law, link, collisions, reading in time, battery. Nothing is stored."""
    plan = wanted.plan()
    found = check_radio(plan)
    advice = recommend_settings(plan) if wanted.recommend else None
    return json_response(_document(found, advice))


def _document(check: RadioCheck, advice: Recommendation | None) -> dict[str, Any]:
    road = check.road
    return {
        "verdict": str(check.verdict),
        "time_on_air_s": round(check.time_on_air_s, 6),
        "range_m": round(check.range_m, 1),
        "preview_m": round(check.preview_m, 1),
        "packet_success": round(check.packet_success, 6),
        "read_probability": round(check.read_probability, 6),
        "battery_days": round(check.battery_days, 1),
        "checks": [{**asdict(finding), "verdict": str(finding.verdict)} for finding in check.checks],
        "road": {
            "station_m": road.station_m.round(2).tolist(),
            "markers_in_range": road.heard.tolist(),
            "packet_success_mean": road.success_mean.round(5).tolist(),
            "packet_success_least": road.success_least.round(5).tolist(),
        },
        "recommendation": None if advice is None else _advice(advice),
    }


def _advice(advice: Recommendation) -> dict[str, Any]:
    return {
        "sentence": advice.sentence,
        "reaches": advice.reaches,
        "radio": None if advice.settings is None else asdict(advice.settings),
        "receiver_channels": advice.receiver_channels,
        "read_probability": round(advice.read_probability, 6),
        "battery_days": round(advice.battery_days, 1),
    }
