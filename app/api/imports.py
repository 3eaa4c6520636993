"""/v1/imports: surveys come in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import orjson
from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from starlette.datastructures import UploadFile

from app.api.dependencies import Caller, Identifier, json_response, next_link
from app.api.problems import MEDIA_TYPE, problem_responses
from app.api.schemas_decodes import State
from app.api.schemas_imports import DECLARATION_EXAMPLE, DeclarationIn, ImportJobOut, ImportJobPage, ImportReportOut
from app.api.strict_json import parse_json
from app.api.uploads import idempotency_of
from app.errors import InvalidParameter, MalformedRequest, UnreadableUpload, UnsupportedUpload
from app.services.idempotency import IdempotencyKey
from app.services.import_jobs import AT_ONCE_BYTES, ImportJobs
from app.services.imports import GivenImport
from app.services.imports import Imports as ImportsService

router = APIRouter(prefix="/v1/imports", tags=["imports"])

MAX_PAGE = 1000
MAX_DECLARATION_BYTES = 64 * 1024
_FORM = "multipart/form-data"
_CURE = "send multipart/form-data with the parts file and declaration"
_REFUSED = {"type": "urn:waymark:problem:import-refused", "title": "The import was refused", "status": 422}
_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            _FORM: {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {
                        "file": {"type": "string", "format": "binary", "description": "The survey."},
                        "declaration": {"type": "object", "description": "DeclarationIn; see docs/imports.md."},
                    },
                },
                "encoding": {"declaration": {"contentType": "application/json"}},
                "example": {"file": "survey.csv", "declaration": DECLARATION_EXAMPLE},
            }
        },
    }
}


@dataclass(frozen=True, slots=True)
class _Asked:
    given: GivenImport
    declaration: DeclarationIn
    idempotency: IdempotencyKey | None
    as_job: bool


async def get_imports(request: Request) -> ImportsService:
    """Use cases on imports."""
    service: ImportsService = request.app.state.imports
    return service


async def get_asked(request: Request) -> _Asked:
    """Read the file and its declaration from the form.

    Raises
    ------
    UnsupportedUpload
        The request is no form.
    UnreadableUpload
        There is no file in it, or an empty one.
    MalformedRequest
        The form or the declaration's JSON cannot be read.
    """
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != _FORM:
        raise UnsupportedUpload("an import is a form", field="Content-Type", limit=_FORM, cure=_CURE)
    async with request.form(max_files=2, max_fields=2, max_part_size=MAX_DECLARATION_BYTES) as form:
        names = [name for name, _value in form.multi_items()]
        if set(names) - {"file", "declaration"} or len(set(names)) != len(names):
            raise MalformedRequest(
                "the form has an unexpected part, or has one twice",
                field="body",
                limit="one file, one declaration",
                cure=_CURE,
            )
        file, declared = form.get("file"), form.get("declaration", "")
        if not isinstance(file, UploadFile):
            raise UnreadableUpload("there is no file in the form", field="file", limit="a part file", cure=_CURE)
        data = await file.read()
        text = await declared.read() if isinstance(declared, UploadFile) else declared.encode()
    if not data:
        raise UnreadableUpload("the file is empty", field="file", limit="one row at least", cure="send the survey")
    if len(text) > MAX_DECLARATION_BYTES:
        raise MalformedRequest("the declaration is too long", field="declaration", limit="64 KiB", cure=_CURE)
    declaration = _declared(text)
    as_job = len(data) > AT_ONCE_BYTES or "respond-async" in request.headers.get("prefer", "").lower()
    return _Asked(declaration.given(data), declaration, idempotency_of(request, data, text), as_job)


def _declared(text: bytes) -> DeclarationIn:
    try:
        return DeclarationIn.model_validate(parse_json(text, "declaration") if text.strip() else {})
    except ValidationError as error:
        faults = [{**fault, "loc": ("body", "declaration", *fault["loc"])} for fault in error.errors()]
        raise RequestValidationError(faults) from error


Asked = Annotated[_Asked, Depends(get_asked)]
Imports = Annotated[ImportsService, Depends(get_imports)]


@router.post(
    "",
    status_code=201,
    response_class=Response,
    openapi_extra=_BODY,
    responses={
        200: {"model": ImportReportOut, "description": "Checked; nothing was stored"},
        201: {"model": ImportReportOut, "description": "Stored"},
        202: {"model": ImportJobOut, "description": "Queued; Location leads to its progress and its report"},
        **problem_responses(409, 415),
    },
)
def post_import(request: Request, asked: Asked, caller: Caller, imports: Imports) -> Response:
    """Import a survey: CSV, GeoJSON, GeoPackage, zipped Shapefile, KML, LandXML or DXF.

    With `dry_run` the report says what would be stored. A refused import answers 422 with the report in the problem;
    nothing of it is stored. A file of more than 8 MiB becomes a job, and so does one that is sent with
    `Prefer: respond-async`: 202, the report comes at Location.
    """
    if asked.as_job:
        jobs: ImportJobs = request.app.state.import_jobs
        document, replayed = jobs.submit(
            caller, asked.declaration.model_dump(mode="json"), asked.given.data, asked.idempotency
        )
        where = {"Location": document["links"]["self"], "Retry-After": "1"}
        return json_response(document, 202, where | ({"Idempotency-Replayed": "true"} if replayed else {}))
    try:
        report, replayed = imports.run(caller, asked.given, asked.idempotency)
    except InvalidParameter as error:
        if error.field is not None and not error.field.startswith(("declaration", "file")):
            error.field = f"declaration.{error.field.removeprefix('position.')}"
        raise
    if report["outcome"] == "refused":
        return _refused(request, report)
    headers = {"Idempotency-Replayed": "true"} if replayed else None
    return json_response(report, 200 if report["dry_run"] else 201, headers)


@router.get("", response_class=Response, responses={200: {"model": ImportJobPage}, **problem_responses()})
def list_imports(
    request: Request,
    caller: Caller,
    state: State | None = None,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = 100,
    before: Annotated[Identifier | None, Query(description="Last id of the page before.")] = None,
) -> Response:
    """Imports that are or were jobs, without their reports, newest first. Those that were answered at once are none."""
    jobs: ImportJobs = request.app.state.import_jobs
    page, last = jobs.page(caller, state=state, before=before, limit=limit)
    return json_response({"items": page}, headers=next_link(request, before=last) if last else None)


@router.get("/{import_id}", response_class=Response, responses={200: {"model": ImportJobOut}, **problem_responses(404)})
def get_import(request: Request, import_id: Identifier, caller: Caller) -> Response:
    """An import that was queued: its state, and its report once it is done. A refused one is done too."""
    jobs: ImportJobs = request.app.state.import_jobs
    return json_response(jobs.get(caller, import_id))


@router.post(
    "/{import_id}/cancel",
    response_class=Response,
    responses={200: {"model": ImportJobOut}, **problem_responses(404, 409)},
)
def cancel_import(request: Request, import_id: Identifier, caller: Caller) -> Response:
    """Call an import off: a queued one never starts, a running one stops before it stores anything.

    409 where it is too late: it is storing already, or finished.
    """
    jobs: ImportJobs = request.app.state.import_jobs
    return json_response(jobs.cancel(caller, import_id))


def _refused(request: Request, report: dict[str, Any]) -> Response:
    first = report["faults"][0]
    place = f"row {first['row']}: " if first["row"] is not None else ""
    body = {
        **_REFUSED,
        "detail": f"{place}{first['message']}; {report['refused_rows']} of {report['rows']} rows are refused",
        "instance": request.url.path,
        "request_id": request.scope.get("state", {}).get("request_id"),
        "field": f"file.{first['field']}",
        "limit": "all rows good" if report["mode"] == "all" else "one good row at least",
        "cure": first["proposal"] or 'correct the rows, or declare mode "good" to store the others',
        "report": report,
    }
    return Response(orjson.dumps(body), 422, media_type=MEDIA_TYPE)
