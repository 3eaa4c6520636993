"""/v1/imports and /v1/exports: surveys come in, markers go out as files."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Annotated, Literal

from fastapi import Depends, Query, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import ConfigDict, Field

from app.api.http.bodies import DeclaredForm, SpooledPart, form_body, idempotency_of, read_declaration
from app.api.http.dependencies import Caller, Idempotency, use_case
from app.api.http.permissions import READERS, SURVEYORS
from app.api.http.problems import FieldError, Problem, problem_responses, report_problem
from app.api.http.responses import (
    BINARY,
    IdempotencyKeyHeader,
    Prefer,
    created_response,
    document_response,
    file_response,
    wants_job,
)
from app.api.http.routes import Router
from app.api.jobs import queued_job
from app.api.markers.searches import Filtered, check_measures
from app.errors import InvalidParameter, UnreadableUpload
from app.families import FamilyName
from app.inputs import Number, StrictModel, Text
from app.markers.reading import Status
from app.services.idempotency import IdempotencyKey
from app.services.markers.searches import checked_box
from app.services.progress import ImportJob, OtherJob
from app.services.request_work import counted_steps
from app.services.surveys.exports import MAX_LEFT_OUT_IDS, STREAMED, SUFFIXES, WHOLE, ExportJobs, filter_of, frame_of
from app.services.surveys.exports import Exports as ExportsService
from app.services.surveys.import_jobs import ImportJobs, takes_long
from app.services.surveys.import_report import (
    DECLARATION_EXAMPLE,
    DeclarationIn,
    ImportInput,
    ImportReport,
    import_input,
)
from app.services.surveys.imports import Imports as ImportsService
from app.values import JsonObject

# === /v1/imports: surveys come in.


import_router = Router("/v1/imports", "imports")

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
        declared = await read_declaration(DeclarationIn, text, "body", "declaration")
        as_job = wants_job(prefer) or takes_long(file)
        key = idempotency_of(request, idempotency_key, text, file)
        yield _Asked(import_input(declared, file), key, as_job)


Asked = Annotated[_Asked, Depends(get_asked)]
Imports = Annotated[ImportsService, use_case(lambda cases: cases.imports)]
Jobs = Annotated[ImportJobs, use_case(lambda cases: cases.import_jobs)]


@import_router.post(
    "",
    SURVEYORS,
    expensive=True,
    status_code=201,
    openapi_extra=_BODY,
    responses={
        200: {"model": ImportReport, "description": "Checked; nothing was stored"},
        201: {"model": ImportReport, "description": "Stored"},
        202: {"model": ImportJob, "description": "Queued; Location leads to its progress and its report"},
        **problem_responses(409, 415, refused=RefusedImport),
    },
)
def post_import(request: Request, asked: Asked, caller: Caller, imports: Imports, jobs: Jobs) -> Response:
    """Import a survey.

    CSV, GeoJSON, GeoPackage, zipped Shapefile, KML, KMZ, GPX, LandXML, JobXML, GSI or DXF.

    With `dry_run` nothing is stored, and the report lists what would be. A refused import answers 422 with the report
    in the problem, and nothing of it is stored. A file of more than 4 MiB or 20,000 lines becomes a job, and so does
    one that is sent with `Prefer: respond-async`: 202, and the job at Location has the report as its result.
    """
    if asked.as_job:
        return queued_job(*jobs.submit(caller, asked.given, asked.idempotency))
    try:
        report, replayed = imports.run(caller, asked.given, asked.idempotency)
    except InvalidParameter as error:
        if error.field is not None and not error.field.startswith(("declaration", "file")):
            error.field = f"declaration.{error.field.removeprefix('position.')}"
        raise
    if report["outcome"] == "refused":
        return _refused(request, report)
    return created_response(report, replayed, status=200 if report["dry_run"] else 201)


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


# === /v1/exports: markers as files.


export_router = Router("/v1/exports", "exports")

ExportFormat = Literal["csv", "geojson", "gpkg", "geoparquet", "flatgeobuf", "shapefile", "kml", "landxml", "dxf"]
_Measure = Annotated[float, Field(strict=True, ge=-1e8, le=1e8, allow_inf_nan=False)]
Exports = Annotated[ExportsService, use_case(lambda cases: cases.exports)]


_Crs = Annotated[Text, Field(min_length=1, max_length=64)]
_Epoch = Annotated[float, Field(ge=1950, le=2200, allow_inf_nan=False)]
_CRS_HELP = "Of the coordinates, such as EPSG:25832."
_REALIZATION_HELP = "Of the crs, such as ETRF2000; without, that in which each marker came."
_EPOCH_HELP = "Of the coordinates; without, that of each marker. [decimal year]"
_DATUM_HELP = "Of the heights: ellipsoid, or such as EPSG:7837; without, each is above its own."


class ExportIn(StrictModel):
    """Markers to write into a file; without a filter, all of them."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"format": "gpkg", "bbox": [114.1, 22.2, 114.3, 22.4]}]})

    format: ExportFormat
    bbox: Annotated[list[Number], Field(min_length=4, max_length=4)] | None = Field(
        None, description="west, south, east, north. [deg]"
    )
    polygon: Text | None = Field(None, max_length=8_000, description="WKT of a POLYGON or MULTIPOLYGON.")
    road: Text | None = Field(None, min_length=1, max_length=200)
    from_m: _Measure | None = Field(None, description="Least measure on the road. [m]")
    to_m: _Measure | None = Field(None, description="Greatest measure on the road. [m]")
    status: Status | None = None
    family: FamilyName | None = None
    crs: _Crs | None = Field(None, description=_CRS_HELP)
    realization: _Crs | None = Field(None, description=_REALIZATION_HELP)
    epoch: _Epoch | None = Field(None, description=_EPOCH_HELP)
    vertical_datum: _Crs | None = Field(None, description=_DATUM_HELP)

    def wanted(self) -> JsonObject:
        """What is wanted, checked, as it is stored in a job."""
        if self.bbox is not None:
            checked_box(*self.bbox)
        wanted = self.model_dump(mode="json", exclude_none=True)
        check_measures(filter_of(wanted))
        frame_of(wanted)
        return wanted


