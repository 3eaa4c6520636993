"""Routes on keys, agencies, the caller's own key, and the audit log."""

from __future__ import annotations

from datetime import timedelta
from typing import Annotated, Literal

from fastapi import Body, Depends, Path, Query, Request, Response
from pydantic import AfterValidator, ConfigDict, Field
from typing_extensions import TypedDict

from app.api.http.dependencies import Caller, Idempotency, LastId, PageSize, use_case
from app.api.http.permissions import ADMINS, EVERYBODY, OPERATORS, PUBLIC, Allowed
from app.api.http.problems import problem_responses
from app.api.http.responses import document_response, json_response, page_response
from app.api.http.routes import Router
from app.api.jobs import queued_job
from app.inputs import Identifier, StrictModel, Text, Time, Whole
from app.registry.audit import EntryFilter
from app.services.access.access import AGENCY_SCOPES, MAX_AGENCY_NAME, Access, Scope
from app.services.access.audit import (
    AgencyPage,
    AuditLog,
    AuditPage,
    KeyDocument,
    KeyPage,
    NewAgencyDocument,
    NewKeyDocument,
)
from app.services.access.audit_jobs import AuditVerifications, VerificationInput
from app.services.access.keys import MAX_OVERLAP, Agencies, Keys, NewKey
from app.services.progress import VerificationJob

# === /v1/audit: the log of what changed an agency's part of the registry.


audit_router = Router("/v1/audit", "audit")


_NEWEST = 2**53 - 1


async def get_entry_filter(
    who: Annotated[Text | None, Query(max_length=200, description="Label of the key or name of the person.")] = None,
    action: Annotated[
        Text | None,
        Query(max_length=80, description="What was done; with `*` at the end all that begin so.", examples=["key.*"]),
    ] = None,
    subject: Annotated[Text | None, Query(max_length=200, description="Id or name of what it was done to.")] = None,
    since: Annotated[Time | None, Query(description="At this time or later.")] = None,
    until: Annotated[Time | None, Query(description="Before this time.")] = None,
) -> EntryFilter:
    """The filter in a query."""
    return EntryFilter(who, action, subject, since, until)


@audit_router.get("", ADMINS | OPERATORS, responses=document_response(AuditPage))
def list_audit_entries(
    request: Request,
    caller: Caller,
    log: Annotated[AuditLog, use_case(lambda cases: cases.audit)],
    wanted: Annotated[EntryFilter, Depends(get_entry_filter)],
    limit: PageSize = 100,
    after: Annotated[int | None, Query(ge=0, lt=2**53, description="Last number of the page before.")] = None,
    order: Annotated[Literal["oldest", "newest"], Query(description="Which entries come first.")] = "oldest",
) -> Response:
    """List the entries of the audit log.

    Oldest first or newest first. `waymark audit verify` computes its hashes again.
    """
    if order == "oldest":
        page, last = log.page(caller, after=after or 0, limit=limit, wanted=wanted)
    else:
        page, last = log.page(caller, before=_NEWEST if after is None else after, limit=limit, wanted=wanted)
    return page_response(request, page, after=last)


@audit_router.post(
    "/verifications",
    ADMINS,
    status_code=202,
    responses=document_response(
        VerificationJob, 409, status=202, description="Queued; Location leads to its progress and result"
    ),
)
def post_verification(
    wanted: Annotated[VerificationInput, Body(examples=[{}])],
    caller: Caller,
    verifications: Annotated[AuditVerifications, use_case(lambda cases: cases.audit_verifications)],
    idempotency: Idempotency,
) -> Response:
    """Verify the audit log.

    Computes every hash of the agency's log and of its markers' versions again, as a job.
    """
    return queued_job(*verifications.request(caller, wanted, idempotency))


# === /v1/keys: the keys of the agency, for its admins; those of operators, for operators.


key_router = Router("/v1/keys", "access")

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


Service = Annotated[Keys, use_case(lambda cases: cases.keys)]


# an operator's key is created on the server's machine only
@key_router.post("", ADMINS, status_code=201, responses=document_response(NewKeyDocument, status=201))
def post_key(key: KeyIn, caller: Caller, keys: Service) -> Response:
    """Create a key.

    Its text is in this answer only; an Idempotency-Key is not heeded, because no answer is kept.
    """
    return _shown_once(keys.create(caller, NewKey(key.scope, key.label, key.expires_at)))


