"""Documents of alignments and plans, as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from typing_extensions import TypedDict

from app.formats.alignments.geometry import EventKind
from app.markers.reading import Verdict
from app.planning.alignment import RoadEvent
from app.planning.plan import LeftOut, PlanFinding
from app.planning.proof import ProofTerms, ReadRate


class WeakMarker(TypedDict):
    """A marker that is read too rarely, and the most frequent cause."""

    number: int
    kind: str
    lane: str
    chainage_m: float
    station_m: float
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
    terms: ProofTerms


class ProofSummary(ProofFigures):
    """The latest proof of a plan as it is."""

    job_id: str
    at: datetime
    """When it ended."""


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


class RoadSummary(TypedDict):
    """What was read of a road."""

    format: str
    lanes: list[LaneSummary]
    events: list[RoadEvent]
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


class ProfileEvent(TypedDict):
    """An event with its position."""

    kind: EventKind
    lane: str
    chainage_m: float
    value: float | str | None
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


class PlanSummary(TypedDict):
    """What was placed, and what the checks found."""

    counts: dict[str, int]
    lane_length_m: float
    verdict: Verdict
    """The worst of all findings."""
    findings: list[PlanFinding]
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
    verdict: Verdict


class PreviewedMarker(TypedDict):
    """A marker that would be placed."""

    number: int
    family: str
    purpose: str
    lane: str
    chainage_m: float
    station_m: float
    """As signs and drawings show it, after the station equations. [m]"""
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
    verdict: Verdict
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


class MadePlanResult(TypedDict):
    """A plan that a job has made."""

    plan_version: int


class ProofResult(TypedDict):
    """A proof in short; the report is a resource of the plan."""

    plan_version: int
    """Version of the plan that was proved."""
    outdated: bool
    """The plan was changed while it was proved: the result is not its proof."""
    passed: bool
    weak: int
    wrong: int


class PackageResult(TypedDict):
    """A package in short."""

    plan_version: int
    """Version of the plan that was packed."""
    size_bytes: int
    sha256: str
    files: int


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
    planned: PlanFinding | None
    """As the plan was approved; null if the check did not apply then."""
    built: PlanFinding | None
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
