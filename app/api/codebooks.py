"""/v1/codebooks: which codes information tags carry, and what they mean."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Query, Request, Response

from app.api.dependencies import Caller, Idempotency, Identifier, Text, json_response, next_link
from app.api.problems import problem_responses
from app.api.schemas_codebooks import CodebookIn, CodebookOut, CodebookPage, EntryList, EntryOut, MeaningsIn
from app.api.strict_json import StrictRoute
from app.errors import InvalidParameter
from app.services.codebooks import Codebooks

router = APIRouter(prefix="/v1/codebooks", tags=["codebooks"], route_class=StrictRoute)

CodebookId = Annotated[Identifier, Path(description="Id of the codebook.")]


async def get_codebooks(request: Request) -> Codebooks:
    """Use cases on codebooks."""
    service: Codebooks = request.app.state.codebooks
    return service


Service = Annotated[Codebooks, Depends(get_codebooks)]


@router.post(
    "",
    status_code=201,
    response_class=Response,
    responses={201: {"model": CodebookOut, "description": "Made"}, **problem_responses(409)},
)
def post_codebook(wanted: CodebookIn, caller: Caller, codebooks: Service, idempotency: Idempotency) -> Response:
    """Make a codebook and give codes to its first meanings. It says how many codes fit and how many are told apart."""
    meanings = [meaning.given for meaning in wanted.meanings]
    document, replayed = codebooks.make(
        caller, wanted.name, wanted.design.given(), wanted.rules.given(), meanings, idempotency
    )
    headers = {"Location": f"/v1/codebooks/{document['id']}", "ETag": _etag(document)}
    return json_response(document, 201, headers | _replay(replayed))


@router.get("", response_class=Response, responses={200: {"model": CodebookPage}, **problem_responses()})
def list_codebooks(
    request: Request,
    caller: Caller,
    codebooks: Service,
    limit: Annotated[int, Query(ge=1, le=100)] = 100,
    after: Annotated[Identifier | None, Query(description="Last id of the page before.")] = None,
) -> Response:
    """Codebooks in the order they were made, without their entries."""
    page, last = codebooks.page(caller, after=after, limit=limit)
    return json_response({"items": page}, headers=next_link(request, after=last) if last else None)


@router.get(
    "/{codebook_id}", response_class=Response, responses={200: {"model": CodebookOut}, **problem_responses(404)}
)
def get_codebook(codebook_id: CodebookId, request: Request, caller: Caller, codebooks: Service) -> Response:
    """One codebook with its entries, with its version as ETag."""
    document = codebooks.get(caller, codebook_id)
    etag = {"ETag": _etag(document)}
    if request.headers.get("if-none-match") == etag["ETag"]:
        return Response(status_code=304, headers=etag)
    return json_response(document, headers=etag)


@router.post(
    "/{codebook_id}/entries",
    status_code=201,
    response_class=Response,
    responses={201: {"model": CodebookOut, "description": "Added"}, **problem_responses(404, 409)},
)
def post_entries(
    codebook_id: CodebookId, wanted: MeaningsIn, caller: Caller, codebooks: Service, idempotency: Idempotency
) -> Response:
    """Give codes to further meanings: all of them or none. Codes given before stay as they are."""
    meanings = [meaning.given for meaning in wanted.meanings]
    document, replayed = codebooks.add_meanings(caller, codebook_id, meanings, idempotency)
    return json_response(document, 201, {"ETag": _etag(document)} | _replay(replayed))


@router.get(
    "/{codebook_id}/entries", response_class=Response, responses={200: {"model": EntryList}, **problem_responses(404)}
)
def list_entries(
    codebook_id: CodebookId,
    caller: Caller,
    codebooks: Service,
    kind: Annotated[Text | None, Query(max_length=40, examples=["bend-right"])] = None,
    value: Annotated[Text | None, Query(max_length=80, examples=["125"])] = None,
) -> Response:
    """Entries of a codebook in the order they were given; with `kind` and `value` the one with this meaning."""
    return json_response({"items": codebooks.list_entries(caller, codebook_id, _meaning(kind, value))})


@router.get(
    "/{codebook_id}/entries/{code}",
    response_class=Response,
    responses={200: {"model": EntryOut}, **problem_responses(404)},
)
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


def _etag(document: dict[str, Any]) -> str:
    return f'"{document["version"]}"'


def _replay(replayed: bool) -> dict[str, str]:
    return {"Idempotency-Replayed": "true"} if replayed else {}
