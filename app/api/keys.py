"""/v1/keys: the keys of the agency, for its admins."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, Field

from app.api.dependencies import Caller, Identifier, Text, Whole, json_response, next_link
from app.api.problems import problem_responses
from app.api.strict_json import StrictRoute
from app.services.access import Scope
from app.services.keys import MAX_OVERLAP, Keys, NewKey

router = APIRouter(prefix="/v1/keys", tags=["access"], route_class=StrictRoute)

MAX_PAGE = 1000
_DAY_S = 86_400
_NO_STORE = {"Cache-Control": "no-store"}
KeyId = Annotated[Identifier, Path(description="Id of the key.")]


def _is_label(label: str) -> str:
    if not label.strip() or not label.isprintable():
        raise ValueError("a label is printable and not blank")
    return label


class KeyIn(BaseModel):
    """A key to make."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"scope": "vehicle", "label": "BUS-7", "expires_at": "2027-06-30T00:00:00Z"}]},
    )

    scope: Scope
    label: Annotated[Text, AfterValidator(_is_label)] = Field(
        min_length=1, max_length=200, description="Who holds it; histories call the holder by it."
    )
    expires_at: AwareDatetime | None = Field(None, description="When it ends; null: it does not.")


class RotationIn(BaseModel):
    """How a key is replaced."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"overlap_s": 3600}]})

    overlap_s: Whole = Field(
        _DAY_S, ge=0, le=int(MAX_OVERLAP.total_seconds()), description="How long the old key stays valid. [s]"
    )
    expires_at: AwareDatetime | None = Field(
        None, description="When the new key ends; null: after as long as the old one was made for."
    )


class KeyOut(BaseModel):
    """A key, without its text. Keys that took over from one another have one `holder_id`."""

    id: str
    holder_id: str
    label: str
    scope: Scope
    prefix: str = Field(description="Its first characters.")
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None
    last_used_at: datetime | None = Field(description="To the minute.")
    valid: bool


class NewKeyOut(KeyOut):
    """A key with its text, which is shown this once."""

    key: str


class KeyPage(BaseModel):
    """A page of keys; the Link header leads to the next one."""

    items: list[KeyOut]


async def get_keys(request: Request) -> Keys:
    """Use cases on keys."""
    service: Keys = request.app.state.keys
    return service


Service = Annotated[Keys, Depends(get_keys)]


@router.post("", status_code=201, response_class=Response, responses={201: {"model": NewKeyOut}, **problem_responses()})
def post_key(key: KeyIn, caller: Caller, keys: Service) -> Response:
    """Make a key. Its text is in this answer only; an Idempotency-Key is not heeded, because no answer is kept."""
    return _shown_once(keys.create(caller, NewKey(key.scope, key.label, key.expires_at)))


@router.get("", response_class=Response, responses={200: {"model": KeyPage}, **problem_responses()})
def list_keys(
    request: Request,
    caller: Caller,
    keys: Service,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = 100,
    after: Annotated[Identifier | None, Query(description="Last id of the page before.")] = None,
) -> Response:
    """The agency's keys, oldest first, also those that have ended."""
    page, last = keys.page(caller, after=after, limit=limit)
    return json_response({"items": page}, headers=next_link(request, after=last) if last else None)


@router.get("/{key_id}", response_class=Response, responses={200: {"model": KeyOut}, **problem_responses(404)})
def get_key(key_id: KeyId, caller: Caller, keys: Service) -> Response:
    """One key."""
    return json_response(keys.get(caller, key_id))


@router.post(
    "/{key_id}/rotate",
    status_code=201,
    response_class=Response,
    responses={201: {"model": NewKeyOut}, **problem_responses(404, 409)},
)
def rotate_key(key_id: KeyId, rotation: RotationIn, caller: Caller, keys: Service) -> Response:
    """Make a key that takes over from this one, for the same holder; this one stays valid for the overlap."""
    overlap = timedelta(seconds=rotation.overlap_s)
    return _shown_once(keys.rotate(caller, key_id, overlap=overlap, expires_at=rotation.expires_at))


@router.delete("/{key_id}", status_code=204, response_class=Response, responses=problem_responses(404, 409))
def revoke_key(key_id: KeyId, caller: Caller, keys: Service) -> Response:
    """End a key now. It stays in the list; the agency's last valid admin key cannot be ended."""
    keys.revoke(caller, key_id)
    return Response(status_code=204)


def _shown_once(document: dict[str, Any]) -> Response:
    return json_response(document, 201, {"Location": f"/v1/keys/{document['id']}", **_NO_STORE})
