"""/v1/public-page: what an agency releases on the public pages of its markers."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Response
from pydantic import ConfigDict, Field

from app.api.http.dependencies import Caller, Version, use_cases
from app.api.http.responses import NOT_MODIFIED, IfNoneMatch, document_response, versioned_response
from app.api.http.strict_json import StrictRoute
from app.families.inputs import Flag, StrictModel
from app.services.public_pages.documents import PublicField, PublicPageDocument
from app.services.public_pages.pages import PublicPages

router = APIRouter(prefix="/v1/public-page", tags=["public pages"], route_class=StrictRoute)

Pages = Annotated[PublicPages, use_cases("public_pages")]


class PublicPageIn(StrictModel):
    """What is released."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {"fields": ["code", "agency", "status", "revision", "road", "measure"], "damage_reports": True},
                {"fields": [], "damage_reports": False},
            ]
        }
    )

    fields: list[PublicField] = Field(
        max_length=6, description="Fields of markers that everybody may see; none: the markers have no public pages."
    )
    damage_reports: Flag = Field(description="Whether the pages have a form for damage reports.")


@router.get("", responses={**NOT_MODIFIED, **document_response(PublicPageDocument)})
def get_public_page_settings(caller: Caller, pages: Pages, if_none_match: IfNoneMatch = None) -> Response:
    """What the agency releases of its markers on their public pages."""
    return versioned_response(pages.settings(caller), if_none_match)


@router.put("", responses=document_response(PublicPageDocument, 412, 428))
def put_public_page_settings(settings: PublicPageIn, caller: Caller, pages: Pages, version: Version) -> Response:
    """Release other fields, or none. It holds at once, for the pages of all markers of the agency."""
    return versioned_response(pages.change(caller, settings.fields, settings.damage_reports, version))
