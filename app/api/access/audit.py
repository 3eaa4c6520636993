"""/v1/audit: the log of what changed an agency's part of the registry."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Body, Path, Query, Request, Response

from app.api.http.dependencies import Caller, Idempotency, Identifier, PageSize, use_cases
from app.api.http.responses import created_response, document_response, json_response, page_response
from app.api.http.strict_json import StrictRoute
from app.services.access.audit import AuditLog
from app.services.access.audit_jobs import AuditVerifications, VerificationDocument, VerificationInput
from app.services.access.documents import AuditPage

router = APIRouter(prefix="/v1/audit", tags=["audit"], route_class=StrictRoute)


@router.get("", responses=document_response(AuditPage))
def list_audit_entries(
    request: Request,
    caller: Caller,
    log: Annotated[AuditLog, use_cases("audit")],
    limit: PageSize = 100,
    after: Annotated[int, Query(ge=0, lt=2**53, description="Last number of the page before.")] = 0,
) -> Response:
    """The agency's log, oldest first. `waymark audit verify` computes its hashes again."""
    page, last = log.page(caller, after=after, limit=limit)
    return page_response(request, page, after=last)


@router.post(
    "/verifications",
    status_code=202,
    responses=document_response(
        VerificationDocument, 409, status=202, description="Queued; Location leads to its progress and result"
    ),
)
def post_verification(
    wanted: Annotated[VerificationInput, Body(examples=[{}])],
    caller: Caller,
    verifications: Annotated[AuditVerifications, use_cases("audit_verifications")],
    idempotency: Idempotency,
) -> Response:
    """Compute every hash of the agency's log and of its markers' versions again, as a job."""
    document, replayed = verifications.request(caller, wanted, idempotency)
    response = created_response(document, replayed, path="/v1/audit/verifications", status=202)
    response.headers["Retry-After"] = "1"
    return response


@router.get("/verifications/{verification_id}", responses=document_response(VerificationDocument, 404))
def get_verification(
    verification_id: Annotated[Identifier, Path(description="Id of the verification's job.")],
    caller: Caller,
    verifications: Annotated[AuditVerifications, use_cases("audit_verifications")],
) -> Response:
    """A verification with its progress, and what it found once it is done."""
    document = verifications.get(caller, verification_id)
    waiting = document["state"] in ("queued", "running")
    return json_response(document, headers={"Retry-After": "1"} if waiting else None)
