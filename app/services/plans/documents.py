"""Documents of alignments and plans, as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field
from typing_extensions import TypedDict

from app.planning.plan import LeftOut
from app.planning.proof.report import DriveResult, MarkerProof, ReadRate
from app.planning.radio_checks import RadioCheck, RadioPlan, Recommendation, check_radio, recommend_settings
from app.radio.reception import RoadReception
from app.radio.settings import RadioSettings
from app.services.documents import document_of

# === What the API returns about a radio plan.


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


class RecommendationDocument(TypedDict):
    """The best lawful settings that were found."""

    sentence: str
    reaches: Annotated[bool, Field(description="Whether the probability asked for is reached.")]
    radio: Annotated[RadioSettings | None, Field(description="Null where nothing is lawful.")]
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
        "radio": advice.settings,
        "receiver_channels": advice.receiver_channels,
        "read_probability": round(advice.read_probability, 6),
        "battery_days": round(advice.battery_days, 1),
    }


# === Documents of proofs of plans, as clients see them.


class ProofTermsDocument(TypedDict):
    """What was driven, and how."""

    drives: int
    seed: int
    conditions: list[str]
    cameras: list[str] | None
    speed_share: float
    lost_share: float
    clearance_m: float
    survey_rmse_m: float
    max_markers_per_drive: int
    max_sections_per_drive: int
    weak_below: float


class WeakMarker(TypedDict):
    """A marker that is read too rarely, and the most frequent cause."""

    number: int
    kind: str
    lane: str
    chainage_m: float
    passes: int
    read: int
    rate: float | None
    """Null if it was missing in every pass."""
    cause: str | None


class ProofFigures(TypedDict):
    """What a proof found, in short."""

    passed: bool
    """No reading was wrong. Weak markers do not count."""
    units: int
    rates: list[ReadRate]
    markers: int
    """Markers that were driven over."""
    weak: int
    wrong: int
    weak_markers: list[WeakMarker]
    """The first 100; the report has all."""
    terms: ProofTermsDocument


class ProofSummary(ProofFigures):
    """The latest proof of a plan as it is."""

    job_id: str
    at: datetime
    """When it ended."""


class WrongReadingDocument(TypedDict):
    """Something that was read and is not there."""

    drive: int
    marker: int
    """That was being passed; 0 beside line magnets."""
    text: str


class ProofDocument(TypedDict):
    """The report of a proof."""

    format: str
    plan: str
    terms: ProofTermsDocument
    complete: bool
    note: str
    rates: list[ReadRate]
    drives: list[DriveResult]
    weak: list[int]
    wrong: list[WrongReadingDocument]
    markers: list[MarkerProof]


# === Documents of alignments and plans, as clients see them.


PlanStatus = Literal["draft", "checked", "proved", "approved", "committed", "built", "surveyed"]


class LaneSummary(TypedDict):
    """A lane of an alignment."""

    name: str
    road: str
    length_m: float
    width_m: list[float]
    """Least and greatest. [m]"""
    design_speed_kmh: list[float] | None
    """Least and greatest; null if the file states none, then the rules of a plan must. [km/h]"""
    min_radius_m: float | None
    """Of its sharpest bend; null on a straight. [m]"""
    max_grade: float
    left_style: str
    right_style: str


class EventSummary(TypedDict):
    """Something on a lane that vehicles must know ahead of time."""

    kind: str
    lane: str
    chainage_m: float
    value: float | str | None


class RoadSummary(TypedDict):
    """What was read of a road."""

    format: str
    lanes: list[LaneSummary]
    events: list[EventSummary]
    areas: int
    lane_length_m: float
    extent_deg: list[float]
    """West, south, east, north; west is greater than east across the antimeridian. [deg]"""
    crs: str
    realization: str | None
    surveyed: bool
    localization_grade: str
    warnings: list[str]


class AlignmentDocument(RoadSummary):
    """A road that plans are made for."""

    id: str
    name: str
    declaration: dict[str, object]
    source_sha256: str
    version: int
    created_at: datetime
    updated_at: datetime


class LaneProfile(TypedDict):
    """A lane along its way; the lists without `line` have one value for each of its samples."""

    name: str
    road: str
    length_m: float
    left_style: str
    right_style: str
    line: list[list[float]]
    """Centre line as longitude and latitude, within 2 cm. [deg]"""
    chainage_m: list[float]
    station_m: list[float]
    """As signs and drawings show it, after the station equations. [m]"""
    curvature_per_m: list[float]
    """The greatest between the neighbouring samples, left positive. [1/m]"""
    grade: list[float]
    design_speed_kmh: list[float] | None
    lon_deg: list[float]
    lat_deg: list[float]


class ProfileEvent(EventSummary):
    """An event with its position."""

    lon_deg: float
    lat_deg: float


class ProfileArea(TypedDict):
    """An area in which nothing is installed."""

    kind: str
    ring_deg: list[list[float]]


class AlignmentProfile(TypedDict):
    """The lanes of an alignment to draw: their lines, stations and curvature."""

    lanes: list[LaneProfile]
    events: list[ProfileEvent]
    areas: list[ProfileArea]


class AlignmentPage(TypedDict):
    """A page of alignments."""

    items: list[AlignmentDocument]


class FindingDocument(TypedDict):
    """One check of a plan, at its worst place."""

    name: str
    figure: float
    relation: str
    limit: float
    unit: str
    source: str
    verdict: str
    sentence: str
    lane: str | None
    station_m: float | None
    lon_deg: float | None
    lat_deg: float | None


class PlanSummary(TypedDict):
    """What was placed, and what the checks found."""

    counts: dict[str, int]
    lane_length_m: float
    verdict: str
    """The worst of all findings."""
    findings: list[FindingDocument]
    left_out: list[LeftOut]
    left_out_count: int
    cost: float
    cost_complete: bool
    currency: str
    codebook_entries: int


class CheckFigure(TypedDict):
    """A check of a plan in a list."""

    name: str
    figure: float
    relation: str
    limit: float
    unit: str
    verdict: str


class PreviewedMarker(TypedDict):
    """A marker that would be placed."""

    number: int
    family: str
    purpose: str
    lane: str
    chainage_m: float
    station_m: float
    offset_m: float
    lon_deg: float
    lat_deg: float


class PlanPreview(PlanSummary):
    """What rules would place, what the checks find, and what it costs. Nothing is stored, no code is assigned."""

    markers: list[PreviewedMarker]


class ReadRules(TypedDict):
    """Rules of a file, as plans take them: what the file leaves out is left out."""

    rules: dict[str, object]


class PlanOverview(TypedDict):
    """A plan in a list, so that variants stand side by side."""

    id: str
    name: str
    alignment_id: str
    status: PlanStatus
    counts: dict[str, int]
    lane_length_m: float
    left_out_count: int
    verdict: str
    checks: list[CheckFigure]
    """Each at its worst place."""
    cost: float
    cost_complete: bool
    currency: str
    version: int
    created_at: datetime
    updated_at: datetime


class PlanDocument(PlanSummary):
    """A plan with its rules and its findings."""

    id: str
    name: str
    alignment_id: str
    status: PlanStatus
    rules: dict[str, object]
    proof: ProofSummary | None
    """Null if it was not proved since its markers were placed."""
    author: str
    approver: str | None
    version: int
    created_at: datetime
    updated_at: datetime


class PlanPage(TypedDict):
    """A page of plans."""

    items: list[PlanOverview]


class PlanVersionDocument(TypedDict):
    """A version of a plan."""

    version: int
    at: datetime
    who: str
    why: str | None
    plan: dict[str, object]


class PlanVersionPage(TypedDict):
    """A page of a plan's history."""

    items: list[PlanVersionDocument]


