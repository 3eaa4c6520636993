"""/v1/audit: the log of what changed an agency's part of the registry."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from app.api.http.dependencies import Caller, PageSize, use_cases
from app.api.http.responses import document_response, page_response
from app.api.http.strict_json import StrictRoute
from app.services.access.audit import AuditLog
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
