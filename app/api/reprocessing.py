"""Routes on reprocessings."""

from __future__ import annotations

from typing import Annotated

from fastapi import Path, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import ConfigDict, Field

from app.api.http.dependencies import Caller, Identifier, LastId, Number, PageSize, Text, use_case
from app.api.http.permissions import ADMINS, EVERYBODY
from app.api.http.problems import problem_responses
from app.api.http.responses import (
    Time,
    created_response,
    document_response,
    file_response,
    json_response,
    page_response,
)
from app.api.http.routes import Router
from app.families.documents import StrictModel
from app.services.decodes.context import DecodeKind
from app.services.markers.searches import checked_box
from app.services.reprocessing import (
    Criteria,
    DecodeVersions,
    ReprocessingDocument,
    ReprocessingPage,
    ReprocessingReport,
    Reprocessings,
)

# === /v1/reprocessings: stored uploads are decoded again, and what changed is reported before it becomes current.


router = Router("/v1/reprocessings", "reprocessing")
decode_versions = Router("/v1/decodes", "decodes")

ReprocessingId = Annotated[Identifier, Path(description="Id of the reprocessing.")]
Service = Annotated[Reprocessings, use_case(lambda cases: cases.reprocessings)]


class ReprocessingIn(StrictModel):
    """Which uploads are decoded again; without criteria, all that are stored."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"kinds": ["frame", "archive"], "older_than": "0.3.0"}]})

    kinds: list[DecodeKind] | None = Field(None, min_length=1, max_length=20)
    since: Time | None = Field(None, description="Uploaded at this time or later.")
    until: Time | None = Field(None, description="Uploaded before this time.")
    vehicle_id: Identifier | None = None
    bbox: Annotated[list[Number], Field(min_length=4, max_length=4)] | None = Field(
        None, description="west, south, east, north of the coarse positions. [deg]"
    )
    decoder: Text | None = Field(None, max_length=200, description="Results of this decoder, as they name it.")
    older_than: Text | None = Field(None, max_length=40, description="Results of earlier releases: 0.3.0.")

    def criteria(self) -> Criteria:
        """The criteria as the use cases know them."""
        box = self.bbox
        if box is not None:
            checked_box(*box)
        return Criteria(
            tuple(self.kinds) if self.kinds is not None else None, self.since, self.until, self.vehicle_id,
            (box[0], box[1], box[2], box[3]) if box is not None else None, self.decoder, self.older_than,
        )  # fmt: skip


@router.post(
    "",
    ADMINS,
    status_code=202,
    responses=document_response(ReprocessingDocument, status=202, description="Queued; Location leads to its progress"),
)
def post_reprocessing(wanted: ReprocessingIn, caller: Caller, reprocessings: Service) -> Response:
    """Decode stored uploads again with the present decoders.

    When no other work waits.

    The results are kept beside the current ones. Nothing changes until the reprocessing is approved.
    """
    return created_response(
        reprocessings.create(caller, wanted.criteria()), False, path="/v1/reprocessings", status=202
    )


@router.get("", ADMINS, responses=document_response(ReprocessingPage))
def list_reprocessings(
    request: Request, caller: Caller, reprocessings: Service, limit: PageSize = 100, after: LastId = None
) -> Response:
    """List the reprocessings of an agency.

    Oldest first.
    """
    page, last = reprocessings.page(caller, after=after, limit=limit)
    return page_response(request, page, after=last)


@router.get("/{reprocessing_id}", ADMINS, responses=document_response(ReprocessingDocument, 404))
def get_reprocessing(reprocessing_id: ReprocessingId, caller: Caller, reprocessings: Service) -> Response:
    """Get a reprocessing.

    With its progress and its sums.
    """
    return json_response(reprocessings.get(caller, reprocessing_id))


@router.get("/{reprocessing_id}/report", ADMINS, responses=document_response(ReprocessingReport, 404))
def get_reprocessing_report(
    request: Request,
    reprocessing_id: ReprocessingId,
    caller: Caller,
    reprocessings: Service,
    limit: PageSize = 100,
    after: LastId = None,
) -> Response:
    """Get the report of a reprocessing.

    Uploads whose readings differ, reading by reading: gained, lost, changed in code, position or confidence.
    """
    page, last = reprocessings.report(caller, reprocessing_id, after=after, limit=limit)
    return page_response(request, page, after=last)


@router.get(
    "/{reprocessing_id}/report.csv",
    ADMINS,
    response_class=StreamingResponse,
    responses={**file_response(["text/csv"]), **problem_responses(404)},
)
def get_reprocessing_csv(reprocessing_id: ReprocessingId, caller: Caller, reprocessings: Service) -> Response:
    """Download the report of a reprocessing as CSV."""
    headers = {"Content-Disposition": f'attachment; filename="reprocessing-{reprocessing_id}.csv"'}
    lines = reprocessings.report_csv(caller, reprocessing_id)
    return StreamingResponse(lines, headers=headers, media_type="text/csv; charset=utf-8")


@router.post("/{reprocessing_id}/cancel", ADMINS, responses=document_response(ReprocessingDocument, 404))
def cancel_reprocessing(reprocessing_id: ReprocessingId, caller: Caller, reprocessings: Service) -> Response:
    """Cancel a reprocessing.

    One that has ended stays as it is.
    """
    return json_response(reprocessings.cancel(caller, reprocessing_id))


@router.post("/{reprocessing_id}/approve", ADMINS, responses=document_response(ReprocessingDocument, 404, 409))
def approve_reprocessing(reprocessing_id: ReprocessingId, caller: Caller, reprocessings: Service) -> Response:
    """Approve the results of a reprocessing.

    They become current. Those of before are kept: `GET /v1/decodes/{decode_id}/versions`.
    """
    return json_response(reprocessings.approve(caller, reprocessing_id))


@decode_versions.get("/{decode_id}/versions", EVERYBODY, responses=document_response(DecodeVersions, 404))
def list_decode_versions(
    decode_id: Annotated[Identifier, Path(description="Id of the decode.")], caller: Caller, reprocessings: Service
) -> Response:
    """List the earlier results of a decode.

    Those that were replaced by reprocessings, newest first.
    """
    return json_response(reprocessings.versions(caller, decode_id))
