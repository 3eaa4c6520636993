"""/v1/exports: markers as files."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Request, Response
from fastapi.responses import StreamingResponse

from app.api.dependencies import Caller
from app.api.marker_filter import Narrowed
from app.api.problems import problem_responses
from app.services.exports import STREAMED, WHOLE
from app.services.exports import Exports as ExportsService

router = APIRouter(prefix="/v1/exports", tags=["exports"])

_SUFFIXES = {"shapefile": "shp.zip", "landxml": "xml"}


async def get_exports(request: Request) -> ExportsService:
    """Use cases on exports."""
    service: ExportsService = request.app.state.exports
    return service


Exports = Annotated[ExportsService, Depends(get_exports)]


@router.get(
    "/{kind}",
    response_class=Response,
    responses={
        200: {"content": {media.partition(";")[0]: {} for media in (STREAMED | WHOLE).values()}},
        **problem_responses(),
    },
)
def get_export(
    kind: Literal["csv", "geojson", "gpkg", "shapefile", "kml", "landxml", "dxf"],
    caller: Caller,
    exports: Exports,
    narrowed: Narrowed,
) -> Response:
    """The markers of a filter, or all: CSV and GeoJSON as a stream, the others as one file.

    The filters are those of GET /v1/markers.

    Positions are longitude and latitude in WGS 84 / ITRF; LandXML and DXF are in the UTM zone they lie in.
    """
    headers = {"Content-Disposition": f'attachment; filename="markers.{_SUFFIXES.get(kind, kind)}"'}
    if kind in STREAMED:
        return StreamingResponse(exports.stream(caller, kind, narrowed), headers=headers, media_type=STREAMED[kind])
    return StreamingResponse(exports.whole(caller, kind, narrowed), headers=headers, media_type=WHOLE[kind])
