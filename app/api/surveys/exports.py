"""/v1/exports: markers as files."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Response
from fastapi.responses import StreamingResponse

from app.api.http.dependencies import Caller, use_cases
from app.api.http.problems import problem_responses
from app.api.http.responses import file_response
from app.api.http.strict_json import StrictRoute
from app.api.markers.filters import Filtered
from app.services.request_work import counted_steps
from app.services.surveys.exports import STREAMED, WHOLE
from app.services.surveys.exports import Exports as ExportsService

router = APIRouter(prefix="/v1/exports", tags=["exports"], route_class=StrictRoute)

MAX_LEFT_OUT_IDS = 20
"""Ids in the header Waymark-Left-Out. Source: chosen by hand, 1 kB."""
_SUFFIXES = {"shapefile": "shp.zip", "landxml": "xml"}
Exports = Annotated[ExportsService, use_cases("exports")]


@router.get(
    "/{kind}",
    responses={
        **file_response(media.partition(";")[0] for media in (STREAMED | WHOLE).values()),
        **problem_responses(),
    },
)
def get_export(
    kind: Literal["csv", "geojson", "gpkg", "shapefile", "kml", "landxml", "dxf"],
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
    headers = {"Content-Disposition": f'attachment; filename="markers.{_SUFFIXES.get(kind, kind)}"'}
    if kind in STREAMED:
        chunks, media_type = exports.stream(caller, kind, filtered), STREAMED[kind]
    else:
        (chunks, left_out), media_type = exports.whole(caller, kind, filtered), WHOLE[kind]
        if left_out:
            headers["Waymark-Left-Out"] = f"{len(left_out)}; {' '.join(left_out[:MAX_LEFT_OUT_IDS])}"
    return StreamingResponse(counted_steps(chunks), headers=headers, media_type=media_type)
