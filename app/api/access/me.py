"""GET /v1/me: who is calling, and what that caller may do."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Response
from pydantic import Field
from typing_extensions import TypedDict

from app.api.http.dependencies import Caller, use_cases
from app.api.http.permissions import PERMISSIONS, PUBLIC
from app.api.http.responses import document_response, json_response
from app.api.http.strict_json import StrictRoute
from app.services.access.access import Access, Scope

router = APIRouter(prefix="/v1/me", tags=["access"], route_class=StrictRoute)


class MeDocument(TypedDict):
    """The caller: its agency, its name in histories, its scope and the routes that the scope may use."""

    agency: Annotated[str, Field(description="Name of the agency.")]
    holder_id: Annotated[str, Field(description="The same for keys that replace one another.")]
    label: Annotated[str, Field(description="What histories call the caller.")]
    scope: Scope
    permissions: Annotated[list[str], Field(description="Methods and path templates, e.g. `PATCH /v1/markers/{id}`.")]


@router.get("", responses=document_response(MeDocument))
def get_me(caller: Caller, access: Annotated[Access, use_cases("access")]) -> Response:
    """The holder of the key or token of this request."""
    allowed = [route for route, scopes in PERMISSIONS.items() if scopes != PUBLIC and caller.scope in scopes]
    document = MeDocument(
        agency=access.agency_name(caller),
        holder_id=caller.key_id,
        label=caller.label,
        scope=caller.scope,
        permissions=sorted(allowed),
    )
    return json_response(document)
