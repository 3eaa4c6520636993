"""Documents of proofs of plans, as clients see them."""

from __future__ import annotations

from datetime import datetime

from typing_extensions import TypedDict


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


class ReadRateDocument(TypedDict):
    """Share of passes in which markers of one kind were read, with its 95 % interval."""

    kind: str
    condition: str
    passes: int
    read: int
    lost: int
    rate: float
    low: float
    high: float


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
    rates: list[ReadRateDocument]
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


class MarkerProofDocument(TypedDict):
    """What the drives show about one marker."""

    number: int
    code: str
    kind: str
    lane: str
    chainage_m: float
    station_m: float
    lon_deg: float
    lat_deg: float
    passes: int
    read: int
    lost: int
    wrong: int
    rate: float | None
    low: float | None
    high: float | None
    fix_rms_m: float | None
    weak: bool
    cause: str | None


class DriveDocument(TypedDict):
    """One drive on one lane."""

    drive: int
    lane: str
    condition: str
    camera: str
    passes: int
    read: int
    fixes: int
    wrong: int
    fix_rms_m: float | None
    fix_worst_m: float | None
    longest_gap_m: float | None
    gap_from_m: float | None
    gap_estimated: bool
    path_rms_m: float | None
    path_worst_m: float | None
    path_worst_at_m: float | None
    path_coverage: float | None
    refusals: list[str]


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
    rates: list[ReadRateDocument]
    drives: list[DriveDocument]
    weak: list[int]
    wrong: list[WrongReadingDocument]
    markers: list[MarkerProofDocument]
