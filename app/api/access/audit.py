"""/v1/audit: the log of what changed an agency's part of the registry."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Body, Depends, Path, Query, Request, Response

from app.api.http.dependencies import Caller, Idempotency, Identifier, PageSize, Text, use_cases
from app.api.http.responses import created_response, document_response, json_response, page_response
from app.api.http.strict_json import StrictRoute
from app.api.http.times import Time
from app.registry.audit import EntryFilter
from app.services.access.audit import AuditLog
from app.services.access.audit_jobs import AuditVerifications, VerificationDocument, VerificationInput
from app.services.access.documents import AuditPage

router = APIRouter(prefix="/v1/audit", tags=["audit"], route_class=StrictRoute)


_NEWEST = 2**53 - 1


async def get_entry_filter(
    who: Annotated[Text | None, Query(max_length=200, description="Label of the key or name of the person.")] = None,
    action: Annotated[
        Text | None,
        Query(max_length=80, description="What was done; with `*` at the end all that begin so.", examples=["key.*"]),
    ] = None,
    subject: Annotated[Text | None, Query(max_length=200, description="Id or name of what it was done to.")] = None,
    since: Annotated[Time | None, Query(description="At this time or later.")] = None,
    until: Annotated[Time | None, Query(description="Before this time.")] = None,
) -> EntryFilter:
    """The filter in a query."""
    return EntryFilter(who, action, subject, since, until)


@router.get("", responses=document_response(AuditPage))
def list_audit_entries(
    request: Request,
    caller: Caller,
    log: Annotated[AuditLog, use_cases("audit")],
    wanted: Annotated[EntryFilter, Depends(get_entry_filter)],
    limit: PageSize = 100,
    after: Annotated[int, Query(ge=0, lt=2**53, description="Last number of the page before.")] = 0,
    before: Annotated[
        int | None, Query(ge=1, lt=2**53, description="Last number of the page before, where the newest come first.")
    ] = None,
    order: Annotated[Literal["oldest", "newest"], Query(description="Which entries come first.")] = "oldest",
) -> Response:
    """The agency's log, oldest first or newest first. `waymark audit verify` computes its hashes again."""
    if order == "oldest":
        page, last = log.page(caller, after=after, limit=limit, wanted=wanted)
        return page_response(request, page, after=last)
    page, last = log.page(caller, before=before or _NEWEST, limit=limit, wanted=wanted)
    return page_response(request, page, before=last)


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
