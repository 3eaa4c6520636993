"""Every error that a client can cause, as an RFC 9457 problem document from one table, with its OpenAPI schema."""

from __future__ import annotations

from collections.abc import Iterable
from http import HTTPStatus
from typing import Any, Literal, NamedTuple, NotRequired

import orjson
import structlog
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import ConfigDict, TypeAdapter, with_config
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core.core_schema import DataclassField, ModelField, TypedDictField, WithDefaultSchema
from starlette.exceptions import HTTPException
from starlette.types import Scope

from app import errors
from app.api.http.permissions import CHALLENGES
from app.api.public_pages.html import as_page
from app.encoders.magnet import CodebookFull
from app.inputs import input_error
from app.services.documents import ErrorCause, cut_text, error_cause
from app.values import JsonObject

# === Schemas of the OpenAPI document that FastAPI does not find by itself: parts of forms, and problem documents.


Mode = Literal["validation", "serialization"]
_TEMPLATE = "#/components/schemas/{model}"
_MODELS: dict[str, tuple[type, Mode]] = {}


def reference(model: type, mode: Mode = "validation") -> dict[str, str]:
    """A reference to the schema of a model, which becomes part of the document."""
    _MODELS[model.__name__] = model, mode
    return {"$ref": _TEMPLATE.format(model=model.__name__)}


def with_reference(response: JsonObject) -> JsonObject:
    """A response of a route whose `model`, if it is a class, is a reference: FastAPI would make its schema at once."""
    if not isinstance(response.get("model"), type):
        return response
    described = {name: value for name, value in response.items() if name != "model"}
    schema = reference(response["model"], "serialization")
    return {**described, "content": {**described.get("content", {}), "application/json": {"schema": schema}}}


class _Schemas(GenerateJsonSchema):
    """Schemas in which a response has all members: those with a default may be left out of requests only."""

    def field_is_required(self, field: ModelField | DataclassField | TypedDictField, total: bool) -> bool:
        if self.mode == "serialization" and field["type"] != "typed-dict-field":
            return True
        return super().field_is_required(field, total)

    def default_schema(self, schema: WithDefaultSchema) -> JsonSchemaValue:
        return self.generate_inner(schema["schema"]) if self.mode == "serialization" else super().default_schema(schema)


def component_schemas(others: Iterable[tuple[Any, Mode]] = ()) -> JsonObject:
    """The schemas of all models that are referred to, of others, and of the models within them, by name."""
    models = (*_MODELS.values(), *others)
    adapters = [(number, mode, TypeAdapter(model)) for number, (model, mode) in enumerate(models)]
    _, schemas = TypeAdapter.json_schemas(adapters, ref_template=_TEMPLATE, schema_generator=_Schemas)
    found: JsonObject = schemas["$defs"]
    return found


# === Every error that a client can cause, as an RFC 9457 problem document from one table.


Described = dict[int | str, JsonObject]
"""What FastAPI's argument `responses` takes: status to description."""
MEDIA_TYPE = "application/problem+json"
MAX_ERRORS = 20
"""Errors that a problem document lists."""
MAX_TEXT_BYTES = 500
"""Of a text in a problem document: with `MAX_ERRORS`, a document is smaller than 64 kB."""
_LOG = structlog.get_logger(__name__)


class ProblemKind(NamedTuple):
    """Status, identifier and title of one class of errors."""

    status: int
    slug: str
    title: str

    @property
    def type(self) -> str:
        """Identifier of the kind."""
        return f"urn:waymark:problem:{self.slug}"


