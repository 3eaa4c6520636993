"""What the API returns about a radio plan."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from typing_extensions import TypedDict

from app.families.cerpm.documents import RadioDocument
from app.planning.radio_checks import RadioCheck
from app.planning.radio_recommendation import Recommendation
from app.radio.reception import RoadReception
from app.services.documents import document_of


class RadioFindingDocument(TypedDict):
    """One check: its figure, the limit, where that comes from, and what follows."""

    name: str
    verdict: str
    figure: float
    relation: Literal[">=", "<="]
    limit: float
    unit: str
    source: str
    sentence: str


class RoadReceptionDocument(TypedDict):
    """Reception at points along the road; null where no marker is in range."""

    station_m: list[float]
    markers_in_range: list[int]
    packet_success_mean: list[float | None]
    packet_success_min: list[float | None]


class RadioSettingsDocument(RadioDocument):
    """Settings of a marker's radio."""


class RecommendationDocument(TypedDict):
    """The best lawful settings that were found."""

    sentence: str
    reaches: Annotated[bool, Field(description="Whether the probability asked for is reached.")]
    radio: Annotated[RadioSettingsDocument | None, Field(description="Null where nothing is lawful.")]
    receiver_channels: int
    read_probability: float
    battery_days: float


class RadioCheckDocument(TypedDict):
    """The result of checking a radio plan."""

    verdict: str
    time_on_air_s: float
    range_m: float
    preview_m: float
    packet_success: float
    read_probability: float
    battery_days: float
    checks: list[RadioFindingDocument]
    road: RoadReceptionDocument
    recommendation: RecommendationDocument | None


def radio_check_document(check: RadioCheck, advice: Recommendation | None) -> RadioCheckDocument:
    """A radio check, with the recommendation if one was asked for."""
    return {
        "verdict": str(check.verdict),
        "time_on_air_s": round(check.time_on_air_s, 6),
        "range_m": round(check.range_m, 1),
        "preview_m": round(check.preview_m, 1),
        "packet_success": round(check.packet_success, 6),
        "read_probability": round(check.read_probability, 6),
        "battery_days": round(check.battery_days, 1),
        "checks": [
            document_of(RadioFindingDocument, finding, verdict=str(finding.verdict)) for finding in check.checks
        ],
        "road": _reception(check.road),
        "recommendation": None if advice is None else _recommendation(advice),
    }


def _reception(road: RoadReception) -> RoadReceptionDocument:
    return {
        "station_m": road.station_m.round(2).tolist(),
        "markers_in_range": road.in_range.tolist(),
        "packet_success_mean": road.success_mean.round(5).tolist(),
        "packet_success_min": road.success_min.round(5).tolist(),
    }


def _recommendation(advice: Recommendation) -> RecommendationDocument:
    return {
        "sentence": advice.sentence,
        "reaches": advice.reaches,
        "radio": None if advice.settings is None else document_of(RadioSettingsDocument, advice.settings),
        "receiver_channels": advice.receiver_channels,
        "read_probability": round(advice.read_probability, 6),
        "battery_days": round(advice.battery_days, 1),
    }