class CommittedPlan(PlanDocument):
    """A plan whose markers are in the registry."""

    markers: int
    """Markers of the registry that it became: a line of magnets is one."""
    uncommitted: int
    """Planned magnets that stand alone on their line and became no marker."""


class BuiltMarker(TypedDict):
    """A marker of a plan beside what was built."""

    number: int
    marker_id: str
    status: str
    along_m: float
    """Built before (negative) or behind its planned place, in the direction of travel. [m]"""
    across_m: float
    """Built left (positive) of its planned place. [m]"""
    heading_deg: float | None
    """Built heading less the planned one. [deg]"""
    in_tolerance: bool


class CheckComparison(TypedDict):
    """A check of a plan beside the same check of what was built."""

    name: str
    planned: FindingDocument | None
    """As the plan was approved; null if the check did not apply then."""
    built: FindingDocument | None
    """With surveyed positions in place of planned ones, and the other markers that are in the registry by now."""
    verdict_changed: bool


class AsBuiltDocument(TypedDict):
    """A plan beside what was built."""

    surveyed: int
    not_surveyed: int
    out_of_tolerance: int
    tolerances: dict[str, float]
    rms_along_m: float | None
    rms_across_m: float | None
    markers: list[BuiltMarker]
    """Those out of tolerance first, then by the size of their residuals; at most 1,000."""
    checks: list[CheckComparison]
    """Empty before the first marker is surveyed."""


# === Use case on radio plans: check one, and recommend settings. Nothing is stored.


def check_plan(plan: RadioPlan, *, recommend: bool) -> RadioCheckDocument:
    """The result of checking a radio plan, with recommended settings if asked for.

    Raises
    ------
    InvalidParameter
        More markers are in range of one receiver than a check allows.
    """
    advice = recommend_settings(plan) if recommend else None
    return radio_check_document(check_radio(plan), advice)
