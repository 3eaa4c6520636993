"""/v1/codebooks: which codes information tags carry, and what they mean; drafts of them without the registry."""

from __future__ import annotations

from typing import Annotated

from fastapi import Path, Query, Request, Response
from pydantic import AfterValidator, ConfigDict, Field, JsonValue

from app.api.http.dependencies import Caller, Idempotency, LastId, use_case
from app.api.http.permissions import PLANNERS, READERS
from app.api.http.responses import (
    NOT_MODIFIED,
    IfNoneMatch,
    created_response,
    document_response,
    json_response,
    page_response,
    versioned_response,
)
from app.api.http.routes import Router
from app.encoders.magnet import CodebookRules
from app.errors import InvalidParameter
from app.inputs import Identifier, StrictModel, Text
from app.markers.magnet import MIN_GAP_M
from app.markers.magnet_design import Meaning, MeaningKind, TagDesign
from app.services.markers.codebooks import (
    CodebookDocument,
    CodebookDraftDocument,
    CodebookPage,
    Codebooks,
    EntryDocument,
    EntryList,
    codebook_draft,
)

# === Schemas of codebooks.


MAX_MEANINGS = 100
"""In one request: each takes up to ten milliseconds."""


def _keeps_apart(design: TagDesign) -> TagDesign:
    if design.min_gap_m < MIN_GAP_M:
        raise InvalidParameter(
            f"min_gap_m is {design.min_gap_m:g} m: the fields of neighbours would be read as one",
            field="min_gap_m",
            limit=f"at least {MIN_GAP_M:g} m",
            cure=f"leave it out for {MIN_GAP_M:g} m",
        )
    return design


Design = Annotated[TagDesign, AfterValidator(_keeps_apart)]


_MEANINGS_EXAMPLE: list[JsonValue] = [
    {"kind": "bend-right", "value": 125},
    {"kind": "stop-line-ahead", "value": 20},
    {"kind": "arrow", "value": "straight-left"},
]


class CodebookIn(StrictModel):
    """A codebook to make, with the first meanings to give codes to."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "name": "City streets",
                    "design": {"magnets": 3, "length_m": 4.0, "segment_m": 0.1},
                    "rules": {"speed_m_s": 13.4, "clearance_m": 0.3, "wrong_way_safe": True},
                    "meanings": _MEANINGS_EXAMPLE,
                }
            ]
        },
    )

    name: Text = Field(max_length=200, description="1 to 80 characters, each name once in an agency.")
    design: Design
    rules: CodebookRules = Field(default_factory=CodebookRules)
    meanings: list[Meaning] = Field(default_factory=list, max_length=MAX_MEANINGS)


class CodebookDraftIn(StrictModel):
    """A codebook to see the capacity of before it is made."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"design": {"magnets": 3, "length_m": 4.0, "segment_m": 0.1}}]},
    )

    design: Design
    rules: CodebookRules = Field(default_factory=CodebookRules)


class MeaningsIn(StrictModel):
    """Further meanings of a codebook."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"meanings": [{"kind": "speed-limit-mph", "value": 25}]}]},
    )

    meanings: list[Meaning] = Field(min_length=1, max_length=MAX_MEANINGS)


# === /v1/codebooks.


router = Router("/v1/codebooks", "codebooks")

CodebookId = Annotated[Identifier, Path(description="Id of the codebook.")]
Service = Annotated[Codebooks, use_case(lambda cases: cases.codebooks)]


@router.post(
    "",
    PLANNERS,
    expensive=True,
    status_code=201,
    responses=document_response(CodebookDocument, 409, status=201, description="Made"),
)
def post_codebook(wanted: CodebookIn, caller: Caller, codebooks: Service, idempotency: Idempotency) -> Response:
    """Make a codebook.

    Its first meanings get codes. The answer counts those that fit and are distinct.
    """
    document, replayed = codebooks.make(caller, wanted.name, wanted.design, wanted.rules, wanted.meanings, idempotency)
    return created_response(document, replayed, path="/v1/codebooks")


@router.get("", READERS, responses=document_response(CodebookPage))
def list_codebooks(
    request: Request,
    caller: Caller,
    codebooks: Service,
    limit: Annotated[int, Query(ge=1, le=100)] = 100,
    after: LastId = None,
) -> Response:
    """List the codebooks of an agency.

    In the order they were made, without their entries.
    """
    page, last = codebooks.page(caller, after=after, limit=limit)
    return page_response(request, page, after=last)


@router.get("/{codebook_id}", READERS, responses={**NOT_MODIFIED, **document_response(CodebookDocument, 404)})
def get_codebook(
    codebook_id: CodebookId, caller: Caller, codebooks: Service, if_none_match: IfNoneMatch = None
) -> Response:
    """Get a codebook with its entries.

    With its version as ETag.
    """
    return versioned_response(codebooks.get(caller, codebook_id), if_none_match)


@router.post(
    "/{codebook_id}/entries",
    PLANNERS,
    expensive=True,
    status_code=201,
    responses=document_response(CodebookDocument, 404, 409, status=201, description="Added"),
)
def post_entries(
    codebook_id: CodebookId, wanted: MeaningsIn, caller: Caller, codebooks: Service, idempotency: Idempotency
) -> Response:
    """Add meanings to a codebook.

    They get codes: all of them or none. Codes given before stay as they are.
    """
    document, replayed = codebooks.add_meanings(caller, codebook_id, wanted.meanings, idempotency)
    return created_response(document, replayed)


@router.get("/{codebook_id}/entries", READERS, responses=document_response(EntryList, 404))
def list_entries(
    codebook_id: CodebookId,
    caller: Caller,
    codebooks: Service,
    kind: MeaningKind | None = None,
    value: Annotated[Text | None, Query(max_length=80, examples=["125"])] = None,
) -> Response:
    """List the entries of a codebook.

    In the order they were given; with `kind` and `value` the one with this meaning.
    """
    return json_response(codebooks.list_entries(caller, codebook_id, _meaning(kind, value)))


@router.get("/{codebook_id}/entries/{code}", READERS, responses=document_response(EntryDocument, 404))
def get_entry(
    codebook_id: CodebookId,
    code: Annotated[Text, Path(max_length=64, examples=["SNS_4_0.1_10-30"])],
    caller: Caller,
    codebooks: Service,
) -> Response:
    """Get what a code of a codebook means."""
    return json_response(codebooks.entry(caller, codebook_id, code))


def _meaning(kind: MeaningKind | None, value: str | None) -> Meaning | None:
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
        number: float | str = float(value) if kind not in ("arrow", "notice") else value
    except ValueError:
        number = value
    return Meaning(kind, number)


# === /v1/codebook-drafts: the capacity of a codebook before it is made. Nothing is stored.


draft_router = Router("/v1/codebook-drafts", "codebooks")


@draft_router.post("", READERS, expensive=True, responses=document_response(CodebookDraftDocument))
def post_codebook_draft(wanted: CodebookDraftIn, caller: Caller) -> Response:
    """Count the codes of a design of a codebook.

    How many there are, how many fit the rules, and the first 200 of them.
    """
    return json_response(codebook_draft(wanted.design, wanted.rules))
