"""The work list and the state of a marker's tests as clients see them."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Literal, NotRequired

from typing_extensions import TypedDict

from app.health.rules import Fault
from app.registry.health import HealthRow
from app.registry.maintenance import ItemRow
from app.services.documents import document_of

ItemStatus = Literal["open", "approved", "dismissed"]
Outcome = Literal["suspect", "retired", "resurvey", "none"]
What = Literal[
    "missing", "moved", "cloned", "wrong-way", "fading", "unregistered", "wrong-way-driver", "reported"
]  # fmt: skip


class UploadLink(TypedDict):
    """An upload that the evidence is of, with the link to its picture: the annotated frame, or the plot."""

    decode_id: str
    at: datetime
    picture: str


class ReportLink(TypedDict):
    """A damage report that was accepted into an item."""

    report_id: str
    kind: str
    at: datetime


class ItemEvidence(TypedDict):
    """Why a fault is suspected. An item that people reported has `reports` instead of figures.

    The likelihood ratio has passed the limit, both as natural logarithms. A healthy marker reaches this ratio with
    `false_alarm_probability` at most. `offset_m` is the estimated displacement of a marker that has moved;
    `elsewhere_lon_deg` and `elsewhere_lat_deg` are where a vehicle was that read the marker far from its place.
    """

    limit: NotRequired[float]
    false_alarm_probability: NotRequired[float]
    month_passes: NotRequired[float]
    offset_m: NotRequired[float]
    offset_east_m: NotRequired[float]
    offset_north_m: NotRequired[float]
    elsewhere_lon_deg: NotRequired[float]
    elsewhere_lat_deg: NotRequired[float]
    uploads: list[UploadLink]
    reports: NotRequired[list[ReportLink]]


class MaintenanceItem(TypedDict):
    """A fault that is suspected, and what a person decided."""

    id: str
    what: What
    status: ItemStatus
    outcome: Outcome | None
    priority: float
    marker_id: str | None
    family: str
    code: str | None
    road: str | None
    measure_m: float | None
    lon_deg: float
    lat_deg: float
    height_m: float | None
    ratio: float
    vehicles: int
    passes: int
    first_at: datetime
    last_at: datetime
    evidence: ItemEvidence
    note: str | None
    decided_by: str | None
    decided_at: datetime | None
    version: int
    created_at: datetime
    updated_at: datetime


class MaintenancePage(TypedDict):
    """A page of the work list, the most urgent item first."""

    items: list[MaintenanceItem]


class HealthDocument(TypedDict):
    """Tests of a marker: logarithms of the likelihood ratios of the faults that have evidence, of the limits from which
    each fault is suspected, and its record.

    `quality` is the mean grade or signal less the usual one, in standard deviations of a pass.
    """

    marker_id: str
    passes: int
    reads: int
    last_at: datetime | None
    read_at: datetime | None
    ratios: dict[str, float]
    limits: dict[str, float]
    quality: float | None


def item_document(row: ItemRow) -> MaintenanceItem:
    """An item as clients see it."""
    return document_of(MaintenanceItem, row, status=row.state)


def health_document(marker_id: str, row: HealthRow | None, limits: Mapping[Fault, float]) -> HealthDocument:
    """A marker's tests as clients see them."""
    shown = {str(fault): round(limit, 3) for fault, limit in limits.items()}
    if row is None:
        return {
            "marker_id": marker_id, "passes": 0, "reads": 0, "last_at": None, "read_at": None, "ratios": {},
            "limits": shown, "quality": None,
        }  # fmt: skip
    return {
        "marker_id": marker_id,
        "passes": row.passes,
        "reads": row.reads,
        "last_at": row.last_at,
        "read_at": row.read_at,
        "ratios": {fault: round(ratio, 3) for fault, ratio in row.ratios.items()},
        "limits": shown,
        "quality": None if row.quality is None else round(row.quality, 3),
    }
