"""/v1/roads: axes with measures; positions to measures and offsets, and back."""

from __future__ import annotations

import math
import re
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response

from app.api.dependencies import Caller, Idempotency, Identifier, Text, Version, json_response, next_link
from app.api.problems import problem_responses
from app.api.schemas_roads import (
    MAX_OFFSET_M,
    MAX_REACH_M,
    PositionsIn,
    ReferencesIn,
    RoadId,
    RoadIn,
    RoadLocated,
    RoadLocatedMany,
    RoadOut,
    RoadPage,
    RoadPatch,
    RoadPlaced,
    RoadPlacedMany,
    RoadVersionPage,
)
from app.api.schemas_searches import MarkerPage
from app.api.strict_json import StrictRoute
from app.errors import InvalidParameter
from app.services.roads import NewRoad, RoadChange
from app.services.roads import Roads as RoadsService

router = APIRouter(prefix="/v1/roads", tags=["roads"], route_class=StrictRoute)

MAX_PAGE = 1000
_CURSOR = re.compile(r"(-?[0-9]{1,9}(?:\.[0-9]{1,20})?(?:e-[0-9]{1,3})?),([0-9a-f-]{36})")
_MetresQuery = Annotated[float | None, Query(ge=-1e8, le=1e8, allow_inf_nan=False)]
_OfVersion = Annotated[
    int | None, Query(alias="version", ge=1, lt=2**31, description="On an earlier version of the road.")
]


async def get_roads(request: Request) -> RoadsService:
    """Use cases on roads."""
    service: RoadsService = request.app.state.roads
    return service


Roads = Annotated[RoadsService, Depends(get_roads)]


@router.post(
    "",
    status_code=201,
    response_class=Response,
    responses={
        200: {"model": RoadOut, "description": "Checked; nothing was stored"},
        201: {"model": RoadOut, "description": "Registered"},
        **problem_responses(409),
    },
)
def post_road(road: RoadIn, caller: Caller, roads: Roads, idempotency: Idempotency) -> Response:
    """Register a road. The markers that name it get the measure and offset of their position."""
    new = NewRoad(
        road.name,
        road.lines(road.geometry),
        tuple(point.given() for point in road.calibration),
        road.measure_markers,
        road.dry_run,
        road.reason,
    )
    document, replayed = roads.register(caller, new, idempotency)
    if road.dry_run:
        return json_response(document)
    headers = {"Location": f"/v1/roads/{document['id']}", "ETag": _etag(document)}
    if replayed:
        headers["Idempotency-Replayed"] = "true"
    return json_response(document, 201, headers)


@router.get("", response_class=Response, responses={200: {"model": RoadPage}, **problem_responses()})
def list_roads(
    request: Request,
    caller: Caller,
    roads: Roads,
    name: Annotated[Text | None, Query(min_length=1, max_length=200)] = None,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = 100,
    after: Annotated[Identifier | None, Query(description="Last id of the page before.")] = None,
) -> Response:
    """Roads in the order they were registered, without their geometry."""
    page, last = roads.page(caller, name=name, after=after, limit=limit)
    return json_response({"items": page}, headers=next_link(request, after=last) if last else None)


@router.get("/{road_id}", response_class=Response, responses={200: {"model": RoadOut}, **problem_responses(404)})
def get_road(road_id: RoadId, request: Request, caller: Caller, roads: Roads) -> Response:
    """One road, with its version as ETag."""
    document = roads.get(caller, road_id)
    etag = {"ETag": _etag(document)}
    if request.headers.get("if-none-match") == etag["ETag"]:
        return Response(status_code=304, headers=etag)
    return json_response(document, headers=etag)


@router.patch(
    "/{road_id}", response_class=Response, responses={200: {"model": RoadOut}, **problem_responses(404, 412, 428)}
)
def patch_road(road_id: RoadId, patch: RoadPatch, caller: Caller, roads: Roads, version: Version) -> Response:
    """Change a road's axis or calibration. Its markers stay where they are; their measures follow."""
    if patch.geometry is None and patch.calibration is None:
        raise InvalidParameter(
            "the patch changes nothing",
            field="body",
            limit="geometry or calibration",
            cure="name what to change",
        )
    change = RoadChange(
        patch.lines(patch.geometry) if patch.geometry is not None else None,
        tuple(point.given() for point in patch.calibration) if patch.calibration is not None else None,
        patch.measure_markers,
        patch.dry_run,
        patch.reason,
    )
    document = roads.change(caller, road_id, change, version)
    return json_response(document, headers=None if patch.dry_run else {"ETag": _etag(document)})


