"""/v1/exports: markers as files."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Response
from fastapi.responses import StreamingResponse
from pydantic import ConfigDict, Field

from app.api.http.dependencies import Caller, Idempotency, Number, Text, use_cases
from app.api.http.problems import problem_responses
from app.api.http.responses import document_response, file_response
from app.api.http.strict_json import StrictRoute
from app.api.jobs.files import queued_job
from app.api.markers.filters import Filtered, check_measures
from app.families import FamilyName
from app.families.inputs import StrictModel
from app.markers.status import Status
from app.services.markers.search_boxes import checked_box
from app.services.progress.documents import JobDocument
from app.services.request_work import counted_steps
from app.services.surveys.export_jobs import MAX_LEFT_OUT_IDS, SUFFIXES, ExportJobs, filter_of
from app.services.surveys.exports import STREAMED, WHOLE
from app.services.surveys.exports import Exports as ExportsService

router = APIRouter(prefix="/v1/exports", tags=["exports"], route_class=StrictRoute)

ExportFormat = Literal["csv", "geojson", "gpkg", "shapefile", "kml", "landxml", "dxf"]
_Measure = Annotated[float, Field(strict=True, ge=-1e8, le=1e8, allow_inf_nan=False)]
Exports = Annotated[ExportsService, use_cases("exports")]


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

    def wanted(self) -> dict[str, Any]:
        """What is wanted, checked, as it is stored in a job."""
        if self.bbox is not None:
            checked_box(*self.bbox)
        wanted = self.model_dump(mode="json", exclude_none=True)
        check_measures(filter_of(wanted))
        return wanted


@router.post(
    "",
    status_code=202,
    responses=document_response(JobDocument, status=202, description="Queued; Location leads to its progress"),
)
def post_export(
    wanted: ExportIn,
    caller: Caller,
    jobs: Annotated[ExportJobs, use_cases("export_jobs")],
    idempotency: Idempotency,
) -> Response:
    """Write markers into a file as a job; the file is at its `links.result` for seven days."""
    return queued_job(*jobs.submit(caller, wanted.wanted(), idempotency))


@router.get(
    "/{kind}",
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
) -> Response:
    """The markers of a filter, or all: CSV and GeoJSON as a stream, the others as one file.

    The filters are those of GET /v1/markers.

    Positions are longitude and latitude in WGS 84 / ITRF; LandXML and DXF are in the UTM zone that most of them lie in.
    Markers too far from it are left out: the file lists them, and the header Waymark-Left-Out has their number and the
    first ids. Retired markers are in LandXML and DXF only with status=retired.
    """
    headers = {"Content-Disposition": f'attachment; filename="markers.{SUFFIXES.get(kind, kind)}"'}
    if kind in STREAMED:
        chunks, media_type = exports.stream(caller, kind, filtered), STREAMED[kind]
    else:
        (chunks, left_out), media_type = exports.whole(caller, kind, filtered), WHOLE[kind]
        if left_out:
            headers["Waymark-Left-Out"] = f"{len(left_out)}; {' '.join(left_out[:MAX_LEFT_OUT_IDS])}"
    return StreamingResponse(counted_steps(chunks), headers=headers, media_type=media_type)
