"""Routes of marker health: the work list, and the tests of a marker."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import Depends, Path, Query, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import ConfigDict, Field

from app.api.http.dependencies import AfterLink, Caller, MarkerId, PageSize, SentVersion, use_case
from app.api.http.permissions import READERS, SURVEYORS
from app.api.http.problems import problem_responses
from app.api.http.responses import cursor_of, document_response, file_response, json_response, page_response
from app.api.http.routes import Router
from app.families import FamilyName
from app.inputs import Identifier, StrictModel, Text
from app.registry.health import ItemFilter
from app.services.health.maintenance import HealthDocument, ItemStatus, MaintenanceItem, MaintenancePage, Outcome, What
from app.services.health.maintenance import Maintenance as MaintenanceService
from app.services.markers.searches import parse_box
from app.services.request_work import counted_steps

# === /v1/maintenance: faults of markers that vehicles show, and the decisions of people on them.


router = Router("/v1", "marker health")

MEDIA_TYPES = {"geojson": "application/geo+json", "csv": "text/csv"}
ItemId = Annotated[Identifier, Path(description="Id of the item.")]
Maintenance = Annotated[MaintenanceService, use_case(lambda cases: cases.maintenance)]


async def get_item_filter(
    road: Annotated[Text | None, Query(min_length=1, max_length=200)] = None,
    what: What | None = None,
    status: Annotated[ItemStatus | None, Query(description="Of the item; without it, all.")] = None,
    family: FamilyName | None = None,
    bbox: Annotated[Text | None, Query(max_length=200, examples=["114.1,22.2,114.3,22.4"])] = None,
    min_priority: Annotated[float | None, Query(ge=0.0, le=1.0, allow_inf_nan=False)] = None,
    marker_id: Annotated[Identifier | None, Query(description="Id of a marker.")] = None,
) -> ItemFilter:
    """The filter in a query.

    Raises
    ------
    InvalidParameter
        A part cannot be read or is out of range.
    """
    box = parse_box(bbox) if bbox is not None else None
    return ItemFilter(road, what, status, family, box, min_priority, marker_id)


Filtered = Annotated[ItemFilter, Depends(get_item_filter)]


class ApprovalIn(StrictModel):
    """What becomes of the marker of an item."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"outcome": "suspect", "note": "seen by the patrol"}, {"outcome": "none"}]},
    )

    outcome: Outcome = Field(
        description="suspect or retired: the marker's new status. resurvey: suspect until it is surveyed again. "
        "none: the marker stays as it is."
    )
    note: Text | None = Field(default=None, min_length=1, max_length=300)


class RejectionIn(StrictModel):
    """Why an item of the work list or a damage report is rejected."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"reason": "the marker was surveyed and is in its place"}]}
    )

    reason: Text = Field(min_length=1, max_length=300)


@router.get("/maintenance", READERS, responses=document_response(MaintenancePage))
def list_maintenance(
    request: Request,
    caller: Caller,
    maintenance: Maintenance,
    filtered: Filtered,
    limit: PageSize = 100,
    after: AfterLink = None,
) -> Response:
    """List the work list of suspected faults.

    The most urgent first; decided ones with `status`.

    Nothing changes a marker until a person approves it.
    """
    page, last = maintenance.page(caller, filtered, after=cursor_of(after), limit=limit)
    return page_response(request, page, after=last)


@router.get("/maintenance.{form}", READERS, responses={**file_response(MEDIA_TYPES.values()), **problem_responses()})
def get_maintenance_file(
    form: Literal["geojson", "csv"], caller: Caller, maintenance: Maintenance, filtered: Filtered
) -> Response:
    """Download the work list as GeoJSON or as a table.

    All items of a filter, the most urgent first.
    """
    headers = {"Content-Disposition": f'attachment; filename="maintenance.{form}"'}
    parts = counted_steps(maintenance.stream(caller, form, filtered))
    return StreamingResponse(parts, headers=headers, media_type=MEDIA_TYPES[form])


@router.get("/maintenance/{item_id}", READERS, responses=document_response(MaintenanceItem, 404))
def get_maintenance_item(item_id: ItemId, caller: Caller, maintenance: Maintenance) -> Response:
    """Get an item of the work list.

    With the evidence and the links to its pictures.
    """
    return json_response(maintenance.get(caller, item_id))


@router.post("/maintenance/{item_id}/approve", SURVEYORS, responses=document_response(MaintenanceItem, 404, 409, 412))
def approve_maintenance_item(
    item_id: ItemId, approval: ApprovalIn, caller: Caller, maintenance: Maintenance, version: SentVersion
) -> Response:
    """Approve an item of the work list.

    Its marker is changed as chosen: a version in its history and an entry of the audit log.

    If-Match names the version of the marker that the decision is based on; without it, any version is changed.
    """
    return json_response(maintenance.approve(caller, item_id, approval.outcome, approval.note, version))


@router.post("/maintenance/{item_id}/reject", SURVEYORS, responses=document_response(MaintenanceItem, 404, 409))
def reject_maintenance_item(
    item_id: ItemId, rejection: RejectionIn, caller: Caller, maintenance: Maintenance
) -> Response:
    """Reject an item of the work list.

    With a reason. Its test starts again.
    """
    return json_response(maintenance.reject(caller, item_id, rejection.reason))


@router.get("/markers/{marker_id}/health", READERS, responses=document_response(HealthDocument, 404))
def get_marker_health(marker_id: MarkerId, caller: Caller, maintenance: Maintenance) -> Response:
    """Get the health of a marker.

    Its tests: likelihood ratios of faults, the limit at which one is suspected, and its record.
    """
    return json_response(maintenance.health(caller, marker_id))