PROBLEMS: dict[type[errors.WaymarkError], ProblemKind] = {
    errors.MalformedRequest: ProblemKind(400, "malformed-request", "The request cannot be read"),
    errors.NotAuthenticated: ProblemKind(401, "not-authenticated", "A valid key is required"),
    errors.NotAllowed: ProblemKind(403, "not-allowed", "The key's scope does not allow this request"),
    errors.NotFound: ProblemKind(404, "not-found", "The resource does not exist"),
    errors.Conflict: ProblemKind(409, "conflict", "The request conflicts with stored data"),
    CodebookFull: ProblemKind(409, "codebook-full", "The codebook has no further code with the required separation"),
    errors.CodeTaken: ProblemKind(409, "code-taken", "The code is already in use"),
    errors.IdempotencyConflict: ProblemKind(
        409, "idempotency-conflict", "The Idempotency-Key was used for another request"
    ),
    errors.StaleVersion: ProblemKind(412, "stale-version", "The resource was changed in the meantime"),
    errors.UploadTooLarge: ProblemKind(413, "too-large", "The request is too large"),
    errors.UnsupportedUpload: ProblemKind(
        415, "unsupported-upload", "The media type or the kind of file is not supported"
    ),
    errors.InvalidParameter: ProblemKind(422, "invalid-parameter", "A value is not allowed"),
    errors.CodeMismatch: ProblemKind(422, "code-mismatch", "The digits do not match the position or scheme"),
    errors.ReferenceSystemError: ProblemKind(422, "reference-system", "The reference system cannot be used"),
    errors.CalibrationRefused: ProblemKind(
        422, "calibration-refused", "The camera cannot be calibrated from these photos"
    ),
    errors.PrintNotGraded: ProblemKind(422, "print-not-graded", "The print cannot be graded from this photo"),
    errors.ProcessStopped: ProblemKind(422, "process-stopped", "The work on the upload was stopped before its end"),
    errors.UnreadableUpload: ProblemKind(422, "unreadable-upload", "The upload cannot be read"),
    errors.VersionRequired: ProblemKind(428, "version-required", "The change must state the version it is based on"),
    errors.TooManyRequests: ProblemKind(429, "too-many-requests", "Too many requests in a short time"),
    errors.QuotaExceeded: ProblemKind(429, "quota-exceeded", "The quota is used up"),
    errors.UploadLocked: ProblemKind(423, "upload-locked", "Another request writes this upload"),
    errors.UploadExpired: ProblemKind(410, "upload-expired", "The upload was not completed in time"),
    errors.WrongOffset: ProblemKind(409, "wrong-offset", "The part does not begin where the upload ends"),
    errors.WrongChecksum: ProblemKind(460, "wrong-checksum", "The bytes do not have the stated checksum"),
    errors.UnsupportedVersion: ProblemKind(412, "unsupported-version", "The version of the protocol is not supported"),
    errors.ProofFailed: ProblemKind(500, "proof-failed", "The artwork could not be read back"),
    errors.StorageFull: ProblemKind(507, "storage-full", "There is no room to store this"),
    errors.Unavailable: ProblemKind(503, "unavailable", "The service is temporarily unavailable"),
}
UNION_TAG = "one-of:"
"""Prefix of the path elements that pydantic adds for the members of a union; they are not part of the body."""
VALIDATION = ProblemKind(422, "invalid-parameter", "A value is not allowed")


class BodyRefused(HTTPException):
    """A domain error found while the body is read; FastAPI would turn any other exception there into a bare 400."""

    def __init__(self, error: errors.WaymarkError) -> None:
        super().__init__(400, error.message)
        self.error = error


class FieldError(NamedTuple):
    """One invalid input."""

    field: str | None
    detail: str
    limit: str | None = None
    cure: str | None = None


class FieldErrorDocument(ErrorCause):
    """One input at fault."""

    detail: str


@with_config(
    ConfigDict(
        json_schema_extra={
            "example": {
                "type": "urn:waymark:problem:invalid-parameter",
                "title": "A value is not allowed",
                "status": 422,
                "detail": "lat_deg is 91.0, outside -90 to 90 degrees",
                "instance": "/v1/markers",
                "field": "position.lat_deg",
                "limit": "-90 to 90 deg",
                "cure": "positions are longitude, latitude in degrees; check for swapped axes or another CRS",
            }
        }
    )
)
class Problem(ErrorCause):
    """RFC 9457 problem document; `field`, `limit` and `cure` are those of the first error.

    At most 20 errors are listed; `errors_left_out` is the number of the others.
    """

    type: str
    title: str
    status: int
    detail: str
    instance: str
    request_id: NotRequired[str]
    errors: NotRequired[list[FieldErrorDocument]]
    errors_left_out: NotRequired[int]


def problem_responses(*statuses: int, refused: type[Problem] | None = None) -> Described:
    """OpenAPI description of the problems that a route can return, besides those of every /v1 route.

    Parameters
    ----------
    refused : type, optional
        The problem document with a report that the route may return with status 422.
    """
    documented: Described = {}
    for status in sorted({400, 401, 403, 408, 413, 415, 422, 429, 500, 503, 507, *statuses}):
        kinds = [kind for kind in PROBLEMS.values() if kind.status == status]
        titles = "; ".join(f"`{kind.slug}`: {kind.title}" for kind in kinds) or HTTPStatus(status).phrase
        documented[status] = {
            "description": titles,
            "content": {MEDIA_TYPE: {"schema": reference(Problem, "serialization")}},
        }
    if refused is not None:
        either = {"anyOf": [reference(document, "serialization") for document in (Problem, refused)]}
        documented[422]["content"] = {MEDIA_TYPE: {"schema": either}}
    return documented


def kind_of(error: errors.WaymarkError) -> ProblemKind | None:
    """The table's entry for an error: that of its class, else of the nearest base class."""
    return next((PROBLEMS[base] for base in type(error).__mro__ if base in PROBLEMS), None)


def problem(
    kind: ProblemKind,
    detail: str,
    scope: Scope,
    faults: list[FieldError] | None = None,
    headers: dict[str, str] | None = None,
    left_out: int = 0,
) -> Response:
    """A problem document as a response: at most `MAX_ERRORS` faults, and texts that are cut to `MAX_TEXT_BYTES`."""
    body = _document(kind, detail, scope)
    if faults:
        errors: list[FieldErrorDocument] = [
            {"detail": _cut(fault.detail), **_cause(fault)} for fault in faults[:MAX_ERRORS]
        ]
        body = {**body, **_cause(faults[0]), "errors": errors}
        if (left_out := left_out + len(faults[MAX_ERRORS:])) > 0:
            body["errors_left_out"] = left_out
    content = orjson.dumps(body, default=str)
    response = Response(content, kind.status, _wait(kind.status, headers) | _protocol(scope), media_type=MEDIA_TYPE)
    for challenge in CHALLENGES if kind.status == 401 else ():
        response.headers.append("WWW-Authenticate", challenge)
    return as_page(response, scope)


