"""/v1/codebooks: which codes information tags carry, and what they mean."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query, Request, Response

from app.api.http.dependencies import Caller, Idempotency, Identifier, LastId, Text, use_cases
from app.api.http.responses import (
    NOT_MODIFIED,
    IfNoneMatch,
    created_response,
    document_response,
    json_response,
    page_response,
    versioned_response,
)
from app.api.http.strict_json import StrictRoute
from app.api.markers.schemas_codebooks import CodebookIn, MeaningsIn
from app.errors import InvalidParameter
from app.services.markers.codebook_documents import CodebookDocument, CodebookPage, EntryDocument, EntryList
from app.services.markers.codebooks import Codebooks

router = APIRouter(prefix="/v1/codebooks", tags=["codebooks"], route_class=StrictRoute)

CodebookId = Annotated[Identifier, Path(description="Id of the codebook.")]
Service = Annotated[Codebooks, use_cases("codebooks")]


@router.post("", status_code=201, responses=document_response(CodebookDocument, 409, status=201, description="Made"))
def post_codebook(wanted: CodebookIn, caller: Caller, codebooks: Service, idempotency: Idempotency) -> Response:
    """Make a codebook and give codes to its first meanings. The answer counts those that fit and are distinct."""
    meanings = [meaning.pair for meaning in wanted.meanings]
    document, replayed = codebooks.make(
        caller, wanted.name, wanted.design.given(), wanted.rules.given(), meanings, idempotency
    )
    return created_response(document, replayed, path="/v1/codebooks")


@router.get("", responses=document_response(CodebookPage))
def list_codebooks(
    request: Request,
    caller: Caller,
    codebooks: Service,
    limit: Annotated[int, Query(ge=1, le=100)] = 100,
    after: LastId = None,
) -> Response:
    """Codebooks in the order they were made, without their entries."""
    page, last = codebooks.page(caller, after=after, limit=limit)
    return page_response(request, page, after=last)


@router.get("/{codebook_id}", responses={**NOT_MODIFIED, **document_response(CodebookDocument, 404)})
def get_codebook(
    codebook_id: CodebookId, caller: Caller, codebooks: Service, if_none_match: IfNoneMatch = None
) -> Response:
    """One codebook with its entries, with its version as ETag."""
    return versioned_response(codebooks.get(caller, codebook_id), if_none_match)


@router.post(
    "/{codebook_id}/entries",
    status_code=201,
    responses=document_response(CodebookDocument, 404, 409, status=201, description="Added"),
)
def post_entries(
    codebook_id: CodebookId, wanted: MeaningsIn, caller: Caller, codebooks: Service, idempotency: Idempotency
) -> Response:
    """Give codes to further meanings: all of them or none. Codes given before stay as they are."""
    meanings = [meaning.pair for meaning in wanted.meanings]
    document, replayed = codebooks.add_meanings(caller, codebook_id, meanings, idempotency)
    return created_response(document, replayed)


@router.get("/{codebook_id}/entries", responses=document_response(EntryList, 404))
def list_entries(
    codebook_id: CodebookId,
    caller: Caller,
    codebooks: Service,
    kind: Annotated[Text | None, Query(max_length=40, examples=["bend-right"])] = None,
    value: Annotated[Text | None, Query(max_length=80, examples=["125"])] = None,
) -> Response:
    """Entries of a codebook in the order they were given; with `kind` and `value` the one with this meaning."""
    return json_response(codebooks.list_entries(caller, codebook_id, _meaning(kind, value)))


@router.get("/{codebook_id}/entries/{code}", responses=document_response(EntryDocument, 404))
def get_entry(
    codebook_id: CodebookId,
    code: Annotated[Text, Path(max_length=64, examples=["SNS_4_0.1_10-30"])],
    caller: Caller,
    codebooks: Service,
) -> Response:
    """What a code means."""
    return json_response(codebooks.entry(caller, codebook_id, code))


def _meaning(kind: str | None, value: str | None) -> tuple[str, float | str] | None:
    if kind is None and value is None:
        return None
    if kind is None or value is None:
        raise InvalidParameter(
            "a meaning is a kind and a value",
            field="kind" if kind is None else "value",
            limit="both or none",
            cure="send both, or leave both out",
        )
    try:
        return kind, float(value) if kind not in ("arrow", "notice") else value
    except ValueError:
        return kind, value
