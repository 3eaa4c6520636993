"""Routes on drives."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import Path, Query, Request, Response

from app.api.http.dependencies import Caller, Idempotency, LastId, PageSize, use_case
from app.api.http.permissions import EVERYBODY, UPLOADERS
from app.api.http.problems import problem_responses
from app.api.http.responses import (
    NOT_MODIFIED,
    IfNoneMatch,
    created_response,
    document_response,
    file_response,
    json_response,
    page_response,
)
from app.api.http.routes import Router
from app.inputs import Identifier
from app.registry.jobs import JobState
from app.services.drives.documents import TRACK_FILES, DrivePage, TrackedDriveDocument
from app.services.drives.drives import Drives as DrivesService
from app.services.drives.drives import NewDrive

# === /v1/drives: decodes of one drive become one track.


router = Router("/v1/drives", "drives")

DriveId = Annotated[Identifier, Path(description="Id of the drive.")]
Drives = Annotated[DrivesService, use_case(lambda cases: cases.drives)]


@router.post(
    "",
    UPLOADERS,
    status_code=202,
    responses={
        202: {"model": TrackedDriveDocument, "description": "Queued; Location leads to its progress and its track"},
        **problem_responses(404, 409),
    },
)
def post_drive(drive: NewDrive, caller: Caller, drives: Drives, key: Idempotency) -> Response:
    """Fuse decodes of one drive into one track.

    Fixes of plates and tags, the path of CERPMs, speeds and headings of traces come together on one time base: offsets
    between the sensors' clocks are estimated. Every marker is used, or left out with its reason.
    """
    document, replayed = drives.make(caller, drive, key)
    response = created_response(document, replayed, path="/v1/drives", status=202)
    response.headers["Retry-After"] = "1"
    return response


@router.get("", EVERYBODY, responses=document_response(DrivePage))
def list_drives(
    request: Request,
    caller: Caller,
    drives: Drives,
    vehicle: Annotated[Identifier | None, Query(description="Id of the vehicle that drove.")] = None,
    state: JobState | None = None,
    limit: PageSize = 100,
    after: LastId = None,
) -> Response:
    """List the drives of an agency.

    Without their reports, newest first. Vehicles see their own.
    """
    page, last = drives.page(caller, vehicle=vehicle, state=state, before=after, limit=limit)
    return page_response(request, page, after=last)


@router.get("/{drive_id}", EVERYBODY, responses=document_response(TrackedDriveDocument, 404))
def get_drive(drive_id: DriveId, caller: Caller, drives: Drives) -> Response:
    """Get a drive.

    Its progress, or what its track rests on: clocks, markers, gaps, figures.
    """
    document = drives.get(caller, drive_id)
    waiting = document["state"] in ("queued", "running")
    return json_response(document, headers={"Retry-After": "1"} if waiting else None)


@router.delete(
    "/{drive_id}", UPLOADERS, status_code=204, responses=problem_responses(404, 409), response_class=Response
)
def delete_drive(drive_id: DriveId, caller: Caller, drives: Drives) -> Response:
    """Delete a finished drive with its track.

    Its decodes stay.
    """
    drives.delete(caller, drive_id)
    return Response(status_code=204)


@router.get(
    "/{drive_id}/track.{form}",
    EVERYBODY,
    responses={
        **file_response([media_type for name, media_type in TRACK_FILES.items() if name.startswith("track")]),
        **NOT_MODIFIED,
        **problem_responses(404),
    },
)
def get_track(
    drive_id: DriveId,
    form: Literal["geojson", "csv", "gpx"],
    caller: Caller,
    drives: Drives,
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Download the track of a drive.

    Positions with covariance, heading and speed.
    """
    return _file(drives, caller, drive_id, f"track.{form}", if_none_match)


@router.get(
    "/{drive_id}/plot.svg",
    EVERYBODY,
    responses={**file_response(["image/svg+xml"]), **NOT_MODIFIED, **problem_responses(404)},
)
def get_track_plot(drive_id: DriveId, caller: Caller, drives: Drives, if_none_match: IfNoneMatch = None) -> Response:
    """Get the plot of a drive's track.

    With its ellipses and markers, and its accuracy over the drive.
    """
    return _file(drives, caller, drive_id, "plot.svg", if_none_match)


def _file(drives: DrivesService, caller: Caller, drive_id: str, name: str, if_none_match: str | None) -> Response:
    headers = {"ETag": f'"{drive_id}-{name}"', "Cache-Control": "private, no-cache"}
    if if_none_match == headers["ETag"]:
        drives.get(caller, drive_id)
        return Response(status_code=304, headers=headers)
    content = drives.file(caller, drive_id, name)
    return Response(content, headers=headers, media_type=TRACK_FILES[name])
