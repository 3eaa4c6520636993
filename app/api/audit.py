"""/v1/audit: the log of what changed an agency's part of the registry."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel

from app.api.dependencies import Caller, json_response, next_link
from app.api.problems import problem_responses
from app.services.audit import AuditLog

router = APIRouter(prefix="/v1/audit", tags=["audit"])

MAX_PAGE = 1000


class AuditHeadOut(BaseModel):
    """The newest entry. Who keeps it elsewhere can tell later whether the log was cut or written anew."""

    number: int
    hash: str


class AuditEntryOut(BaseModel):
    """One operation, with the hash of the entry before it."""

    number: int
    at: str
    who: str
    key_id: str | None
    action: str
    subject: str | None
    detail: dict[str, Any] | None
    versions: int
    digest: str
    previous_hash: str
    hash: str


class AuditPage(BaseModel):
    """A page of the log, oldest first, and its head."""

    items: list[AuditEntryOut]
    head: AuditHeadOut | None


@router.get("", response_class=Response, responses={200: {"model": AuditPage}, **problem_responses()})
def list_entries(
    request: Request,
    caller: Caller,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = 100,
    after: Annotated[int, Query(ge=0, lt=2**53, description="Last number of the page before.")] = 0,
) -> Response:
    """The agency's log, oldest first. `waymark audit verify` computes its hashes again."""
    log: AuditLog = request.app.state.audit
    page, last, head = log.page(caller, after=after, limit=limit)
    return json_response({"items": page, "head": head}, headers=next_link(request, after=last) if last else None)
