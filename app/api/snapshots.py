"""/v1/snapshots: what vehicles take along."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import BaseModel, Field

from app.api.dependencies import Caller, Text, json_response
from app.api.marker_filter import parse_box
from app.api.problems import problem_responses
from app.markers.snapshot import MEDIA_TYPE, VERSION
from app.services.snapshots import MAX_HOURS
from app.services.snapshots import Snapshots as SnapshotsService

router = APIRouter(prefix="/v1/snapshots", tags=["snapshots"])


class PublicKeyOut(BaseModel):
    """The key that snapshots are verified with."""

    algorithm: str = Field(examples=["Ed25519"])
    key_id: str = Field(description="First eight bytes of its SHA-256, hexadecimal; every snapshot names it.")
    public_key: str = Field(description="32 bytes, hexadecimal.")
    snapshot_version: int = Field(examples=[VERSION])


async def get_snapshots(request: Request) -> SnapshotsService:
    """Use cases on snapshots."""
    service: SnapshotsService = request.app.state.snapshots
    return service


Snapshots = Annotated[SnapshotsService, Depends(get_snapshots)]


@router.get(
    "",
    response_class=Response,
    responses={200: {"content": {MEDIA_TYPE: {}}, "description": "See docs/snapshots.md"}, **problem_responses()},
)
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


@router.get("/public-key", response_class=Response, responses={200: {"model": PublicKeyOut}, **problem_responses()})
def get_public_key(snapshots: Snapshots) -> Response:
    """What this server's snapshots are verified with. A vehicle gets it once, over a channel that it trusts."""
    key = snapshots.public_key()
    document = {
        "algorithm": "Ed25519",
        "key_id": key.key_id.hex(),
        "public_key": key.public_key.hex(),
        "snapshot_version": VERSION,
    }
    return json_response(document)
