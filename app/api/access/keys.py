"""/v1/keys: the keys of the agency, for its admins; those of operators, for operators."""

from __future__ import annotations

from datetime import timedelta
from typing import Annotated

from fastapi import APIRouter, Path, Request, Response
from pydantic import AfterValidator, ConfigDict, Field

from app.api.http.dependencies import Caller, Identifier, LastId, PageSize, Text, Whole, use_cases
from app.api.http.problems import problem_responses
from app.api.http.responses import document_response, json_response, page_response
from app.api.http.strict_json import StrictRoute
from app.api.http.times import Time
from app.families.inputs import StrictModel
from app.services.access.access import AGENCY_SCOPES, Scope
from app.services.access.documents import KeyDocument, KeyPage, NewKeyDocument
from app.services.access.keys import MAX_OVERLAP, Keys, NewKey

router = APIRouter(prefix="/v1/keys", tags=["access"], route_class=StrictRoute)

_DAY_S = 86_400
NO_STORE = {"Cache-Control": "private, no-store"}
KeyId = Annotated[Identifier, Path(description="Id of the key.")]


def is_label(label: str) -> str:
    if not label.strip() or not label.isprintable():
        raise ValueError("a label is printable and not blank")
    return label


def _is_of_agencies(scope: Scope) -> Scope:
    if scope not in AGENCY_SCOPES:
        raise ValueError("keys of operators are created on the server's machine: waymark key --operator")
    return scope


class KeyIn(StrictModel):
    """A key to make."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"scope": "vehicle", "label": "BUS-7", "expires_at": "2027-06-30T00:00:00Z"}]},
    )

    scope: Annotated[Scope, AfterValidator(_is_of_agencies)] = Field(description="Any but `operator`.")
    label: Annotated[Text, AfterValidator(is_label)] = Field(
        min_length=1, max_length=200, description="Who holds it; histories call the holder by it."
    )
    expires_at: Time | None = Field(None, description="When it ends; null: it does not.")


class RotationIn(StrictModel):
    """How a key is replaced."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"overlap_s": 3600}]})

    overlap_s: Whole = Field(
        _DAY_S, ge=0, le=int(MAX_OVERLAP.total_seconds()), description="How long the old key stays valid. [s]"
    )
    expires_at: Time | None = Field(
        None, description="When the new key ends; null: after as long as the old one was made for."
    )


Service = Annotated[Keys, use_cases("keys")]


@router.post("", status_code=201, responses=document_response(NewKeyDocument, status=201))
def post_key(key: KeyIn, caller: Caller, keys: Service) -> Response:
    """Make a key. Its text is in this answer only; an Idempotency-Key is not heeded, because no answer is kept."""
    return _shown_once(keys.create(caller, NewKey(key.scope, key.label, key.expires_at)))


@router.get("", responses=document_response(KeyPage))
def list_keys(request: Request, caller: Caller, keys: Service, limit: PageSize = 100, after: LastId = None) -> Response:
    """The agency's keys, oldest first, also those that have ended."""
    page, last = keys.page(caller, after=after, limit=limit)
    return page_response(request, page, after=last)


@router.get("/{key_id}", responses=document_response(KeyDocument, 404))
def get_key(key_id: KeyId, caller: Caller, keys: Service) -> Response:
    """One key."""
    return json_response(keys.get(caller, key_id))


@router.post("/{key_id}/rotate", status_code=201, responses=document_response(NewKeyDocument, 404, 409, status=201))
def rotate_key(key_id: KeyId, rotation: RotationIn, caller: Caller, keys: Service) -> Response:
    """Make a key that takes over from this one, for the same holder; this one stays valid for the overlap."""
    overlap = timedelta(seconds=rotation.overlap_s)
    return _shown_once(keys.rotate(caller, key_id, overlap=overlap, expires_at=rotation.expires_at))


@router.delete("/{key_id}", status_code=204, responses=problem_responses(404, 409))
def revoke_key(key_id: KeyId, caller: Caller, keys: Service) -> Response:
    """End a key now. It stays in the list; the agency's last valid admin key cannot be ended."""
    keys.revoke(caller, key_id)
    return Response(status_code=204)


def _shown_once(document: NewKeyDocument) -> Response:
    return json_response(document, 201, {"Location": f"/v1/keys/{document['id']}", **NO_STORE})
