"""Reprocessings as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field, JsonValue
from typing_extensions import TypedDict

from app.registry.reprocessings import ReprocessedRow, ReprocessingRow
from app.services.error_documents import ErrorDocument
from app.services.reprocessing.compare import Change

State = Literal["running", "ready", "cancelled", "failed", "accepted"]


class ReprocessingSummary(TypedDict):
    """What was decoded again, in numbers of readings, and of uploads that failed."""

    gained: int
    lost: int
    changed: int
    same: int
    failed: int


class ReprocessingLinks(TypedDict):
    """Paths of the reprocessing and of its reports."""

    self: str
    report: str
    csv: str


class ReprocessingDocument(TypedDict):
    """A reprocessing: its results are beside the current ones until it is accepted."""

    id: str
    state: State
    who: str
    criteria: dict[str, JsonValue]
    done: Annotated[int, Field(description="Uploads that were decoded again.")]
    total: int
    shards: Annotated[dict[str, int], Field(description="Number of its jobs by state.")]
    summary: ReprocessingSummary
    created_at: datetime
    accepted_at: datetime | None
    accepted_by: str | None
    links: ReprocessingLinks


class ReprocessingPage(TypedDict):
    """A page of reprocessings, oldest first; the Link header leads to the next one."""

    items: list[ReprocessingDocument]


class ReprocessedDecode(TypedDict):
    """An upload whose readings differ, or that could not be decoded again."""

    decode_id: str
    decoder_before: str | None
    decoder: str | None
    error: ErrorDocument | None
    gained: int
    lost: int
    changed: int
    same: int
    changes: list[Change]


class ReprocessingReport(TypedDict):
    """A page of uploads whose readings differ; the Link header leads to the next one."""

    items: list[ReprocessedDecode]


class DecodeVersion(TypedDict):
    """A result that was current before."""

    reprocessing_id: Annotated[str, Field(description="That replaced it.")]
    decoder: str | None
    finished_at: datetime | None
    replaced_at: datetime
    result: dict[str, JsonValue]


class DecodeVersions(TypedDict):
    """Results of a decode that were current before, newest first."""

    items: list[DecodeVersion]


def reprocessing_document(row: ReprocessingRow, shards: dict[str, int], sums: dict[str, int]) -> ReprocessingDocument:
    """A reprocessing as clients see it."""
    path = f"/v1/reprocessings/{row.id}"
    return {
        "id": row.id,
        "state": state_of(row, shards),
        "who": row.who,
        "criteria": row.criteria,
        "done": sums["done"],
        "total": row.decodes,
        "shards": shards,
        "summary": {
            "gained": sums["gained"],
            "lost": sums["lost"],
            "changed": sums["changed"],
            "same": sums["same"],
            "failed": sums["failed"],
        },
        "created_at": row.created_at,
        "accepted_at": row.accepted_at,
        "accepted_by": row.accepted_by,
        "links": {"self": path, "report": f"{path}/report", "csv": f"{path}/report.csv"},
    }


def state_of(row: ReprocessingRow, shards: dict[str, int]) -> State:
    """The state of a reprocessing, from those of its jobs."""
    if row.accepted_at is not None:
        return "accepted"
    if shards.get("queued") or shards.get("running"):
        return "running"
    if shards.get("cancelled"):
        return "cancelled"
    return "failed" if shards.get("failed") else "ready"


def reprocessed_document(row: ReprocessedRow) -> ReprocessedDecode:
    """An upload that was decoded again as clients see it."""
    names: Any = ReprocessedDecode.__annotations__
    return {name: value for name, value in row._asdict().items() if name in names}  # type: ignore[return-value]
