"""/v1/exports: markers as files."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import StreamingResponse

from app.api.dependencies import Caller, Text
from app.api.problems import problem_responses
from app.api.schemas_markers import Status
from app.api.searches import parse_box
from app.errors import InvalidParameter
from app.registry.markers import MarkerFilter
from app.services.exports import STREAMED, WHOLE
from app.services.exports import Exports as ExportsService
from app.services.search_areas import area_of_text

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
    bbox: Annotated[Text | None, Query(max_length=200, examples=["8.3,48.9,8.6,49.1"])] = None,
    polygon: Annotated[Text | None, Query(max_length=8_000, description="WKT of a POLYGON or MULTIPOLYGON.")] = None,
    road: Annotated[Text | None, Query(min_length=1, max_length=200)] = None,
    from_m: Annotated[float | None, Query(ge=-1e8, le=1e8, allow_inf_nan=False)] = None,
    to_m: Annotated[float | None, Query(ge=-1e8, le=1e8, allow_inf_nan=False)] = None,
    code: Annotated[Text | None, Query(min_length=1, max_length=64)] = None,
    status: Status | None = None,
    family: Literal["plate", "magnet", "cerpm"] | None = None,
) -> Response:
    """The markers of a filter, or all: CSV and GeoJSON as a stream, the others as one file.

    The filters are those of GET /v1/markers.

    Positions are longitude and latitude in WGS 84 / ITRF; LandXML and DXF are in the UTM zone they lie in.
    """
    if road is None and (from_m is not None or to_m is not None):
        raise InvalidParameter(
            "measures belong to a road", field="road", limit="a road with from_m, to_m", cure="name the road"
        )
    narrowed = MarkerFilter(
        box=parse_box(bbox) if bbox is not None else None,
        area=area_of_text(polygon) if polygon is not None else None,
        road=road,
        from_m=from_m,
        to_m=to_m,
        digits=code,
        status=status,
        family=family,
    )
    headers = {"Content-Disposition": f'attachment; filename="markers.{_SUFFIXES.get(kind, kind)}"'}
    if kind in STREAMED:
        return StreamingResponse(exports.stream(caller, kind, narrowed), headers=headers, media_type=STREAMED[kind])
    return StreamingResponse(exports.whole(caller, kind, narrowed), headers=headers, media_type=WHOLE[kind])
