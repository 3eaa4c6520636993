"""/v1/agencies: agencies with their first keys, created by the server's operator."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Request, Response
from pydantic import AfterValidator, ConfigDict, Field

from app.api.access.keys import NO_STORE, is_label
from app.api.http.dependencies import Caller, Idempotency, LastId, PageSize, Text, use_cases
from app.api.http.responses import document_response, json_response, page_response
from app.api.http.strict_json import StrictRoute
from app.families.inputs import StrictModel
from app.services.access.access import MAX_AGENCY_NAME
from app.services.access.agencies import Agencies
from app.services.access.documents import AgencyPage, NewAgencyDocument

router = APIRouter(prefix="/v1/agencies", tags=["access"], route_class=StrictRoute)

Service = Annotated[Agencies, use_cases("agencies")]


class AgencyIn(StrictModel):
    """An agency to create."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"name": "Roads of Karlsruhe"}]})

    name: Text = Field(
        min_length=1,
        max_length=MAX_AGENCY_NAME,
        description="Printable characters in Unicode's form NFC, with single spaces; no other agency has it.",
    )
    key_label: Annotated[Text, AfterValidator(is_label)] = Field(
        "first admin key", min_length=1, max_length=200, description="What histories call the holder of the admin key."
    )


@router.post("", status_code=201, responses=document_response(NewAgencyDocument, 409, status=201))
def post_agency(agency: AgencyIn, caller: Caller, agencies: Service, idempotency: Idempotency) -> Response:
    """Create an agency with an admin key, as the server's operator.

    The key's text is in this response, and in those to repetitions under the same Idempotency-Key. The agency's admin
    creates all further keys with it: `POST /v1/keys`.
    """
    document, replayed = agencies.create(caller, agency.name, agency.key_label, idempotency)
    return json_response(document, 201, NO_STORE | ({"Idempotency-Replayed": "true"} if replayed else {}))


@router.get("", responses=document_response(AgencyPage))
def list_agencies(request: Request, agencies: Service, limit: PageSize = 100, after: LastId = None) -> Response:
    """The agencies of this server, oldest first, for its operator."""
    page, last = agencies.page(after=after, limit=limit)
    return page_response(request, page, after=last)