@router.get(
    "/{road_id}/versions",
    response_class=Response,
    responses={200: {"model": RoadVersionPage}, **problem_responses(404)},
)
def list_road_versions(
    road_id: RoadId,
    request: Request,
    caller: Caller,
    roads: Roads,
    limit: Annotated[int, Query(ge=1, le=100)] = 10,
    after: Annotated[int, Query(ge=0, lt=2**31, description="Last version of the page before.")] = 0,
) -> Response:
    """The road's history, oldest first."""
    page, last = roads.history(caller, road_id, after=after, limit=limit)
    return json_response({"items": page}, headers=next_link(request, after=last) if last else None)


@router.get(
    "/{road_id}/locate", response_class=Response, responses={200: {"model": RoadLocated}, **problem_responses(404)}
)
def locate_on_road(
    road_id: RoadId,
    caller: Caller,
    roads: Roads,
    lon: Annotated[float, Query(allow_inf_nan=False, description="Longitude. [deg]")],
    lat: Annotated[float, Query(allow_inf_nan=False, description="Latitude. [deg]")],
    max_offset_m: Annotated[float, Query(gt=0, le=MAX_REACH_M, allow_inf_nan=False)] = 100.0,
    version: _OfVersion = None,
) -> Response:
    """Measure and offset of a position, left positive; several feet where the road passes more than once."""
    return json_response(_only(roads.locate(caller, road_id, [(lon, lat)], max_offset_m, version)))


@router.post(
    "/{road_id}/locate",
    response_class=Response,
    responses={200: {"model": RoadLocatedMany}, **problem_responses(404)},
)
def locate_many_on_road(
    road_id: RoadId, body: PositionsIn, caller: Caller, roads: Roads, version: _OfVersion = None
) -> Response:
    """Measures and offsets of up to 1000 positions."""
    positions = [(position[0], position[1]) for position in body.positions]
    return json_response(roads.locate(caller, road_id, positions, body.max_offset_m, version))


@router.get(
    "/{road_id}/position", response_class=Response, responses={200: {"model": RoadPlaced}, **problem_responses(404)}
)
def get_position_on_road(
    road_id: RoadId,
    caller: Caller,
    roads: Roads,
    measure_m: Annotated[float, Query(ge=-1e8, le=1e8, allow_inf_nan=False)],
    offset_m: Annotated[float, Query(ge=-MAX_OFFSET_M, le=MAX_OFFSET_M, allow_inf_nan=False)] = 0.0,
    version: _OfVersion = None,
) -> Response:
    """Position of a measure and an offset; refused where the measure is on no road, several where it repeats."""
    document = _only(roads.place(caller, road_id, [(measure_m, offset_m)], version))
    if not document["places"]:
        ranges = ", ".join(f"{s['from_m']:.3f} to {s['to_m']:.3f} m" for s in document["sections"][:20])
        raise InvalidParameter(
            f"the measure {measure_m:.3f} m is on no part of road {document['road']}",
            field="measure_m",
            limit=ranges,
            cure="choose a measure of the road; equations of stationing leave gaps",
        )
    return json_response(document)


@router.post(
    "/{road_id}/position",
    response_class=Response,
    responses={200: {"model": RoadPlacedMany}, **problem_responses(404)},
)
def get_positions_on_road(
    road_id: RoadId, body: ReferencesIn, caller: Caller, roads: Roads, version: _OfVersion = None
) -> Response:
    """Positions of up to 1000 measures and offsets; no place where a measure is on no road."""
    references = [(reference.measure_m, reference.offset_m) for reference in body.references]
    return json_response(roads.place(caller, road_id, references, version))


@router.get(
    "/{road_id}/markers", response_class=Response, responses={200: {"model": MarkerPage}, **problem_responses(404)}
)
def list_markers_on_road(
    road_id: RoadId,
    request: Request,
    caller: Caller,
    roads: Roads,
    from_m: _MetresQuery = None,
    to_m: _MetresQuery = None,
    min_offset_m: _MetresQuery = None,
    max_offset_m: _MetresQuery = None,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = 100,
    after: Annotated[Text | None, Query(max_length=100, description="As the link to the next page has it.")] = None,
) -> Response:
    """Markers on the road in the order of their measures."""
    page, last = roads.markers(
        caller,
        road_id,
        measures_m=(from_m, to_m),
        offsets_m=(min_offset_m, max_offset_m),
        after=_cursor(after),
        limit=limit,
    )
    return json_response({"items": page}, headers=next_link(request, after=last) if last else None)


def _only(document: dict[str, Any]) -> dict[str, Any]:
    (item,) = document.pop("items")
    return {**document, **item}


def _etag(document: dict[str, Any]) -> str:
    return f'"{document["version"]}"'


def _cursor(after: str | None) -> tuple[float, str] | None:
    if after is None:
        return None
    found = _CURSOR.fullmatch(after)
    if found is None or not math.isfinite(float(found[1])):
        raise InvalidParameter(
            "this is not where a page of this road's markers ended",
            field="after",
            limit="as the link to the next page has it",
            cure="start without after, and follow the links",
        )
    return float(found[1]), found[2]