def report_problem(slug: str, title: str, fault: FieldError, scope: Scope, report: object) -> Response:
    """The response to a request that was refused with a report of everything that is wrong with it."""
    body = _document(ProblemKind(422, slug, title), fault.detail, scope)
    return Response(orjson.dumps({**body, **_cause(fault), "report": report}), 422, media_type=MEDIA_TYPE)


def _document(kind: ProblemKind, detail: str, scope: Scope) -> Problem:
    document: Problem = {
        "type": kind.type,
        "title": kind.title,
        "status": kind.status,
        "detail": _cut(detail),
        "instance": _cut(scope.get("path", "")),
    }
    if (request_id := scope.get("state", {}).get("request_id")) is not None:
        document["request_id"] = request_id
    return document


def _cause(fault: FieldError) -> ErrorCause:
    return error_cause(*(None if text is None else _cut(text) for text in (fault.field, fault.limit, fault.cure)))


def _cut(text: str) -> str:
    return cut_text(text, MAX_TEXT_BYTES)


def problem_from(error: errors.WaymarkError, scope: Scope) -> Response:
    """The response to a domain error; an error that is in no table is a bug of Waymark."""
    kind = kind_of(error)
    if kind is None:
        return unexpected(error, scope)
    if kind.status >= 500 and not isinstance(error, errors.ClientLeft):
        _LOG.error("request failed", error=type(error).__name__, detail=error.message)
    faults = [FieldError(field=e.field, detail=e.message, limit=e.limit, cure=e.cure) for e in (error, *error.parts)]
    wait = {"Retry-After": str(error.retry_after_s)} if isinstance(error, errors.TooManyRequests) else None
    return problem(kind, error.message, scope, faults, wait)


def unexpected(error: Exception, scope: Scope) -> Response:
    """The response to a bug: the details are in the log, the client gets only the request's id.

    A full disk is no bug: requests and responses pass through temporary files at many places.
    """
    if errors.is_disk_full(error):
        return problem_from(errors.StorageFull("the folder for temporary files"), scope)
    _LOG.error("unexpected error", exc_info=error, path=scope.get("path"))
    kind = ProblemKind(500, "internal-error", "The server failed")
    return problem(kind, "an unexpected error; its details are in the server's log under this request_id", scope)


def install_problem_handlers(app: FastAPI) -> None:
    """Turn every error of an app into a problem document."""

    async def on_domain_error(request: Request, error: Exception) -> Response:
        assert isinstance(error, errors.WaymarkError)
        return problem_from(error, request.scope)

    async def on_validation_error(request: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        found = error.errors()
        faults = [validation_fault(item) for item in found[:MAX_ERRORS]]
        cause = (found[0].get("ctx") or {}).get("error")
        kind = kind_of(cause) if isinstance(cause, errors.WaymarkError) else None
        return problem(kind or VALIDATION, faults[0].detail, request.scope, faults, left_out=len(found) - len(faults))

    async def on_http_error(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        if isinstance(error, BodyRefused):
            response = problem_from(error.error, request.scope)
            response.headers["Connection"] = "close"  # what is left of the body is not worth reading
            return response
        phrase = HTTPStatus(error.status_code).phrase
        kind = ProblemKind(error.status_code, phrase.lower().replace(" ", "-"), phrase)
        return problem(kind, _http_detail(request, error), request.scope, headers=dict(error.headers or {}))

    app.add_exception_handler(errors.WaymarkError, on_domain_error)
    app.add_exception_handler(RequestValidationError, on_validation_error)
    app.add_exception_handler(HTTPException, on_http_error)


def _http_detail(request: Request, error: HTTPException) -> str:
    if error.status_code == 404:
        return f"there is no resource at {request.url.path}"
    if error.status_code == 405:
        return f"{request.method} is not allowed at {request.url.path}"
    return str(error.detail)


def validation_fault(item: JsonObject) -> FieldError:
    """The invalid input that an error of pydantic names."""
    location = [str(part) for part in item["loc"] if not str(part).startswith(UNION_TAG)]
    error = input_error(item, location[1:], location[0])
    return FieldError(error.field, error.message, error.limit, error.cure)


def _protocol(scope: Scope) -> dict[str, str]:
    """Every response to a client of tus names the version of the protocol (tus 1.0, "Tus-Resumable")."""
    is_tus = any(name == b"tus-resumable" for name, _value in scope.get("headers", ()))
    return {"Tus-Resumable": "1.0.0", "Tus-Version": "1.0.0"} if is_tus else {}


def _wait(status: int, headers: dict[str, str] | None) -> dict[str, str]:
    extra = dict(headers or {})
    if status in (503, 507):
        extra["Retry-After"] = "5"
    return extra
