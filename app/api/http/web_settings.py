"""GET /v1/page-settings: what the web pages need to know before anybody has signed in."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Request, Response
from pydantic import Field
from typing_extensions import TypedDict

from app.api.http.responses import document_response, json_response
from app.api.http.strict_json import StrictRoute

router = APIRouter(prefix="/v1/page-settings", tags=["system"], route_class=StrictRoute)


class SignInOptions(TypedDict):
    """How a page signs somebody in at the identity provider: OAuth 2.0, authorization code with PKCE (RFC 7636)."""

    issuer: str
    client_id: str
    authorize_url: Annotated[str, Field(description="The provider's authorization endpoint.")]
    token_url: Annotated[str, Field(description="The provider's token endpoint.")]
    scopes: Annotated[str, Field(description="Scopes to request, separated by spaces.")]


class BaseMap(TypedDict):
    """The map under the markers."""

    kind: Literal["pmtiles", "raster"]
    url: Annotated[str, Field(description="Of a PMTiles file, or of raster tiles with {z}, {x} and {y}.")]
    attribution: str


class PageSettings(TypedDict):
    """Settings of the web pages."""

    version: Annotated[str, Field(description="Of the server.")]
    sign_in: Annotated[SignInOptions | None, Field(description="null: sign in with a key.")]
    base_map: Annotated[BaseMap | None, Field(description="null: the pages draw a grid.")]
    guide: Annotated[bool, Field(description="The documents are at /guide: false where they were not built.")]


@router.get("", responses=document_response(PageSettings))
async def get_page_settings(request: Request) -> Response:
    """Sign-in, base map and guide of the web pages. Needs no key."""
    return json_response(request.app.state.page_settings)