@key_router.get("", ADMINS | OPERATORS, responses=document_response(KeyPage))
def list_keys(request: Request, caller: Caller, keys: Service, limit: PageSize = 100, after: LastId = None) -> Response:
    """List the keys of an agency.

    Oldest first, also those that have ended.
    """
    page, last = keys.page(caller, after=after, limit=limit)
    return page_response(request, page, after=last)


@key_router.get("/{key_id}", ADMINS | OPERATORS, responses=document_response(KeyDocument, 404))
def get_key(key_id: KeyId, caller: Caller, keys: Service) -> Response:
    """Get a key."""
    return json_response(keys.get(caller, key_id))


@key_router.post(
    "/{key_id}/rotate",
    ADMINS | OPERATORS,
    status_code=201,
    responses=document_response(NewKeyDocument, 404, 409, status=201),
)
def rotate_key(key_id: KeyId, rotation: RotationIn, caller: Caller, keys: Service) -> Response:
    """Replace a key by a new one.

    For the same holder; the old one stays valid for the overlap.
    """
    overlap = timedelta(seconds=rotation.overlap_s)
    return _shown_once(keys.rotate(caller, key_id, overlap=overlap, expires_at=rotation.expires_at))


@key_router.delete("/{key_id}", ADMINS | OPERATORS, status_code=204, responses=problem_responses(404, 409))
def revoke_key(key_id: KeyId, caller: Caller, keys: Service) -> Response:
    """End a key now.

    It stays in the list; the agency's last valid admin key cannot be ended.
    """
    keys.revoke(caller, key_id)
    return Response(status_code=204)


def _shown_once(document: NewKeyDocument) -> Response:
    return json_response(document, 201, {"Location": f"/v1/keys/{document['id']}", **NO_STORE})


# === GET /v1/me: who is calling, and what that caller may do.


me_router = Router("/v1/me", "access")


class MeDocument(TypedDict):
    """The caller: its agency, its name in histories, its scope and the routes that the scope may use."""

    agency: Annotated[str, Field(description="Name of the agency.")]
    holder_id: Annotated[str, Field(description="The same for keys that replace one another.")]
    label: Annotated[str, Field(description="What histories call the caller.")]
    scope: Scope
    permissions: Annotated[list[str], Field(description="Methods and path templates, e.g. `PATCH /v1/markers/{id}`.")]


async def get_permissions(request: Request) -> dict[str, Allowed]:
    """Who may use each route."""
    permissions: dict[str, Allowed] = request.app.state.permissions
    return permissions


@me_router.get("", EVERYBODY | OPERATORS, responses=document_response(MeDocument))
def get_me(
    caller: Caller,
    access: Annotated[Access, use_case(lambda cases: cases.access)],
    permissions: Annotated[dict[str, Allowed], Depends(get_permissions)],
) -> Response:
    """Get the holder of the key or token of this request."""
    allowed = [route for route, scopes in permissions.items() if scopes != PUBLIC and caller.scope in scopes]
    document = MeDocument(
        agency=access.agency_name(caller),
        holder_id=caller.key_id,
        label=caller.label,
        scope=caller.scope,
        permissions=sorted(allowed),
    )
    return json_response(document)


# === /v1/agencies: agencies with their first keys, created by the server's operator.


agency_router = Router("/v1/agencies", "access")

AgenciesService = Annotated[Agencies, use_case(lambda cases: cases.agencies)]


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


@agency_router.post("", OPERATORS, status_code=201, responses=document_response(NewAgencyDocument, 409, status=201))
def post_agency(agency: AgencyIn, caller: Caller, agencies: AgenciesService, idempotency: Idempotency) -> Response:
    """Create an agency with an admin key.

    As the server's operator.

    The key's text is in this response, and in those to repetitions under the same Idempotency-Key. The agency's admin
    creates all further keys with it: `POST /v1/keys`.
    """
    document, replayed = agencies.create(caller, agency.name, agency.key_label, idempotency)
    return json_response(document, 201, NO_STORE | ({"Idempotency-Replayed": "true"} if replayed else {}))


@agency_router.get("", OPERATORS, responses=document_response(AgencyPage))
def list_agencies(request: Request, agencies: AgenciesService, limit: PageSize = 100, after: LastId = None) -> Response:
    """List the agencies of this server.

    Oldest first, for its operator.
    """
    page, last = agencies.page(after=after, limit=limit)
    return page_response(request, page, after=last)
