"""Routes on reprocessings."""

from __future__ import annotations

from typing import Annotated

from fastapi import Path, Request, Response
from fastapi.responses import StreamingResponse

from app.api.http.dependencies import Caller, LastId, PageSize, use_case
from app.api.http.permissions import ADMINS, EVERYBODY
from app.api.http.problems import problem_responses
from app.api.http.responses import (
    created_response,
    document_response,
    file_response,
    json_response,
    page_response,
)
from app.api.http.routes import Router
from app.inputs import Identifier
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


@router.post(
    "",
    ADMINS,
    status_code=202,
    responses=document_response(ReprocessingDocument, status=202, description="Queued; Location leads to its progress"),
)
def post_reprocessing(criteria: Criteria, caller: Caller, reprocessings: Service) -> Response:
    """Decode stored uploads again with the present decoders.

    When no other work waits.

    The results are kept beside the current ones. Nothing changes until the reprocessing is approved.
    """
    return created_response(reprocessings.create(caller, criteria), False, path="/v1/reprocessings", status=202)


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
