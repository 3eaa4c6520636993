"""Routes on drives."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import Path, Query, Request, Response
from pydantic import ConfigDict, Field

from app.api.http.dependencies import Caller, Idempotency, Identifier, LastId, Number, PageSize, Text, use_case
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
from app.errors import InvalidParameter
from app.families.documents import Flag, StrictModel
from app.registry.jobs import JobState
from app.services.drives.collect import DEFAULT_CLOCK_SIGMA_S, DecodeClock
from app.services.drives.documents import TRACK_FILES, DrivePage, TrackedDriveDocument
from app.services.drives.drives import MAX_DECODES, NewDrive
from app.services.drives.drives import Drives as DrivesService
from app.tracks.types import MAX_CLOCK_SIGMA_S, TrackRules

# === Bodies of requests on drives.


_RULES = TrackRules()


class DriveDecodeIn(StrictModel):
    """A decode of a drive, and its sensor's clock."""

    id: Identifier
    clock: Annotated[Text, Field(min_length=1, max_length=80)] | None = Field(
        None, description="Name of the clock; decodes with the same name share one. Without it, each has its own."
    )
    offset_s: Annotated[Number, Field(ge=-1e7, le=1e7)] = Field(
        0.0, description="To be added to the times of the decode, where the clock was set wrong."
    )
    clock_sigma_s: Annotated[Number, Field(ge=0, le=MAX_CLOCK_SIGMA_S)] = Field(
        DEFAULT_CLOCK_SIGMA_S, description="How far the clock may be off; 0: it is exact, no offset is estimated."
    )


class DriveOptionsIn(StrictModel):
    """How the track is estimated."""

    rate_hz: Annotated[Number, Field(ge=0.1, le=10)] = Field(_RULES.rate_hz, description="Of the positions.")
    max_sigma_m: Annotated[Number, Field(ge=0.05, le=100)] = Field(
        _RULES.max_sigma_m, description="Where a standard deviation is larger, the track has a gap."
    )
    outlier_probability: Annotated[Number, Field(ge=1e-9, le=0.1)] = Field(
        _RULES.outlier_probability, description="Share of good markers that the gate may leave out."
    )
    speed_scale_sigma: Annotated[Number, Field(ge=1e-4, le=0.2)] = Field(
        _RULES.speed_scale_sigma, description="Scale error of the vehicle's speed to be expected."
    )
    heading_bias_sigma_deg: Annotated[Number, Field(ge=0.01, le=30)] = Field(
        _RULES.heading_bias_sigma_deg, description="Bias of the vehicle's heading to be expected."
    )
    use_unfit: Flag = Field(False, description="Use positions that are not for localization, too.")


class DriveIn(StrictModel):
    """A drive to make of decodes that are done."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "name": "L 560, Monday morning",
                    "decodes": [
                        {"id": "019cb624-0000-7000-8000-0000000000aa", "clock": "bar", "clock_sigma_s": 0.1},
                        {"id": "019cb624-0000-7000-8000-0000000000ab", "clock": "camera", "offset_s": -0.2},
                    ],
                    "options": {"rate_hz": 5, "max_sigma_m": 1.0},
                }
            ]
        }
    )

    name: Annotated[Text, Field(min_length=1, max_length=80)] | None = None
    vehicle: Annotated[Text, Field(max_length=80)] | None = Field(None, description="Name or id of the vehicle.")
    decodes: Annotated[list[DriveDecodeIn], Field(min_length=1, max_length=MAX_DECODES)]
    options: DriveOptionsIn = Field(default_factory=DriveOptionsIn)

    def drive(self) -> NewDrive:
        """The drive to make.

        Raises
        ------
        InvalidParameter
            A decode is named twice.
        """
        ids = [entry.id for entry in self.decodes]
        twice = next((k for k, name in enumerate(ids) if name in ids[:k]), None)
        if twice is not None:
            raise InvalidParameter(
                f"decode {ids[twice]} is named twice", field=f"decodes.{twice}.id", limit="each decode once"
            )
        options = self.options.model_dump()
        use_unfit = options.pop("use_unfit")
        clocks = tuple(
            DecodeClock(entry.id, entry.clock or entry.id, entry.offset_s, entry.clock_sigma_s)
            for entry in self.decodes
        )
        return NewDrive(clocks, self.name, self.vehicle, TrackRules(**options), use_unfit)


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
def post_drive(body: DriveIn, caller: Caller, drives: Drives, key: Idempotency) -> Response:
    """Fuse decodes of one drive into one track.

    Fixes of plates and tags, the path of CERPMs, speeds and headings of traces come together on one time base: offsets
    between the sensors' clocks are estimated. Every marker is used, or left out with its reason.
    """
    document, replayed = drives.make(caller, body.drive(), key)
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
