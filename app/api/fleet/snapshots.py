"""/v1/snapshots: what vehicles take along."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response

from app.api.http.dependencies import Caller, Text, use_cases
from app.api.http.problems import problem_responses
from app.api.http.responses import document_response, file_response, json_response
from app.api.http.strict_json import StrictRoute
from app.markers.snapshot import MEDIA_TYPE
from app.services.fleet.documents import TrustDocument, trust_document
from app.services.fleet.snapshots import MAX_HOURS
from app.services.fleet.snapshots import Snapshots as SnapshotsService
from app.services.markers.search_boxes import parse_box

router = APIRouter(prefix="/v1/snapshots", tags=["snapshots"], route_class=StrictRoute)
Snapshots = Annotated[SnapshotsService, use_cases("snapshots")]


@router.get("", responses={**file_response([MEDIA_TYPE], "See docs/snapshots.md"), **problem_responses()})
def get_snapshot(
    caller: Caller,
    snapshots: Snapshots,
    bbox: Annotated[Text, Query(max_length=200, examples=["8.3,48.9,8.6,49.1"])],
    hours: Annotated[
        float, Query(gt=0, le=MAX_HOURS, allow_inf_nan=False, description="How long it holds. [h]")
    ] = 24.0,
) -> Response:
    """The markers of an area, signed, for vehicles that decode without a connection; all but the retired ones.

    With the agency's codebooks. Keys of CERPMs are not in it.
    """
    headers = {"Content-Disposition": 'attachment; filename="markers.waymark"', "Cache-Control": "private, no-store"}
    return Response(snapshots.make(caller, parse_box(bbox), hours), headers=headers, media_type=MEDIA_TYPE)


@router.get("/trust", responses=document_response(TrustDocument))
def get_trust(caller: Caller, snapshots: Snapshots) -> Response:
    """What the agency's snapshots are verified with. The operator installs it in a vehicle over a trusted channel."""
    return json_response(trust_document(snapshots.trust(caller)))
