"""/v1/codebook-drafts: the capacity of a codebook before it is made. Nothing is stored."""

from __future__ import annotations

from fastapi import APIRouter, Response

from app.api.http.dependencies import Caller
from app.api.http.responses import document_response, json_response
from app.api.http.strict_json import StrictRoute
from app.api.markers.schemas_codebooks import CodebookDraftIn
from app.services.markers.codebook_documents import CodebookDraftDocument, codebook_draft

router = APIRouter(prefix="/v1/codebook-drafts", tags=["codebooks"], route_class=StrictRoute)


@router.post("", responses=document_response(CodebookDraftDocument))
def post_codebook_draft(wanted: CodebookDraftIn, caller: Caller) -> Response:
    """How many codes a design has, how many fit the rules, and the first 200 of them."""
    return json_response(codebook_draft(wanted.design.given(), wanted.rules.given()))