@export_router.post(
    "",
    READERS,
    status_code=202,
    responses=document_response(OtherJob, status=202, description="Queued; Location leads to its progress"),
)
def post_export(
    wanted: ExportIn,
    caller: Caller,
    jobs: Annotated[ExportJobs, use_case(lambda cases: cases.export_jobs)],
    idempotency: Idempotency,
) -> Response:
    """Write markers into a file as a job.

    The file is at its `links.result` for seven days.
    """
    return queued_job(*jobs.submit(caller, wanted.wanted(), idempotency))


@export_router.get(
    "/{kind}",
    READERS,
    expensive=True,
    responses={
        **file_response(media.partition(";")[0] for media in (STREAMED | WHOLE).values()),
        **problem_responses(),
    },
)
def get_export(
    kind: ExportFormat,
    caller: Caller,
    exports: Exports,
    filtered: Filtered,
    crs: Annotated[_Crs | None, Query(description=_CRS_HELP)] = None,
    realization: Annotated[_Crs | None, Query(description=_REALIZATION_HELP)] = None,
    epoch: Annotated[_Epoch | None, Query(description=_EPOCH_HELP)] = None,
    vertical_datum: Annotated[_Crs | None, Query(description=_DATUM_HELP)] = None,
) -> Response:
    """Download markers as a file.

    The markers of a filter, or all: CSV and GeoJSON as a stream, the others as one file.

    The filters are those of GET /v1/markers.

    Without crs, positions are longitude and latitude in WGS 84 / ITRF; LandXML and DXF are in the projected system in
    which most of the markers came, or else in the UTM zone that most of them lie in. Markers outside its area are left
    out: the file lists them, and the header Waymark-Left-Out has their number and the first ids. Retired markers are in
    LandXML and DXF only with status=retired.
    """
    wanted = {"crs": crs, "realization": realization, "epoch": epoch, "vertical_datum": vertical_datum}
    frame = frame_of(wanted)
    headers = {"Content-Disposition": f'attachment; filename="markers.{SUFFIXES.get(kind, kind)}"'}
    if kind in STREAMED:
        chunks, media_type = exports.stream(caller, kind, filtered, frame), STREAMED[kind]
    else:
        (chunks, left_out), media_type = exports.whole(caller, kind, filtered, frame), WHOLE[kind]
        if left_out:
            headers["Waymark-Left-Out"] = f"{len(left_out)}; {' '.join(left_out[:MAX_LEFT_OUT_IDS])}"
    return StreamingResponse(counted_steps(chunks), headers=headers, media_type=media_type)
