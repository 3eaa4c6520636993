"""/v1/imports: surveys come in."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request, Response

from app.api.http.bodies import SpooledPart
from app.api.http.dependencies import Caller, Identifier, LastId, PageSize, use_cases
from app.api.http.forms import DeclaredForm, form_body, idempotency_of, read_declaration
from app.api.http.problems import FieldError, Problem, problem_responses, report_problem
from app.api.http.responses import (
    BINARY,
    IdempotencyKeyHeader,
    Prefer,
    created_response,
    document_response,
    json_response,
    page_response,
    wants_job,
)
from app.api.http.strict_json import StrictRoute
from app.api.surveys.schemas import DECLARATION_EXAMPLE, DeclarationIn
from app.errors import InvalidParameter, UnreadableUpload
from app.registry.jobs import JobState
from app.services.idempotency import IdempotencyKey
from app.services.surveys.declarations import import_input
from app.services.surveys.documents import ImportJobDocument, ImportJobPage, ImportReport
from app.services.surveys.import_jobs import ImportJobs, takes_long
from app.services.surveys.import_report import ImportInput
from app.services.surveys.imports import Imports as ImportsService

router = APIRouter(prefix="/v1/imports", tags=["imports"], route_class=StrictRoute)

MAX_DECLARATION_BYTES = 64 * 1024
_CURE = "send multipart/form-data with the parts file and declaration"
_FORM = DeclaredForm("an import", "file", MAX_DECLARATION_BYTES, _CURE)
_BODY = form_body(
    {"file": {**BINARY, "description": "The survey."}},
    "declaration",
    DeclarationIn,
    {"file": "survey.csv", "declaration": DECLARATION_EXAMPLE},
)


@dataclass(frozen=True, slots=True)
class _Asked:
    given: ImportInput
    declared: dict[str, Any]
    idempotency: IdempotencyKey | None
    as_job: bool


class RefusedImport(Problem):
    """The problem document of an import that was refused, with the report."""

    report: ImportReport


async def get_asked(
    request: Request, idempotency_key: IdempotencyKeyHeader = None, prefer: Prefer = None
) -> AsyncIterator[_Asked]:
    """Read the file and its declaration from the form; the file is deleted when the request ends.

    Raises
    ------
    UnsupportedUpload
        The request is no form.
    UnreadableUpload
        There is no file in it, or an empty one.
    MalformedRequest
        The form or the declaration's JSON cannot be read.
    """
    async with _FORM.received(request) as (form, text):
        part = form.get("file")
        if not isinstance(part, SpooledPart):
            raise UnreadableUpload("there is no file in the form", field="file", limit="a part file", cure=_CURE)
        file = part.spooled
        if not file.size:
            raise UnreadableUpload("the file is empty", field="file", limit="one row at least", cure="send the survey")
        declared = (await read_declaration(DeclarationIn, text, "body", "declaration")).declared()
        as_job = wants_job(prefer) or takes_long(file)
        key = idempotency_of(request, idempotency_key, text, file)
        yield _Asked(import_input(declared, file), declared, key, as_job)


Asked = Annotated[_Asked, Depends(get_asked)]
Imports = Annotated[ImportsService, use_cases("imports")]
Jobs = Annotated[ImportJobs, use_cases("import_jobs")]


@router.post(
    "",
    status_code=201,
    openapi_extra=_BODY,
    responses={
        200: {"model": ImportReport, "description": "Checked; nothing was stored"},
        201: {"model": ImportReport, "description": "Stored"},
        202: {"model": ImportJobDocument, "description": "Queued; Location leads to its progress and its report"},
        **problem_responses(409, 415, refused=RefusedImport),
    },
)
def post_import(request: Request, asked: Asked, caller: Caller, imports: Imports, jobs: Jobs) -> Response:
    """Import a survey: CSV, GeoJSON, GeoPackage, zipped Shapefile, KML, KMZ, GPX, LandXML, JobXML, GSI or DXF.

    With `dry_run` the report says what would be stored. A refused import answers 422 with the report in the problem;
    nothing of it is stored. A file of more than 4 MiB or 20,000 lines becomes a job, and so does one that is
    sent with `Prefer: respond-async`: 202, the report comes at Location.
    """
    if asked.as_job:
        document, replayed = jobs.submit(caller, asked.declared, asked.given.file, asked.idempotency)
        response = created_response(document, replayed, path="/v1/imports", status=202)
        response.headers["Retry-After"] = "1"
        return response
    try:
        report, replayed = imports.run(caller, asked.given, asked.idempotency)
    except InvalidParameter as error:
        if error.field is not None and not error.field.startswith(("declaration", "file")):
            error.field = f"declaration.{error.field.removeprefix('position.')}"
        raise
    if report["outcome"] == "refused":
        return _refused(request, report)
    return created_response(report, replayed, status=200 if report["dry_run"] else 201)


@router.get("", responses=document_response(ImportJobPage))
def list_imports(
    request: Request,
    caller: Caller,
    jobs: Jobs,
    state: JobState | None = None,
    limit: PageSize = 100,
    before: LastId = None,
) -> Response:
    """Imports that are or were jobs, without their reports, newest first. Those that were answered at once are none."""
    page, last = jobs.page(caller, state=state, before=before, limit=limit)
    return page_response(request, page, before=last)


@router.get("/{import_id}", responses=document_response(ImportJobDocument, 404))
def get_import(import_id: Identifier, caller: Caller, jobs: Jobs) -> Response:
    """An import that was queued: its state, and its report once it is done. A refused one is done too."""
    return json_response(jobs.get(caller, import_id))


@router.post("/{import_id}/cancel", responses=document_response(ImportJobDocument, 404, 409))
def cancel_import(import_id: Identifier, caller: Caller, jobs: Jobs) -> Response:
    """Call an import off: a queued one never starts, a running one stops before it stores anything.

    409 where it is too late: it is storing already, or finished.
    """
    return json_response(jobs.cancel(caller, import_id))


def _refused(request: Request, report: ImportReport) -> Response:
    first = report["faults"][0]
    place = f"row {first['row']}: " if first["row"] is not None else ""
    fault = FieldError(
        f"file.{first['field']}",
        f"{place}{first['message']}; {report['refused_rows']} of {report['rows']} rows are refused",
        "all rows good" if report["mode"] == "all" else "one good row at least",
        first["proposal"] or 'correct the rows, or declare mode "good" to store the others',
    )
    return report_problem("import-refused", "The import was refused", fault, request.scope, report)
